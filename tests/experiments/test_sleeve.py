"""Tests of experiment sleeve, in which one large skin covers several boards.

The tests cover held-out indentations, borders between boards, the frame rate, scores and the map of errors.
"""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import mean_squared_error

from pipeline.experiments.sleeve import (
    NEAR_MM,
    Area,
    draw_errors,
    errors_mm,
    figures,
    hold_out_last,
    lay_out,
    over_seeds,
    rate_hz,
    score_places,
    tables,
)
from reskin.data.rows import Rows
from reskin.errors import ParamsError
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


def test_single_board_has_no_border():
    assert lay_out((20.0, 20.0), [(0.0, 0.0)], boards_n=(1, 1), pitch_mm=0.0).borders_mm == ((), ())


@given(st.floats(0, 50.8), st.floats(0, 101.6))
def test_place_is_near_a_border_if_any_border_is_near(x_mm, y_mm):
    to_border_mm = min(abs(x_mm - 25.4), *(abs(y_mm - border_mm) for border_mm in AREA.borders_mm[1]))
    assert AREA.near_border(np.array([[x_mm, y_mm]]))[0] == (to_border_mm < NEAR_MM)


@given(st.lists(st.integers(6, 40), min_size=1, max_size=3), st.floats(0.1, 0.9))
def test_last_indentations_of_each_capture_are_held_out(pokes_n, test_fraction):
    rows = rows_of(*pokes_n)
    train, test = hold_out_last(rows, test_fraction)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, test])), np.arange(len(rows)))
    for i, n in enumerate(pokes_n):
        first, last = (np.unique(rows.indentation[part][rows.capture[part] == f"c{i}"]) for part in (train, test))
        assert first.max() < last.min()
        assert len(last) == round(test_fraction * n)


@pytest.mark.parametrize("test_fraction", [0.05, 0.99])
def test_split_without_training_or_test_rows_is_refused(test_fraction):
    with pytest.raises(ParamsError, match="would be held out, but training and test need"):
        hold_out_last(rows_of(9), test_fraction)


@given(st.floats(10, 400), st.floats(0, 1e3))
def test_frame_rate_is_measured_within_indentations(rate, pause_s):
    t_s = np.concatenate([np.arange(5), 5 + rate * pause_s + np.arange(5)]) / rate
    reading_i = [0, 1, 2, 3, 4] * 2
    found_hz = rate_hz([readings_of(t_s, [0] * 5 + [1] * 5, reading_i)])
    # Tolerance: times of up to 1e3 s are rounded by 1e-10 of a frame of 2.5 ms.
    assert found_hz == pytest.approx(rate, rel=1e-6)


def test_frame_rate_cannot_be_measured_from_single_readings():
    with pytest.raises(ParamsError, match="is computed from successive readings of the same indentation"):
        rate_hz([readings_of([0.0, 1.0], [0, 1], [0, 0])])


def test_scores_equal_scikit_learn_and_loops():
    true, predicted, indentation = predictions()
    scored = score_places(true, [predicted], indentation, AREA)
    far_mm = [np.hypot(p[0] - t[0], p[1] - t[1]) for t, p in zip(true, predicted, strict=True)]
    assert scored["mse_xy_mm2"]["mean"] == pytest.approx(mean_squared_error(true[:, :2], predicted[:, :2]))
    assert scored["mse_f_N2"]["mean"] == pytest.approx(mean_squared_error(true[:, 2], predicted[:, 2]))
    # The median of 180 values is the mean of the two in the middle.
    assert scored["median_error_mm"]["mean"] == pytest.approx(np.sort(far_mm)[89:91].mean())
    assert scored["p95_error_mm"]["mean"] == pytest.approx(np.quantile(far_mm, 0.95))
    near = [far for far, one in zip(far_mm, true, strict=True) if AREA.near_border(one[None, :2])[0]]
    assert scored["near_seam"]["median_error_mm"]["mean"] == pytest.approx(np.median(near))
    assert 3 * scored["near_seam"]["pokes_n"] == len(near)
    assert scored["near_seam"]["pokes_n"] + scored["inside"]["pokes_n"] == 60


@given(st.floats(0, 20), st.integers(0, 100))
def test_all_place_errors_equal_the_offset_that_all_predictions_share(off_mm, seed):
    true, _, indentation = predictions(seed)
    scored = score_places(true, [true + (0.6 * off_mm, -0.8 * off_mm, 0.0)], indentation, AREA)
    for part in (scored, scored["near_seam"], scored["inside"]):
        assert part["median_error_mm"]["mean"] == pytest.approx(off_mm, abs=1e-9)
    assert scored["p95_error_mm"]["mean"] == pytest.approx(off_mm, abs=1e-9)


def test_border_scores_are_missing_if_no_press_is_near_a_border():
    alone = lay_out((50.8, 101.6), [(0.0, 0.0)], boards_n=(1, 1), pitch_mm=0.0)
    true, predicted, indentation = predictions()
    scored = score_places(true, [predicted], indentation, alone)
    assert "near_seam" not in scored
    assert scored["inside"]["pokes_n"] == 60


