"""Compare two runs value by value: which numbers, texts and verdicts differ, and which only one run has.

Equal runs give equal values to the last digit, so this module knows no tolerances.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

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
