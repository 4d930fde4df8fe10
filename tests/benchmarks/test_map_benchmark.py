"""Processor time of the universal model: estimates of one and of many readings, calibration by pokes and by labels.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_map_benchmark.py`. All times are for one thread. The test
asserts only that the predictions are finite.
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


def test_time_of_estimates_and_calibration():
    skin, rng = load_universal(), rng_for(0, "map")
    tables = skin.tables
    lattice_i = rng.integers(len(tables.axis_mm), size=(2, POKES_N))
    force_i = rng.integers(len(tables.force_N), size=POKES_N)
    db_uT, force_N = tables.mean_uT[*lattice_i, force_i], tables.force_N[force_i]
    # The fields are not converted to the chips' axes, because this does not affect the time.
    b_uT = db_uT + tables.rest_uT + rng.normal(0, 4, (POKES_N, CHANNELS_N))
    rest_uT = b_uT[:1] - db_uT[:1]
    print(f"\nload of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    skin.zero(rest_uT).estimate(b_uT[:1])
    print_time("one reading", 1e6, "us", lambda i: skin.estimate(b_uT[i % POKES_N][None]), 4000)
    print_time(f"each of {POKES_N} readings at once", 1e6 / POKES_N, "us", lambda i: skin.estimate(b_uT), 100)
    print_time("zeroing", 1e3, "ms", lambda i: skin.zero(rest_uT).estimate(b_uT[:1]), 50)

    def calibrate(i: int) -> None:
        skin.see(b_uT).estimate(b_uT[:1])

    def calibrate_to_one(i: int) -> None:
        skin.see(b_uT[i % POKES_N][None]).estimate(b_uT[:1])

    print_time(
        f"calibration to {POKES_N} pokes", 1e3, "ms", calibrate, 30, lambda: skin.zero(rest_uT).estimate(b_uT[:1])
    )
    print_time("calibration to one more poke", 1e3, "ms", calibrate_to_one, 50)
    place_mm = tables.axis_mm[lattice_i].T + CENTRE_MM
    for n in (5, 40):

        def label(i: int, n: int = n) -> None:
            skin.label(place_mm[:n], force_N[:n], b_uT[:n]).estimate(b_uT[:1])

        print_time(
            f"calibration to {n} labels", 1e3, "ms", label, 20, lambda: skin.zero(rest_uT).see(b_uT).estimate(b_uT[:1])
        )
    print_time("calibration to one more poke, with labels", 1e3, "ms", calibrate_to_one, 50)
    assert np.isfinite(skin.predict(b_uT)).all()


def print_time(
    what: str, times: float, unit: str, call: Callable[[int], object], calls_n: int,
    before: Callable[[], object] = lambda: None,
) -> None:  # fmt: skip
    """Call `call` `calls_n` times; print the minimum, median and 99th percentile of the times."""
    took = []
    for i in range(size(calls_n, 2)):
        before()
        start_s = time.process_time()
        call(i)
        took.append(times * (time.process_time() - start_s))
    minimum, p50, p99 = np.percentile(took, [0, 50, 99])
    print(f"  {what}: minimum {minimum:.4g}, median {p50:.4g}, p99 {p99:.4g} {unit}")
