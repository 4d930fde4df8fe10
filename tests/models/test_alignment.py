"""Tests of methods that align the field changes of a new skin with those of known skins.

The methods are compared with SciPy's matrix square roots, a known linear map, and leave-one-out errors.
"""

import numpy as np
import pytest
from scipy.linalg import sqrtm

from reskin.models.alignment import RIDGES, choose_ridge, coral, direct, match_channels
from reskin.seeds import rng_for


def draw_inputs(name: str, n: int = 80, c: int = 4) -> np.ndarray:
    """Return random inputs of a skin. Their channels are correlated, and have different scales and means."""
    rng = rng_for(0, "alignment", name)
    return rng.standard_normal((n, c)) @ rng.standard_normal((c, c)) * rng.uniform(1, 30, c) + rng.normal(0, 20, c)


SOURCE, TARGET = draw_inputs("of"), draw_inputs("to", n=70)


def test_matched_channels_have_the_means_and_deviations_of_the_target():
    moved = match_channels(SOURCE, TARGET)(SOURCE)
    np.testing.assert_allclose(moved.mean(axis=0), TARGET.mean(axis=0))
    np.testing.assert_allclose(moved.std(axis=0, ddof=1), TARGET.std(axis=0, ddof=1))


def test_matching_channels_recovers_gains_and_offsets():
    gains, offsets = np.array([0.5, 2.0, 1.3, 0.9]), np.array([3.0, -7.0, 0.0, 40.0])
    np.testing.assert_allclose(match_channels(SOURCE, SOURCE * gains + offsets)(SOURCE), SOURCE * gains + offsets)


def test_coral_inputs_have_the_covariance_of_the_target():
    moved = coral(SOURCE, TARGET, ridge=0.0)(SOURCE)
    np.testing.assert_allclose(np.cov(moved, rowvar=False), np.cov(TARGET, rowvar=False))
    np.testing.assert_allclose(moved.mean(axis=0), TARGET.mean(axis=0))


def test_coral_equals_a_product_of_square_roots_of_covariances():
    scale = SOURCE.std(axis=0, ddof=1)
    source, target = (np.cov(side / scale, rowvar=False) + np.eye(4) for side in (SOURCE, TARGET))
    expected = (SOURCE - SOURCE.mean(axis=0)) / scale @ np.linalg.inv(sqrtm(source)) @ sqrtm(
        target
    ) * scale + TARGET.mean(axis=0)
    np.testing.assert_allclose(coral(SOURCE, TARGET)(SOURCE), expected)


@pytest.mark.parametrize("align", [match_channels, coral])
def test_aligning_a_skin_with_itself_does_not_change_its_inputs(align):
    np.testing.assert_allclose(align(SOURCE, SOURCE)(SOURCE), SOURCE)


def test_constant_channel_is_shifted_but_not_scaled():
    source, target = SOURCE.copy(), TARGET.copy()
    source[:, 1], target[:, 1] = 3.0, 5.0
    np.testing.assert_allclose(match_channels(source, target)(source)[:, 1], 5.0)


def test_direct_standardisation_recovers_a_linear_map():
    known = np.eye(4) + 0.3 * rng_for(0, "known map").standard_normal((4, 4))
    np.testing.assert_allclose(direct(SOURCE, SOURCE @ known, 1e-12).matrix, known, rtol=1e-6)
    np.testing.assert_allclose(direct(SOURCE, SOURCE @ known, 1e12).matrix, np.eye(4), atol=1e-6)


def test_direct_standardisation_does_not_change_channels_that_no_pair_covers():
    pairs = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0]])
    found = direct(pairs, 3 * pairs, 1e-9)
    np.testing.assert_allclose(found(np.eye(4)), np.diag([3.0, 3.0, 1.0, 1.0]), atol=1e-6)


@pytest.mark.parametrize("noise", [0.01, 30.0])
def test_chosen_ridge_penalty_has_the_smallest_leave_one_out_error(noise):
    source = draw_inputs("pairs", n=9)
    to = source @ np.diag([1.5, 0.5, 1.0, 1.2]) + noise * rng_for(0, "noise").standard_normal(source.shape)

    def error(ridge: float) -> float:
        total = 0.0
        for i in range(len(source)):
            rest = np.delete(np.arange(len(source)), i)
            # The penalty is proportional to the sum of squares of all pairs, also when one pair is left out.
            held = ridge * (source**2).sum() / source.shape[1]
            gain = np.linalg.solve(
                source[rest].T @ source[rest] + held * np.eye(4), source[rest].T @ (to - source)[rest]
            )
            total += float((((to - source)[i] - source[i] @ gain) ** 2).sum())
        return total

    assert choose_ridge(source, to) == min(RIDGES, key=error)
