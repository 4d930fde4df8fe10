"""Frames are inverted, recorded boards keep readings by press, and written networks estimate as before."""

import numpy as np

from pipeline.training.universal_variants import (
    READINGS_N,
    Frame,
    Variant,
    Variants,
    read_networks,
    recorded_board,
    write_networks,
)
from reskin import io
from reskin.data.rows import Rows
from reskin.seeds import rng_for
from reskin.universal.map import NOMINAL, NOMINAL_SPREADS, new_map
from reskin.universal.model import PriorModel
from reskin.universal.network import predict
from reskin.universal.training import SkinPrior, TrainingSettings, draw_weights
from tests.universal.skins import SETUP, made_tables

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Frame(np.tile(QUARTER, (5, 1, 1)), (8.0, 7.0), mirrored=True)


def test_labels_and_places_are_inverse():
    label_mm = np.array([[8.0, 7.0], [9.0, 10.0]])
    np.testing.assert_allclose(FRAME.place(label_mm), [[0, 0], [1, -3]])
    np.testing.assert_allclose(FRAME.label(FRAME.place(label_mm)), label_mm)
    turned = FRAME.field(np.tile([1.0, 2.0, 3.0], 5)[None])
    np.testing.assert_allclose(turned, np.tile([-2.0, 1.0, 3.0], 5)[None])


def test_readings_of_a_recorded_board_stay_with_their_press():
    counts = [2, 150, 1, 3]  # readings of presses; the third has no force, the last lies on another board
    press = np.repeat(np.arange(4), counts)
    board = np.where(press == 3, "other", "own")
    target = np.stack([8 + press, 7 + press, np.where(press == 2, 0.0, 1 + press)], axis=1).astype(np.float32)
    db_uT = np.tile(press[:, None] + 1, (1, 15)).astype(np.float32)
    names = np.array(["c"] * len(press)), board, board
    rows = Rows(*names, db_uT, target, np.zeros(len(press), np.int32), press, {})
    found = recorded_board(rows, FRAME, "own", np.ones(15))
    assert found.db_uT.shape == (2, READINGS_N, 15)
    np.testing.assert_allclose(found.place_mm, [[0, 0], [1, -1]])
    np.testing.assert_allclose(found.force_N, np.tile([[1], [2]], READINGS_N))
    np.testing.assert_allclose(found.db_uT[..., 2], np.tile([[1], [2]], READINGS_N))


def test_written_networks_estimate_as_before(tmp_path):
    networks = [draw_weights(15, rng_for(0, "written", i)) for i in range(2)]
    model = PriorModel(new_map(made_tables()), networks)
    nominal, held_out = (
        Variant(SkinPrior(name, NOMINAL, NOMINAL_SPREADS, SETUP), model) for name in ("nominal", "without b1")
    )
    settings = TrainingSettings(skins_n=1, steps_n=2, seeds_n=2)
    write_networks(tmp_path / "universal", Variants(nominal, {"b1": held_out}), settings, 0)
    read = read_networks(tmp_path / "universal", "without b1")
    db_uT = rng_for(0, "readings").normal(0, 300, (3, 15))
    before, after = (predict(of, db_uT, np.zeros(15), db_uT) for of in (networks, read))
    np.testing.assert_array_equal(before.place_mm, after.place_mm)
    card = io.read_json(tmp_path / "universal/without-b1.json")
    assert "universal" in card["method"]
    assert card["spreads"] == NOMINAL_SPREADS
