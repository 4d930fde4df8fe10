"""Force error of a simulated gripper whose controller uses the model's force estimate as feedback.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_gripper_benchmark.py`, which prints the numbers. Nothing is
asserted.
"""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.model import load_universal
from tests.benchmarks import size
from tests.live.gripper import AIM_N, PERIOD_S, RATE_HZ, SETTLED_S, Finger, fit, grip

SKINS_N = size(6, 1)
PLACES_MM = size(((8.0, 8.0), (5.0, 10.0)), ((8.0, 8.0),))
POKES_N, SECONDS = size(600, 20), size(PERIOD_S, SETTLED_S + 0.1)


@pytest.mark.parametrize(
    ("feedback", "aim_N"), [("network of this skin", AIM_N), ("map of simulated skins", 2 * AIM_N)]
)
def test_error_of_the_held_force(feedback, aim_N):
    errors, within = [], []
    for seed in range(SKINS_N):
        models = [fit(seed, POKES_N)] if feedback.startswith("network") else load_universal()
        for place_mm in PLACES_MM:
            held = grip(Finger(seed, place_mm), models, rng_for(seed, "grip"), aim_N=aim_N, seconds=SECONDS)
            error = np.abs(held[round(SETTLED_S * RATE_HZ) :, 0] / aim_N - 1)
            errors.append(error.mean())
            within.append((error < 0.1).mean())
    print(f"\n{feedback}, {aim_N:g} N, {SKINS_N} skins at {len(PLACES_MM)} places each:")
    print(f"  error of the true force: median {np.median(errors):.1%}, worst {max(errors):.1%}")
    print(
        f"  time within 10 %: mean {np.mean(within):.0%}; "
        f"all the time in {np.sum(np.array(within) == 1)} of {len(within)} grips"
    )
