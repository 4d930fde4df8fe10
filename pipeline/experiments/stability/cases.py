"""One row of the stability table. In: what was tried and what came of it. Out: a `Case`, which holds or does not.

What happened is worded from what was measured, never typed. Refuses to know what is tried.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

from pipeline.core.errors import ReskinError


@dataclass(frozen=True)
class Case:
    """A case of PHYSICS 10: what should happen and why, what happened, and the error where there is one."""

    area: str
    case: str
    should: str
    happened: str
    error: float | None
    limit: float | None
    holds: bool


def measured(area: str, case: str, *, should: str, happened: str, error: float, limit: float) -> Case:
    """Judge a case by its error; NaN does not hold."""
    return Case(area, case, should, happened, error, limit, holds=bool(error <= limit))


def told(area: str, case: str, *, should: str, happened: str, holds: bool) -> Case:
    """Judge a case by a fact."""
    return Case(area, case, should, happened, None, None, holds=bool(holds))


def refused(area: str, case: str, *, should: str, attempt: Callable[[], object]) -> Case:
    """Try what must not go through; any error but the project's own is a fault of ours and is let out."""
    try:
        attempt()
    except ReskinError as error:
        return told(area, case, should=should, happened=f"refused: {error}", holds=True)
    return told(area, case, should=should, happened="went on without a word", holds=False)


def peak_bytes(work: Callable[[], object]) -> int:
    """Give the most memory that Python and NumPy held at once while working, what was there before left out."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
