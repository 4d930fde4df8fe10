"""Tests of what a scene's files become in MLflow, and of servers and stores that do not work."""

import http.server
import json
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import mlflow
import numpy as np
import pandas as pd
import pytest

import reskin
from pipeline.tracking import TrackingUnavailable, after_stage, publish
from reskin import io
from tests.live.boards import write_model

pytestmark = pytest.mark.filterwarnings("ignore")  # importing mlflow.pyfunc causes warnings about MLflow's types
SCORES = {"accuracy_pct": 50.0, "mse_xy_mm2": 2.0}


@pytest.fixture(autouse=True)
def _checkout(monkeypatch, tmp_path, empty_store):
    """Work in a folder with an empty store and the files of scene ci: two trainings, the final model and scores."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    for fold in ("b0", "b1"):
        write_card("train_multi", f"lobo.paper.{fold}", fold=fold, scores={"all": SCORES})
    held_out = {"b0": {"accuracy_pct": 60.0}, "b1": {"accuracy_pct": 70.0}}
    write_card("final", "final", question="final", held_out=held_out)
    write_means(50.0)
    Path("data/scores/ci").mkdir(parents=True)
    io.write_tensors(Path(".reskin/cells/lobo.paper.b0.safetensors"), {"curve": np.zeros(1)}, {"seconds": "4.5"})


def write_card(stage: str, name: str, **changes) -> None:
    folder = Path("data/models/ci") / stage
    folder.mkdir(parents=True, exist_ok=True)
    weights = write_model(folder, name)
    card = {
        "question": "lobo", "recipe_name": "paper", "fold": "all boards", "key": name, "seed": 1, "seed_i": 0,
        "curve": [3.0, 2.0, 1.0], "curve_steps": [16, 32, 48], "train_rows_n": 4, "train_boards": ["b1"],
        "train_skins": ["s1"], "test_boards": ["b0"], "test_skins": ["s0"],
    }  # fmt: skip
    written = io.read_json(io.card_of(weights))
    io.write_model(weights, io.read_tensors(weights)[0], written | card | changes)


def write_means(accuracy_pct: float) -> None:
    scores = {"table2": {"multi": {"accuracy_pct": accuracy_pct}}, "drift_end": {"each": {"accuracy_pct": 90.0}}}
    io.write_json(Path("reports/ci/scores.json"), scores)


def client() -> mlflow.MlflowClient:
    return mlflow.MlflowClient(f"sqlite:///{Path('mlflow.db').resolve()}")


def runs(query: str = "") -> dict:
    experiment = client().get_experiment_by_name("ci")
    found = client().search_runs([experiment.experiment_id], query)
    assert len({run.info.run_name for run in found}) == len(found)
    return {run.info.run_name: run for run in found}


def test_training_has_parameters_curve_scores_duration_and_model_card():
    publish("ci")
    run = runs()["lobo.paper.b0"]
    assert run.info.status == "FINISHED"
    assert run.data.metrics == SCORES | {"loss": 1.0, "train_s": 4.5}
    assert (run.info.end_time - run.info.start_time) / 1e3 == 4.5
    expected = {"method": "multi", "recipe": "paper", "fold": "b0", "seed": "1", "train_rows_n": "4"}
    assert run.data.params.items() >= expected.items()
    curve = client().get_metric_history(run.info.run_id, "loss")
    assert [(point.step, point.value) for point in curve] == [(16, 3.0), (32, 2.0), (48, 1.0)]
    files = {file.path for file in client().list_artifacts(run.info.run_id)}
    assert files == {"lobo.paper.b0.json", "lobo.paper.b0.safetensors"}


def test_means_of_methods_come_first_and_have_the_parameters_that_their_trainings_share():
    publish("ci")
    mean = runs("tags.kind = 'mean'")["mean of multi"]
    assert mean.data.metrics == {"accuracy_pct": 50.0}
    assert mean.data.params["trainings_n"] == "2"
    assert mean.data.params["recipe"] == "paper"
    assert "fold" not in mean.data.params
    assert runs()["drift_end"].data.metrics == {"each.accuracy_pct": 90.0}
    experiment = client().get_experiment_by_name("ci")
    view = json.loads(json.loads(experiment.tags["mlflow.sharedViewState.scores"])["state"])
    listed = client().search_runs([experiment.experiment_id], order_by=[f"{view['orderByKey']} ASC"])
    assert [run.data.tags["kind"] for run in listed] == ["mean", "mean", "model", "training", "training"]
    assert view["selectedColumns"][0] == "metrics.`accuracy_pct`"


def test_what_mlflow_has_is_not_written_again():
    assert publish("ci").startswith("ci: 5 of 5 runs")
    before = {run.info.run_id for run in runs().values()}
    assert publish("ci").startswith("ci: 0 of 5 runs")
    assert {run.info.run_id for run in runs().values()} == before
    assert len(client().search_model_versions("name = 'reskin-ci'")) == 1


def test_run_of_a_killed_process_and_training_with_new_scores_are_replaced():
    publish("ci")
    killed = runs()["lobo.paper.b0"].info.run_id
    client().set_terminated(killed, "KILLED")
    write_card("train_multi", "lobo.paper.b1", fold="b1", scores={"all": SCORES | {"accuracy_pct": 77.0}})
    assert publish("ci").startswith("ci: 2 of 5 runs")
    found = runs("tags.kind = 'training'")
    assert {run.info.status for run in found.values()} == {"FINISHED"}
    assert found["lobo.paper.b0"].info.run_id != killed
    assert found["lobo.paper.b1"].data.metrics["accuracy_pct"] == 77.0


def test_final_model_loads_without_pickle_and_predicts():
    publish("ci")
    mlflow.set_tracking_uri(f"sqlite:///{Path('mlflow.db').resolve()}")
    model = mlflow.pyfunc.load_model("models:/reskin-ci@champion")
    names = model.metadata.get_input_schema().input_names()
    assert names[:4] == ["Bx0", "By0", "Bz0", "Bx1"]
    db_uT = np.random.default_rng(0).normal(0, 100, (4, 15))
    predicted = model.predict(pd.DataFrame(db_uT, columns=names)[names[::-1]])  # columns are found by name
    assert list(predicted) == ["x_mm", "y_mm", "force_N"]
    ours = reskin.load_model("data/models/ci/final/final.safetensors").zero(np.zeros(15)).predict(db_uT)
    np.testing.assert_allclose(predicted.to_numpy(), ours, rtol=1e-6)
    assert client().get_run(model.metadata.run_id).data.metrics["accuracy_pct"] == 65.0  # mean over held-out boards
    assert not list(Path("mlartifacts").rglob("*.pkl"))


def test_champion_is_the_model_in_the_checkout():
    publish("ci")
    write_card("final", "final", question="final", held_out={}, key="other")
    publish("ci")
    assert int(client().get_model_version_by_alias("reskin-ci", "champion").version) == 2
    write_card("final", "final", question="final", held_out={"b0": {"accuracy_pct": 65.0}})
    publish("ci")
    assert int(client().get_model_version_by_alias("reskin-ci", "champion").version) == 1


def test_stages_write_trainings_and_the_report_writes_means(capsys):
    after_stage("train_multi", "ci")
    assert set(runs()) == {"lobo.paper.b0", "lobo.paper.b1", "final"}
    after_stage("report", "ci")
    assert "mean of multi" in runs()
    assert "http://127.0.0.1:5000/#/experiments/" in capsys.readouterr().err


def test_results_of_dvc_exp_are_in_an_experiment_of_their_own(tmp_path, monkeypatch):
    copy = tmp_path / ".dvc/tmp/exps/tmp1"
    for folder in ("data", "reports"):
        shutil.copytree(folder, copy / folder)
    monkeypatch.chdir(copy)
    publish("ci")
    monkeypatch.chdir(tmp_path)
    assert client().get_experiment_by_name("ci (dvc exp)")
    assert not client().search_model_versions("name = 'reskin-ci'")


def test_nothing_is_written_if_publishing_is_off(monkeypatch):
    monkeypatch.setenv("RESKIN_PUBLISH", "0")
    after_stage("report", "ci")
    assert client().get_experiment_by_name("ci") is None


class OnlyHealth(http.server.BaseHTTPRequestHandler):
    """HTTP server that answers /health only."""

    def do_GET(self) -> None:
        if self.path == "/health":
            self.send_response(200)
            self.end_headers()
        else:
            time.sleep(30)

    do_POST = do_GET

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def absent() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"http://127.0.0.1:{server.getsockname()[1]}"  # closed when the function returns


@pytest.fixture
def silent() -> Iterator[str]:
    """Yield the address of a server that accepts connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}"


@pytest.fixture
def hung() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), OnlyHealth) as server:
        server.daemon_threads, server.block_on_close = True, False
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize("kind", ["absent", "silent", "hung", "mistyped"])
def test_server_that_does_not_work_costs_seconds(kind, request, monkeypatch, capsys):
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    uri = "http://127.0.0.1:99999" if kind == "mistyped" else request.getfixturevalue(kind)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    start_s = time.monotonic()
    after_stage("train_multi", "ci")
    assert time.monotonic() - start_s < 20  # by default, MLflow would retry for minutes
    assert "No result is lost. When it works again, send the results: reskin publish" in capsys.readouterr().err


def test_broken_store_is_reported_with_its_remedy():
    Path("mlflow.db").write_bytes(b"junk" * 99)
    with pytest.raises(TrackingUnavailable, match="move .*mlflow.db away. Then send the results: reskin publish"):
        publish("ci")
    Path("mlflow.db").unlink()
