"""Tests of the answers to the question whether models work on a skin that was not in training."""

import pytest

from pipeline.paper import PLACE_ACCURACY_MIN_PCT, TABLE_2
from pipeline.report.answers import CHOSEN_ON, NO, PARTLY, UNTESTED, YES, answers, force_level, level, rms
from pipeline.report.figures import TESTED, WAYS
from tests.report.synthetic import all_experiments


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
    place = answers(scene(accuracy, over(0.8, 0.7, 0.9))).place
    assert place.level == reached
    assert ("not reached" in " ".join(place.sentences)) == (
        "ci95" in accuracy and accuracy["ci95"][1] < PLACE_ACCURACY_MIN_PCT
    )


@pytest.mark.parametrize(
    ("r2", "reached"), [(over(0.95, 0.92, 0.97), YES), (over(0.76, 0.6, 0.85), PARTLY), (over(0.2, 0.1, 0.3), NO)]
)
def test_answer_says_that_forces_are_not_usable_if_r2_is_low(r2, reached):
    force = answers(scene(over(80.0, 70.0, 90.0), r2)).force
    assert (force.level, force_level(r2)) == (reached, reached)
    assert ("not usable" in force.short) == (reached == NO)
    assert "rms error 0.50 N" in force.short
    assert "1.4 N" in force.short  # The mean force is 1.4 N.


def test_answer_describes_the_best_model_that_needs_no_labels():
    found = answers(scene(over(80.0, 70.0, 88.0), over(0.8, 0.7, 0.9)))
    assert found.place.short.startswith("80.0 % [70.0, 88.0] of readings are within 1 mm")
    assert f"Paper: {TABLE_2['adapted']['accuracy_pct'][0]:g} %" in " ".join(found.place.sentences)
    assert [effort.scores["accuracy_pct"]["mean"] for effort in found.efforts] == [50.0, 80.0]
    assert found.efforts[1].cells["place: rms error"] == "0.70 mm [0.60, 0.80]"


def labelled(method: str, labels_n: int, accuracy: float, r2: float) -> dict:
    stats = {"accuracy_pct": accuracy, "mse_xy_mm2": 0.5, "mse_f_N2": 1.0, "r2_f": r2}
    few = {name: {"mean": value, "n": 2, "values": [value - 0.1, value + 0.1]} for name, value in stats.items()}
    return {"method": method, "inputs": "raw", "labels_n": labels_n, "as_labelled": few}


def test_scores_with_labels_are_given_after_the_answer_without_labels():
    rows = [("network", 0, 31.0, -2.0), ("network", 40, 55.0, 0.1), ("universal, alone", 0, 71.0, 0.2)]
    rows += [("universal, alone", 10, 79.0, 0.4), ("universal, alone", 40, 91.0, 0.6)]
    found = answers(all_experiments("recorded") | {"labels": [labelled(*one) for one in rows]})
    assert (found.place.level, found.force.level) == (PARTLY, NO)
    assert found.place.short.startswith("71.0 %")
    compared = [sentence for sentence in found.place.sentences if sentence.endswith("within 1 mm.")]
    assert [sentence.rpartition(": ")[2].partition(" %")[0] for sentence in compared] == ["31.0", "91.0"]
    assert [effort.labels_n for effort in found.efforts] == [0, 0, 10, 40]
    assert "(partly usable)" in found.force.sentences[-1]


def few(low: float, high: float) -> dict:
    return {"mean": (low + high) / 2, "n": 2, "values": [low, high]}


def pressed(method: str, labels: str, accuracy: float, presses_n: int = 65) -> dict:
    scores = {"accuracy_pct": few(accuracy - 1, accuracy + 1), "r2_f": few(0.0, 0.2), "mse_f_N2": few(1.0, 4.0)}
    place = {"mse_xy_mm2": few(0.5, 0.7)}
    return {"tested": TESTED, "presses_n": presses_n, "method": method, "labels": labels} | scores | place


