"""Stage code: write the digests of all modules that each stage imports to data/code/<stage>.

Every other stage depends on its own file in that folder, so that DVC reruns the stages that import an edited module.
Comments and docstrings are not part of a digest. `pipeline.report` and the YAML files of experiments contain captions;
they are included only in the files of stages that show results.
"""

import gc
from pathlib import Path

from pipeline.catalogue import experiment_files
from pipeline.stages import EXPERIMENTS, MODULES, module_name
from reskin import io
from reskin.code import digest, imported

REPORT = "pipeline.report"
PRESENTATION = f"{REPORT}.experiments"  # imports the modules of experiments by name


def all_stages() -> list[str]:
    """List all stages except this one."""
    return list(dict.fromkeys([*MODULES, *experiment_files()]))


def digests_of(stage: str) -> dict[str, str]:
    """Return the digests of all modules that affect a stage's outputs, by module name."""
    names = imported(module_name(stage))
    if PRESENTATION in names:
        return {name: digest(name) for name in imported(module_name(stage), *map(module_name, experiment_files()))}
    computing = [name for name in names if not name.startswith(REPORT)]
    return {name: digest(name, data=not name.startswith(EXPERIMENTS)) for name in computing}


def write_digests(digests: Path) -> None:
    """Write a file for each stage, with one line per module: its digest and its name."""
    gc.disable()  # garbage collection would take a third of the time
    try:
        by_stage = {stage: digests_of(stage) for stage in all_stages()}
    finally:
        gc.enable()
    for stage, by_module in by_stage.items():
        lines = [f"{module_digest}  {name}\n" for name, module_digest in by_module.items()]
        io.write_text(digests / stage, "".join(lines))
