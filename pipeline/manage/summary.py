"""Summarise the planned scenes: main scores, whether these equal the committed scores, and where to look next."""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

from pipeline.manage.compare import Comparison, Echo, Report, compare_reports, read_folder, read_revision
from pipeline.report.summary import summarise
from reskin.errors import SchemaError

COMMITTED = "HEAD"
WIDTH = 100  # largest number of characters in a line
NEXT = (
    ("{page}", "figures and tables; open it in a browser"),
    ("make ui", "MLflow: all training runs with curves, scores and models"),
    (".venv/bin/reskin live --emulate nominal", "live estimates of contacts on a simulated board"),
    ("docs/tutorial.md", "from a simulated board to your own model in 30 minutes"),
    ("docs/add-a-skin.md", "use your own boards: reskin new, reskin add, dvc repro"),
)


def print_summary(root: Path, scenes: list[str], echo: Echo) -> None:
    """Print the main scores of scenes, whether their reports equal the committed ones, and where to look next."""
    pages = []
    for scene in scenes:
        if not (root / "reports" / scene / "numbers.json").exists():
            echo(f"Scene {scene}: no results yet. Run: dvc repro report@{scene}\n")
            continue
        fresh = read_folder(root / "reports" / scene, scene)
        pages.append(f"reports/{scene}/index.html")
        for sentence in _comparison(root, scene, fresh):
            echo(fill(sentence, WIDTH))
        for line in ("", *summarise(fresh.numbers)):
            echo(line)
        echo("")
    page = pages[0] if len(pages) == 1 else "reports/index.html"
    steps = [(command.format(page=page), purpose) for command, purpose in NEXT]
    width = max(len(command) for command, _ in steps)
    echo("Next:")
    for command, purpose in steps if pages else steps[1:]:
        echo(f"  {command.ljust(width)}   {purpose}")


def _comparison(root: Path, scene: str, fresh: Report) -> list[str]:
    """Say in sentences whether a report equals the committed one."""
    try:
        committed = read_revision(root, scene, COMMITTED)
    except SchemaError:  # the report was never committed, for example because the scene is new
        return [f"Scene {scene}: its report is not committed, so there is nothing to compare it with."]
    parts = compare_reports(committed, fresh)
    values = f"{sum(part.compared_n for part in parts.values()):,} numbers and table cells"
    if all(part.reproduced for part in parts.values()):
        if fresh.provenance == committed.provenance:
            if _is_up_to_date(root, scene):
                return [
                    f"Scene {scene} is reproduced: all results from which its report is made equal those in dvc.lock, "
                    f"so DVC kept the report {committed.where}, with {values}."
                ]
            return [f"Scene {scene}: reports/{scene} is still the report {committed.where}; it was not computed again."]
        return [f"Scene {scene} is reproduced: all {values} equal those {committed.where}."]
    return [
        f"Scene {scene} is not reproduced exactly: {_differences(parts)} of {values} differ from those "
        f"{committed.where}.",
        *_probable_reasons(committed.provenance, fresh.provenance),
        f"To list all differences: reskin compare {scene}",
    ]


def _is_up_to_date(root: Path, scene: str) -> bool:
    """Return whether the inputs and outputs of a scene's report are, according to DVC, those that dvc.lock records."""
    command = [sys.executable, "-m", "dvc", "status", "--json", f"report@{scene}"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    return done.returncode == 0 and done.stdout.strip() == "{}"


def _differences(parts: Mapping[str, Comparison]) -> str:
    differing = [difference for part in parts.values() for difference in part.differing]
    unpaired_n = sum(len(part.missing) + len(part.new) for part in parts.values())
    verdicts_n = sum(difference.verdicts is not None for difference in differing)
    largest = max((difference.relative or 0.0 for difference in differing), default=0.0)
    details = [f"by up to {100 * largest:.2g} %"] if largest else []
    details += [f"{unpaired_n:,} are in only one of the two reports"] if unpaired_n else []
    details += [f"{verdicts_n} verdicts changed"]
    return f"{len(differing):,} ({'; '.join(details)})"


def _probable_reasons(committed: Mapping[str, Any], fresh: Mapping[str, Any]) -> list[str]:
    """List what differs between the runs: the code, and versions of packages."""
    old, new = (
        {f"package {name}": version for name, version in side.get("versions", {}).items()}
        | {"code": side.get("trained"), "code of the report": side.get("git")}
        for side in (committed, fresh)
    )
    changed = [f"{name} {new.get(name)} (committed: {old.get(name)})" for name in new if new[name] != old.get(name)]
    return [f"The runs differ in {', '.join(changed)}."] if changed else []
