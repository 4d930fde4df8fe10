"""Tests of the answers to the question whether models work on a skin that was not in training."""

import pytest

from pipeline.report.answers import (
    ANSWER,
    NO,
    PARTLY,
    RIG,
    SHIPPED,
    UNTESTED,
    YES,
    answers,
    force_level,
    level,
    rms,
)
from pipeline.statistics import Stat
from tests.report.synthetic import all_experiments, new_board


def over(mean: float, low: float, high: float) -> dict:
    return {"mean": mean, "n": 6, "sd": 1.0, "ci95": [low, high]}


def row(accuracy: dict, r2: dict, mse_f_N2: float = 0.25) -> dict:
    return {
        "accuracy_pct": accuracy,
        "mse_xy_mm2": over(0.49, 0.36, 0.64),
        "mse_f_N2": over(mse_f_N2, mse_f_N2 / 2, mse_f_N2 * 2),
        "r2_f": r2,
    }


def scene(accuracy: dict, r2: dict, source: str = "simulated") -> dict:
    return all_experiments(source) | {
        "table2": {"multi": row(over(50.0, 40.0, 60.0), over(0.2, 0.1, 0.3)), "adapted": row(accuracy, r2)},
        "constant_force": {"table2": {"mse_f_N2": {"mean": 1.96, "n": 6}}},
    }


@pytest.mark.parametrize(
    ("accuracy", "reached"),
    [
        (over(95.0, 91.0, 98.0), YES),
        (over(95.0, 85.0, 98.0), PARTLY),  # The interval includes the required accuracy.
        (over(78.7, 72.1, 84.2), PARTLY),
        (over(30.0, 20.0, 60.0), NO),
        ({"mean": 92.0, "n": 2, "values": [91.0, 93.0]}, YES),
        # One of the two boards does not reach the required accuracy.
        ({"mean": 92.0, "n": 2, "values": [89.0, 95.0]}, PARTLY),
    ],
)
def test_answer_on_places_is_yes_only_if_the_whole_interval_reaches_the_limit(accuracy, reached):
    assert answers(scene(accuracy, over(0.8, 0.7, 0.9))).place.level == reached


@pytest.mark.parametrize(
    ("r2", "reached"), [(over(0.95, 0.92, 0.97), YES), (over(0.76, 0.6, 0.85), PARTLY), (over(0.2, 0.1, 0.3), NO)]
)
def test_answer_on_forces_depends_on_r2(r2, reached):
    force = answers(scene(over(80.0, 70.0, 90.0), r2)).force
    assert (force.level, force_level(r2)) == (reached, reached)


def test_answer_describes_the_best_model_that_needs_no_labels():
    found = answers(scene(over(80.0, 70.0, 88.0), over(0.8, 0.7, 0.9)))
    assert [effort.scores["accuracy_pct"]["mean"] for effort in found.efforts] == [50.0, 80.0]
    assert found.efforts[1].cells["place: rms error"] == "0.70 mm [0.60, 0.80]"


@pytest.mark.parametrize("methods", [(SHIPPED,), (SHIPPED, RIG)])
def test_answer_is_about_boards_that_were_never_seen_if_they_were_tested(methods):
    found = answers(all_experiments("recorded") | {"new_board": new_board(methods)})
    best = found.efforts[3 * (len(methods) - 1)]  # the last method without labels
    assert (best.role, best.labels_n, best.scores["accuracy_pct"]["mean"]) == (ANSWER, 0, 20.0 + 20 * len(methods))
    assert [effort.labels_n for effort in found.efforts] == [0, 10, 40] * len(methods)
    assert (found.place.level, found.force.level) == (PARTLY if RIG in methods else NO, NO)


def test_scene_without_held_out_boards_does_not_say_how_well_new_skins_work():
    alone = {name: value for name, value in all_experiments("recorded").items() if name != "table2"}
    found = answers(alone)
    assert (found.place.level, found.force.level, found.efforts) == (UNTESTED, UNTESTED, ())
    bare = {name: value for name, value in alone.items() if not name.startswith("single")}
    assert answers(bare).place.sentences == ()


def test_recordings_without_forces_have_no_answer_on_forces():
    numbers = scene(over(80.0, 70.0, 88.0), over(0.8, 0.7, 0.9), "recorded")
    for name in ("mse_f_N2", "r2_f"):
        del numbers["table2"]["adapted"][name]
    found = answers(numbers)
    assert (found.place.level, found.force.level) == (PARTLY, UNTESTED)
    assert found.efforts[-1].cells["force: rms error"] == "–"


def test_rms_of_squared_errors_has_no_standard_deviation():
    assert rms({"mean": 4.0, "n": 2, "sd": 1.0, "values": [1.0, 9.0]}) == Stat(2.0, 2, values=(1.0, 3.0))
    assert rms(None) is None


def test_answer_depends_on_the_mean_if_there_is_no_interval():
    assert [level({"mean": value, "n": 1}, 90.0, 50.0) for value in (90.0, 89.9, 49.9)] == [YES, PARTLY, NO]
