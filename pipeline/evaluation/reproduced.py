"""Does a run agree with another? In: two nested numbers.json. Out: what is equal, within tolerance, beyond it, absent.

Refuses to know files, git and how it is shown.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.evaluation.tolerance import ignored, tolerance_of

NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+−]?\d+)?")
LABEL_N = 3  # leading words of a row that may name it
Leaf = bool | int | float | str | None


@dataclass(frozen=True)
class Difference:
    """A number, or a text, that differs by more than it may."""

    name: str
    committed: Leaf
    fresh: Leaf
    tolerance: str

    @property
    def off(self) -> str:
        """The difference, of numbers; texts and truths just differ."""
        if isinstance(self.committed, str | bool | None) or isinstance(self.fresh, str | bool | None):
            return "differs"
        return f"{self.fresh - self.committed:+.3g}"


@dataclass(frozen=True)
class Comparison:
    """How many values (numbers, truths, texts) are equal or within tolerance, and all others."""

    equal_n: int
    within_n: int
    beyond: list[Difference]
    missing: list[str]
    new: list[str]

    @property
    def reproduced(self) -> bool:
        """Tell whether all is there, and within tolerance."""
        return not (self.beyond or self.missing or self.new)


def compare(committed: Mapping[str, Any], fresh: Mapping[str, Any]) -> Comparison:
    """Hold the fresh numbers against the committed ones, each within the tolerance of its name."""
    old, new = (dict(leaves(one)) for one in (committed, fresh))
    both = [name for name in old if name in new]
    equal = [name for name in both if _same(old[name], new[name])]
    differing = [name for name in both if not _same(old[name], new[name])]
    beyond = [name for name in differing if not _within(name, old[name], new[name])]
    return Comparison(
        len(equal),
        len(differing) - len(beyond),
        [Difference(name, old[name], new[name], _rule(name, old[name])) for name in beyond],
        [name for name in old if name not in new],
        [name for name in new if name not in old],
    )


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Leaf]]:
    """Name every number, truth and text; a row of a list by its leading words, so that a row more shifts no other."""
    if isinstance(value, Mapping):
        for key, own in value.items():
            yield from leaves(own, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for label, own in zip(_labels(value), value, strict=True):
            yield from leaves(own, f"{name}[{label}]")
    elif not ignored(name):
        yield name, value


def _labels(rows: Sequence[Any]) -> list[str]:
    """Name rows by as few leading words as tell them apart, else by their places among their like."""
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
    """Tell whether two are equal; a text's numbers do not count, as they stand elsewhere as numbers."""
    if isinstance(old, str) and isinstance(new, str):
        return NUMBER.sub("#", old) == NUMBER.sub("#", new)
    return old == new and isinstance(old, bool) == isinstance(new, bool)


def _within(name: str, old: Leaf, new: Leaf) -> bool:
    if isinstance(old, str | bool | None) or isinstance(new, str | bool | None):
        return False
    return tolerance_of(name).allows(float(old), float(new))


def _rule(name: str, old: Leaf) -> str:
    return "exact" if isinstance(old, str | bool | None) else str(tolerance_of(name))
