"""Tests of likelihood powers and of the variance inflation from cross-validated labels.

A likelihood is raised to a power below 1, so that intervals are not too narrow if errors of the model are correlated.
"""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.calibration import (
    PRIOR_N,
    LikelihoodPowers,
    folds_of_labels,
    lower_by_misfit,
    lower_by_residuals,
    variance_inflation,
    variance_inflations,
)
from reskin.universal.map import Estimate


def estimate(off_mm: np.ndarray, sd_mm: float) -> Estimate:
    nothing = np.zeros(len(off_mm))
    return Estimate(off_mm, np.full(off_mm.shape, sd_mm), nothing, nothing, nothing)


@pytest.mark.parametrize("labels_n", [0, 1, 3, 5, 12, 40])
def test_cross_validation_holds_out_every_label_once(labels_n):
    parts = folds_of_labels(labels_n)
    assert sorted(i for _, held_out in parts for i in held_out) == list(range(labels_n))
    assert all(sorted([*kept, *held_out]) == list(range(labels_n)) for kept, held_out in parts)
    assert all(len(held_out) for _, held_out in parts)


def test_variance_inflation_is_1_for_normal_residuals_and_4_for_doubled_ones():
    off = np.abs(rng_for(0, "residuals").standard_normal((200_000, 2)))
    assert variance_inflation(off) == pytest.approx(1, abs=0.01)
    assert variance_inflation(2 * off) == pytest.approx(4, rel=0.01)


def test_variance_inflation_from_few_residuals_is_shrunk_to_one():
    assert variance_inflation(np.zeros((0, 2))) == 1
    none_off = variance_inflation(np.zeros((5, 2)))
    assert none_off == pytest.approx((PRIOR_N / (PRIOR_N + 10)) ** 2)
    assert (
        none_off
        < 1
        < variance_inflation(np.full((1, 2), 3.0))
        < variance_inflation(np.full((20, 2), 3.0))
        < 9 / (2 / np.pi)
    )


def test_variance_inflation_is_estimated_for_each_likelihood_power():
    at_mm, off_mm = np.zeros((20, 2)), np.ones((20, 2))
    parts = [([estimate(off_mm, 1.0), estimate(off_mm, 0.25)], at_mm)] * 2
    assert variance_inflations(2, parts) == pytest.approx(
        [variance_inflation(np.ones((40, 2))), variance_inflation(np.full((40, 2), 4.0))]
    )
    assert variance_inflations(2, []) == [1, 1]


def test_likelihood_powers_are_at_most_one():
    assert [lower_by_misfit(0.5, misfit) for misfit in (0.1, 1.0, 2.0)] == [1.0, 0.5, 0.25]
    assert [lower_by_residuals(0.5, of) for of in (0.1, 1.0, 2.0)] == [1.0, 0.5, 0.25]


def test_likelihood_powers_are_interpolated_between_numbers_of_labels():
    powers = LikelihoodPowers({0: {0: 0.9, 10: 0.9}, 12: {0: 0.8, 10: 0.2}}, {0: 0.3})
    assert [powers.power_for(12, n, even=False) for n in (0, 5, 10, 99)] == pytest.approx([0.8, 0.4, 0.2, 0.2])
    assert [powers.power_for(n, 0, even=False) for n in (0, 11, 12, 65)] == pytest.approx([0.9, 0.9, 0.8, 0.8])
    assert [powers.are_enough(n) for n in (0, 11, 12, 65)] == [False, False, True, True]
    assert powers.power_for(65, 7, even=True) == pytest.approx(0.3)
