"""Tests of the compiled loop that sums the change of field of moving dipoles.

It is compared with a NumPy loop and magpylib, must be linear, and must return exact zeros where nothing changes.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.extremes.physics import dipoles
from reskin.physics import magnet
from reskin.physics.magnet import change_of_field
from reskin.seeds import rng_for
from tests.laws import LIMITS

# This is the rounding error of a few thousand double-precision operations, relative to the sum of the magnitudes.
ROUNDING = 1e-12
seeds = st.integers(0, 10**6)


@pytest.fixture(autouse=True, scope="module")
def compiled():
    """Compile the loop before the tests, because Hypothesis limits the time of each example."""
    change_of_field(*scene(0))


def naive(rest, moved, observers_m):
    """Return the reference: the sum of the field differences of all dipoles, in a NumPy loop."""
    after_T = magnet.field_of_each(*moved, observers_m)
    return (after_T - magnet.field_of_each(*rest, observers_m)).sum(axis=1)


def scene(seed, nodes_n=200):
    """Return dipoles before and after a move, and the places of observers.

    The dipoles move by about 0.1 mm, and their moments change by about 10 %. No dipole and no observer is at the
    origin.
    """
    rng = rng_for(seed, "change")
    nodes_m = rng.uniform((2e-3, -9e-3, 1e-3), (9e-3, 4e-3, 3e-3), size=(nodes_n, 3))
    moments = 1e-5 * rng.normal(size=(nodes_n, 3))
    moved = nodes_m + 1e-4 * rng.normal(size=nodes_m.shape), moments + 1e-6 * rng.normal(size=nodes_m.shape)
    return (nodes_m, moments), moved, rng.uniform((-3e-3, -3e-3, -2e-3), (3e-3, 3e-3, -1e-3), size=(5, 3))


def size_T(rest, moved, observers_m):
    return np.abs(magnet.field_of_each(*rest, observers_m)).sum()


@given(seeds)
def test_compiled_sum_equals_naive_sum(seed):
    args = scene(seed)
    np.testing.assert_allclose(change_of_field(*args), naive(*args), atol=ROUNDING * size_T(*args))


@given(seeds, st.floats(-5, 5).filter(lambda factor: abs(factor) > 1e-6))
def test_field_change_equals_that_of_magpylib_and_is_linear_in_the_moments(seed, factor):
    assert dipoles(seed)[1] <= LIMITS["dipoles_moved"]
    (nodes_m, moments), (moved_m, turned), chips_m = scene(seed)
    once_T = change_of_field((nodes_m, moments), (moved_m, turned), chips_m)
    more_T = change_of_field((nodes_m, factor * moments), (moved_m, factor * turned), chips_m)
    np.testing.assert_allclose(more_T, factor * once_T, atol=ROUNDING * np.abs(factor * once_T).max())


def test_empty_set_of_dipoles_does_not_change_the_field():
    nothing = (np.zeros((0, 3)), np.zeros((0, 3)))
    assert not change_of_field(nothing, nothing, np.ones((2, 3))).any()


def test_field_change_by_a_tiny_move_is_precise():
    # Reference: the derivative of the field along the move. For a move of 1e-9 m, the change is only 1e-6 of the field,
    # so a difference of two fields would lose six digits.
    (nodes_m, moments), _, observers_m = scene(3)
    step_m = np.array([1e-9, 0.0, 0.0])
    found_T = change_of_field((nodes_m, moments), (nodes_m + step_m, moments), observers_m)
    wide_m = 1e3 * step_m
    ahead_T, behind_T = (magnet.field(nodes_m + side * wide_m, moments, observers_m) for side in (1, -1))
    # The relative tolerance covers the terms of next order, (1e-6 m / 3e-3 m)^2 and 1e-9 m / 3e-3 m.
    np.testing.assert_allclose(found_T, (ahead_T - behind_T) / 2e3, rtol=1e-4)
