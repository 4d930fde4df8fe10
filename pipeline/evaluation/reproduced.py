"""Does a run agree with another? In: two nested numbers.json. Out: what is equal, within tolerance, beyond it, absent.

The only home of tolerances: how far a number may lie from the committed one, and why. Refuses to know files, git and
how it is shown.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

# A name: `table2.multi.accuracy_pct.mean`, `sweep_pokes[65].mse_xy_mm2.sd`, `audit[skins, lobo/b0].holds`.
IGNORED = (
    (r"provenance\.(git|trained|device|seconds)$", "the commit, the machine and its seconds"),
    (r"drift\.findings.*\.(verdict|of_trainings|why|holds)$", "words about numbers that are compared themselves"),
    (r"runtime\.stages\b", "seconds and memory of stages"),
    (r"runtime\.(learning|adaptation)\b", "seconds; their scores stand under their own questions"),
    (r"runtime\..*\.(median_s|repeats_n|train_s|inference_us|seconds)$", "seconds"),
)
NUMBER = re.compile(r"[-+−]?\d[\d.,]*(e[-+−]?\d+)?")
LABEL_N = 3  # leading words of a row that may name it
Leaf = bool | int | float | str | None


@dataclass(frozen=True)
class Tolerance:
    """A number whose name matches may differ by `absolute`, or by `relative` of the committed one, if that is more."""

    pattern: str
    absolute: float
    relative: float
    why: str

    def allows(self, committed: float, fresh: float) -> bool:
        """Tell whether two numbers are the same within it."""
        return abs(fresh - committed) <= max(self.absolute, self.relative * abs(committed))

    def __str__(self) -> str:
        """Say it: `2`, `25 %`, `0.02 or 25 %`, `exact`."""
        parts = [f"{self.absolute:g}"] * bool(self.absolute) + [f"{100 * self.relative:g} %"] * bool(self.relative)
        return " or ".join(parts) or "exact"


COMPUTED = r"(capture|described|variation|sensitivity|left_out|verification|stability|runtime|audit)"  # no training
LAST_BITS = "other instruction sets add in another order: weights differ in their last bits, and training magnifies it"
# Of trainings: some 1.5 times the most by which they moved under other instructions and in float64 (docs/repeat.md).
# Where every library is held to AVX2 (core/numerics.py) nothing moves at all.
TOLERANCES = (  # the first that matches holds
    Tolerance(r"runtime\..*work_n$", 0.0, 0.01, "an adaptive integrator takes a step more or less"),
    Tolerance(r"^trainings\.", 3.0, 0.0, "other last bits, and another training collapses"),
    Tolerance(r"(_n|\.n|_i|seed)$", 0.0, 0.0, "a count"),
    Tolerance(r"stability\[learning", 0.01, 0.25, LAST_BITS),
    Tolerance(rf"^{COMPUTED}\b.*error$", 1e-7, 1e-3, "below 1e-7 an error is rounding itself"),
    Tolerance(rf"^{COMPUTED}", 1e-9, 1e-3, "computed in double precision, without training"),
    Tolerance(r"\.by_(board|skin)\..*_pct\b", 15.0, 0.0, f"{LAST_BITS}; of a few networks"),
    Tolerance(r"(^|\.)(paired|contrasts)\b.*\.by_(board|skin)\..*mse_", 1.5, 0.25, f"{LAST_BITS}; of a few networks"),
    Tolerance(r"_pct\.(sd|sd_seeds)$", 4.0, 0.0, f"{LAST_BITS}; the spread of a few units"),
    Tolerance(r"\.(sd|sd_seeds)$|\.spread\.", 0.5, 0.5, f"{LAST_BITS}; the spread of a few units"),
    Tolerance(r"_pct\.ci95\b", 6.0, 0.5, f"{LAST_BITS}; an end of an interval over few boards"),
    Tolerance(r"\.ci95\b", 0.75, 0.5, f"{LAST_BITS}; an end of an interval over few boards"),
    Tolerance(r"_pct\b", 3.0, 0.0, LAST_BITS),
    Tolerance(r"(^|\.)(paired|contrasts)\b.*mse_", 0.25, 0.25, f"{LAST_BITS}; a small difference of two means"),
    Tolerance(r"mse_\w+", 0.002, 0.25, LAST_BITS),
    Tolerance(r"", 0.02, 0.25, LAST_BITS),
)


@dataclass(frozen=True)
class Difference:
    """A number, or a text, that differs by more than it may."""

    name: str
    committed: Leaf
    fresh: Leaf

    @property
    def off(self) -> str:
        """The difference, of numbers; texts and truths just differ."""
        both = _numbers(self.committed, self.fresh)
        return f"{both[1] - both[0]:+.3g}" if both else "differs"

    @property
    def tolerance(self) -> str:
        """By how much it may differ."""
        return str(tolerance_of(self.name)) if _numbers(self.committed) else "exact"

    @property
    def allowed(self) -> bool:
        """Tell whether it is within its tolerance."""
        both = _numbers(self.committed, self.fresh)
        return bool(both) and tolerance_of(self.name).allows(*both)


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
    old, new = (dict(leaves(numbers)) for numbers in (committed, fresh))
    both = [name for name in old if name in new]
    differing = [Difference(name, old[name], new[name]) for name in both if not _same(old[name], new[name])]
    beyond = [difference for difference in differing if not difference.allowed]
    missing, added = [name for name in old if name not in new], [name for name in new if name not in old]
    return Comparison(len(both) - len(differing), len(differing) - len(beyond), beyond, missing, added)


def ignored(name: str) -> bool:
    """Tell whether a number is of the machine, and of no result."""
    return any(re.search(pattern, name) for pattern, _ in IGNORED)


def tolerance_of(name: str) -> Tolerance:
    """Find the tolerance of a number."""
    return next(tolerance for tolerance in TOLERANCES if re.search(tolerance.pattern, name))


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, Leaf]]:
    """Name every number, truth and text; a row of a list by its leading words, so that a row more shifts no other."""
    if isinstance(value, Mapping):
        for key, nested in value.items():
            yield from leaves(nested, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list):
        for label, nested in zip(_labels(value), value, strict=True):
            yield from leaves(nested, f"{name}[{label}]")
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


def _numbers(*values: Leaf) -> list[float]:
    """Give all values as numbers; none of them if one is a text or a truth."""
    numbers = [float(value) for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    return numbers if len(numbers) == len(values) else []
