"""Tests of experiment touches, in which one or two numbered places of a pad are touched.

The pad is simulated. The field change of two touches is the sum of the field changes of the two single touches.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.optimize import lsq_linear

from pipeline.experiments.touches import (
    Touched,
    Touches,
    evaluate_detection,
    evaluate_forces,
    evaluate_places,
    evaluate_superposition,
    relative_residual,
    sort_recordings,
    split_by_time,
    tables,
    touched_rows,
)
from reskin.data.rows import Selection
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from tests.data.tables import readings as make_readings

PLACES = (1, 2, 3, 4)
SECTION = Touches(train_fraction=0.6, aside_fraction=0.2, false_alarm_fraction=0.05)
NOISE_uT = 2.0


def pad(rows_n=40):
    """Return recordings of touches at each place and at each pair of places.

    Each place has a direction in the space of channels. The field change is the sum over the touched places of the
    force times the direction of the place, plus noise.
    """
    rng = rng_for(0, "touches", "pad")
    directions = dict(zip(PLACES, 400 * rng.normal(size=(len(PLACES), 15)), strict=True))
    result = []
    for places in [*((place,) for place in PLACES), *combinations(PLACES, 2)]:
        force_N = rng.uniform(1, 3, (rows_n, len(places)))
        db_uT = force_N @ np.stack([directions[place] for place in places]) + rng.normal(0, NOISE_uT, (rows_n, 15))
        result.append(Touched(str(places), places, db_uT.astype(np.float32), force_N.sum(axis=1).astype(np.float32)))
    sorted_ = sort_recordings(result)
    return sorted_.single, sorted_.double


@pytest.fixture(scope="module")
def split_pad():
    single, double = pad()
    return [split_by_time(one, SECTION) for one in single], double


def test_rows_are_split_into_training_threshold_and_test_rows_in_order_of_time():
    recording = pad()[0][0]
    blocks = split_by_time(recording, SECTION)
    parts = [blocks.train, blocks.aside, blocks.test]
    assert [len(part.db_uT) for part in parts] == [24, 8, 8]
    np.testing.assert_array_equal(np.concatenate([part.db_uT for part in parts]), recording.db_uT)


def test_residual_equals_the_residual_of_bounded_least_squares():
    rng = rng_for(0, "touches", "left over")
    known = {place: rng.normal(size=15) for place in PLACES}
    db_uT = rng.normal(0, 100, (5, 15)).astype(np.float32)
    basis = np.stack([known[2], known[4]], axis=1)
    costs = [lsq_linear(basis, row.astype(float), (0, np.inf)).cost for row in db_uT]
    naive = np.sqrt(2 * np.array(costs)) / np.linalg.norm(db_uT.astype(float), axis=1)
    # The relative tolerance is for the difference between two solvers of least squares.
    np.testing.assert_allclose(relative_residual(known, (2, 4), db_uT), naive, rtol=1e-6)


def test_residual_is_small_only_for_the_pair_of_places_that_is_touched(split_pad):
    blocks, double = split_pad
    numbers = evaluate_superposition(blocks, double)
    assert len(numbers["pairs"]) == 6
    for pair in numbers["pairs"]:
        assert pair["rank"] == 1
        # The noise is 8 uT in each of 15 channels, and the field changes are about 4000 uT.
        assert pair["left_over_pct"] < 2
        assert pair["best_alone_pct"] > 10 * pair["left_over_pct"]


def test_touch_of_a_place_that_was_not_in_training_is_taken_for_two_touches(split_pad):
    result = evaluate_detection(*split_pad, SECTION, 0)
    for name in result["detected_pct"]:
        assert result["unseen_place_called_two_pct"][name] > 90
    assert result["detected_pct"]["direction above noise"] > 90
    assert result["sums_called_two_pct"]["direction above noise"] > 90


def test_touched_places_and_forces_are_predicted(split_pad):
    blocks, double = split_pad
    place, force = evaluate_places(blocks, double), evaluate_forces(blocks, rng_for(0, "touches", "force"))
    assert place["by_time"]["mean"] == 100
    assert place["by_time"]["chance_pct"] == 25
    assert force["by_time"]["mean"] < 0.02 * force["variance"]["mean"]


def test_recordings_without_the_number_of_a_place_are_refused():
    readings = make_readings(f=60, Fz_N=np.linspace(0, 2, 60, dtype=np.float32))
    result = touched_rows(readings, {"rows_n": 60, "place_7_rows_n": 60}, Selection(force_min_N=1.0))
    assert result.places == (7,)
    assert result.force_N.min() >= 1
    with pytest.raises(ParamsError, match="one or two numbered places are needed"):
        touched_rows(readings, {"rows_n": 60}, Selection(force_min_N=1.0))


def test_unusable_recordings_are_omitted_with_a_reason():
    single, double = pad()
    short = replace(single[0][:19], name="short")
    again = replace(single[1], name="second of place 2")
    result = sort_recordings([*single[1:], again, short, *double])
    assert [one.name for one in result.single] == [one.name for one in single[1:]]
    assert result.problem is None
    assert result.left_out["short"] == "19 rows with enough force, but 20 are needed"
    assert result.left_out["second of place 2"] == "recording (2,) of place 2 alone is used instead"
    without_1 = [one for one in double if 1 not in one.places]
    assert [one.name for one in result.double] == [one.name for one in without_1]
    assert result.left_out["(1, 2)"] == "no recording of place 1 alone"


def test_result_states_why_recordings_of_pairs_alone_cannot_be_used():
    _, double = pad()
    result = sort_recordings(double)
    assert (
        result.problem
        == "places recorded alone: 0; at least 2 are needed. Add recordings of single places to the scene."
    )
    numbers = {
        "force_min_N": 0.5, "single": {"recordings_n": 0, "rows_n": 0}, "double": {"recordings_n": 0, "rows_n": 0},
        "left_out": result.left_out, "not_computed": result.problem,
    }  # fmt: skip
    shown = tables(numbers, "recorded")
    assert list(shown) == ["touches"]
    assert shown["touches"]["not used because"].tolist()[0] == result.problem
    assert len(shown["touches"]) == 1 + len(double)


def test_fractions_that_leave_no_test_rows_are_refused():
    with pytest.raises(ValidationError, match="the rest are the test rows"):
        Touches(train_fraction=0.8, aside_fraction=0.2, false_alarm_fraction=0.05)


def test_table_of_pairs_shows_only_touched_pairs(split_pad):
    blocks, double = split_pad
    for pairs in (double, []):
        numbers = {
            "force_min_N": 0.5, "single": {"recordings_n": 4, "rows_n": 160},
            "double": {"recordings_n": len(pairs), "rows_n": 40 * len(pairs)}, "place": evaluate_places(blocks, pairs),
            "force": evaluate_forces(blocks, rng_for(0, "touches", "force")),
            "superposition": evaluate_superposition(blocks, pairs),
            "detection": evaluate_detection(blocks, pairs, SECTION, 0),
        }  # fmt: skip
        shown = tables(numbers, "recorded")
        assert ("touches_superposition" in shown) == bool(pairs)
        assert ("two touches reported as two, %" in shown["touches_detection"]) == bool(pairs)
        assert all((table["source"] == "recorded").all() for table in shown.values())
