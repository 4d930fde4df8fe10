"""Compare the reports of two runs value by value: which numbers, texts and verdicts differ."""

import csv
import io
import json
import re
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from shutil import which
from typing import Any

import pandas as pd

from pipeline.stage import say
from reskin.errors import ReskinError, SchemaError

LABEL_N = 3  # leading words of a row that may name it
# How a cell with a verdict begins; the first three are of results before 2026-11.
VERDICT = re.compile(
    r"(yes|no|inconclusive( \(one board\))?|supported|contradicted|undecided|not judged \([^)]*\))(?![\w ])"
)
Leaf = bool | int | float | str | None


class Absent(Enum):
    """Marks a value that one of the two runs does not have."""

    ABSENT = "absent"


ABSENT = Absent.ABSENT


@dataclass(frozen=True)
class Difference:
    """A value that differs. Names look like `table2.multi.accuracy_pct.mean` or `sweep_pokes[65].mse_xy_mm2.sd`."""

    name: str
    committed: Leaf
    fresh: Leaf

    @property
    def relative(self) -> float | None:
        """The difference relative to the larger of two numbers (0 to 2); None if one is no number."""
        old, new = (_number(value) for value in (self.committed, self.fresh))
        return None if old is None or new is None else abs(new - old) / max(abs(old), abs(new))

    @property
    def verdicts(self) -> tuple[str, str] | None:
        """The verdicts that two texts begin with; None if one does not or they are equal."""
        old, new = (VERDICT.match(value) if isinstance(value, str) else None for value in (self.committed, self.fresh))
        return (old[1], new[1]) if old and new and old[1] != new[1] else None


@dataclass(frozen=True)
class Comparison:
    """The values that differ, the names that only one run has, and the number of equal values by first name."""

    equal: Counter[str]
    differing: list[Difference]
    missing: list[str]
    new: list[str]

    @property
    def reproduced(self) -> bool:
        """Whether both runs have the same values."""
        return not (self.differing or self.missing or self.new)


def compare(committed: Mapping[str, Any], fresh: Mapping[str, Any]) -> Comparison:
    """Compare nested numbers, truths and texts of a fresh run with committed ones."""
    equal: Counter[str] = Counter()
    differing, missing, added = [], [], []
    for name, old, new in _pairs(committed, fresh, ""):
        if new is ABSENT:
            missing.append(name)
        elif old is ABSENT:
            added.append(name)
        elif _same(old, new):
            equal[part_of(name)] += 1
        else:
            differing.append(Difference(name, old, new))
    return Comparison(equal, differing, missing, added)


def part_of(name: str) -> str:
    """Give the first part of a name.

    >>> part_of("sweep_pokes[65].mse_xy_mm2.sd")
    'sweep_pokes'
    """
    return re.split(r"[.\[]", name, maxsplit=1)[0]


def leaves(value: Any) -> Iterator[tuple[str, Leaf]]:
    """Name every number, truth and text of a nested value."""
    yield from ((name, leaf) for name, leaf, _ in _pairs(value, ABSENT, ""))


def _pairs(old: Any, new: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """Name every value of either side, with what stands under this name in both."""
    present = [value for value in (old, new) if value is not ABSENT]
    if all(isinstance(value, Mapping) for value in present):
        before, after = ({} if value is ABSENT else value for value in (old, new))
        for key in {**before, **after}:
            yield from _pairs(before.get(key, ABSENT), after.get(key, ABSENT), f"{name}.{key}" if name else str(key))
    elif all(isinstance(value, list) for value in present):
        before, after = _rows([] if old is ABSENT else old, [] if new is ABSENT else new)
        for label in {**before, **after}:
            yield from _pairs(before.get(label, ABSENT), after.get(label, ABSENT), f"{name}[{label}]")
    elif any(isinstance(value, Mapping | list) for value in present):  # another kind on each side
        yield from _pairs(old, ABSENT, name)
        yield from _pairs(ABSENT, new, name)
    else:
        yield name, old, new


def _rows(old: Sequence[Any], new: Sequence[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Name the rows of two lists by their leading words, so that an additional row shifts no other.

    Where the words differ and the lists are equally long, rows are paired by their places.
    """
    before, after = _labels(old), _labels(new)
    if set(before) != set(after) and len(before) == len(after):
        after = before
    return dict(zip(before, old, strict=True)), dict(zip(after, new, strict=True))


def _labels(rows: Sequence[Any]) -> list[str]:
    """Name rows by as few leading words as make them differ; rows that still agree are numbered."""
    if not all(isinstance(row, Mapping) for row in rows):
        return [str(i) for i in range(len(rows))]
    named: list[str] = []
    for words_n in range(1, LABEL_N + 1):
        named = [", ".join(_words(row)[:words_n]) for row in rows]
        if len(set(named)) == len(named):
            return named
    seen: Counter[str] = Counter()
    labels = []
    for label in named:
        seen[label] += 1
        labels.append(f"{label} #{seen[label]}".strip() if seen[label] > 1 or not label else label)
    return labels


def _words(row: Mapping[str, Any]) -> list[str]:
    """Take the texts and counts that a row begins with."""
    words = []
    for value in row.values():
        if not isinstance(value, str | int) or isinstance(value, bool):
            break
        words.append(str(value))
    return words


def _same(old: Leaf, new: Leaf) -> bool:
    both_nan = old != old and new != new  # the only value that is unequal to itself
    return (old == new or both_nan) and isinstance(old, bool) == isinstance(new, bool)


def _number(value: Leaf) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


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
    return [{str(key): _one_number(cell) for key, cell in row.items()} for row in rows]


def _one_number(cell: str) -> int | float | str:
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
