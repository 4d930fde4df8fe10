"""Tests of how models are made: from simulation, with recorded boards, and refined on one skin."""

import numpy as np
import pytest

from pipeline.training.board_model import folder_of, make
from reskin import io
from reskin.errors import ParamsError, SchemaError
from reskin.layouts import file_of
from reskin.schema import Readings
from reskin.universal import making
from reskin.universal import model as model_module
from reskin.universal.episodes import RecordedBoard, TrainingSettings
from reskin.universal.making import make_model, read_recordings, with_boards
from reskin.universal.model import load_universal, write
from reskin.universal.population import Population
from tests.universal.skins import LAYOUT, draw

TINY = TrainingSettings(skins_n=2, steps_n=4)


@pytest.fixture(autouse=True)
def _few_skins(monkeypatch):
    monkeypatch.setattr(making, "REFERENCE_SKINS_N", 8)
    monkeypatch.setattr(making, "simulate", lambda _, skins_n, seed, name: SKINS)


def population(skins):
    rest_uT = np.stack([LAYOUT.to_board(skin.rest_uT[None])[0] for skin in skins])
    db_uT = np.stack([[LAYOUT.to_board(skin.b_uT - skin.rest_uT)] * 2 for skin in skins])
    parts = db_uT, rest_uT, np.stack([skin.place_mm - 8 for skin in skins]), np.stack([skin.force_N for skin in skins])
    return Population(*(part.astype(np.float32) for part in parts))


SKINS = population(draw(12))


def boards() -> list[RecordedBoard]:
    parts = (SKINS.db_uT[:, 0][:, :, None], SKINS.rest_uT, SKINS.place_mm, SKINS.force_N[..., None])
    return [RecordedBoard(f"b{i}", *(part[i] for part in parts)) for i in range(2)]


def test_a_model_that_was_made_and_one_with_boards_can_be_written_and_loaded(tmp_path):
    model = make_model(LAYOUT, TINY, say=lambda _: None)
    known, held_out = with_boards(model, boards(), TINY, say=lambda _: None)
    assert [each.board for each in held_out] == ["b0", "b1"]
    assert known.card["source"] == "simulated and recorded"
    assert any((known.weights[name] != model.weights[name]).any() for name in model.weights)
    for each in (model, known):
        write(each, each.card, tmp_path / "m.safetensors")
        loaded = load_universal(file=tmp_path / "m.safetensors").zero(draw(12)[0].rest_uT)
        np.testing.assert_allclose(
            loaded.predict(draw(12)[0].b_uT), each.zero(draw(12)[0].rest_uT).predict(draw(12)[0].b_uT), rtol=1e-6
        )
        model_module._read_parts.cache_clear()  # the same file has another content next


def test_a_single_board_is_used_but_not_held_out():
    _, held_out = with_boards(load_universal(), boards()[:1], TINY, say=lambda _: None)
    assert held_out == []


def test_refined_network_fits_its_labels_better_and_is_saved_with_the_skin(tmp_path):
    skin, model = draw(12)[3], load_universal()
    skin = skin._replace(place_mm=8 + 1.2 * (skin.place_mm - 8))  # a skin that is not like the simulated ones
    model.zero(skin.rest_uT).label(skin.place_mm[:10], skin.force_N[:10], skin.b_uT[:10])
    with pytest.raises(SchemaError, match="at least 20 labels with known forces; got 10"):
        model.refine()
    model.label(skin.place_mm[:60], skin.force_N[:60], skin.b_uT[:60])

    def error_mm():
        return np.abs(model.predict(skin.b_uT)[:, :2] - skin.place_mm).mean()

    before_mm, before_N, before = error_mm(), model.predict(skin.b_uT)[:, 2], model.skin.judge
    assert model.refine().skin.data.refined
    assert error_mm() < before_mm
    # What follows from the labels still comes from the network that does not know them.
    np.testing.assert_array_equal(model.predict(skin.b_uT)[:, 2], before_N)
    assert model.skin.judge.sd_mm == before.sd_mm
    model.save(tmp_path / "s.safetensors")
    again = load_universal(tmp_path / "s.safetensors")
    np.testing.assert_allclose(again.predict(skin.b_uT), model.predict(skin.b_uT), rtol=1e-6)
    assert not model.label([8.0, 8.0], 1.0, skin.b_uT[:1]).skin.data.refined  # the earlier labels are discarded
    assert not again.zero(skin.rest_uT).skin.data.refined


def recorded(tmp_path, **changes):
    """Write a table of readings of one skin with two presses, of two readings each, to a folder."""
    skin, n = draw(12)[0], 4
    press = np.array([0, 0, 1, 1], np.int32)
    arrays = {
        "indentation": press, "pass_i": press, "reading_i": press, "n_contacts": press,
        "x_mm": skin.place_mm[press, 0], "y_mm": skin.place_mm[press, 1], "depth_mm": np.ones(n),
        "Fx_N": np.zeros(n), "Fy_N": np.zeros(n), "Fz_N": skin.force_N[press], "b_uT": skin.b_uT[press],
        "noload_uT": np.tile(skin.rest_uT, (n, 1)), "temperature_degC": np.full((n, 5), 25.0),
    }  # fmt: skip
    arrays = {
        name: np.asarray(value, value.dtype if value.dtype == np.int32 else np.float32)
        for name, value in (arrays | changes).items()
    }
    io.write_readings(
        tmp_path / "c.parquet", [Readings("c", "b0", "s0", "recorded", t_s=np.arange(float(n)), **arrays)], {}
    )
    return skin


def test_recordings_are_read_along_the_axes_of_the_board(tmp_path):
    skin = recorded(tmp_path)
    for mirrored, sign in ((False, 1), (True, -1)):
        (board,) = read_recordings(tmp_path, LAYOUT, mirrored=mirrored)
        assert board.name == "b0/s0"
        np.testing.assert_allclose(board.place_mm, (skin.place_mm[:2] - 8) * [1, sign], atol=1e-5)
        np.testing.assert_allclose(board.force_N[:, 0], skin.force_N[:2], rtol=1e-6)
        np.testing.assert_allclose(board.db_uT[:, 0], LAYOUT.to_board(skin.b_uT[:2] - skin.rest_uT), atol=0.01)


def test_unusable_recordings_and_layouts_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ParamsError, match="has no Parquet file"):
        read_recordings(tmp_path, LAYOUT)
    recorded(tmp_path, Fz_N=np.full(4, np.nan))
    with pytest.raises(ParamsError, match="b0/s0 has no press with a known place and force"):
        read_recordings(tmp_path, LAYOUT)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ParamsError, match="neither a folder nor a scene"):
        folder_of(tmp_path / "none")
    with pytest.raises(ParamsError, match="must end in .safetensors"):
        make(file_of("reskin"), tmp_path / "m.npz")
    with pytest.raises(ParamsError, match="Add --recordings"):
        make(file_of("reskin"), tmp_path / "m.safetensors", start=tmp_path / "m")
    (tmp_path / "m.json").write_text("{}")
    with pytest.raises(ParamsError, match="exists"):
        make(file_of("reskin"), tmp_path / "m.safetensors")
