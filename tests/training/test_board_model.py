"""Tests of a universal model that is made for a board other than the paper's.

The tests cover the file of the model, its accuracy on simulated skins, and errors for invalid input.
"""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.constants import milli

import reskin
from pipeline.training import shipping
from pipeline.training.shipping import calibrate, draw_prior_skins, law_error
from reskin import io, predicting
from reskin.config import parse
from reskin.errors import ParamsError, SchemaError
from reskin.live.session import GuidedPresses
from reskin.live.tracker import UniversalEstimator, layout_of_board
from reskin.physics.board import BoardDesign, Spreads, draw_board
from reskin.physics.chip import ChipDesign, read_field
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import changes_of_field, draw_skin
from reskin.seeds import rng_for
from reskin.simulation.defaults import nominal
from reskin.universal.batches import TrainingSettings
from reskin.universal.layout import read_layout
from reskin.universal.model import FILE, Universal, load_universal
from tests.live.boards import make_script, play_to_skin

SPREADS, CHIP = parse(Spreads, nominal("spreads"), "spreads"), parse(ChipDesign, nominal("chip"), "chip")
# The board has four chips at the corners of a square, with another pitch and other turns. The skin is thicker, and the
# pressed area has corners.
LAYOUT = """
name: square
chips:
  - {x_mm: -4.0, y_mm: -3.0, turn_deg: 90}
  - {x_mm: 4.0, y_mm: -3.0, turn_deg: 0}
  - {x_mm: -4.0, y_mm: 3.0, turn_deg: 270}
  - {x_mm: 4.0, y_mm: 3.0, turn_deg: 180}
centre_mm: [0.0, 20.0]
gap_mm: 1.2
skin:
  size_mm: [14.0, 12.0]
  thickness_mm: 2.5
  polarity: checkerboard
  flipped: false
  magnetisation: 0.6
  modulus_MPa: 0.19
tip_radius_mm: 3.0
area: {half_x_mm: 5.0, half_y_mm: 4.0, octagon: false}
force_N: [0.1, 8.0]
spreads: {seat_x_mm: 0.3, seat_y_mm: 0.3}
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Make a model for `LAYOUT`, with few skins and few training steps."""
    folder = tmp_path_factory.mktemp("board")
    (folder / "square.yaml").write_text(LAYOUT)
    usual = shipping.read_inputs

    def few(layout):
        training = TrainingSettings(skins_n=40, steps_n=150, seeds_n=1)
        return replace(usual(layout=layout), training=training, labels_n=(0, 10))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shipping, "CALIBRATION_SKINS_N", 1)
        patch.setattr(shipping, "read_inputs", few)
        said: list[str] = []
        shipping.make(folder / "square.yaml", folder / "square.safetensors", said.append)
    (fields,) = [line for line in said if "mT" in line]
    assert 1.0 < float(re.findall(r"up to ([0-9.]+) mT", fields)[0]) < 6.5
    return folder / "square.safetensors"


@pytest.mark.parametrize(("labels_n", "least"), [(0, 0.6), (20, 0.75)])
def test_simulated_presses_of_the_board_are_placed_within_1_mm(made, labels_n, least):
    model = reskin.load_universal(file=made)
    inputs = shipping.read_inputs(layout=model.layout)
    # These skins are not among those of the training.
    skins = draw_prior_skins(inputs.prior, 6, 3, "of the test", law_error(0.0))
    within = []
    for i in range(len(skins)):
        b_uT, place_mm = calibrate(model, skins, i, (45, labels_n), even=False, seed=3)
        assert b_uT.shape[1] == 12
        assert (np.abs(place_mm - [0.0, 20.0]) < [5.5, 4.5]).all()
        within.append((np.abs(model.predict(b_uT)[:, :2] - place_mm) <= 1).all(axis=1).mean())
    assert np.mean(within) > least


