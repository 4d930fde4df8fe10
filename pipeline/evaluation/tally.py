"""How many trainings collapsed? In: what is said of each. Out: plain counts. Refuses to know how it is found out."""

from collections.abc import Iterable, Mapping
from typing import Any


def tally(done: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Count trainings: all, those that collapsed, and those of them that were kept as no other draw went better.

    >>> tally([{"collapsed": False, "collapsed_before_n": 1}, {"collapsed": True, "collapsed_before_n": 2}])
    {'trainings_n': 5, 'collapsed_n': 4, 'kept_collapsed_n': 1}
    """
    own = list(done)
    kept_n, before_n = sum(one["collapsed"] for one in own), sum(one["collapsed_before_n"] for one in own)
    return {"trainings_n": len(own) + before_n, "collapsed_n": before_n + kept_n, "kept_collapsed_n": kept_n}
