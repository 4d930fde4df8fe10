"""`reskin compare`: compare the reports of a fresh run with committed ones, and say what differs.

Compares numbers.json and the tables of a scene. It knows no tolerances: see `evaluation.reproduced`.
"""

import csv
import io
import json
import subprocess
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import which
from typing import Any

import pandas as pd

from pipeline.core.errors import ReskinError, SchemaError
from pipeline.core.stage import say
from pipeline.evaluation.reproduced import Comparison, Difference, compare, part_of

LISTED_N = 10  # largest differences, and differing parts, that are listed
MACHINE = ("device", "versions", "trained", "git")  # of the provenance: what may explain a difference
EXPECTED = (
    "With the code, settings and versions (constraints.txt) of the committed run, values are equal on every x86-64 "
    "processor with AVX2; a GPU or other versions may differ. If none of these explains it, please report it."
)
Echo = Callable[[str], None]


@dataclass(frozen=True)
class Reports:
    """What two runs are compared by: numbers.json, the cells of tables, and where they came from."""

    where: str  # how a sentence names them
    numbers: dict[str, Any]
    tables: dict[str, list[dict[str, Any]]]
    provenance: dict[str, Any]


def compare_scene(root: Path, scene: str, against: str, echo: Echo) -> int:
    """Compare `reports/<scene>` with those of a revision or a folder; return the exit status of `tell`.

    A scene that cannot be compared is an error in one sentence, so that other scenes are compared all the same.
    """
    try:
        folder = root / "reports" / scene
        if not (folder / "numbers.json").exists():
            remedy = f"Try: reskin scenes use {scene}, then dvc repro."
            raise SchemaError(folder / "numbers.json", "the file", "there", "none", remedy)
        committed = read_folder(Path(against), scene) if Path(against).exists() else read_revision(root, scene, against)
        return tell(scene, committed, read_folder(folder, scene), echo)
    except ReskinError as error:
        say(f"error: {error}")
        return error.exit_code


def read_folder(place: Path, scene: str) -> Reports:
    """Read the reports of a scene from `reports/<scene>` itself, a folder around it, or the folder of a file."""
    around = place if place.is_dir() else place.parent
    candidates = (around, around / scene, around / "reports" / scene)
    folder = next((one for one in candidates if (one / "numbers.json").is_file()), None)
    if folder is None:
        remedy = "Name reports/<scene> of another checkout."
        raise SchemaError(place, "the folder", f"one that holds {scene}/numbers.json", "none", remedy)
    names = [file for pattern in ("*.json", "tables/*.csv") for file in sorted(folder.glob(pattern))]
    return _parse(f"in {folder}", {str(file.relative_to(folder)): file.read_text("utf-8") for file in names})


def read_revision(root: Path, scene: str, revision: str) -> Reports:
    """Read the reports of a scene from git."""
    folder = f"./reports/{scene}"
    listed = _git(root, "ls-tree", "-r", "--name-only", revision, f"{folder}/") if which("git") else None
    names = [name for name in (listed or "").splitlines() if name.endswith((".json", ".csv"))]
    if f"reports/{scene}/numbers.json" not in names:
        remedy = "Try: reskin compare SCENE --against REVISION-OR-FOLDER."
        raise SchemaError(f"git revision {revision}", f"reports/{scene}/numbers.json", "committed", "none", remedy)
    commit = _git(root, "log", "-1", "--format=%h", revision, "--", folder) or ""
    texts = {name.removeprefix(f"reports/{scene}/"): _git(root, "show", f"{revision}:./{name}") or "" for name in names}
    return _parse(f"committed at {commit.strip()}", texts)


