"""What a study of error against run time gives: errors, which are the same in every run, and seconds, which are not.

In: one method with one setting, or a call to be timed. Out: a row of each kind, with equal keys, and the choice of a
rule. `race` alone reads the clock. Refuses to know what was computed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from scipy.constants import milli

from reskin.errors import ParamsError
from reskin.physics.magnet import Quadrature

REFERENCE = "reference"  # the method of a row that says how wrong the reference of its study is at most
CANDIDATES = "Gauss in z"  # the rules that `nodes.place_nodes` can lay
ERROR_MAX = 0.02  # DESIGN 6: an indentation at no more than 2 % error of dB
Key = tuple[str, str, str]  # study, method, setting


@dataclass(frozen=True)
class Row:
    """One method with one setting."""

    study: str
    method: str
    setting: str

    @property
    def key(self) -> Key:
        return (self.study, self.method, self.setting)


@dataclass(frozen=True)
class Precision(Row):
    """How wrong one method is with one setting, relative to the size of what it computes; or why it failed."""

    work_n: int  # nodes that are summed, or right-hand sides that were called
    error: float | None  # None: failed
    failure: str | None = None
    parts: dict[str, float] = field(default_factory=dict)  # the error of each depth, where a study has depths


@dataclass(frozen=True)
class Seconds(Row):
    """Median time of an indentation."""

    median_s: float
    repeats_n: int


@dataclass(frozen=True)
class Contestant:
    """A call to be timed, and how many indentations it computes."""

    key: Key
    call: Callable[[], Any]
    indentations_n: int


@dataclass(frozen=True)
class Choice:
    """The cheapest rule that is good enough (None: no rule is), and how the rule in use compares (None: not tried)."""

    setting: str | None
    nodes_n: int | None
    error: float | None
    used_setting: str
    used_nodes_n: int | None
    used_error: float | None
    differs: bool


def written(rule: Quadrature) -> str:
    """Write a rule as rows and figures do."""
    return f"{rule.cell_m / milli:.3g} mm x {rule.layers_n}"


def choose(rows: Sequence[Precision], *, used: Quadrature, error_max: float = ERROR_MAX) -> Choice:
    """Take the rule with the fewest nodes among those whose error, of the worst depth, is below `error_max`.

    Nodes stand for time, to which they are proportional, so that the choice is the same in every run.
    """
    tried = {row.setting: row for row in rows if row.method == CANDIDATES}
    passing = [row for row in tried.values() if row.error is not None and row.error < error_max]
    best = min(passing, key=lambda row: (row.work_n, row.error), default=None)
    now = tried.get(written(used))
    return Choice(
        setting=best.setting if best else None,
        nodes_n=best.work_n if best else None,
        error=best.error if best else None,
        used_setting=written(used),
        used_nodes_n=now.work_n if now else None,
        used_error=now.error if now else None,
        differs=best is None or best.setting != written(used),
    )


def race(contestants: Sequence[Contestant], repeats_n: int) -> list[Seconds]:
    """Time all contestants in turn, `repeats_n` rounds of them, so that a busy moment of the machine hits all alike.

    Each has run before, when its error was found: compilation and caches are not part of an indentation.
    """
    if repeats_n < 1:
        raise ParamsError("stopwatch", "repeats_n", "1 or more", repeats_n, "Repeat.")
    times_s = np.empty((repeats_n, len(contestants)))
    for round_i in range(repeats_n):
        # Every other round runs backwards, so that nobody always inherits the caches of the same neighbour.
        for i in range(len(contestants))[:: -1 if round_i % 2 else 1]:
            start_s = perf_counter()
            contestants[i].call()
            times_s[round_i, i] = perf_counter() - start_s
    return [
        Seconds(*contestant.key, median_s=float(np.median(laps_s)) / contestant.indentations_n, repeats_n=repeats_n)
        for contestant, laps_s in zip(contestants, times_s.T, strict=True)
    ]
