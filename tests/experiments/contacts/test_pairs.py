"""Tests of readings of two contacts, which are made by adding the field changes of two presses.

Other tests check predictions for such readings, and the thresholds above which a reading counts as two contacts.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.contacts import (
    TOLERANCE_MM,
    compare_prediction,
    detection_rates,
    draw_pairs,
    keep_aside,
    position_along_line,
    summarise_nested,
)
from reskin.data.grid import points_mm
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from tests.data import tables

SKINS = ("b0_s0", "b0_s1", "b1_s0")


def grid_rows(force=True):
    """Return rows of several skins. On each skin, each place of the grid is pressed twice, with random forces."""
    skins = np.repeat(SKINS, 130)
    rows = tables.rows([name[:2] for name in skins], skins)
    target = np.column_stack([np.tile(points_mm(), (6, 1)), rng_for(0, "force").uniform(0, 3, len(skins))])
    target[:, 2] = target[:, 2] if force else np.nan
    return replace(rows, target=target.astype(np.float32))


ROWS = grid_rows()
B0_ROWS = np.flatnonzero(ROWS.board == "b0")


def pairs_at(separation_mm, rows=ROWS, tested=B0_ROWS, pairs_n=80):
    return draw_pairs(rows, tested, separation_mm, pairs_n=pairs_n, rng=rng_for(0, "pairs", f"{separation_mm}"))


@given(st.sampled_from([2.0, 4.2, 6.0, 8.5, 12.0, 16.0]))
def test_pairs_are_on_one_skin_at_the_given_distance(separation_mm):
    pairs = pairs_at(separation_mm)
    assert (ROWS.skin[pairs.weaker] == ROWS.skin[pairs.stronger]).all()
    assert set(ROWS.board[pairs.weaker]) == {"b0"}
    apart_mm = np.linalg.norm(ROWS.target[pairs.weaker, :2] - ROWS.target[pairs.stronger, :2], axis=1)
    # The tolerance includes the rounding of 16 mm to single precision.
    assert np.abs(apart_mm - separation_mm).max() <= TOLERANCE_MM + 1e-5
    assert (ROWS.target[pairs.weaker, 2] <= ROWS.target[pairs.stronger, 2]).all()
    assert len(pairs.weaker) == 80


def test_place_is_paired_with_itself_only_at_distance_zero():
    same = pairs_at(0.0)
    np.testing.assert_array_equal(ROWS.target[same.weaker, :2], ROWS.target[same.stronger, :2])
    # The grid is scaled, so that neighbouring places are 0.4 mm apart. This is less than the tolerance of distances.
    close = replace(ROWS, target=(ROWS.target * [0.2, 0.2, 1]).astype(np.float32))
    pairs = pairs_at(0.4, rows=close)
    assert (close.target[pairs.weaker, :2] != close.target[pairs.stronger, :2]).any(axis=1).all()


def test_if_forces_are_unknown_the_weaker_contact_has_the_smaller_field():
    rows = grid_rows(force=False)
    pairs = pairs_at(4.0, rows=rows)
    length = [np.linalg.norm(rows.db_uT[side], axis=1) for side in (pairs.weaker, pairs.stronger)]
    assert (length[0] <= length[1]).all()
    numbers = compare_prediction(rows.target[pairs.weaker], rows.target[pairs.stronger], ROWS.target[pairs.weaker])
    assert not {"force_over_sum", "force_over_larger"} & set(numbers)


def test_reading_of_a_pair_is_the_sum_of_field_changes():
    pairs = pairs_at(6.0)
    for i in range(5):
        both = ROWS.db_uT[pairs.weaker[i]] + ROWS.db_uT[pairs.stronger[i]]
        np.testing.assert_array_equal(pairs.sum_uT(ROWS.db_uT)[i], both)


def test_distance_that_no_two_places_have_is_refused():
    with pytest.raises(ParamsError, match=r"31 mm apart, within 0.5 mm. Correct contacts.separations_mm"):
        pairs_at(31.0)


def contacts_of(*rows):
    return np.array(rows, np.float32)


def test_distances_and_forces_of_a_prediction_are_relative_to_both_contacts():
    weaker, stronger = contacts_of([0, 0, 1], [0, 0, 1]), contacts_of([4, 0, 3], [0, 8, 3])
    predicted = contacts_of([3, 0.5, 4], [0, 5, 2])
    numbers = compare_prediction(weaker, stronger, predicted)
    # Only the first prediction is within 1 mm of a contact, both in x and in y.
    assert numbers["near_either_pct"] == 50
    assert numbers["nearest_mm"] == pytest.approx((np.hypot(1, 0.5) + 3) / 2)
    assert numbers["along"] == pytest.approx((3 / 4 + 5 / 8) / 2)
    assert numbers["nearer_the_stronger_pct"] == 100
    assert numbers["force_over_sum"] == pytest.approx(6 / 8)
    assert numbers["force_over_larger"] == pytest.approx(6 / 6)


@given(st.floats(-1, 2), st.floats(-5, 5))
def test_moving_a_prediction_sideways_keeps_its_position_along_the_line_of_contacts(share, aside_mm):
    weaker, stronger = contacts_of([2, 3, 1]), contacts_of([5, 7, 2])
    foot = weaker[0] + share * (stronger - weaker)[0]
    predicted = contacts_of(foot + aside_mm * np.array([-0.8, 0.6, 0]))
    # The tolerance is that of single precision.
    assert position_along_line(weaker, stronger, predicted)[0] == pytest.approx(share, abs=1e-5)


@pytest.mark.parametrize(
    ("boards", "skins", "passes", "aside", "what"),
    [
        (["b0", "b1", "b2"], ["s0", "s1", "s2"], [0, 0, 0], [2], "board"),
        (["b0", "b0", "b0"], ["s0", "s1", "s1"], [0, 0, 1], [1, 2], "skin"),
        (["b0", "b0", "b0"], ["s0", "s0", "s0"], [0, 1, 2], [2], "pass"),
    ],
)
def test_rows_for_thresholds_are_of_another_board_or_else_another_skin_or_pass(boards, skins, passes, aside, what):
    fit, kept, unit = keep_aside(tables.rows(boards, skins, passes), np.arange(3))
    assert (kept.tolist(), unit) == (aside, what)
    assert sorted([*fit, *kept]) == [0, 1, 2]


def test_fitting_thresholds_raises_if_all_rows_are_of_one_pass_of_one_skin():
    with pytest.raises(ParamsError, match="of a single board, skin and pass"):
        keep_aside(tables.rows(["b0"] * 2, ["s0"] * 2), np.arange(2))


def scores(name, shift=0.0, n=400):
    return {"odd": rng_for(0, "scores", name).normal(shift, 1, n)}


def test_detection_threshold_does_not_depend_on_the_tested_single_contacts():
    aside, double = scores("aside"), {0.0: scores("same"), 4.0: scores("four", 2)}
    one = detection_rates(aside, scores("single"), double, 0.1)
    other = detection_rates(aside, scores("single", 5), double, 0.1)
    assert one["by_separation"][4.0]["detected_pct"] == other["by_separation"][4.0]["detected_pct"]
    assert detection_rates(aside, aside, double, 0.1)["false_alarm_pct"]["odd"] == pytest.approx(10, abs=100 / 400)


def test_overall_roc_area_excludes_pairs_whose_contacts_are_at_the_same_place():
    single, separated = scores("single"), scores("four", 2)
    found = detection_rates(scores("aside"), single, {0.0: scores("same", -9), 4.0: separated}, 0.1)
    assert found["auc"] == found["by_separation"][4.0]["auc"]
    assert found["by_separation"][0.0]["auc"]["odd"] < 0.01


def test_numbers_in_nested_dicts_are_averaged_over_boards():
    trees = [{"a": {"b": 1.0}, "c": 4.0}, {"a": {"b": 3.0}, "c": 6.0}]
    assert summarise_nested(trees) == {
        "a": {"b": {"mean": 2.0, "n": 2, "sd": pytest.approx(np.sqrt(2)), "values": [1.0, 3.0]}},
        "c": {"mean": 5.0, "n": 2, "sd": pytest.approx(np.sqrt(2)), "values": [4.0, 6.0]},
    }
    assert summarise_nested(trees[:1])["c"] == {"mean": 4.0, "n": 1}
