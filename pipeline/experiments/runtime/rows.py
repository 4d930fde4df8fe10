"""What a study of error against run time gives: errors, which are the same in every run, and seconds, which are not.

In: one method with one setting. Out: a row of each kind, with equal keys. Refuses to know what was computed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

REFERENCE = "reference"  # the method of a row that says how wrong the reference of its study is at most
CANDIDATES = "Gauss in z"  # the rules that `nodes.place_nodes` can lay
ERROR_MAX = 0.02  # DESIGN 6: an indentation at no more than 2 % error of dB
Key = tuple[str, str, str]  # study, method, setting


@dataclass(frozen=True)
class Precision:
    """How wrong one method is with one setting, relative to the size of what it computes; or why it failed."""

    study: str
    method: str
    setting: str
    work_n: int  # nodes that are summed, or right-hand sides that were called
    error: float | None  # None: failed
    failure: str | None = None
    parts: dict[str, float] = field(default_factory=dict)  # the error of each depth, where a study has depths

    @property
    def key(self) -> Key:
        return (self.study, self.method, self.setting)


@dataclass(frozen=True)
class Seconds:
    """Median time of an indentation."""

    study: str
    method: str
    setting: str
    median_s: float
    repeats_n: int

    @property
    def key(self) -> Key:
        return (self.study, self.method, self.setting)


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
