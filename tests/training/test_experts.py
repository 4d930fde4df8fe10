"""Frames turn back, known boards' readings keep their pokes, and written networks answer as before."""

import numpy as np

from pipeline.training.universal import READINGS_N, Experts, Frame, read_networks, recorded, write_networks
from reskin import io
from reskin.data.rows import Rows
from reskin.seeds import rng_for
from reskin.universal.map import NOMINAL, OF_NOMINAL
from reskin.universal.network import predict
from reskin.universal.training import Lessons, Syllabus, draw_weights
from tests.universal.skins import SETUP, made_tables

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Frame(np.tile(QUARTER, (5, 1, 1)), (8.0, 7.0), mirrored=True)


def test_labels_and_places_turn_into_each_other():
    label_mm = np.array([[8.0, 7.0], [9.0, 10.0]])
    np.testing.assert_allclose(FRAME.place(label_mm), [[0, 0], [1, -3]])
    np.testing.assert_allclose(FRAME.label(FRAME.place(label_mm)), label_mm)
    turned = FRAME.field(np.tile([1.0, 2.0, 3.0], 5)[None])
    np.testing.assert_allclose(turned, np.tile([-2.0, 1.0, 3.0], 5)[None])


def test_a_known_boards_readings_stay_with_their_poke():
    counts = [2, 150, 1, 3]  # readings of pokes; the third has no force, the last lies on another board
    poke = np.repeat(np.arange(4), counts)
    board = np.where(poke == 3, "other", "own")
    target = np.stack([8 + poke, 7 + poke, np.where(poke == 2, 0.0, 1 + poke)], axis=1).astype(np.float32)
    db_uT = np.tile(poke[:, None] + 1, (1, 15)).astype(np.float32)
    names = np.array(["c"] * len(poke)), board, board
    rows = Rows(*names, db_uT, target, np.zeros(len(poke), np.int32), poke, {})
    found = recorded(rows, FRAME, "own", np.ones(15))
    assert found.db_uT.shape == (2, READINGS_N, 15)
    np.testing.assert_allclose(found.place_mm, [[0, 0], [1, -1]])
    np.testing.assert_allclose(found.force_N, np.tile([[1], [2]], READINGS_N))
    np.testing.assert_allclose(found.db_uT[..., 2], np.tile([[1], [2]], READINGS_N))


def test_written_networks_answer_as_before(tmp_path):
    networks = [draw_weights(15, rng_for(0, "written", i)) for i in range(2)]
    experts = Experts(made_tables(), networks, None, Syllabus("without b1", NOMINAL, OF_NOMINAL, SETUP))
    write_networks(tmp_path / "universal", [experts], Lessons(skins_n=1, steps_n=2, seeds_n=2), 0)
    read = read_networks(tmp_path / "universal", "without b1")
    db_uT = rng_for(0, "readings").normal(0, 300, (3, 15))
    before, after = (predict(of, db_uT, np.zeros(15), db_uT) for of in (networks, read))
    np.testing.assert_array_equal(before.place_mm, after.place_mm)
    card = io.read_json(tmp_path / "universal/without-b1.json")
    assert "universal" in card["method"]
    assert card["spreads"] == OF_NOMINAL
