"""Stage code: write the digests of all modules that each stage imports to data/code/<stage>.

Every other stage depends on its file there, so that an edit runs the stages again that import the edited code.
Comments and docstrings are not part of a digest. Modules that only show results (`pipeline.report`) and the YAML files
of experiments count for the stages that show results, not for those that compute them.
"""

from pathlib import Path

from pipeline.catalogue import experiment_files
from pipeline.stages import EXPERIMENTS, STAGES, module_name
from reskin import io
from reskin.code import digest, imported

REPORT = "pipeline.report"
SHOWING = f"{REPORT}.experiments"  # imports the modules of experiments by name


def entries() -> dict[str, str]:
    """Name the module that each stage runs."""
    return {stage: module_name(stage) for stage in dict.fromkeys((*STAGES, *experiments()))}


def experiments() -> list[str]:
    """Name the stages that run a module of `pipeline.experiments`."""
    return [*experiment_files(), "audit"]


def shows(stage: str) -> bool:
    """Tell whether a stage shows results."""
    return SHOWING in imported(module_name(stage))


def digests_of(stage: str) -> dict[str, str]:
    """Give the digest of each module that decides what a stage writes, by its name."""
    if shows(stage):
        names = imported(module_name(stage), *map(module_name, experiments()))
        return {name: digest(name) for name in names}
    names = [name for name in imported(module_name(stage)) if not name.startswith(REPORT)]
    return {name: digest(name, data=not name.startswith(EXPERIMENTS)) for name in names}


def write_digests(digests: Path) -> None:
    """Write for each stage one line for each module: its digest and its name."""
    for stage in entries():
        lines = [f"{found}  {name}\n" for name, found in digests_of(stage).items()]
        io.write_text(digests / stage, "".join(lines))
