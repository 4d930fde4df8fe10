"""How long does an answer take? In: a call. Out: median seconds. Refuses to know what is called."""

from collections.abc import Callable
from time import perf_counter

import numpy as np

REPEATS_N = 25


def median_s(call: Callable[[], object]) -> float:
    """Time a call a few times, after one that warms the caches."""
    call()
    times_s = []
    for _ in range(REPEATS_N):
        start_s = perf_counter()
        call()
        times_s.append(perf_counter() - start_s)
    return float(np.median(times_s))