def test_answer_uses_experiment_random_presses_if_it_was_run():
    """In this experiment, tested presses are at other places than the labels."""
    rig, shipped = WAYS
    rows = [pressed(rig, "0", 65.0), pressed(rig, "10", 77.0), pressed(rig, "40", 87.0), pressed(rig, "0", 60.0, 12)]
    rows += [pressed(shipped, "0", 43.0), pressed(shipped, "40", 76.0), pressed(rig, "weight", 70.0)]
    numbers = all_experiments("recorded") | {"labels": [labelled("network", 0, 31.0, -2.0)]}
    found = answers(numbers | {"random_presses": {"draws_n": 10, "rows": rows}})
    assert found.place.short.startswith("65.0 % (64.0; 66.0)")
    assert found.place.second == f"Universal model (ours), {WAYS[shipped]}: 43.0 % (42.0; 44.0) within 1 mm."
    assert "With 40 labelled presses: 87.0 % (86.0; 88.0) within 1 mm." in found.place.sentences
    # The rms error is the mean over the two boards.
    assert found.force.short.startswith("not usable; rms error 1.5 N")
    assert "needs from the new skin: 65 presses without labels." in found.tested
    assert "optimistic" not in found.tested
    numbers["provenance"] = numbers["provenance"] | {"scene": CHOSEN_ON}
    assert "so the scores are optimistic" in answers(numbers | {"random_presses": {"draws_n": 10, "rows": rows}}).tested


def test_answer_states_the_numbers_of_boards_and_skins_if_the_protocol_is_missing():
    numbers = scene(over(86.0, 78.0, 91.5), over(0.8, 0.7, 0.9))
    numbers["described"] = {"grid": {"over_skins": {"rest_changes_in_1_uT": {"mean": 5.0, "n": 18}}}}
    del numbers["protocol"]
    numbers["lobo"]["by_board"] = {f"b{i}": {"trained_on_skins_n": 15} for i in range(6)}
    assert answers(numbers).tested.startswith("Tested on 6 simulated boards with 18 skins")


def test_scene_without_held_out_boards_does_not_say_how_well_new_skins_work():
    alone = {name: value for name, value in all_experiments("recorded").items() if name != "table2"}
    found = answers(alone)
    assert (found.place.level, found.force.level, found.efforts) == (UNTESTED, UNTESTED, ())
    assert "held-out readings" in found.place.sentences[0]
    seen = {"hover": {"screw": {"seen": True}}, "single_skins": {"screw": {"accuracy_pct": 100.0, "mse_xy_mm2": 0.1}}}
    assert "without touch" in answers(alone | seen).place.sentences[0]
    bare = {name: value for name, value in alone.items() if not name.startswith("single")}
    assert answers(bare).place.sentences == ()


def test_recordings_without_forces_have_no_answer_on_forces():
    numbers = scene(over(80.0, 70.0, 88.0), over(0.8, 0.7, 0.9), "recorded")
    for name in ("mse_f_N2", "r2_f"):
        del numbers["table2"]["adapted"][name]
    found = answers(numbers)
    assert (found.place.level, found.force.level) == (PARTLY, UNTESTED)
    assert found.efforts[-1].cells["force: rms error"] == "–"


def test_answer_from_a_simulated_scene_says_that_it_is_no_evidence_about_real_skins():
    simulated, recorded = (
        answers(scene(over(80.0, 70.0, 88.0), over(0.8, 0.7, 0.9), source)).tested
        for source in ("simulated", "recorded")
    )
    assert "no evidence about real skins" in simulated
    assert "no evidence" not in recorded


def test_rms_of_squared_errors_has_no_standard_deviation():
    assert rms({"mean": 4.0, "n": 2, "sd": 1.0, "values": [1.0, 9.0]}) == {"mean": 2.0, "n": 2, "values": [1.0, 3.0]}
    assert rms(None) is None


def test_answer_depends_on_the_mean_if_there_is_no_interval():
    assert [level({"mean": value, "n": 1}, 90.0, 50.0) for value in (90.0, 89.9, 49.9)] == [YES, PARTLY, NO]
