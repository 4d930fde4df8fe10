"""Holds a fresh run against committed numbers. In: a scene, a revision or a folder. Out: a comparison, and words of it.

Refuses to know tolerances, and what a number means.
"""

import json
import re
import subprocess
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from shutil import which
from typing import Any

import pandas as pd

from pipeline.core import io
from pipeline.core.errors import ReskinError, SchemaError
from pipeline.core.stage import say
from pipeline.evaluation.reproduced import Comparison, compare

SHOWN_N = 40  # rows of a table in a terminal


def compare_scene(root: Path, scene: str, against: str) -> Comparison:
    """Compare the numbers that lie in `reports/` with those of a revision, a folder or a file."""
    file = root / "reports" / scene / "numbers.json"
    if not file.exists():
        raise SchemaError(file, "the file", "there", "none", f"Try: reskin scenes use {scene}, then dvc repro.")
    return compare(read_committed(root, scene, against), io.read_json(file))


def read_committed(root: Path, scene: str, against: str) -> dict[str, Any]:
    """Read the numbers to compare with: from a path if there is one of that name, else from git."""
    place = Path(against)
    if place.exists():
        names = ("", "numbers.json", f"{scene}/numbers.json", f"reports/{scene}/numbers.json")
        found = next((place / name for name in names if (place / name).is_file()), None)
        if found is None:
            remedy = "Name reports/<scene> of another checkout, or a numbers.json."
            raise SchemaError(against, "the folder", f"one that holds {scene}/numbers.json", "none", remedy)
        return io.read_json(found)
    words = ["git", "show", f"{against}:./reports/{scene}/numbers.json"]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False) if which("git") else None
    if done is None or done.returncode:
        remedy = "Try: reskin compare SCENE --against REVISION-OR-FOLDER."
        raise SchemaError(f"git revision {against}", f"reports/{scene}/numbers.json", "committed", "none", remedy)
    return json.loads(done.stdout)


def tell(name: str, against: str, compare_one: Callable[[], Comparison], echo: Callable[[str], None]) -> int:
    """Tell how a comparison went; return its exit status: 0, 1 if a value is beyond its tolerance, 2 without one."""
    try:
        done = compare_one()
    except ReskinError as error:
        say(f"error: {error}")
        return error.exit_code
    if table := table_of(done):
        echo(table)
    echo(verdict(name, against, done))
    return 0 if done.reproduced else 1


def table_of(done: Comparison) -> str:
    """Tabulate what differs by more than it may, and name what only one side has; empty if there is nothing."""
    columns = ("number", "committed", "fresh", "difference", "tolerance")
    rows = [(x.name, _short(x.committed), _short(x.fresh), x.off, x.tolerance) for x in done.beyond[:SHOWN_N]]
    table = pd.DataFrame(rows, columns=columns)
    lines = [str(table.to_markdown(index=False, disable_numparse=True))] if rows else []
    lines += [f"and {len(done.beyond) - SHOWN_N} more"] * (len(done.beyond) > SHOWN_N)
    for word, names in (("only committed", done.missing), ("only fresh", done.new)):
        questions = Counter(re.split(r"[.\[]", name)[0] for name in names)
        lines += [f"{word}: {', '.join(f'{name} ({n} values)' for name, n in questions.items())}"] * bool(names)
    return "\n".join(lines)


def verdict(scene: str, against: str, done: Comparison) -> str:
    """Say in one sentence whether the run is the committed one."""
    counts = f"{done.equal_n} values equal those of {against}, {done.within_n} differ within their tolerance"
    if done.reproduced and not done.within_n:
        return f"{scene}: reproduced: all {counts.partition(',')[0]}."
    if done.reproduced:
        arithmetic = "another processor's arithmetic does that; with AVX2, code, data or settings did: look at git diff"
        return f"{scene}: reproduced within tolerance: {counts}, none beyond ({arithmetic})."
    lone_n = len(done.missing) + len(done.new)
    return (
        f"{scene}: not reproduced: {counts}, {len(done.beyond)} beyond it, {lone_n} on one side only "
        "(other settings or code do that; with the same, please report it)."
    )


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)[:40]
