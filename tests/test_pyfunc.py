"""Tests of models in MLflow's format: signature, example, loading by their alias, and serving by HTTP."""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest

import reskin
from pipeline.pyfunc import COLUMNS, channel_names, read_example
from pipeline.tracking import Results, publish
from reskin import io
from reskin.universal.model import FILE
from tests.benchmarks import FULL
from tests.live.boards import write_model

pytestmark = pytest.mark.filterwarnings("ignore")  # importing mlflow.pyfunc causes warnings about MLflow's types
DB_uT = np.random.default_rng(0).normal(0, 100, (4, 15))


def write_final(folder: Path, key: str = "k0") -> Path:
    """Write a network with the card of a final model."""
    folder.mkdir(exist_ok=True)
    weights = write_model(folder, "final")
    card = io.read_json(weights.with_suffix(".json"))
    names = {"question": "final", "recipe_name": "paper", "fold": "all boards", "git": "abc", "key": key}
    card |= names | {"seed": 1, "seed_i": 0, "curve": [2.0, 1.0], "curve_steps": [1, 2], "train_rows_n": 9}
    card |= {"train_boards": ["b0", "b1"], "train_skins": ["s0"], "test_boards": [], "test_skins": []}
    held_out = {"b0": {"accuracy_pct": 60.0, "mse_xy_mm2": 1.0}, "b1": {"accuracy_pct": 70.0, "mse_xy_mm2": 2.0}}
    io.write_json(weights.with_suffix(".json"), card | {"held_out": held_out})
    return weights


def publish_final(root: Path, key: str = "k0") -> Path:
    weights = write_final(root / "models", key)
    readings = root / "readings.parquet"
    pd.DataFrame({"b_uT": list(DB_uT + 100), "noload_uT": list(0 * DB_uT + 100)}).to_parquet(readings)
    publish(Results({}, {}, root / "reports", final=weights, readings=[readings]), scene="ci", root=root)
    return weights


@pytest.fixture(scope="module")
def root(tmp_path_factory, empty_store) -> Path:
    """Return a folder whose MLflow store has the models of a scene and the universal model."""
    folder = tmp_path_factory.mktemp("models")
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    shutil.copy(empty_store, folder / "mlflow.db")
    publish_final(folder)
    return folder


@pytest.fixture
def client(root, monkeypatch) -> mlflow.MlflowClient:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{root / 'mlflow.db'}")
    mlflow.set_registry_uri(None)
    return mlflow.MlflowClient()


def test_read_example_returns_the_largest_field_changes_of_a_recording(tmp_path):
    changes_uT = DB_uT * np.array([[0.0], [3.0], [2.0], [1.0]])
    pd.DataFrame({"b_uT": list(changes_uT + 50), "noload_uT": list(0 * DB_uT + 50)}).to_parquet(tmp_path / "a.parquet")
    example_uT = read_example([tmp_path / "missing.parquet", tmp_path / "a.parquet"])
    np.testing.assert_allclose(example_uT, changes_uT[1:], atol=1e-9)
    assert read_example([]) is None


def test_model_with_the_alias_champion_has_the_predictions_of_the_saved_model(client, root):
    model = mlflow.pyfunc.load_model("models:/reskin-ci@champion")
    assert model.metadata.get_input_schema().input_names() == channel_names(15)
    assert model.metadata.get_output_schema().input_names() == list(COLUMNS)
    readings = pd.DataFrame(DB_uT, columns=channel_names(15))
    expected = reskin.load_model(root / "models/final.safetensors").zero(np.zeros(15)).predict(DB_uT)
    np.testing.assert_allclose(model.predict(readings).to_numpy(), expected, rtol=1e-6)
    by_name = model.predict(readings[readings.columns[::-1]])  # columns are found by name
    np.testing.assert_allclose(by_name.to_numpy(), expected, rtol=1e-6)
    example = model.input_example
    assert example.shape == (3, 15)
    assert np.isfinite(model.predict(example).to_numpy()).all()
    run = client.get_run(model.metadata.run_id)
    assert run.data.metrics["accuracy_pct"] == 65.0  # the mean over both held-out boards
    assert run.data.metrics["mse_xy_mm2"] == 1.5


