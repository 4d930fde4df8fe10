"""Tests of the scores of predictions."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from sklearn.metrics import r2_score

from reskin.metrics import METRICS, median_error_mm, register, score, score_groups

TRUE = np.array([[2.0, 2.0, 1.0], [4.0, 6.0, 2.0], [8.0, 8.0, 3.0], [16.0, 0.0, 0.5]])


def test_perfect_predictions_have_no_error_and_r2_of_one():
    found = score(TRUE, TRUE)
    assert {name: found[name] for name in METRICS} == {
        "accuracy_pct": 100.0, "mse_xy_mm2": 0.0, "mse_f_N2": 0.0, "r2_f": 1.0,
    }  # fmt: skip


@given(st.lists(st.tuples(st.floats(0, 10), st.floats(0, 10)), min_size=2, max_size=20))
@example([(5.357178012399851, 0.0)] * 3)
def test_r2_of_force_equals_scikit_learn(forces):
    true, predicted = (np.column_stack([np.zeros((len(forces), 2)), part]) for part in zip(*forces, strict=True))
    found, constant = score(true, predicted), true.copy()
    constant[:, 2] = true[:, 2].mean()
    if np.ptp(true[:, 2]) > 1e-3:
        assert found["r2_f"] == pytest.approx(r2_score(true[:, 2], predicted[:, 2]), rel=1e-6, abs=1e-9)
        assert score(true, constant)["r2_f"] == pytest.approx(0, abs=1e-9)
    if np.ptp(true[:, 2]) == 0:
        assert "r2_f" not in score(true, constant)


def test_accuracy_counts_predictions_within_one_millimetre_in_both_axes():
    error = np.array([[1.0, -1.0, 0.0], [1.01, 0.0, 0.0], [0.0, -1.01, 0.0], [0.5, 0.5, 0.0]])
    assert score(TRUE, TRUE + error)["accuracy_pct"] == 50.0


def test_place_error_equals_a_loop():
    rng = np.random.default_rng(0)
    predicted = TRUE + rng.normal(size=TRUE.shape)
    total = 0.0
    for i in range(len(TRUE)):
        for axis in (0, 1):
            total += (predicted[i, axis] - TRUE[i, axis]) ** 2
    # The tolerance is rounding, because the same terms are summed in another order.
    assert score(TRUE, predicted)["mse_xy_mm2"] == pytest.approx(total / (2 * len(TRUE)), rel=1e-12)


def test_rows_without_a_force_are_not_scored_for_force():
    true = TRUE.copy()
    true[1:, 2] = np.nan
    assert score(true, TRUE + [0, 0, 2.0])["mse_f_N2"] == 4.0
    true[0, 2] = np.nan
    assert "mse_f_N2" not in score(true, TRUE)


@given(st.floats(-5, 5), st.floats(-5, 5))
def test_registration_removes_a_constant_offset_of_places(dx_mm, dy_mm):
    shifted = TRUE + [dx_mm, dy_mm, 0.0]
    # The tolerance is the rounding of means of numbers below 32.
    assert score(TRUE, register(TRUE, shifted))["mse_xy_mm2"] == pytest.approx(0.0, abs=1e-24)


BOARD = np.repeat(["b0", "b1"], 2)
SKIN = np.array(["s0", "s1", "s1", "s2"])


def test_each_group_of_rows_is_scored_separately():
    predicted = TRUE + np.random.default_rng(1).normal(size=TRUE.shape)
    scores = score_groups(TRUE, predicted, BOARD, SKIN)
    assert scores["rows_n"] == 4
    assert scores["all"] == score(TRUE, predicted)
    assert scores["by_skin"]["s1"] == score(TRUE[1:3], predicted[1:3])


def test_registration_subtracts_one_offset_per_board():
    offset = np.where(BOARD == "b0", 3.0, -2.0)[:, None] * [1.0, 1.0, 0.0]
    scores = score_groups(TRUE, TRUE + offset, BOARD, SKIN)
    assert scores["all"]["accuracy_pct"] == 0.0
    assert scores["registered"]["accuracy_pct"] == 100.0


def test_median_place_error_is_the_median_of_distances():
    assert median_error_mm(TRUE[:3, :2], TRUE[:3, :2] + [[3.0, 4.0], [0.0, 1.0], [9.0, 9.0]]) == 5.0