def tell(title: str, committed: Reports, fresh: Reports, echo: Echo) -> int:
    """Say how two runs compare, the summary last; return 0 if all values are equal, else 1."""
    parts = {
        "numbers.json": compare(committed.numbers, fresh.numbers),
        "tables": compare(committed.tables, fresh.tables),
    }
    counts = {part: done.equal.total() + len(done.differing) for part, done in parts.items()}
    values = f"{sum(counts.values()):,} values"
    of_parts = " and ".join(f"{n:,} of {part}" for part, n in counts.items())
    if all(done.reproduced for done in parts.values()):
        echo(f"{title}: reproduced: all {values} equal those {committed.where} ({of_parts}).")
        return 0
    echo(_machines(committed.provenance, fresh.provenance))
    for part, done in parts.items():
        echo(f"\n{part}: {_counted(done)}")
        for word, names in (("only committed", done.missing), ("only fresh", done.new)):
            if names:
                echo(f"{word}: {_listed(Counter(map(part_of, names)))}")
    sized = [[one for one in done.differing if one.relative] for done in parts.values()]
    numbers = sorted(next(filter(None, sized), []), key=_by_size)  # tables repeat what numbers.json holds
    if numbers:
        echo(f"\nLargest differences, relative to the larger of the two numbers:\n{_largest(numbers[:LISTED_N])}")
    turned = [one for done in parts.values() for one in done.differing if one.verdicts]
    echo("\n".join([f"\nVerdicts that changed: {len(turned) or 'none'}", *map(_turned, turned)]))
    differing_n = sum(len(done.differing) for done in parts.values())
    lone_n = sum(len(done.missing) + len(done.new) for done in parts.values())
    by = f", numbers by up to {_percent(numbers[0])}" if numbers else ""
    lone = f"; {lone_n:,} are in one run only" if lone_n else ""
    verdicts = f"{len(turned)} verdict{'s' if len(turned) != 1 else ''} changed" if turned else "no verdict changed"
    echo(
        f"\n{title}: not equal: {differing_n:,} of {values} differ from those {committed.where}{by}{lone}; {verdicts}. "
        f"{EXPECTED}"
    )
    return 1


def _machines(committed: Mapping[str, Any], fresh: Mapping[str, Any]) -> str:
    """Tabulate on what machine, with what code and versions both ran."""
    rows = [{"run": key, "committed": _short(committed.get(key)), "fresh": _short(fresh.get(key))} for key in MACHINE]
    return str(pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True))


def _counted(done: Comparison) -> str:
    compared_n = done.equal.total() + len(done.differing)
    differing = Counter(part_of(one.name) for one in done.differing)
    if not differing:
        return f"all {compared_n:,} that both have are equal"
    return f"{len(done.differing):,} of {compared_n:,} differ: {_listed(differing)}"


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{part} {n:,}" for part, n in counts.most_common())


def _by_size(one: Difference) -> float:
    return -(one.relative or 0.0)


def _percent(one: Difference) -> str:
    return f"{100 * (one.relative or 0.0):.3g} %"


def _largest(differences: Sequence[Difference]) -> str:
    rows = [
        {
            "number": one.name,
            "committed": _short(one.committed),
            "fresh": _short(one.fresh),
            "differs by": _percent(one),
        }
        for one in differences
    ]
    return str(pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True))


def _turned(one: Difference) -> str:
    old, new = one.verdicts or ("", "")
    return f"- {one.name}: {old} -> {new}"


def _short(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {one}" for name, one in value.items())
    return "unknown" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def _parse(where: str, texts: Mapping[str, str]) -> Reports:
    """Parse the files of a report by name."""
    numbers = json.loads(texts["numbers.json"])
    provenance = numbers.get("provenance", {}) | json.loads(texts.get("provenance.json", "{}"))
    tables = {Path(name).stem: _cells(words) for name, words in sorted(texts.items()) if name.endswith(".csv")}
    return Reports(where, numbers, tables, provenance)


def _cells(words: str) -> list[dict[str, Any]]:
    rows = csv.DictReader(io.StringIO(words))
    return [{str(key): _number(cell) for key, cell in row.items()} for row in rows]


def _number(cell: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


def _git(root: Path, *words: str) -> str | None:
    """Run git in the checkout and give what it prints; None if it fails."""
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)
    return None if done.returncode else done.stdout
