"""One row of the leak audit. In: what was looked at and what was found. Out: a `Check`, which holds, is known, or not.

What is known is told, and fails nothing: a leak that the paper's own protocol has, a network that collapsed.
Refuses to know what is looked at.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Check:
    """A rule that keeps training apart from testing, and what was found of it."""

    what: str
    where: str
    rule: str
    found: str
    holds: bool
    known: bool


def holds(checks: Iterable[Check]) -> bool:
    """Tell whether every rule holds, but for the leaks that are known."""
    return all(check.holds or check.known for check in checks)


def to_words(checks: Iterable[Check]) -> list[dict[str, str | bool]]:
    """Write checks as JSON words."""
    return [asdict(check) for check in checks]
