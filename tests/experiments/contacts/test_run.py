"""Tests of experiment contacts on a skin whose field is linear, with a predictor that is exact for single contacts."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.experiments.contacts import Contacts, evaluate_board
from pipeline.settings import Settings
from pipeline.training.jobs import SceneData
from reskin.config import read_yaml
from reskin.data.grid import points_mm
from reskin.data.splits import Fold
from reskin.seeds import rng_for
from tests.data import tables

SECTION = Contacts(pairs_n=40, separations_mm=(4.0, 8.0), false_alarm_fraction=0.1)
CI = Path(__file__).resolve().parents[3] / "pipeline/scenes/ci.yaml"


def scene_data():
    boards = np.repeat(["b0", "b1", "b2"], 260)
    rows = tables.rows(boards, [f"{board}_s0" for board in boards])
    force_N = rng_for(0, "forces").uniform(0.5, 3, len(boards))
    places_mm = np.tile(points_mm(), (12, 1))
    # Each of nine channels has a place. It reads the force of a contact, multiplied by a weight that falls with the
    # distance between the contact and this place.
    spots_mm = np.array([[x, y] for x in (2, 8, 14) for y in (2, 8, 14)])
    near = np.exp(-((places_mm[:, None] - spots_mm) ** 2).sum(axis=2) / 50)
    db_uT = (200 * force_N[:, None] * near).astype(np.float32)
    target = np.column_stack([places_mm, force_N]).astype(np.float32)
    return SceneData(
        "test", Settings("ci", "ci.yaml", read_yaml(CI), {}), replace(rows, db_uT=db_uT, target=target), []
    )


def nearest_neighbour(data):
    """Return a predictor that returns the targets of the most similar row. It is exact for single contacts."""

    def predict(db_uT):
        known = data.rows.db_uT / np.linalg.norm(data.rows.db_uT, axis=1, keepdims=True)
        which = (db_uT @ known.T).argmax(axis=1)
        force_N = np.linalg.norm(db_uT, axis=1) / np.linalg.norm(data.rows.db_uT[which], axis=1)
        return np.column_stack([data.rows.target[which, :2], force_N * data.rows.target[which, 2]]).astype(np.float32)

    return predict


DATA = scene_data()
TEST = np.flatnonzero(DATA.rows.board == "b0")
FOLD = Fold("lobo", "b0", np.flatnonzero(DATA.rows.board != "b0"), TEST, np.zeros(0, np.int64))
NUMBERS, DRAWN = evaluate_board(DATA, FOLD, SECTION, [nearest_neighbour(DATA)])


def test_contacts_far_apart_are_detected_better_than_close_ones():
    found = NUMBERS["by_separation"]
    for detector in ("direction and length", "direction above noise", "residual"):
        # The ROC area at chance level is 0.5.
        assert found[8.0]["auc"][detector] > max(found[4.0]["auc"][detector], 0.7)
        # The threshold is chosen for 10 % false alarms on the contacts that are set aside.
        assert NUMBERS["false_alarm_pct"][detector] < 25


def test_predicted_place_is_between_the_contacts_and_nearer_to_the_stronger_one():
    assert 0.5 < NUMBERS["falls"][8.0]["along"] < 1.0
    assert NUMBERS["falls"][4.0]["nearest_mm"] < NUMBERS["falls"][8.0]["nearest_mm"]
    # Two contacts at one place equal a single contact with the sum of their forces.
    assert NUMBERS["falls"][0.0]["near_either_pct"] == 100
    assert [len(values) for values in DRAWN["along"].values()] == [40, 40]


def test_disagreement_of_networks_is_omitted_if_there_is_only_one_network():
    assert "networks disagree" not in NUMBERS["auc"]
    numbers, _ = evaluate_board(
        DATA, FOLD, SECTION, [nearest_neighbour(DATA), lambda db_uT: nearest_neighbour(DATA)(-db_uT)]
    )
    assert "networks disagree" in numbers["auc"]


def test_equal_seeds_give_equal_results():
    assert evaluate_board(DATA, FOLD, SECTION, [nearest_neighbour(DATA)]) == (NUMBERS, DRAWN)