def test_alias_champion_moves_to_the_current_model(tmp_path, monkeypatch, empty_store):
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")
    client = mlflow.MlflowClient()

    def champion() -> int:
        return int(client.get_model_version_by_alias("reskin-ci", "champion").version)

    publish_final(tmp_path)
    publish_final(tmp_path)
    assert len(client.search_model_versions("name = 'reskin-ci'")) == 1
    publish_final(tmp_path, key="k1")
    assert champion() == 2
    publish_final(tmp_path)  # the earlier results are restored
    assert champion() == 1


def test_universal_model_is_calibrated_by_parameters(client):
    model = mlflow.pyfunc.load_model("models:/reskin-universal@champion")
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(seed=3), [[8.0, 8.0, 1.0], [4.0, 10.0, 0.8]])
    noload_uT = noload_uT[0]
    db_uT = pd.DataFrame(b_uT - noload_uT, columns=channel_names(15))
    labels = [[8.0, 8.0, force_N[0]], [4.0, 10.0, force_N[1]]]
    params = {
        "noload_uT": noload_uT.tolist(), "presses_uT": db_uT.to_numpy().ravel().tolist(),
        "labelled_uT": db_uT.to_numpy().ravel().tolist(), "labels": np.ravel(labels).tolist(),
    }  # fmt: skip
    skin = reskin.load_universal().zero(noload_uT).see(b_uT)
    skin.label(np.array(labels)[:, :2], force_N, b_uT)
    np.testing.assert_allclose(model.predict(db_uT, params).to_numpy(), skin.predict(b_uT), rtol=1e-4, atol=1e-3)
    uncalibrated = model.predict(db_uT).to_numpy()  # without parameters, the estimates are those for a nominal skin
    assert uncalibrated.shape == (2, 3)
    assert not np.allclose(uncalibrated, skin.predict(b_uT), rtol=1e-4)
    assert io.sha256(Path(model._model_impl.file)) == io.sha256(FILE)


def test_scoring_server_returns_predictions_for_its_example(client):
    from mlflow.pyfunc import scoring_server

    model = mlflow.pyfunc.load_model("models:/reskin-ci@champion")
    body = json.dumps(serving_example(model))
    response = scoring_server.invocations(body, "application/json", model, model.metadata.get_input_schema())
    assert response.status == 200
    rows = json.loads(response.response)["predictions"]
    assert [list(row) for row in rows] == [list(COLUMNS)] * 3


def serving_example(model) -> dict:
    """Return the body of a request, from the files of the model."""
    folder = mlflow.artifacts.download_artifacts(f"runs:/{model.metadata.run_id}/model")
    return io.read_json(Path(folder) / "serving_input_example.json")


@pytest.mark.skipif(not FULL, reason="slow: run `make bench`")
@pytest.mark.parametrize("name", ["reskin-ci", "reskin-universal"])
def test_command_mlflow_models_serve_returns_predictions_by_http(client, root, name):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    uri = f"models:/{name}@champion"
    body = json.dumps(serving_example(mlflow.pyfunc.load_model(uri))).encode()
    command = [sys.executable, "-m", "mlflow", "models", "serve", "-m", uri, "--env-manager", "local", "-p", str(port)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    with subprocess.Popen(command, env=environment, start_new_session=True) as server:
        try:
            rows = post(f"http://127.0.0.1:{port}/invocations", body)
        finally:
            os.killpg(server.pid, 15)
    assert [list(row) for row in rows] == [list(COLUMNS)] * 3


def post(url: str, body: bytes, limit_s: float = 120.0) -> list:
    """Send a request until the server has started; return the predictions."""
    until_s = time.monotonic() + limit_s
    while True:
        try:
            request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
            with urllib.request.urlopen(request, timeout=10) as answer:
                return json.load(answer)["predictions"]
        except urllib.error.URLError:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.5)
