"""What map and network of the project take: a reading as a controller asks, 65 pokes to learn from, one more, labels.

`RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_map_benchmark.py`.
Processor time of one thread. Nothing is asserted but
that readings were answered.
"""

import os
import time
from collections.abc import Callable

import numpy as np

from reskin.data.grid import CENTRE_MM
from reskin.seeds import rng_for
from reskin.universal.calibration import CHANNELS_N
from reskin.universal.model import load_universal
from tests.benchmarks import size

POKES_N = 65


def test_readings_one_by_one_and_at_once_and_what_learning_takes():
    skin, rng = load_universal(), rng_for(0, "map")
    tables = skin.tables
    at = rng.integers(len(tables.axis_mm), size=(2, POKES_N))
    force_i = rng.integers(len(tables.force_N), size=POKES_N)
    db_uT, force_N = tables.mean_uT[*at, force_i], tables.force_N[force_i]
    b_uT = db_uT + tables.rest_uT + rng.normal(0, 4, (POKES_N, CHANNELS_N))  # axes are as good as any for the time
    rest_uT = b_uT[:1] - db_uT[:1]
    print(f"\nload of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    skin.zero(rest_uT).estimate(b_uT[:1])
    say("a reading", 1e6, "us", lambda i: skin.estimate(b_uT[i % POKES_N][None]), 4000)
    say(f"{POKES_N} readings at once, each", 1e6 / POKES_N, "us", lambda i: skin.estimate(b_uT), 100)
    say("zeroed and ready again", 1e3, "ms", lambda i: skin.zero(rest_uT).estimate(b_uT[:1]), 50)

    def see(i: int) -> None:
        skin.see(b_uT).estimate(b_uT[:1])

    def see_one(i: int) -> None:
        skin.see(b_uT[i % POKES_N][None]).estimate(b_uT[:1])

    say(f"{POKES_N} pokes seen and ready", 1e3, "ms", see, 30, lambda: skin.zero(rest_uT).estimate(b_uT[:1]))
    say("one more poke seen and ready", 1e3, "ms", see_one, 50)
    place_mm = tables.axis_mm[at].T + CENTRE_MM
    for n in (5, 40):

        def label(i: int, n: int = n) -> None:
            skin.label(place_mm[:n], force_N[:n], b_uT[:n]).estimate(b_uT[:1])

        say(f"{n} labels told and ready", 1e3, "ms", label, 20, lambda: skin.zero(rest_uT).see(b_uT).estimate(b_uT[:1]))
    say("one more poke seen and ready, with labels", 1e3, "ms", see_one, 50)
    assert np.isfinite(skin.predict(b_uT)).all()


def say(
    what: str, times: float, unit: str, call: Callable[[int], object], calls_n: int,
    before: Callable[[], object] = lambda: None,
) -> None:  # fmt: skip
    """Print the least, the median and the 99th percentile of so many calls."""
    took = []
    for i in range(size(calls_n, 2)):
        before()
        start_s = time.process_time()
        call(i)
        took.append(times * (time.process_time() - start_s))
    least, p50, p99 = np.percentile(took, [0, 50, 99])
    print(f"  {what}: least {least:.4g}, median {p50:.4g}, p99 {p99:.4g} {unit}")
