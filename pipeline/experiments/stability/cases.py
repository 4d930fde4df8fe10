"""One row of the stability table: an extreme case, what came of it, and whether that is what should have.

Cases (the modules beside this one) are tried on any inputs: the stage tabulates those of a scene, tests draw others.
Refuses to know what is tried.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

from reskin.errors import ReskinError


@dataclass(frozen=True)
class Case:
    """A case of PHYSICS 10: what should happen and why, what happened, and the error where there is one."""

    area: str
    case: str
    should: str
    happened: str  # worded from what was measured, never typed
    error: float | None
    limit: float | None
    holds: bool


def measured(area: str, case: str, *, should: str, happened: str, error: float, limit: float) -> Case:
    """Judge a case by its error; NaN does not hold."""
    return Case(area, case, should, happened, error, limit, holds=bool(error <= limit))


def observed(area: str, case: str, *, should: str, happened: str, holds: bool) -> Case:
    """Judge a case by a fact."""
    return Case(area, case, should, happened, None, None, holds=bool(holds))


def refused(area: str, case: str, *, should: str, attempt: Callable[[], object]) -> Case:
    """Try what must not go through; any error but the project's own is a fault of ours and is let out."""
    try:
        attempt()
    except ReskinError as error:
        return observed(area, case, should=should, happened=f"refused: {error}", holds=True)
    return observed(area, case, should=should, happened="went on without a word", holds=False)


def peak_bytes(work: Callable[[], object]) -> int:
    """Give the most memory that Python and NumPy held at once while working, what was there before left out."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
