"""Compare the reports of two runs value by value: which numbers, texts and verdicts differ."""

import csv
import io
import json
import re
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from shutil import which
from typing import Any

import pandas as pd

from pipeline.scenes import scene_file
from pipeline.stage import say
from reskin.errors import ReskinError, SchemaError

# A row of a list gets a name, so that it can be compared with the row of the same name in the other run. The name
# consists of at most this number of the row's first texts and counts.
LABEL_N = 3
LISTED_N = 10  # number of differences that are printed, beginning with the largest
# The verdict at the beginning of a table's cell. Only results from before 2026-11 contain the verdicts yes and no.
VERDICT = re.compile(
    r"(yes|no|inconclusive( \(one board\))?|supported|contradicted|undecided|within interval|significant difference|"
    r"not judged \([^)]*\))(?![\w ])"
)
# Files of a report that are compared. The files in folder runtime are not: they hold run times, which always differ.
COMPARED = re.compile(r"[^/]+\.json|tables/[^/]+\.csv")
MACHINE = ("device", "versions", "trained", "git")  # keys of the provenance that may explain a difference
EXPECTED = (
    "Values are equal on every x86-64 processor with AVX2 if the code, the settings and the versions of packages "
    "(constraints.txt) are those of the committed run. On a GPU, or with other versions of packages, values may "
    "differ. If none of these reasons explains a difference, please report it."
)
MISSING: Any = object()  # placeholder for a value that one of the two runs lacks

Leaf = bool | int | float | str | None
Echo = Callable[[str], None]


@dataclass(frozen=True)
class Difference:
    """A value that differs between two runs.

    Names look like `table2.multi.accuracy_pct.mean` or `sweep_pokes[65].mse_xy_mm2.sd`.
    """

    name: str
    committed: Leaf
    fresh: Leaf

    @property
    def relative(self) -> float | None:
        """Absolute difference divided by the larger magnitude (0 to 2); None unless both values are numbers."""
        old, new = self.committed, self.fresh
        if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in (old, new)):
            return None
        return abs(float(new) - float(old)) / max(abs(float(old)), abs(float(new)))  # type: ignore[arg-type]

    @property
    def verdicts(self) -> tuple[str, str] | None:
        """The verdicts at the beginning of both texts; None if the verdicts are equal, or if a text has no verdict."""
        old, new = (VERDICT.match(value) if isinstance(value, str) else None for value in (self.committed, self.fresh))
        return (old[1], new[1]) if old and new and old[1] != new[1] else None


@dataclass(frozen=True)
class Comparison:
    """The result of comparing the committed values with those of a fresh run.

    - equal: number of equal values, by section of the results.
    - differing: values that differ between the runs.
    - missing: names of values that only the committed run has.
    - new: names of values that only the fresh run has.
    """

    equal: Counter[str]
    differing: list[Difference]
    missing: list[str]
    new: list[str]

    @property
    def reproduced(self) -> bool:
        """Whether both runs have the same values."""
        return not (self.differing or self.missing or self.new)

    @property
    def compared_n(self) -> int:
        """Number of values that both runs have."""
        return self.equal.total() + len(self.differing)


def compare(committed: Mapping[str, Any], fresh: Mapping[str, Any]) -> Comparison:
    """Compare the nested numbers, booleans and texts of a fresh run with the committed ones."""
    comparison = Comparison(Counter(), [], [], [])
    for name, old, new in _pairs(committed, fresh, ""):
        if new is MISSING:
            comparison.missing.append(name)
        elif old is MISSING:
            comparison.new.append(name)
        elif _equal(old, new):
            comparison.equal[section_of(name)] += 1
        else:
            comparison.differing.append(Difference(name, old, new))
    return comparison


def _equal(old: Leaf, new: Leaf) -> bool:
    both_nan = old != old and new != new  # NaN is the only value that is unequal to itself
    return (old == new or both_nan) and isinstance(old, bool) == isinstance(new, bool)


def section_of(name: str) -> str:
    """Return the first part of a name.

    >>> section_of("sweep_pokes[65].mse_xy_mm2.sd")
    'sweep_pokes'
    """
    return re.split(r"[.\[]", name, maxsplit=1)[0]


def leaves(value: Any) -> Iterator[tuple[str, Leaf]]:
    """Yield every number, boolean and text of a nested value, with its name."""
    yield from ((name, leaf) for name, leaf, _ in _pairs(value, MISSING, ""))


