"""Runs stages as DVC would, each in a process of its own, forked from one that holds what they would all begin with.

`warm_stages` starts it in a checkout. Each line of its input names stages (`drift@ci sleeve@ci`; none: all), which run
in DVC's order and are committed as `dvc commit` does; then it says `DONE`, or `FAILED`, and reads on. Most of a tiny
stage's time is imports, and following the material under a tip for its tables; tests/recordings/test_lab_story.py runs
DVC itself.
"""

import gc
import importlib
import os
import runpy
import shlex
import sys
import traceback

from dvc.repo import Repo, lock_repo
from dvc.repo.reproduce import get_active_graph, plan_repro

from tests.stages.checkout import DONE, FAILED

LIBRARIES = (
    "torch", "pandas", "pyarrow.parquet", "scipy.optimize", "scipy.signal", "scipy.stats", "sklearn.ensemble", "numba",
    "matplotlib.figure", "magpylib", "pydantic", "jinja2",
)  # fmt: skip
DEEP_M = 1.3e-3  # past the deepest poke of scene ci


def run_stage(name: str, command: str) -> int:
    """Run `python -m pipeline STAGE ...` in a fork; give its exit status."""
    sys.stdout.flush()
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    status = 1
    try:
        os.environ["DVC_STAGE"] = name
        sys.argv = shlex.split(command)[2:]
        runpy.run_module("pipeline", run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as exit:
        status = exit.code if isinstance(exit.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def begin(simulated: set[tuple[str, str]]) -> None:
    """Import what stages import, and follow the material under a tip for the skins of these scenes' protocols."""
    importlib.import_module("pipeline")  # first, as it tells NumPy which instructions to use
    import numpy as np

    from pipeline.settings import read_settings
    from pipeline.simulation import simulation_settings
    from pipeline.stages.code import entries
    from reskin.physics.skin import draw_skin, moved_dipoles

    for name in (*LIBRARIES, *entries().values()):
        importlib.import_module(name)
    for scene, protocol in simulated:
        settings = read_settings(scene)
        of = simulation_settings(settings)
        kind = of.boards[of.protocols[protocol].boards]
        rule, name = kind.quadrature.in_si(), f"{kind.letter}0_s0"
        skin = draw_skin(of.skin, of.spreads, seed=settings.seed, name=name, rule=rule, sides_m=kind.skin_m)
        list(moved_dipoles(skin, np.array([[0.0, 0.0, DEEP_M]])))  # its tables are kept
    gc.freeze()  # else each stage would look through all this, and copy it, at each search for what nobody holds


def run_stages(asked: list[str]) -> str:
    with Repo() as repo:
        planned = plan_repro(get_active_graph(repo.index.graph))
        with_words = [stage for stage in planned if stage.cmd]  # the others are recordings that were added
        stages = {stage.addressing: stage for stage in with_words if not asked or stage.addressing in asked}
        simulating = [shlex.split(stage.cmd) for name, stage in stages.items() if name.startswith("simulate@")]
        begin({(words[words.index("--scene") + 1], words[words.index("--protocol") + 1]) for words in simulating})
        for name, stage in stages.items():
            print(f"Running stage '{name}':", flush=True)
            for out in stage.outs:  # as `dvc repro` does: a stage that writes nothing has nothing
                out.remove()
            if run_stage(name, stage.cmd):
                return FAILED
        with lock_repo(repo):
            for stage in stages.values():
                stage.save(run_cache=False)  # which holds former runs: no story asks for them
                stage.commit()
            next(iter(stages.values())).dvcfile.dump_stages([*stages.values()], update_pipeline=False)
    return DONE


if __name__ == "__main__":
    for line in sys.stdin:
        print(run_stages(line.split()), flush=True)
