"""Run stages as DVC does, but each in a fork of one process that has imported all modules.

`warm_stages` (checkout.py) starts this program in a copy of the checkout. Each line of input names stages (`drift@ci
sleeve@ci`; an empty line means all stages). The program runs these stages in DVC's order, commits them like `dvc
commit`, prints `DONE` or `FAILED`, and reads the next line. This program saves time, because small stages spend most of
their time on imports and on tables of skin deformation. tests/recordings/test_lab_story.py runs DVC itself.
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
from dvc.stage import PipelineStage

from tests.stages.checkout import DONE, FAILED

LIBRARIES = (
    "torch", "pandas", "pyarrow.parquet", "scipy.optimize", "scipy.signal", "scipy.stats", "sklearn.ensemble", "numba",
    "matplotlib.figure", "magpylib", "pydantic", "jinja2",
)  # fmt: skip
DEEP_M = 1.3e-3  # deeper than all pokes in scene ci


def run_stage(name: str, command: str) -> int:
    """Run the command `python -m pipeline STAGE ...` of a stage in a fork; return the exit status."""
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


def commands_of(stage: PipelineStage) -> list[str]:
    """Return the commands of a stage; DVC stores them as a text or as a list of texts."""
    return stage.cmd if isinstance(stage.cmd, list) else [stage.cmd]


def preload(protocols: set[tuple[str, str]]) -> None:
    """Import the modules of all stages; compute the deformation tables for these (scene, protocol) pairs."""
    importlib.import_module("pipeline")  # first, because it sets variables that NumPy reads when imported
    import numpy as np

    from pipeline.catalogue import module_name
    from pipeline.settings import read_settings
    from pipeline.simulation import simulation_settings
    from pipeline.stages.code import all_stages
    from reskin.physics.skin import draw_skin, moved_dipoles

    for name in (*LIBRARIES, *map(module_name, all_stages())):
        importlib.import_module(name)
    for scene, protocol in protocols:
        settings = read_settings(scene)
        simulation = simulation_settings(settings)
        kind = simulation.boards[simulation.protocols[protocol].boards]
        rule, name = kind.quadrature.in_si(), f"{kind.letter}0_s0"
        skin = draw_skin(
            simulation.skin, simulation.spreads, seed=settings.seed, name=name, rule=rule, sides_m=kind.skin_m
        )
        list(moved_dipoles(skin, np.array([[0.0, 0.0, DEEP_M]])))  # caches the deformation tables of the skin
    gc.freeze()  # garbage collection in forks then does not copy memory


def run_stages(names: list[str]) -> str:
    with Repo() as repo:
        planned = plan_repro(get_active_graph(repo.index.graph))
        with_commands = [stage for stage in planned if stage.cmd]  # stages without a command are tracked recordings
        stages = {stage.addressing: stage for stage in with_commands if not names or stage.addressing in names}
        commands = [shlex.split(stage.cmd) for name, stage in stages.items() if name.startswith("simulate@")]
        preload(
            {(command[command.index("--scene") + 1], command[command.index("--protocol") + 1]) for command in commands}
        )
        for name, stage in stages.items():
            print(f"Running stage '{name}':", flush=True)
            for out in stage.outs:  # removes outputs first, as `dvc repro` does
                out.remove()
            if any(run_stage(name, command) for command in commands_of(stage)):
                return FAILED
        with lock_repo(repo):
            for stage in stages.values():
                stage.save(run_cache=False)  # tests do not use DVC's run cache
                stage.commit()
            next(iter(stages.values())).dvcfile.dump_stages([*stages.values()], update_pipeline=False)
    return DONE


if __name__ == "__main__":
    for line in sys.stdin:
        print(run_stages(line.split()), flush=True)