def test_scores_have_mean_and_standard_deviation_over_seeds():
    assert over_seeds([{"a": 1.0}]) == {"a": {"mean": 1.0, "n": 1}}
    two = over_seeds([{"a": 1.0}, {"a": 3.0}])["a"]
    assert (two["mean"], two["n"], two["sd"]) == (2.0, 2, pytest.approx(np.sqrt(2)))


def test_each_tested_indentation_is_plotted_once():
    true, predicted, indentation = predictions(n=20)
    order = rng_for(0, "order").permutation(60)
    plotted = draw_errors(AREA, true[order], errors_mm(true, predicted)[order], indentation[order])
    np.testing.assert_allclose(plotted["x_mm"], true[::3, 0], atol=0.0051)  # Plotted places are rounded to 0.01 mm.
    np.testing.assert_allclose(plotted["error_mm"], errors_mm(true, predicted).reshape(20, 3).mean(axis=1), atol=0.0051)
    assert len(plotted["chips_x_mm"]) == len(CROSS_MM)
    assert (plotted["borders_x_mm"], plotted["area_mm"]) == ([pytest.approx(25.4)], [50.8, 101.6])
    assert isinstance(AREA, Area)


SVG = "{http://www.w3.org/2000/svg}"


def numbers_and_figure_data(n=40):
    true, predicted, indentation = predictions(n=n)
    others = {"shape": [predicted, true], "knn-raw": [predicted]}
    numbers = {
        "chips_n": 16, "rate_hz": 132.98, "area_mm": list(AREA.sides_mm), "pokes_n": 5 * n, "trained_n": 4 * n,
        "tested_n": n, "near_mm": NEAR_MM, **score_places(true, [predicted], indentation, AREA),
        "variants": {name: score_places(true, outputs, indentation, AREA) for name, outputs in others.items()},
    }  # fmt: skip
    return numbers, draw_errors(AREA, true, errors_mm(true, predicted), indentation)


def test_table_lists_methods_without_a_number_of_the_paper():
    numbers, _ = numbers_and_figure_data()
    table = tables(numbers, "simulated")["sleeve"]
    assert table["method"].tolist() == ["the paper's network", "network, recipe shape", "k nearest neighbours (dB)"]
    assert set(table["source"]) == {"simulated"}
    assert set(table["paper"]) == {"none, only a demonstration"}
    assert table["seeds"].tolist() == ["1", "2", "1"]
    assert "±" in table["accuracy, %"][1]
    assert "column `seeds` gives their number" in table.attrs["spread"]
    # The table gives three digits.
    assert float(table["median error, mm"][0]) == pytest.approx(numbers["median_error_mm"]["mean"], rel=5e-3)
    near = numbers["near_seam"]["median_error_mm"]["mean"]
    assert float(table["median error near a border, mm"][0]) == pytest.approx(near, rel=5e-3)
    assert f"first {4 * 40} pokes" in table.attrs["meaning"]


def test_table_has_a_dash_for_border_errors_if_no_press_is_near_a_border():
    numbers, _ = numbers_and_figure_data()
    del numbers["near_seam"]
    table = tables(numbers, "simulated")["sleeve"]
    assert table["median error near a border, mm"][0] == "–"
    assert "0 are less than" in table.attrs["meaning"]


def test_table_compares_our_skin_and_boards_with_those_of_the_paper():
    table = tables(numbers_and_figure_data()[0], "simulated")["sleeve_set_up"].set_index("what")
    assert table.loc["chips", ["ours", "paper"]].tolist() == ["16", "40"]
    assert table.loc["rate, Hz", ["ours", "paper"]].tolist() == ["133.0", "133"]


def test_map_shows_tested_presses_chips_and_source():
    numbers, figure_data = numbers_and_figure_data()
    texts = figures(numbers, figure_data, "simulated")
    assert list(texts) == ["sleeve.svg"]
    marks = [
        len(group.findall(f".//{SVG}use")) for group in ElementTree.fromstring(texts["sleeve.svg"]).iter(f"{SVG}g")
    ]
    assert len(figure_data["x_mm"]) == 40
    assert len(figure_data["chips_x_mm"]) in marks
    assert 40 in marks
    text = " ".join(re.findall(r">([^<>]+)</text>", texts["sleeve.svg"]))
    for label in ("(simulated)", "x / mm", "y / mm", "place error", "border between boards"):
        assert label in text


def test_equal_predictions_and_source_give_an_equal_figure():
    numbers, figure_data = numbers_and_figure_data()
    once, again, other = (
        figures(numbers, figure_data, source)["sleeve.svg"] for source in ("simulated", "simulated", "x")
    )
    assert once == again
    assert once != other
    assert np.isfinite(figure_data["error_mm"]).all()
