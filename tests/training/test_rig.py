"""Tests of universal models that are made with the other boards of a rig."""

from dataclasses import replace

import numpy as np
import pytest

import reskin
from pipeline.training.recorded import RecordedBoards
from pipeline.training.rig import READINGS_N, prior_without, recorded_board
from reskin.data.rows import Rows
from reskin.errors import SchemaError
from reskin.seeds import rng_for
from reskin.universal.axes import BoardAxes
from reskin.universal.law import START
from reskin.universal.layout import paper_layout
from reskin.universal.map import fit_residual
from reskin.universal.model import Universal, load_universal, write
from reskin.universal.network import draw_weights
from tests.universal.recorded import AXES, simulated_presses
from tests.universal.skins import SETUP, make_tables, poked_uT


def make_rows() -> Rows:
    """Return the readings of four presses; the third press has no force, and the last press is on another board."""
    counts = [2, 150, 1, 3]
    press = np.repeat(np.arange(4), counts)
    board = np.where(press == 3, "other", "own")
    target = np.stack([8 + press, 7 + press, np.where(press == 2, 0.0, 1 + press)], axis=1).astype(np.float32)
    db_uT = np.tile(press[:, None] + 1, (1, 15)).astype(np.float32)
    names = np.array(["c"] * len(press)), board, board
    return Rows(*names, db_uT, target, np.zeros(len(press), np.int32), press, {})


def test_recorded_readings_are_grouped_by_press():
    axes = BoardAxes(SETUP, (90.0,) * 5, (8.0, 7.0), labels_mirrored=True, stated_by="a test")
    found = recorded_board(make_rows(), axes, "own", np.ones(15))
    assert found.db_uT.shape == (2, READINGS_N, 15)
    np.testing.assert_allclose(found.place_mm, [[0, 0], [1, -1]])
    np.testing.assert_allclose(found.force_N, np.tile([[1], [2]], READINGS_N))
    np.testing.assert_allclose(found.db_uT[..., 2], np.tile([[1], [2]], READINGS_N))


def test_prior_of_a_held_out_board_contains_nothing_of_this_board():
    presses = {"own": AXES.align(simulated_presses()), "other": AXES.align(simulated_presses(START))}
    laws = {"own": replace(START, gap_mm=9.0), "other": START}
    prior = prior_without(RecordedBoards(make_rows(), AXES, presses), laws, "own", paper_layout())
    assert prior.name == "without own"
    assert prior.centre == START
    assert [board.force_N.min() for board in prior.recorded] == [4.0]  # the readings of board `other`
    np.testing.assert_array_equal(prior.recorded[0].rest_uT, presses["other"].rest_uT.ravel().astype(np.float32))
    assert len(prior.residual.place_mm) == len(presses["other"].place_mm)


def make_model() -> Universal:
    """Return a model whose residual says that the fields on another board were 20 % larger in channel 0."""
    place_mm, force_N = np.array([[0.0, 0.0], [3.0, -2.0], [-4.0, 1.0]]), np.array([1.0, 2.0, 5.0])
    residual = fit_residual([place_mm], [force_N], [0.2 * np.eye(15)[[0, 0, 0]]])
    networks = [draw_weights(15, rng_for(0, "rig"))]
    return Universal(make_tables(), networks, load_universal().powers, paper_layout(), {}, 0.0, residual)


def calibrated(model: Universal) -> np.ndarray:
    """Calibrate a model to three labelled presses; return its estimates of other presses."""
    rng = rng_for(1, "rig")
    place_mm, force_N = rng.uniform(-5, 5, (8, 2)), rng.uniform(1, 8, 8)
    b_uT = model.layout.to_chips(poked_uT(place_mm, force_N, np.array([0.5, -0.5, 0.3])))
    model.zero(np.zeros((1, 15))).label(place_mm[:3] + 8.0, force_N[:3], b_uT[:3])
    return model.predict(b_uT[3:])


def test_model_file_with_a_residual_gives_the_same_predictions(tmp_path):
    model, file = make_model(), tmp_path / "b1.safetensors"
    write(model.tables, model.networks, model.powers, model.layout, {"name": "rig"}, file, model.residual)
    loaded = reskin.load_universal(file=file)
    # The file has single precision. The differences are rounding errors.
    np.testing.assert_allclose(calibrated(loaded), calibrated(model), rtol=1e-4, atol=1e-4)
    # The residual has an effect, so that it would be noticed if the file did not contain it.
    without = replace(model, residual=None)
    assert np.abs(calibrated(without) - calibrated(model)).max() > 0.01


def test_damaged_model_file_is_refused(tmp_path):
    model, file = make_model(), tmp_path / "b1.safetensors"
    write(model.tables, model.networks, model.powers, model.layout, {"name": "rig"}, file, model.residual)
    content = bytearray(file.read_bytes())
    content[-5] ^= 1
    file.write_bytes(content)
    with pytest.raises(SchemaError, match="digest"):
        load_universal(file=file)
