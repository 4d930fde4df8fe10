"""One line of a controller holds half a newton by our estimate, though what it holds stiffens."""

import numpy as np

from pipeline.core.seeds import rng_for
from tests.live.gripper import AIM_N, PERIOD_S, RATE_HZ, SETTLED_S, Finger, fit, grip


def test_half_a_newton_is_held_within_a_fifth_by_a_network_of_this_skin():
    held = grip(Finger(seed=0), [fit(seed=0, pokes_n=300)], rng_for(0, "grip"), seconds=PERIOD_S / 2)
    true_N, estimate_N = held[round(SETTLED_S * RATE_HZ) :].T
    assert abs(estimate_N.mean() / AIM_N - 1) < 0.05
    np.testing.assert_allclose(true_N, AIM_N, atol=0.2 * AIM_N)  # as far as the estimate is right
    assert held[:, 0].max() < 2 * AIM_N  # nor is it crushed at the first touch
