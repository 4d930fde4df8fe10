"""Runs stages as DVC would, each in a process of its own, forked from one that has imported the libraries already.

python tests/stages/warm.py [STAGE ...]: in a checkout, all stages or these (`drift@ci`), in DVC's order; then commits
as `dvc commit` does. Most of a tiny stage's time is imports; tests/recordings/test_lab_story.py runs DVC itself.
"""

import importlib
import os
import runpy
import shlex
import sys
import traceback

from dvc.repo import Repo
from dvc.repo.reproduce import get_active_graph, plan_repro

LIBRARIES = (
    "torch", "pandas", "pyarrow.parquet", "scipy.optimize", "scipy.signal", "scipy.stats", "sklearn.ensemble", "numba",
    "matplotlib.figure", "magpylib", "pydantic", "jinja2",
)  # fmt: skip


def run_stage(name: str, command: str) -> int:
    """Do what pipeline/run.sh does with a stage's words, in a fork; give its exit status."""
    sys.stdout.flush()
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        os.environ["DVC_STAGE"] = name
        stage, *words = shlex.split(command)[2:]
        experiment = os.path.isdir(f"pipeline/experiments/{stage}")
        module = f"pipeline.experiments.{stage}.run" if experiment else f"pipeline.stages.{stage}"
        sys.argv = [module, *words]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as exit:
        status = exit.code if isinstance(exit.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def main(asked: list[str]) -> None:
    for name in LIBRARIES:
        importlib.import_module(name)
    with Repo() as repo:
        for stage in plan_repro(get_active_graph(repo.index.graph)):
            name = stage.addressing
            if asked and name not in asked:
                continue
            print(f"Running stage '{name}':", flush=True)
            for out in stage.outs:  # as `dvc repro` does: a stage that writes nothing has nothing
                out.remove()
            if status := run_stage(name, stage.cmd):
                sys.exit(f"stage {name} ended with {status}")
        repo.commit(force=True)


if __name__ == "__main__":
    sys.path.insert(0, os.getcwd())  # the copy's code, where this file was started from another folder
    main(sys.argv[1:])
