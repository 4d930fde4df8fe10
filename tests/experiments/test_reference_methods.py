"""Tests of the reference methods, with which the universal model is compared.

The tests check the pairs of presses on two boards, the alarm for readings of foreign boards, the controls (which are
compared with exact solutions), and the tables.
"""

from typing import Any

import numpy as np
import pytest

from pipeline.experiments import reference_methods
from pipeline.experiments.reference_methods import (
    FOREIGN,
    INVERSION,
    NONE,
    OF_RIGHT,
    OWN,
    QUARTER_TURN,
    STRANGERS,
    WHY,
    Board,
    alarm_statistics,
    limits_of,
    next_board,
    pairs_uT,
    score_flagged,
    standardised_uT,
    summarise,
    tables,
    unlabelled_controls,
)
from pipeline.settings import Settings
from pipeline.training.jobs import SceneData
from pipeline.training.universal import pool_rows
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.metrics import score_groups
from reskin.models.adversarial import Domains
from reskin.models.network import Predictor, draw_weights, paper_layers
from reskin.seeds import rng_for
from tests.models.example_jobs import recipe

PLACES_MM = np.array([[4.0, 4.0], [6.0, 4.0], [8.0, 6.0], [4.0, 8.0], [6.0, 8.0]])
FORCES_N = np.array([1.0, 4.0])
MAP = np.eye(6) + 0.2 * rng_for(0, "skins differ").standard_normal((6, 6))


def old_uT(place_mm: np.ndarray, force_N: np.ndarray) -> np.ndarray:
    """Return field changes of board b0, which are linear in log F at each place."""
    towards = np.cos(place_mm @ rng_for(0, "fields").standard_normal((2, 6)))
    return 100 * towards * (2 + np.log(force_N))[:, None]


