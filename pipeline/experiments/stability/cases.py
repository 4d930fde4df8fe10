"""A row of the stability table: an extreme case, with the expected and the actual behaviour.

The other modules of this package run cases on any inputs: the experiment uses those of a scene, tests use random ones.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

from reskin.errors import ReskinError


@dataclass(frozen=True)
class Case:
    """A case: expected and actual behaviour, and the error if the case has one."""

    area: str
    case: str
    should: str
    happened: str  # composed from measured values
    error: float | None
    limit: float | None
    holds: bool


def error_case(area: str, case: str, *, should: str, happened: str, error: float, limit: float) -> Case:
    """Return a case that holds if its error is at most `limit`; it does not hold for NaN."""
    return Case(area, case, should, happened, error, limit, holds=bool(error <= limit))


def condition_case(area: str, case: str, *, should: str, happened: str, holds: bool) -> Case:
    """Return a case that holds if a condition is true."""
    return Case(area, case, should, happened, None, None, holds=bool(holds))


def rejection_case(area: str, case: str, *, should: str, attempt: Callable[[], object]) -> Case:
    """Return a case that holds if `attempt` raises `ReskinError`; other exceptions are bugs and propagate."""
    try:
        attempt()
    except ReskinError as error:
        return condition_case(area, case, should=should, happened=f"refused: {error}", holds=True)
    return condition_case(area, case, should=should, happened="no error was raised", holds=False)


def peak_bytes(work: Callable[[], object]) -> int:
    """Return the peak memory in bytes that Python and NumPy allocate during `work`."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