def test_presses_simulated_by_independent_code_are_placed_within_1_mm(made):
    # This simulator computes positions and turns of chips by other code than the model. A wrong turn of one chip makes
    # places wrong.
    model = load_universal(file=made)
    layout, rng, within, with_wrong_turn = model.layout, rng_for(0, "square"), [], []
    turned = (layout.chips[0].model_copy(update={"turn_deg": 270}), *layout.chips[1:])
    wrong = Universal(model.tables, model.networks, model.powers, layout.model_copy(update={"chips": turned}))
    design = BoardDesign(
        chips_xy_mm=tuple(map(tuple, layout.chips_mm.tolist())), chips_turn_deg=layout.turns_deg, gap_mm=layout.gap_mm
    )
    usual = layout.setup().design
    # If the magnetisation were stronger, some chips would saturate.
    strength_T = layout.skin.magnetisation * usual.saturation_T
    skin_design = usual.model_copy(update={"modulus_kPa": 190.0, "saturation_T": strength_T})
    for name in ("b0", "b1", "b2"):
        board = draw_board(design, SPREADS, seed=5, name=name)
        skin = draw_skin(
            skin_design, SPREADS, seed=5, name=name, rule=Quadrature(0.8e-3, 4), sides_m=layout.setup().sides_m
        )
        place_mm = rng.uniform(-1, 1, (60, 2)) * layout.half_mm
        depth_mm = rng.uniform(0.4, 1.2, (60, 1))
        rest_T, change_T = changes_of_field(board, skin, np.column_stack([place_mm, depth_mm]) * milli)
        noload_uT, _ = read_field(rest_T[None], board, design=CHIP, rng=rng)
        b_uT, _ = read_field(rest_T + change_T, board, design=CHIP, rng=rng)
        for each, found in ((model, within), (wrong, with_wrong_turn)):
            each.zero(noload_uT).see(b_uT[:40])
            off_mm = each.predict(b_uT[40:])[:, :2] - layout.centre_mm - place_mm[40:]
            found.append((np.abs(off_mm) <= 1).all(axis=1).mean())
    assert np.mean(within) > 0.8
    assert np.mean(with_wrong_turn) < 0.5


def test_readings_of_another_number_of_chips_are_refused(made):
    square, paper = load_universal(file=made), load_universal()
    with pytest.raises(SchemaError, match="b_uT has 15 numbers. This model needs 12 numbers per reading"):
        square.zero(np.zeros(15))
    with pytest.raises(SchemaError, match="b_uT has 12 numbers. This model needs 15 numbers per reading"):
        paper.zero(np.zeros(12))
    with pytest.raises(SchemaError, match="b_uT has shape .1, 15.. This model needs 12 numbers"):
        square.zero(np.zeros(12)).predict(np.zeros((1, 15)))


def test_fields_of_the_model_have_the_order_and_axes_of_chips_in_the_layout(made):
    model = load_universal(file=made)
    tables, layout = model.tables, model.layout
    strongest = np.abs(tables.mean_uT[..., 5, :]).reshape(-1, 4, 3).max(axis=(0, 2))
    assert strongest.max() < 2 * strongest.min()
    board_uT = np.arange(12.0)[None]
    by_hand_uT = [1, -0, 2, 3, 4, 5, -7, 6, 8, -9, -10, 11]  # The chips are turned by 90, 0, 270 and 180 degrees.
    np.testing.assert_allclose(layout.to_chips(board_uT)[0], by_hand_uT, atol=1e-12)
    np.testing.assert_allclose(layout.to_board(layout.to_chips(board_uT)), board_uT, atol=1e-12)
    assert np.abs(tables.axis_mm).max() == pytest.approx(5.4)
    assert np.abs(model.skin.hypotheses.place_mm).max(axis=0) == pytest.approx([5.4, 4.4], abs=0.8)


