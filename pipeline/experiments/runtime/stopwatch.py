"""Times of calls that compete. In: contestants. Out: the median seconds of each.

The one place of these studies that reads the clock. Refuses to know what is computed.
"""

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from pipeline.core.errors import ParamsError
from pipeline.experiments.runtime.rows import Contestant, Seconds


def race(contestants: Sequence[Contestant], repeats_n: int) -> list[Seconds]:
    """Time all contestants in turn, `repeats_n` rounds of them, so that a busy moment of the machine hits all alike.

    Each has run before, when its error was found: compilation and caches are not part of an indentation.
    """
    if repeats_n < 1:
        raise ParamsError("stopwatch", "repeats_n", "1 or more", repeats_n, "Repeat.")
    times_s = np.empty((repeats_n, len(contestants)))
    for round_i in range(repeats_n):
        # Every other round runs backwards, so that nobody always inherits the caches of the same neighbour.
        order = range(len(contestants))[:: -1 if round_i % 2 else 1]
        for i in order:
            start_s = perf_counter()
            contestants[i].call()
            times_s[round_i, i] = perf_counter() - start_s
    return [
        Seconds(*one.key, median_s=float(np.median(own_s)) / one.indentations_n, repeats_n=repeats_n)
        for one, own_s in zip(contestants, times_s.T, strict=True)
    ]
