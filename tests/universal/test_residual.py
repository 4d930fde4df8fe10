"""Tests of the residual model, which predicts the part of the law's errors that is common to all boards.

The law is the formula that gives the field change for a place and a force.
"""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.map import NOISE, SHARED, fit_residual, kernel, no_residual

# The places are so far apart that errors at different places are not correlated.
APART_MM = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0]])
FORCE_N = np.ones(3)
ERRORS = rng_for(0, "missed").standard_normal((3, 15))


@pytest.mark.parametrize("boards_n", [1, 2, 5])
def test_errors_that_all_boards_share_are_predicted_for_a_new_board(boards_n):
    found = fit_residual([APART_MM] * boards_n, [FORCE_N] * boards_n, [ERRORS] * boards_n).at(APART_MM, np.zeros(3))
    # Expected: the conditional mean of a normal variable, given n equal values. Each value has the variance 1 + NOISE.
    # The covariance of two boards is SHARED, and so is the covariance of each board with the new board.
    part = boards_n * SHARED / (1 + NOISE + (boards_n - 1) * SHARED)
    np.testing.assert_allclose(found, part * ERRORS, rtol=1e-9)


def test_predicted_error_is_zero_far_from_presses_or_without_boards():
    far_mm = np.array([[100.0, 100.0]])
    assert np.abs(fit_residual([APART_MM], [FORCE_N], [ERRORS]).at(far_mm, np.zeros(1))).max() < 1e-9
    assert (no_residual(15).at(far_mm, np.zeros(1)) == 0).all()


def test_order_of_boards_does_not_matter():
    one = fit_residual([APART_MM, APART_MM + 1], [FORCE_N, 2 * FORCE_N], [ERRORS, ERRORS**2])
    other = fit_residual([APART_MM + 1, APART_MM], [2 * FORCE_N, FORCE_N], [ERRORS**2, ERRORS])
    np.testing.assert_allclose(one.at(APART_MM, np.zeros(3)), other.at(APART_MM, np.zeros(3)), rtol=1e-9)
    np.testing.assert_allclose(one.channel_cov, other.channel_cov)
    assert np.trace(one.channel_cov) == pytest.approx(1)


def test_kernel_is_squared_exponential():
    place_mm, log_N = np.array([[0.0, 0.0], [3.0, 0.0]]), np.array([0.0, 1.2])
    expected = [[1, np.exp(-0.5)], [np.exp(-0.5), 1]]
    np.testing.assert_allclose(kernel(place_mm, place_mm, np.zeros(2), np.zeros(2)), expected)
    np.testing.assert_allclose(kernel(place_mm[:1], place_mm[:1], log_N[:1], log_N[1:]), [[np.exp(-0.5)]])
