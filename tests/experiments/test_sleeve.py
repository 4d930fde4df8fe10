"""Tests of experiment sleeve, in which one large skin covers several boards.

The tests cover held-out indentations, borders between boards, the frame rate, scores, and the map of errors.
"""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import mean_squared_error

from pipeline.experiments.sleeve import (
    errors_mm,
    hold_out_last,
    lay_out,
    rate_hz,
    score_places,
    summarise,
)
from pipeline.scores import make_table
from reskin.data.rows import Rows
from reskin.schema import Readings
from reskin.seeds import rng_for

CROSS_MM = [(x + a, y + b) for y in (-38.1, -12.7, 12.7, 38.1) for x in (-12.7, 12.7) for a, b in ((0, 0), (7, 0))]
AREA = lay_out((50.8, 101.6), CROSS_MM, boards_n=(2, 4), pitch_mm=25.4)
SIDES_MM = np.array(AREA.sides_mm)


def rows_of(*pokes_n, readings_n=3):
    """Return rows of captures c0, c1, and so on.

    The arguments are the numbers of indentations of these captures.
    """
    capture = np.repeat([f"c{i}" for i in range(len(pokes_n))], [readings_n * n for n in pokes_n])
    f = len(capture)
    empty, who = np.zeros((f, 3), np.float32), np.array(["b0"] * f)
    indentation = np.repeat(np.arange(sum(pokes_n)), readings_n)
    return Rows(capture, who, who, empty, empty, np.zeros(f, np.int32), indentation, {})


def predictions(seed=0, n=60, wrong_mm=1.0):
    """Return true values (x, y, F), predictions, and the numbers of `n` indentations with three readings each."""
    rng = rng_for(seed, "answers")
    true = np.repeat(np.column_stack([rng.uniform((4, 4), SIDES_MM - 4, (n, 2)), rng.uniform(0, 3, n)]), 3, axis=0)
    return true, true + wrong_mm * rng.standard_normal(true.shape), np.repeat(np.arange(n), 3)


def readings_of(t_s, indentation, reading_i):
    f = len(t_s)
    column, empty = np.zeros(f, np.float32), np.zeros((f, 3), np.float32)
    return Readings(
        capture="c0", board="v0", skin="v0_s0", source="simulated", indentation=np.array(indentation, np.int32),
        pass_i=np.zeros(f, np.int32), reading_i=np.array(reading_i, np.int32), x_mm=column, y_mm=column,
        depth_mm=column, Fx_N=column, Fy_N=column, Fz_N=column, b_uT=empty, noload_uT=empty,
        temperature_degC=column[:, None], t_s=np.array(t_s, np.float64), n_contacts=np.zeros(f, np.int32),
    )  # fmt: skip


def test_borders_and_chips_of_two_by_four_boards_are_at_the_designed_places():
    assert AREA.borders_mm[0] == pytest.approx((25.4,))
    assert AREA.borders_mm[1] == pytest.approx((25.4, 50.8, 76.2))
    # These are the centre chip and the right chip of board 0.
    np.testing.assert_allclose(AREA.chips_mm[:2], [(12.7, 12.7), (19.7, 12.7)])
    np.testing.assert_allclose(AREA.chips_mm[-2:], [(38.1, 88.9), (45.1, 88.9)])


@given(st.lists(st.integers(6, 40), min_size=1, max_size=3), st.floats(0.1, 0.9))
def test_last_indentations_of_each_capture_are_held_out(pokes_n, test_fraction):
    rows = rows_of(*pokes_n)
    train, test = hold_out_last(rows, test_fraction)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, test])), np.arange(len(rows)))
    for i, n in enumerate(pokes_n):
        first, last = (np.unique(rows.indentation[part][rows.capture[part] == f"c{i}"]) for part in (train, test))
        assert first.max() < last.min()
        assert len(last) == round(test_fraction * n)


@given(st.floats(10, 400), st.floats(0, 1e3))
def test_frame_rate_is_measured_within_indentations(rate, pause_s):
    t_s = np.concatenate([np.arange(5), 5 + rate * pause_s + np.arange(5)]) / rate
    reading_i = [0, 1, 2, 3, 4] * 2
    found_hz = rate_hz([readings_of(t_s, [0] * 5 + [1] * 5, reading_i)])
    # Tolerance: times of up to 1e3 s are rounded by 1e-10 of a frame of 2.5 ms.
    assert found_hz == pytest.approx(rate, rel=1e-6)


def test_scores_equal_scikit_learn_and_loops():
    true, predicted, _ = predictions()
    near = AREA.near_border(true[:, :2])
    scored = score_places(true, predicted, near)
    far_mm = [np.hypot(p[0] - t[0], p[1] - t[1]) for t, p in zip(true, predicted, strict=True)]
    assert scored["mse_xy_mm2"] == pytest.approx(mean_squared_error(true[:, :2], predicted[:, :2]))
    assert scored["mse_f_N2"] == pytest.approx(mean_squared_error(true[:, 2], predicted[:, 2]))
    # The median of 180 values is the mean of the two in the middle.
    assert scored["median_error_mm"] == pytest.approx(np.sort(far_mm)[89:91].mean())
    assert scored["p95_error_mm"] == pytest.approx(np.quantile(far_mm, 0.95))
    of_part_mm = [far for far, one in zip(far_mm, near, strict=True) if one]
    assert scored["median_error_near_seam_mm"] == pytest.approx(np.median(of_part_mm))


def scores_of(**networks: list[np.ndarray]) -> pd.DataFrame:
    """Score the predictions of each network of each method; no place is near a border."""
    true, _, _ = predictions()
    rows = [
        {"method": method, "seed": seed} | score_places(true, predicted, np.zeros(len(true), bool))
        for method, by_seed in networks.items() for seed, predicted in enumerate(by_seed)
    ]  # fmt: skip
    return make_table(rows)


def test_numbers_of_each_method_are_means_over_its_networks():
    true, first, _ = predictions()
    second = true + 2 * (first - true)
    measured = {"chips_n": 16, "tested": {"near_seam": 0, "inside": 60}}
    numbers = summarise(scores_of(paper=[first, second], knn=[first]), measured)
    one_mm, two_mm = np.median(errors_mm(true, first)), np.median(errors_mm(true, second))
    assert numbers["median_error_mm"].mean == pytest.approx((one_mm + two_mm) / 2)
    assert (numbers["median_error_mm"].n, numbers["chips_n"]) == (2, 16)
    assert numbers["variants"]["knn"]["inside"]["median_error_mm"].mean == pytest.approx(one_mm)
    assert numbers["inside"]["pokes_n"] == 60
    assert "near_seam" not in numbers  # no press is near a border