def _pairs(old: Any, new: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield the name, the old value and the new value of each entry of `old` or `new`; a missing value is `MISSING`."""
    present = [value for value in (old, new) if value is not MISSING]
    if all(isinstance(value, Mapping) for value in present):
        before, after = ({} if value is MISSING else value for value in (old, new))
        for key in {**before, **after}:
            yield from _pairs(before.get(key, MISSING), after.get(key, MISSING), f"{name}.{key}" if name else str(key))
    elif all(isinstance(value, list) for value in present):
        before, after = _label_rows([] if old is MISSING else old, [] if new is MISSING else new)
        for label in {**before, **after}:
            yield from _pairs(before.get(label, MISSING), after.get(label, MISSING), f"{name}[{label}]")
    elif any(
        isinstance(value, Mapping | list) for value in present
    ):  # only one of the two values is a mapping or a list
        yield from _pairs(old, MISSING, name)
        yield from _pairs(MISSING, new, name)
    else:
        yield name, old, new


def _label_rows(old: Sequence[Any], new: Sequence[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Give each row of two lists a label, by which the rows of the lists are paired.

    The labels are made from the first values of a row, so that an additional row in one list does not change which
    other rows are paired. If the labels of the lists differ but the lists are equally long, rows are paired by
    position.
    """
    before, after = _labels(old), _labels(new)
    if set(before) != set(after) and len(before) == len(after):
        after = before
    return dict(zip(before, old, strict=True)), dict(zip(after, new, strict=True))


def _labels(rows: Sequence[Any]) -> list[str]:
    """Return a label for each row, which consists of the first texts and counts of the row.

    The labels are as short as possible: the first text or count alone, if this makes all labels different; otherwise
    the first two, and so on. Labels that are still equal are numbered.
    """
    if not all(isinstance(row, Mapping) for row in rows):
        return [str(i) for i in range(len(rows))]
    leading: list[list[str]] = []
    for row in rows:
        leading.append([])
        for value in row.values():
            if not isinstance(value, str | int) or isinstance(value, bool):
                break
            leading[-1].append(str(value))
    labels: list[str] = []
    for n in range(1, LABEL_N + 1):
        labels = [", ".join(texts[:n]) for texts in leading]
        if len(set(labels)) == len(labels):
            return labels
    seen: Counter[str] = Counter()
    numbered = []
    for label in labels:
        seen[label] += 1
        numbered.append(f"{label} #{seen[label]}".strip() if seen[label] > 1 or not label else label)
    return numbered


@dataclass(frozen=True)
class Report:
    """A report of a scene.

    - where: location of the report, for messages.
    - numbers: content of numbers.json.
    - tables: rows of each table, by name of the table.
    - provenance: code, versions and machine that made the report.
    """

    where: str
    numbers: dict[str, Any]
    tables: dict[str, list[dict[str, Any]]]
    provenance: dict[str, Any]


def compare_scene(root: Path, scene: str, against: str, echo: Echo) -> int:
    """Compare `reports/<scene>` with the scene's report in a git revision or a folder; return the exit status.

    An error, such as a missing report, is printed rather than raised, so that the caller can continue with other
    scenes. The exit status is then that of the error.
    """
    try:
        folder = root / "reports" / scene
        if not (folder / "numbers.json").exists():
            scene_file(root, scene)
            remedy = f"Run the scene first: reskin scenes use {scene}, then dvc repro."
            raise SchemaError(f"{folder / 'numbers.json'}: file not found. {remedy}")
        committed = read_folder(Path(against), scene) if Path(against).exists() else read_revision(root, scene, against)
        return print_comparison(scene, committed, read_folder(folder, scene), echo)
    except ReskinError as error:
        say(f"error: {error}")
        return error.exit_code


def read_folder(path: Path, scene: str) -> Report:
    """Read a scene's report; `path` is `reports/<scene>`, a folder that contains it, or a file in one of these."""
    start = path if path.is_dir() else path.parent
    candidates = (start, start / scene, start / "reports" / scene)
    folder = next((candidate for candidate in candidates if (candidate / "numbers.json").is_file()), None)
    if folder is None:
        remedy = "Give the path of folder reports/<scene> in another checkout."
        raise SchemaError(f"{path}: this folder contains no {scene}/numbers.json. {remedy}")
    files = {file.relative_to(folder).as_posix(): file for file in sorted(folder.rglob("*.*"))}
    return _parse(f"in {folder}", {name: files[name].read_text("utf-8") for name in files if COMPARED.fullmatch(name)})


def read_revision(root: Path, scene: str, revision: str) -> Report:
    """Read the report of a scene from a git revision."""
    folder = f"./reports/{scene}"
    listed = _git(root, "ls-tree", "-r", "--name-only", revision, f"{folder}/") if which("git") else ""
    names = [name for name in listed.splitlines() if COMPARED.fullmatch(name.removeprefix(f"reports/{scene}/"))]
    if f"reports/{scene}/numbers.json" not in names:
        remedy = (
            f"Commit reports/{scene} first, or name another revision or a folder: reskin compare {scene} --against ..."
        )
        raise SchemaError(f"git revision {revision} has no reports/{scene}/numbers.json. {remedy}")
    commit = _git(root, "log", "-1", "--format=%h", revision, "--", folder).strip()
    texts = {name.removeprefix(f"reports/{scene}/"): _git(root, "show", f"{revision}:./{name}") for name in names}
    return _parse(f"committed at {commit}", texts)


def _git(root: Path, *arguments: str) -> str:
    """Run git in the checkout and return its output; an empty string if git fails."""
    completed = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=False)
    return "" if completed.returncode else completed.stdout