def test_saved_calibration_is_refused_for_other_boards(made, tmp_path):
    model, file = load_universal(file=made), tmp_path / "s1.safetensors"
    rest_uT = model.layout.to_chips(model.tables.rest_uT[None])
    press_uT = rest_uT + model.layout.to_chips(model.tables.mean_uT[6:8, 5, 5])
    model.zero(rest_uT).see(press_uT).label([[0.5, 20.5], [1.0, 20.5]], [2.0, 2.0], press_uT).save(file)
    again = reskin.load_universal(file, file=made)
    np.testing.assert_allclose(again.predict(press_uT), model.predict(press_uT), rtol=1e-4)
    with pytest.raises(SchemaError, match="calibrated board must be reskin, the board of the model; got square"):
        load_universal(file)
    with pytest.raises(SchemaError, match="places must be on the skin, from .-7.0, 14.0. to .7.0, 26.0. mm"):
        model.label([[8.0, 8.0]], [2.0], press_uT[:1])


def test_live_page_and_command_predict_accept_the_model(made, tmp_path):
    model = predicting.read_models([made])
    assert model.layout.name == "square"
    calibration = tmp_path / "s1.safetensors"
    rest_uT = model.layout.to_chips(model.tables.rest_uT[None])
    model.zero(rest_uT).save(calibration)
    assert predicting.read_models([calibration, made]).zeroed
    with pytest.raises(ParamsError, match="a universal model cannot be combined with other models"):
        predicting.read_models([made, FILE])
    estimator = UniversalEstimator(model)
    assert estimator.channels_n == 12
    estimator.set_noload(rest_uT)
    assert estimator(np.full((2, 12), 50.0, np.float32)).target.shape == (2, 3)
    shown = layout_of_board(estimator.board)
    assert (shown.corner_mm, shown.skin_mm) == ((-7.0, 14.0), (14.0, 12.0))
    np.testing.assert_allclose(shown.chips_mm[1], [4.0, 17.0])
    guided_mm = GuidedPresses(estimator.board).place_mm - [0.0, 20.0]
    assert (np.abs(guided_mm) < [5.0, 4.0]).all()
    assert np.abs(guided_mm).max() > 2.5


def test_board_is_read_live_with_the_model_for_its_layout(made):
    skin, readings = play_to_skin(make_script(pokes_n=1, chips_n=4), predicting.read_models([made]))
    assert skin.layout.known
    assert np.isfinite(np.concatenate([batch.target[batch.contact] for batch in readings])).all()
    assert any(batch.contact.any() for batch in readings)
    other, _ = play_to_skin(make_script(pokes_n=1, chips_n=5), predicting.read_models([made]))
    problem = "no place or force is estimated: the universal model is for boards with 4 chips."
    assert f"{problem} Use a model for this board." in other.alarms()


def test_model_card_states_the_layout_and_the_limits_of_use(made):
    card = io.read_json(made.with_suffix(".json"))
    assert card["source"] == "simulated"
    assert card["layout"] == read_layout(made.with_suffix(".yaml")).model_dump(mode="json")
    assert card["centre"]["gap_mm"] == 1.2
    assert card["spreads"]["seat_x_mm"] == 0.3
    assert "layout" in card["not_for"]


def test_model_card_of_another_model_is_refused(made, tmp_path):
    file = tmp_path / "mixed.safetensors"
    shutil.copy(made, file)
    io.write_json(file.with_suffix(".json"), io.read_json(FILE.with_suffix(".json")))
    with pytest.raises(SchemaError, match="layout must be of 4 chips; got 5 chips. Use the card"):
        load_universal(file=file)


def test_existing_output_is_not_overwritten(made):
    with pytest.raises(ParamsError, match="square.safetensors exists. Choose another name"):
        shipping.make(made.with_suffix(".yaml"), made)
    with pytest.raises(ParamsError, match="must end in .safetensors. Try: "):
        shipping.make(made.with_suffix(".yaml"), made.with_suffix(".bin"))
