"""Stage code: for each other stage, write the digests of all modules that this stage imports.

The digests of a stage are written to the file data/code/<stage>, on which the stage depends in dvc.yaml. If a module is
edited, the files of the stages that import this module change, and DVC runs these stages again. Comments and docstrings
are not part of a digest, so edits of them cause no runs.

The modules in `SHOWING` affect only how results are shown. Therefore, they are included only in the file of stage
report.
"""

import gc
from pathlib import Path

from pipeline.catalogue import ANALYSES, MODULES, module_name
from reskin import io
from reskin.code import digest, imported

# Packages and modules that only show results, and the catalogue, whose effects on other stages are in the plan.
SHOWING = ("pipeline.catalogue", "pipeline.report", "pipeline.plot", "pipeline.formatting", "pipeline.paper")


def all_stages() -> list[str]:
    """List all stages except this one."""
    return list(dict.fromkeys([*MODULES, *ANALYSES]))


def digests_of(stage: str) -> dict[str, str]:
    """Return the digests of all modules that affect the outputs of a stage, by the name of the module."""
    if stage == "report":  # it shows results, and imports the modules of experiments by their names
        return {name: digest(name) for name in imported(module_name(stage), *map(module_name, ANALYSES))}
    return {name: digest(name) for name in imported(module_name(stage)) if not name.startswith(SHOWING)}


def write_digests(digests: Path) -> None:
    """Write a file for each stage, with one line per module: the digest of the module, and its name."""
    gc.disable()  # otherwise, garbage collection would take a third of the time
    try:
        by_stage = {stage: digests_of(stage) for stage in all_stages()}
    finally:
        gc.enable()
    for stage, by_module in by_stage.items():
        lines = [f"{module_digest}  {name}\n" for name, module_digest in by_module.items()]
        io.write_text(digests / stage, "".join(lines))
