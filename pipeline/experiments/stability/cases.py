"""A row of the stability table: an extreme case, the expected and the actual behaviour.

The modules beside this one run cases on any inputs: the experiment tabulates those of a scene, tests draw others.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

from reskin.errors import ReskinError


@dataclass(frozen=True)
class Case:
    """A case: expected and actual behaviour, and the error where there is one."""

    area: str
    case: str
    should: str
    happened: str  # composed from measured values
    error: float | None
    limit: float | None
    holds: bool


def measured(area: str, case: str, *, should: str, happened: str, error: float, limit: float) -> Case:
    """Return a case that holds if its error is at most `limit`; NaN does not hold."""
    return Case(area, case, should, happened, error, limit, holds=bool(error <= limit))


def observed(area: str, case: str, *, should: str, happened: str, holds: bool) -> Case:
    """Return a case that holds if a condition does."""
    return Case(area, case, should, happened, None, None, holds=bool(holds))


def refused(area: str, case: str, *, should: str, attempt: Callable[[], object]) -> Case:
    """Return a case that holds if `attempt` raises `ReskinError`; other errors are bugs and propagate."""
    try:
        attempt()
    except ReskinError as error:
        return observed(area, case, should=should, happened=f"refused: {error}", holds=True)
    return observed(area, case, should=should, happened="went on without a word", holds=False)


def peak_bytes(work: Callable[[], object]) -> int:
    """Return the peak memory in bytes that Python and NumPy allocate during `work`."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
