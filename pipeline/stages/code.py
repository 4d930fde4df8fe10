"""Stage code: the project's modules -> data/code/<stage>, the digests of all modules that a stage imports.

Every other stage depends on its file here, so that an edit re-runs the stages that import the edited code, and words in
comments and docstrings re-run none. Refuses to know settings and data.
"""

import argparse
from pathlib import Path

from reskin import io
from reskin.code import ROOT, digest, imported

STAGES, EXPERIMENTS = ROOT / "pipeline/stages", ROOT / "pipeline/experiments"
SHOWING = "pipeline.report.parts"  # imports by name what shows each experiment


def entries() -> dict[str, str]:
    """Name the module that each stage runs."""
    own = {file.stem: f"pipeline.stages.{file.stem}" for file in STAGES.glob("[!_]*.py")}
    experiments = (file.parent.name for file in EXPERIMENTS.glob("*/run.py"))
    return own | {name: f"pipeline.experiments.{name}.run" for name in experiments}


def modules_of(entry: str) -> list[str]:
    """Name the modules that decide what a stage writes."""
    found = imported(entry)
    if SHOWING not in found:
        return found
    return imported(entry, *(f"pipeline.experiments.{file.parent.name}.show" for file in EXPERIMENTS.glob("*/show.py")))


def code(digests: Path) -> None:
    """Write for each stage a line a module: its digest and its name."""
    for stage, entry in entries().items():
        lines = [f"{digest(name)}  {name}\n" for name in modules_of(entry)]
        io.write_text(digests / stage, "".join(lines))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="sh pipeline/run.sh code", description=code.__doc__)
    parser.add_argument("--digests", type=Path, required=True)
    code(parser.parse_args().digests)
