"""Tests of the public functions of `reskin`: results equal those of the pipeline, and docstring examples run."""

import doctest
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import reskin
from reskin import io
from reskin.config import read_yaml
from reskin.data.rows import Selection, load_rows
from reskin.errors import ReskinError
from reskin.models.trained import read_network
from reskin.seeds import rng_for
from reskin.simulation.capture import simulate_capture
from reskin.simulation.defaults import nominal
from reskin.simulation.settings import parse_simulation
from tests.test_io import readings
from tests.test_predicting import model  # noqa: F401 (a fixture)

ROOT = Path(__file__).resolve().parents[1]
QUIET_CHIP = {"noise_xy_uT": 0.0, "noise_z_uT": 0.0}


@pytest.mark.parametrize("name", ["reskin", "reskin.api", "reskin.errors", "reskin.estimators"])
def test_examples_in_docstrings_run(name):
    done = doctest.testmod(importlib.import_module(name), extraglobs={"reskin": reskin})
    assert (done.failed, done.attempted > 0) == (0, True)


def test_importing_reskin_imports_no_slow_packages():
    modules = ("torch", "scipy", "pandas", "sklearn", "mlflow")
    code = f"import sys, reskin; print([name for name in {modules} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_only_the_estimators_need_scikit_learn(monkeypatch):
    assert {"ContactRegressor", "SCORERS"} < set(dir(reskin))
    monkeypatch.setattr("reskin.find_spec", lambda name: None)
    with pytest.raises(
        ReskinError, match=r"reskin.SCORERS: the Python package `scikit-learn` is not installed.*'\.\[learn\]'"
    ):
        _ = reskin.SCORERS
    assert "ContactRegressor" not in dir(reskin)
    assert all(hasattr(reskin, name) for name in reskin.__all__)


def test_load_rows_returns_the_rows_that_the_pipeline_uses(tmp_path):
    files = [tmp_path / f"data/indentations/small/c{i}.parquet" for i in range(2)]
    for file in files:
        io.write_readings(file, [readings()], {})
    rows = reskin.load_rows(tmp_path / "data/indentations/small")
    expected = load_rows(files, Selection(force_min_N=0.0))
    for name in ("capture", "board", "skin", "db_uT", "target", "pass_i", "indentation"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(expected, name))


def test_simulate_pokes_returns_the_fields_of_a_simulated_capture_without_noise():
    simulate = read_yaml(ROOT / "pipeline/scenes/quick.yaml")["simulate"]
    simulate["protocols"] = {"grid": simulate["protocols"]["grid"] | {"passes_n": 1, "depths_mm": [1.0], "terms": []}}
    exact = {name: 0.0 for name in ("robot_place_sd_mm", "robot_depth_sd_mm", "place_offset_sd_mm", "force_noise_N")}
    shared = {name: nominal(name) for name in ("skin", "spreads", "terms")}
    shared |= {"chip": nominal("chip", QUIET_CHIP), "rig": nominal("rig", exact)}
    capture = simulate_capture(parse_simulation(simulate, shared, "quick"), "grid", board="b0", skin="b0_s0", seed=3)
    contact = capture.probe.contact
    places = np.stack([getattr(capture.probe, name)[contact] for name in ("x_mm", "y_mm", "depth_mm")], axis=1)

    skin = reskin.draw_skin("b0_s0", seed=3)
    board = reskin.draw_board("b0", seed=3)
    noload_uT, b_uT, Fz_N = reskin.simulate_pokes(skin, places.tolist(), board=board, chip=QUIET_CHIP)

    per_poke = capture.b_uT.reshape(len(places), -1, 15)
    # The tolerance is the largest step of a chip. The rounding of places to single precision changes the field less.
    step_uT = 0.5
    assert np.abs(per_poke[:, 1] - noload_uT).max() <= step_uT
    last_contact_i = per_poke.shape[1] - 1 - shared["rig"]["moving_frames_n"]
    assert np.abs(per_poke[:, last_contact_i] - b_uT).max() <= step_uT
    assert np.abs(b_uT - noload_uT).max() > 100 * step_uT
    # The tolerance is the resolution of the force sensor.
    np.testing.assert_allclose(Fz_N, capture.probe.Fz_N[contact], atol=0.01)


def test_functions_that_draw_skins_and_boards_accept_plain_values_and_refuse_wrong_ones():
    spreads = {"chip_offset_uT": 0.0}
    board = reskin.draw_board(chips_xy_mm=[[0, 0], [7, 0]], chips_turn_deg=[0, 90], spreads=spreads)
    assert board.chips_m.shape == (2, 3)
    assert reskin.simulate_pokes(reskin.draw_skin(thickness_mm=3), [[8, 8, 1]], board=board).b_uT.shape == (1, 6)
    with pytest.raises(ReskinError, match="draw_skin: thickness_mm must be"):
        reskin.draw_skin(thickness_mm="thick")
    with pytest.raises(ReskinError, match=r"pokes has shape \(3,\); it needs rows of x_mm, y_mm, depth_mm"):
        reskin.simulate_pokes(reskin.draw_skin(), [8, 8, 1])