def make_rows() -> Rows:
    """Return rows of two boards with the same presses, and two readings each.

    The matrix `MAP` converts fields of board b1 to those of board b0.
    """
    place_mm = np.tile(np.repeat(PLACES_MM, 2, axis=0), (2, 1))
    force_N = np.tile(FORCES_N, 10)
    board = np.repeat(["b0", "b1"], 10)
    db_uT = old_uT(place_mm, force_N)
    db_uT[10:] = db_uT[10:] @ np.linalg.inv(MAP)
    twice = [np.repeat(part, 2, axis=0) for part in (board, db_uT, np.column_stack([place_mm, force_N]))]
    names = np.array(["c"] * 40), twice[0], twice[0]
    fields = twice[1].astype(np.float32), twice[2].astype(np.float32)
    return Rows(*names, *fields, np.zeros(40, np.int32), np.arange(40) // 2, {})


def fold(name: str, train: range, pool: range, test: range) -> Fold:
    return Fold("labels", name, np.array(train), np.array(test), np.array(pool))


DATA = SceneData("test", Settings("test", "test.yaml", {"seed": 0}, {}), make_rows(), [])
FOLD = fold("b1-draw0", range(20), range(20, 40), range(20, 40))


def test_presses_are_paired_with_fields_of_the_known_board_at_equal_place_and_force():
    rows = make_rows()
    rows.target[20:22, 2] = 2.0  # The force of this press is between the two forces of board b0.
    rows.target[22:24, 2] = 9.0  # The force of this press is above the largest force of board b0.
    rows.target[24:26, :2] = 50.0  # Board b0 has no press at this place.
    found = pairs_uT(rows, FOLD.train, [np.arange(i, i + 2) for i in (20, 22, 24, 26)])
    place_mm = PLACES_MM[[0, 0]]
    np.testing.assert_allclose(found[:2], old_uT(place_mm, np.array([2.0, 4.0])), rtol=1e-5)
    assert np.isnan(found[2]).all()
    np.testing.assert_allclose(found[3], rows.db_uT[6], rtol=1e-5)


def test_linear_map_fitted_to_pairs_recovers_fields_of_the_known_board():
    back_uT = standardised_uT(DATA, FOLD, pool_rows(DATA, FOLD))
    # The tolerance is due to the ridge penalty, which is above 0.
    np.testing.assert_allclose(back_uT, DATA.rows.db_uT[:20], rtol=0.02, atol=2.0)
    nowhere = fold("b1-draw0", range(2), range(36, 40), range(20, 40))
    with pytest.raises(ParamsError, match="no labelled poke is within"):
        standardised_uT(DATA, nowhere, pool_rows(DATA, nowhere))


def test_network_that_collapsed_is_trained_again(monkeypatch):
    good = draw_weights(paper_layers(15), rng_for(0, "good"))
    known = rng_for(0, "known").normal(size=(20, 15)).astype(np.float32)
    target = Predictor(good, "paper", "cpu")(known)
    dead = {name: np.zeros_like(value) for name, value in good.items()}
    tries = iter([dead, good])
    monkeypatch.setattr(reference_methods, "train_adversarial", lambda *keys: next(tries))
    weights, record = reference_methods.train_until_converged(Domains(known, target, known), recipe(), 1.0, 0, "b1")
    assert weights is good
    assert record == {"collapsed": False, "collapsed_before_n": 1}


def test_control_uses_the_same_draw_of_the_next_board():
    names = "b0-draw0", "b0-draw1", "b1-draw0", "b1-draw1"
    folds = [fold(name, range(1), range(1), range(1)) for name in names]
    assert [next_board(one, folds).name for one in folds] == ["b1-draw0", "b1-draw1", "b0-draw0", "b0-draw1"]


def test_each_simulated_foreign_board_has_fields_of_unchanged_length():
    chips = rng_for(0, "chips").standard_normal((3, 5, 3))
    for name, change in STRANGERS.items():
        np.testing.assert_allclose(np.linalg.norm(change(chips), axis=(1, 2)), np.linalg.norm(chips, axis=(1, 2)))
        assert not np.allclose(change(chips), chips), name
    np.testing.assert_allclose(chips @ np.linalg.matrix_power(QUARTER_TURN, 4), chips)
    this_board = Board(chips[:1].reshape(1, -1), chips.reshape(3, -1), chips.reshape(3, -1))
    swapped = this_board.alter(STRANGERS["two chips exchanged"]).pool_uT.reshape(3, 5, 3)
    np.testing.assert_array_equal(swapped, chips[:, [0, 2, 1, 3, 4]])


def test_readings_above_the_limit_of_their_board_are_flagged():
    right = {"b0": np.array([0.1, 0.2, 0.3, 0.4]), "b1": np.array([0.1, 0.1, 0.2, 0.2])}
    foreign = {"b0": np.array([0.9, 0.9]), "b1": np.array([0.1, 0.9])}
    found = alarm_statistics(foreign, right, {"b0": 0.35, "b1": 0.15})
    assert found["alarm_pct"]["mean"] == pytest.approx((100 + 50) / 2)
    # The ROC area counts equal scores as one half.
    assert found["auc"]["mean"] == pytest.approx((1.0 + 0.5 * 0.25 + 0.5) / 2)
    assert found["left_median"]["mean"] == pytest.approx((0.9 + 0.5) / 2)
    assert alarm_statistics(right, right, {"b0": 0.35, "b1": 0.15})["auc"]["mean"] == pytest.approx(0.5)


def test_accuracy_of_flagged_and_other_readings_is_averaged_over_boards():
    value = {"b0": np.array([0.0, 1.0, 2.0, 9.0]), "b1": np.array([0.0, 1.0, 2.0, 3.0])}
    off_mm = {board: np.array([[0.0, 0.5], [0.5, 0.0], [0.0, 0.5], [2.0, 0.0]]) for board in value}
    assert limits_of(value, 0.0) == {"b0": 3.0, "b1": 9.0}
    found = score_flagged(value, off_mm, 0.0)
    assert found["flagged_pct"]["mean"] == pytest.approx((25 + 0) / 2)
    # No reading of board b1 is flagged, so only one board has this score.
    assert found["accuracy_pct_flagged"] == {"mean": 0.0, "n": 1}
    assert found["mse_xy_mm2_flagged"]["mean"] == pytest.approx(2.0)
    assert found["accuracy_pct_others"]["mean"] == pytest.approx((100 + 75) / 2)
    assert found["mse_xy_mm2_others"]["n"] == 2


def points(method: str, given: str, off_mm: dict[str, float]) -> list[dict[str, Any]]:
    true = np.array([[4.0, 4.0, 1.0], [6.0, 8.0, 2.0]])
    board = np.array(["b", "b"])
    found = []
    for name, by_mm in off_mm.items():
        skin = np.char.add(board, name)
        keys = {"method": method, "name": given, "labels_n": 0, "fold": f"b{name}", "seed_i": 0}
        found.append(keys | {"scores": score_groups(true, true + [[by_mm, 0, 0], [0, 0, 0]], skin, skin)})
    return found


def numbers() -> dict[str, Any]:
    name = INVERSION
    inversion_points = points(name, OWN, {"0": 0.0, "1": 0.5}) + points(name, FOREIGN, {"0": 2.0, "1": 0.5})
    others = points("ridge", NONE, {"0": 2.0, "1": 2.0}) + points("ridge, CORAL", OWN, {"0": 0.0, "1": 2.0})
    controls = unlabelled_controls() | {("ridge, CORAL", OWN, 0): ("ridge", NONE, 0)}
    stat = {"mean": 0.9, "n": 2, "ci95": [0.8, 1.0]}
    row = {"alarm_pct": stat, "auc": stat, "left_median": stat}
    strangers = [{"stranger": "all magnetic poles swapped", "law": OF_RIGHT} | row]
    return {
        "methods": summarise(inversion_points + others, controls), "unpaired_n": 2,
        "alarm": {"asked_pct": 5.0, "limit": stat, "right": row, "strangers": strangers},
        "flagged": [{"method": name, "by": "misfit", "flagged_pct": stat, "mse_xy_mm2_others": stat}],
    }  # fmt: skip


def test_difference_from_the_control_is_paired_by_board():
    rows = {(row["method"], row["pokes"]): row for row in numbers()["methods"]}
    over = rows[INVERSION, FOREIGN]["over"]
    assert over["by_board"]["b0"]["accuracy_pct"] == pytest.approx(-50.0)
    assert over["accuracy_pct"]["mean"] == pytest.approx(-25.0)
    assert rows["ridge, CORAL", OWN]["over"]["accuracy_pct"]["mean"] == pytest.approx(25.0)
    assert "over" not in rows["ridge", NONE]


def test_tables_contain_differences_from_controls_and_the_source():
    tables_by_name = tables(numbers(), "recorded")
    assert tables_by_name["rivals"]["method"].tolist() == ["ridge", "ridge, CORAL"]
    assert tables_by_name["rivals"]["what it can and cannot correct"].tolist() == ["–", WHY["CORAL"]]
    assert tables_by_name["rivals"]["paired, accuracy, points"][1].startswith("+25")
    assert tables_by_name["rivals_told"]["paired, accuracy, points"].tolist()[1].startswith("-25")
    assert tables_by_name["rivals_alarm"]["physical model"].tolist() == [OF_RIGHT] * 2
    # No reading was flagged, so there is no error of flagged readings.
    assert tables_by_name["rivals_flagged"]["MSE_xy, mm² (flagged)"].tolist() == ["–"]
    assert tables_by_name["rivals"].attrs["meaning"].endswith("2 labelled pokes had no pair.")
    assert all(set(table["source"]) == {"recorded"} for table in tables_by_name.values())
