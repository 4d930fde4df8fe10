"""Class `Case`, whose instances are the rows of the stability experiment's table, and functions that create cases.

The other modules of this package define cases as functions of their inputs. The experiment calls these functions with
the inputs of a scene, and the tests call them with random inputs.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

from reskin.errors import ReskinError


@dataclass(frozen=True)
class Case:
    """The result of one case: what should happen, what happened, and whether the two agree.

    If the case measures an error, `error` and `limit` are this error and the largest accepted error.
    """

    area: str
    case: str
    should: str  # expected behaviour
    happened: str  # observed behaviour, described with measured values
    error: float | None
    limit: float | None
    holds: bool


def error_case(area: str, case: str, *, should: str, happened: str, error: float, limit: float) -> Case:
    """Return a case that holds if its error is at most `limit`; a case whose error is NaN does not hold."""
    return Case(area, case, should, happened, error, limit, holds=bool(error <= limit))


def condition_case(area: str, case: str, *, should: str, happened: str, holds: bool) -> Case:
    """Return a case without an error, which holds if the condition `holds` is true."""
    return Case(area, case, should, happened, None, None, holds=bool(holds))


def rejection_case(area: str, case: str, *, should: str, attempt: Callable[[], object]) -> Case:
    """Return a case that holds if calling `attempt` raises `ReskinError`; other exceptions are bugs and propagate."""
    try:
        attempt()
    except ReskinError as error:
        return condition_case(area, case, should=should, happened=f"error: {error}", holds=True)
    return condition_case(area, case, should=should, happened="no error was raised", holds=False)


def peak_bytes(work: Callable[[], object]) -> int:
    """Return the peak memory in bytes that Python and NumPy allocate while `work` is called."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