def test_simulating_no_pokes_gives_empty_arrays():
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(), np.zeros((0, 3)))
    with_poke = reskin.simulate_pokes(reskin.draw_skin(), [[8, 8, 1]])
    assert (noload_uT.shape, b_uT.shape, force_N.shape) == ((0, 15), (0, 15), (0,))
    assert (noload_uT.dtype, b_uT.dtype, force_N.dtype) == tuple(array.dtype for array in with_poke)


def test_touch_and_record_accept_only_known_keyword_arguments():
    touch = reskin.touch(1, 2, depth_mm=0.5, Fx_N=0.1, Fz_N=3, pass_i=4)
    assert touch == (True, 1, 2, 0.5, 0.1, touch.Fy_N, 3, 4)
    assert np.isnan(touch.Fy_N)
    with pytest.raises(TypeError, match="unexpected keyword argument 'Fz'"):
        reskin.touch(1, 2, Fz=3)
    with pytest.raises(TypeError, match="unexpected keyword argument 'bord'"):
        # A misspelt keyword is an error before the port is opened.
        reskin.record(iter(()), port="/dev/none", bord="b1")


def test_open_accepts_loaded_models(model):  # noqa: F811
    network, universal = reskin.load_model(model), reskin.load_universal()
    for models, name in (
        ([network], "1 network"), ([network, str(model), network], "3 networks"), ((model, model), "2 networks"),
        (iter([model, network]), "2 networks"), ([universal], "universal model"),
        (universal, "universal model"), ([], "universal model"),
        (network, "1 network"), (model, "1 network"),
    ):  # fmt: skip
        assert reskin.open("/dev/none", model=models).estimator.name == name
    with pytest.raises(ReskinError, match="a universal model cannot be combined with other models"):
        reskin.open("/dev/none", model=[network, universal])
    with pytest.raises(ReskinError, match="a model must be a file or a loaded model; got int"):
        reskin.open("/dev/none", model=[1])
    with pytest.raises(ReskinError, match="a model must be a file or a loaded model; got NoneType"):
        reskin.open("/dev/none", model=None)


def test_loaded_model_returns_the_predictions_of_its_network(model):  # noqa: F811
    b_uT = rng_for(0, "api").normal(500, 100, (4, 15)).astype(np.float32)

    loaded = reskin.load_model(str(model)).zero(b_uT[:2].tolist())
    predicted = loaded.predict(b_uT[2:].tolist())

    noload_uT = b_uT[:2].mean(axis=0, dtype=np.float64)
    np.testing.assert_array_equal(predicted, read_network(model)((b_uT[2:] - noload_uT).astype(np.float32)))
    np.testing.assert_array_equal(loaded.predict(b_uT[2].tolist()), predicted[0])
    with pytest.raises(ReskinError, match="the no-load reading is missing"):
        reskin.load_model(model).predict(b_uT)
    with pytest.raises(ReskinError, match=r"fields of shape \(2,\) do not fit the 15 channels"):
        loaded.predict([1.0, 2.0])


def test_shipped_model_estimates_field_changes_like_readings():
    noload_uT, b_uT, _ = reskin.simulate_pokes(reskin.draw_skin(), [[6.0, 9.0, 1.0], [10.0, 5.0, 0.6]])
    universal = reskin.load_universal().zero(noload_uT)
    changes = universal.estimate(b_uT - noload_uT.mean(axis=0, dtype=np.float64), changes=True)
    np.testing.assert_allclose(changes.place_mm, universal.predict(b_uT)[:, :2], atol=1e-3)


def test_simulated_recording_is_loaded_in_the_same_way_as_a_recorded_one(tmp_path):
    folder = reskin.simulate_recording(tmp_path / "run1", board="b1", skin="b1_s0", depths_mm=[1.0])
    frame = reskin.load_recording(folder)
    assert [frame[name].unique().tolist() for name in ("capture", "board", "skin", "source")] == [
        ["run1"], ["b1"], ["b1_s0"], ["simulated"],
    ]  # fmt: skip
    assert (frame["indentation"].nunique(), frame["depth_mm"].unique().tolist()) == (65, [1.0])
    again = reskin.simulate_recording(tmp_path / "again" / "run1", board="b1", skin="b1_s0", depths_mm=[1.0])
    assert reskin.load_recording(again).equals(frame)
    with pytest.raises(ReskinError, match="run1 exists. Choose another folder"):
        reskin.simulate_recording(folder)
    for wrong in ({"depths_mm": [-1.0]}, {"passes_n": 0}, {"board": "a b"}):
        with pytest.raises(ReskinError, match="simulate_recording"):
            reskin.simulate_recording(tmp_path / "wrong", **wrong)
    assert not (tmp_path / "wrong").exists()
