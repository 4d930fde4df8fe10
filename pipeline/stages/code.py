"""Stage code: write the digests of all modules that each stage imports to data/code/<stage>.

Every other stage depends on its file there, so that an edit runs the stages again that import the edited code.
Comments and docstrings are not part of a digest.
"""

from pathlib import Path

from pipeline.stages import EXPERIMENTS, STAGES, module_name
from reskin import io
from reskin.code import digest, imported

SHOWING = "pipeline.report.parts"  # imports by name what shows each experiment


def entries() -> dict[str, str]:
    """Name the module that each stage runs."""
    experiments = sorted(file.parent.name for file in EXPERIMENTS.glob("*/run.py"))
    return {stage: module_name(stage) for stage in (*STAGES, *experiments)}


def modules_of(entry: str) -> list[str]:
    """Name the modules that decide what a stage writes."""
    found = imported(entry)
    if SHOWING not in found:
        return found
    return imported(entry, *(f"pipeline.experiments.{file.parent.name}.show" for file in EXPERIMENTS.glob("*/show.py")))


def write_digests(digests: Path) -> None:
    """Write for each stage one line for each module: its digest and its name."""
    for stage, entry in entries().items():
        lines = [f"{digest(name)}  {name}\n" for name in modules_of(entry)]
        io.write_text(digests / stage, "".join(lines))