def _parse(where: str, texts: Mapping[str, str]) -> Report:
    """Parse the files of a report; `texts`: their contents by file name."""
    numbers = json.loads(texts["numbers.json"])
    provenance = numbers.get("provenance", {}) | json.loads(texts.get("provenance.json", "{}"))
    tables = {
        Path(name).stem: [
            {str(title): _parse_cell(cell) for title, cell in row.items()} for row in csv.DictReader(io.StringIO(text))
        ]
        for name, text in sorted(texts.items())
        if name.endswith(".csv")
    }
    return Report(where, numbers, tables, provenance)


def _parse_cell(cell: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


def compare_reports(committed: Report, fresh: Report) -> dict[str, Comparison]:
    """Compare numbers.json and the cells of tables of two reports."""
    return {
        "numbers.json": compare(committed.numbers, fresh.numbers),
        "tables": compare(committed.tables, fresh.tables),
    }


def print_comparison(scene: str, committed: Report, fresh: Report, echo: Echo) -> int:
    """Print how the reports of two runs differ; the summary is printed last.

    Returns the exit status, which is 0 if all values are equal, and 1 otherwise.
    """
    parts = compare_reports(committed, fresh)
    values = f"{sum(part.compared_n for part in parts.values()):,} values"
    if all(part.reproduced for part in parts.values()):
        by_part = " and ".join(f"{part.compared_n:,} of {name}" for name, part in parts.items())
        echo(f"{scene}: reproduced: all {values} equal those {committed.where} ({by_part}).")
        return 0
    machines = [
        {"run": key, "committed": _show(committed.provenance.get(key)), "fresh": _show(fresh.provenance.get(key))}
        for key in MACHINE
    ]
    counts = []
    for name, part in parts.items():
        by_kind = {
            "differ": Counter(section_of(difference.name) for difference in part.differing),
            "only committed": Counter(map(section_of, part.missing)),
            "only fresh": Counter(map(section_of, part.new)),
        }
        for section in dict.fromkeys(chain.from_iterable(by_kind.values())):
            numbers = {title: str(by_section[section]) for title, by_section in by_kind.items()}
            counts.append({"part": name, "section": section, "equal": str(part.equal[section])} | numbers)
    differing = [difference for part in parts.values() for difference in part.differing]
    # Tables repeat the numbers of numbers.json, so their differences are listed only if none of those numbers differs.
    numeric = next(
        filter(None, ([difference for difference in part.differing if difference.relative] for part in parts.values())),
        [],
    )
    largest = [
        {
            "largest differences": difference.name,
            "committed": _show(difference.committed),
            "fresh": _show(difference.fresh),
            "relative, %": f"{100 * (difference.relative or 0.0):.3g}",
        }
        for difference in sorted(numeric, key=lambda difference: -(difference.relative or 0.0))[:LISTED_N]
    ]
    verdicts = [
        {"changed verdicts": difference.name, "committed": difference.verdicts[0], "fresh": difference.verdicts[1]}
        for difference in differing
        if difference.verdicts
    ]
    for rows in (machines, counts, largest, verdicts):
        if rows:
            echo(str(pd.DataFrame(rows).to_markdown(index=False, disable_numparse=True)) + "\n")
    unpaired_n = sum(len(part.missing) + len(part.new) for part in parts.values())
    echo(
        f"{scene}: not equal: {len(differing):,} of {values} differ from those {committed.where}; {unpaired_n:,} are "
        f"in one run only; {len(verdicts)} verdicts changed. {EXPECTED}"
    )
    return 1


def _show(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {item}" for name, item in value.items())
    return "unknown" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
