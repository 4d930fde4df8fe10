"""The force sensor against its data sheet: range, noise, and a count of what was held at the range."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reskin.seeds import rng_for
from reskin.simulation.rig import FORCE_RANGE_N, read_force

inside_N = st.tuples(st.floats(-25, 25), st.floats(-25, 25), st.floats(-35, 35))


def read(force_N, noise_N=0.0):
    return read_force(np.atleast_2d(np.asarray(force_N, float)), noise_N=noise_N, rng=rng_for(0, "force"))


@given(inside_N)
def test_within_its_range_a_quiet_sensor_says_the_force(force_N):
    read_N, clipped_n = read(force_N)
    np.testing.assert_array_equal(read_N[0], np.float32(force_N))
    assert clipped_n == 0


def test_past_its_range_it_says_the_range_and_counts_each_value():
    read_N, clipped_n = read([[25.1, 0, 0], [0, -1e4, 1e4], [0, 0, -36], [0, 0, 34.9]])
    np.testing.assert_array_equal(read_N, np.float32([[25, 0, 0], [0, -25, 35], [0, 0, -35], [0, 0, 34.9]]))
    assert clipped_n == 4


def test_noise_has_the_stated_spread_and_is_clipped_with_the_force():
    read_N, clipped_n = read(np.zeros((40_000, 3)), noise_N=1 / 160)
    np.testing.assert_allclose(read_N.std(axis=0), 1 / 160, rtol=0.02)  # four times 1 / sqrt(2 n)
    assert clipped_n == 0
    read_N, clipped_n = read(np.tile(FORCE_RANGE_N, (1000, 1)), noise_N=1 / 160)
    assert (read_N <= np.float32(FORCE_RANGE_N)).all()
    assert 1400 < clipped_n < 1600  # half of 3000, give or take 3.7 sd


def test_the_same_generator_gives_the_same_readings():
    assert read([1.0, 2.0, 3.0], 0.1)[0].tobytes() == read([1.0, 2.0, 3.0], 0.1)[0].tobytes()
