import json
import logging
import shutil
import socket
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import mlflow
import numpy as np
import pytest

from pipeline import tracking
from pipeline.tracking import Results, Span, Times, TrackingUnavailable, metrics_of, probe, publish
from pipeline.views import SCORES, VIEWS
from reskin import io
from tests.report.synthetic import new_board


@pytest.fixture(autouse=True)
def _embedded(monkeypatch, tmp_path, empty_store):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    shutil.copy(empty_store, tmp_path / "mlflow.db")


@pytest.fixture
def silent_server() -> Iterator[str]:
    """Yield the address of a server that accepts connections and never responds."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        accepted: list[socket.socket] = []
        threading.Thread(target=lambda: accepted.append(server.accept()[0]), daemon=True).start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        for connection in accepted:
            connection.close()


@pytest.fixture
def dead_address() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        # The socket is closed when the function returns, so nobody listens at the address.
        return f"http://127.0.0.1:{server.getsockname()[1]}"


def write_model(models: Path, name: str, key: str, accuracy_pct: float = 50.0) -> None:
    card = {
        "scene": "ci", "question": "lobo", "recipe_name": "paper", "fold": name, "git": "abc", "key": key, "seed": 1,
        "seed_i": 0, "recipe": {"steps_n": 3, "inputs": "raw", "architecture": "paper"}, "train_rows_n": 4,
        "train_skins": ["b1_s0"], "train_boards": ["b1"], "test_boards": ["b0"],
        "test_skins": ["s0"],
        "curve": [3.0, 2.0, 1.0], "curve_steps": [16, 32, 48], "input": {"channels_n": 15},
        "scores": {"all": {"accuracy_pct": accuracy_pct, "mse_xy_mm2": 2.0, "force_mean_N": 1.0},
                   "registered": {"accuracy_pct": 60.0, "mse_xy_mm2": 1.0},
                   "by_skin": {}, "board_of": {}, "rows_n": 4},
    }  # fmt: skip
    io.write_json(models / f"{name}.json", card)
    io.write_tensors(models / f"{name}.safetensors", {"weights.a": np.zeros(2, np.float32)}, {})


def write(root: Path, **keys: str) -> dict[str, int]:
    io.remove(root / "models")
    for name, key in keys.items():
        write_model(root / "models", name, key)
    write_report(root / "reports")
    return send(root, {"train_multi": root / "models"})


def send(root: Path, models=None, curves=None, **options) -> dict[str, int]:
    """Publish folders of models and curves by stage, and the report, to MLflow experiment `ci`."""
    results = Results(models or {}, curves or {}, root / "reports", **options)
    return publish(results, scene="ci", root=root, register=False)


def write_report(reports: Path, accuracy_pct: float = 50.0, seconds: float = 1.0) -> None:
    numbers = {
        "provenance": {"seed": 1, "seconds": seconds}, "runtime": {"stages": {"report": {"seconds": seconds}}},
        "table2": {"multi": {"accuracy_pct": {"mean": accuracy_pct, "n": 2}}},
        "drift": {
            "each": [{"contacts_n": 5, "accuracy_pct": 90.0}, {"contacts_n": 10, "accuracy_pct": 80.0}],
            "findings": [{"finding": "f", "holds": True}], "policy": "each",
        },
    }  # fmt: skip
    io.write_json(reports / "numbers.json", numbers)
    io.write_json(reports / "scores.json", {"table2": {"multi": {"accuracy_pct": accuracy_pct}}})
    io.write_text(reports / "index.html", f"<p>{seconds}</p>")
    io.write_text(reports / "figures/a.svg", "<svg/>")


def runs(root: Path, query: str) -> list:
    client = mlflow.MlflowClient(f"sqlite:///{root / 'mlflow.db'}")
    return list(client.search_runs([client.get_experiment_by_name("ci").experiment_id], query))


def test_each_training_run_is_published_once(tmp_path):
    assert write(tmp_path, b0="k0", b1="k1") == {"new_n": 2, "kept_n": 0, "superseded_n": 0}
    assert write(tmp_path, b0="k0", b1="k1") == {"new_n": 0, "kept_n": 2, "superseded_n": 0}
    children = runs(tmp_path, "tags.kind = 'training'")
    (parent,) = runs(tmp_path, "tags.stage = 'train_multi' and tags.kind = 'stage'")
    assert sorted(run.data.tags["fold"] for run in children) == ["b0", "b1"]
    assert {run.data.tags["mlflow.parentRunId"] for run in children} == {parent.info.run_id}
    assert {run.info.status for run in [*children, parent]} == {"FINISHED"}
    assert parent.data.metrics == {"accuracy_pct.lobo.paper": 50.0, "mse_xy_mm2.lobo.paper": 2.0}
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    run = children[0]
    assert run.data.metrics == {
        "accuracy_pct": 50.0, "mse_xy_mm2": 2.0, "registered_accuracy_pct": 60.0, "registered_mse_xy_mm2": 1.0,
        "loss": 1.0,
    }  # fmt: skip
    assert run.data.params["steps_n"] == "3"
    curve = client.get_metric_history(run.info.run_id, "loss")
    assert [(point.step, point.value) for point in curve] == [(16, 3.0), (32, 2.0), (48, 1.0)]
    files = {Path(one.path).name for one in client.list_artifacts(run.info.run_id, "model")}
    assert files == {"MLmodel", f"{run.info.run_name}.json", f"{run.info.run_name}.safetensors"}
    assert {run.data.params["method"], run.data.params["fold"]} == {"lobo.paper", run.data.tags["fold"]}
    assert (run.data.tags["board"], run.data.tags["skin"]) == ("b0", "s0")
    contexts = {one.tags[0].value: one.dataset.name for one in client.get_run(run.info.run_id).inputs.dataset_inputs}
    assert contexts == {part: f"ci, {run.data.tags['fold']}, {part}" for part in ("train", "test")}

    # After a change of settings, the new result is current, and the run of the old result is kept.
    assert write(tmp_path, b0="k0", b1="k9") == {"new_n": 1, "kept_n": 1, "superseded_n": 2}
    current = runs(tmp_path, "tags.kind = 'training' and tags.current = 'true'")
    assert sorted(run.data.tags["cell"] for run in current) == ["k0", "k9"]

    # An incomplete run of a killed process is replaced. With restored settings, the old result is current again.
    client.set_terminated(next(run.info.run_id for run in current if run.data.tags["cell"] == "k9"), "KILLED")
    assert write(tmp_path, b0="k0", b1="k9")["new_n"] == 1
    assert write(tmp_path, b0="k0", b1="k1") == {"new_n": 0, "kept_n": 2, "superseded_n": 2}
    current = runs(tmp_path, "tags.kind = 'training' and tags.current = 'true'")
    assert sorted(run.data.tags["cell"] for run in current) == ["k0", "k1"]


def test_runs_with_old_scores_and_runs_of_dropped_experiments_are_not_current(tmp_path):
    write(tmp_path, b0="k0", b1="k1")
    # The key is that of the same training run, but the score is new.
    write_model(tmp_path / "models", "b1", "k1", accuracy_pct=77.0)
    counts = send(tmp_path, {"train_multi": tmp_path / "models"})
    assert counts == {"new_n": 1, "kept_n": 1, "superseded_n": 2}
    current = runs(tmp_path, "tags.kind = 'training' and tags.current = 'true'")
    assert sorted(run.data.metrics["accuracy_pct"] for run in current) == [50.0, 77.0]

    # A dropped experiment has no current runs.
    send(tmp_path)
    assert [run.data.tags["stage"] for run in runs(tmp_path, "tags.current = 'true'")] == ["report"]


def test_run_of_a_report_has_its_figures_page_and_numbers(tmp_path):
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    write(tmp_path)
    (run,) = runs(tmp_path, "tags.stage = 'report'")
    assert run.info.status == "FINISHED"
    assert {one.path for one in client.list_artifacts(run.info.run_id)} == {
        "figures", "index.html", "numbers.json", "scores.json",
    }  # fmt: skip
    assert [one.path for one in client.list_artifacts(run.info.run_id, "figures")] == ["figures/a.svg"]
    assert run.data.metrics == {"table2.multi.accuracy_pct": 50.0}

    # Changed costs only update files of the report's run; a changed number creates a new run.
    write_report(tmp_path / "reports", seconds=2.0)
    send(tmp_path)
    (same,) = runs(tmp_path, "tags.stage = 'report'")
    assert len(client.get_metric_history(same.info.run_id, "table2.multi.accuracy_pct")) == 1
    assert Path(client.download_artifacts(same.info.run_id, "index.html")).read_text() == "<p>2.0</p>"
    write_report(tmp_path / "reports", accuracy_pct=60.0)
    assert send(tmp_path)["superseded_n"] == 1
    (current,) = runs(tmp_path, "tags.stage = 'report' and tags.current = 'true'")
    assert current.data.metrics == {"table2.multi.accuracy_pct": 60.0}


def test_counts_are_not_published_as_metrics():
    numbers = {"capture": {"bytes_n": 5}, "drift": {"skins_n": 3, "end": {"accuracy_pct": {"mean": 90.0, "n": 2}}}}
    assert metrics_of(numbers) == [("drift.end.accuracy_pct.mean", 90.0, 0)]


def test_runs_have_the_start_and_the_end_of_their_training(tmp_path):
    for name in ("b0", "b1"):
        write_model(tmp_path / "models", name, name)
    trainings = {("train_multi", "b0"): Span(1000.0, 4.0), ("train_multi", "b1"): Span(1003.0, 6.5)}
    times, scores = Times(trainings, {"drift": Span(2000.0, 9.0)}), {"train_multi": {"accuracy_pct": 51.0}}
    curves = {"drift": [("each", 0, {"accuracy_pct": 60.0})]}
    send(tmp_path, {"train_multi": tmp_path / "models"}, curves, times=times, scores=scores)
    by_name = {run.info.run_name: run for run in runs(tmp_path, "")}
    spans = {name: (run.info.start_time, run.info.end_time) for name, run in by_name.items()}
    assert spans["b0"] == (1_000_000, 1_004_000)
    assert spans["b1"] == (1_003_000, 1_009_500)
    assert spans["train_multi"] == (1_000_000, 1_009_500)  # The span is from the first start to the last end.
    assert spans["drift"] == (2_000_000, 2_009_000)
    assert by_name["b1"].data.metrics["train_s"] == 6.5
    stage = by_name["train_multi"].data.metrics
    assert (stage["accuracy_pct"], stage["train_s"]) == (51.0, 10.5)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    curve = client.get_metric_history(by_name["b0"].info.run_id, "loss")
    assert curve[-1].timestamp == 1_004_000  # The last step is at the end of the training.


def test_views_list_the_scores_first(tmp_path):
    write_model(tmp_path / "models", "b0", "k0")
    write_report(tmp_path / "reports")
    send(tmp_path, {"train_multi": tmp_path / "models"}, scores={"train_multi": {"accuracy_pct": 51.0}})
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    tags = client.get_experiment_by_name("ci").tags
    for view in VIEWS:
        state = json.loads(json.loads(tags[f"mlflow.sharedViewState.{view.key}"])["state"])
        assert state["selectedColumns"][:4] == [f"metrics.`{name}`" for name in SCORES]
        assert len(runs(tmp_path, state["searchFilter"])) == 1
        assert f"viewStateShareKey={view.key}" in tags["mlflow.note.content"]
    client.set_experiment_tag(client.get_experiment_by_name("ci").experiment_id, "mlflow.note.content", "ours")
    write(tmp_path, b0="k0")
    assert client.get_experiment_by_name("ci").tags["mlflow.note.content"] == "ours"


def test_runs_that_were_published_with_an_earlier_layout_are_superseded(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "LAYOUT", 2)
    write(tmp_path, b0="k0")
    monkeypatch.undo()
    assert write(tmp_path, b0="k0") == {"new_n": 1, "kept_n": 0, "superseded_n": 3}
    assert len(runs(tmp_path, "tags.current = 'true' and tags.kind = 'training'")) == 1


def test_run_of_a_sweep_has_its_metrics_by_step(tmp_path):
    write_report(tmp_path / "reports")
    curves = {"sweep_pokes": [("adapted", 0, {"accuracy_pct": 60.0}), ("adapted", 65, {"accuracy_pct": 70.0})]}
    send(tmp_path, curves=curves)
    send(tmp_path, curves=curves)
    (run,) = runs(tmp_path, "tags.stage = 'sweep_pokes' and tags.current = 'true'")
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    history = client.get_metric_history(run.info.run_id, "adapted.accuracy_pct")
    assert [(point.step, point.value) for point in history] == [(0, 60.0), (65, 70.0)]


CURVES = {old: {"sweep_pokes": [("adapted", 0, {"accuracy_pct": pct})]} for old, pct in ((True, 60.0), (False, 61.0))}


def publish_state(root: Path, old: bool, reported: bool = True) -> dict:
    """Write old or new results to a workspace and publish them; update the reports only if `reported`."""
    io.remove(root / "models")
    write_model(root / "models", "b0", "k0" if old else "k9", accuracy_pct=50.0 if old else 51.0)
    if reported:
        write_report(root / "reports", accuracy_pct=50.0 if old else 51.0)
    return send(root, {"train_multi": root / "models"}, CURVES[old])


def current(root: Path) -> set[str]:
    return {run.info.run_id for run in runs(root, "tags.current = 'true'")}


def test_restored_results_become_current_without_new_runs(tmp_path):
    publish_state(tmp_path, old=True)
    first = current(tmp_path)
    publish_state(tmp_path, old=False)
    assert len(first) == 4  # These are the runs of a training, of its stage, of a sweep and of the report.
    assert current(tmp_path) & first == set()
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    before = {run.info.run_id: history_points_n(client, run) for run in runs(tmp_path, "")}
    assert publish_state(tmp_path, old=True) == {"new_n": 0, "kept_n": 1, "superseded_n": 4}
    assert current(tmp_path) == first
    assert {run.info.run_id: history_points_n(client, run) for run in runs(tmp_path, "")} == before


def history_points_n(client: mlflow.MlflowClient, run) -> int:
    return sum(len(client.get_metric_history(run.info.run_id, name)) for name in run.data.metrics)


@pytest.mark.parametrize("restored", [True, False])
def test_run_of_a_report_that_was_not_restored_is_found_by_its_results(tmp_path, restored):
    publish_state(tmp_path, old=True)
    first = current(tmp_path)
    publish_state(tmp_path, old=False)
    if not restored:
        io.remove(tmp_path / "reports")
    publish_state(tmp_path, old=True, reported=False)
    assert current(tmp_path) == first


def test_results_are_published_although_their_report_is_missing(tmp_path):
    publish_state(tmp_path, old=True)
    io.remove(tmp_path / "reports")
    publish_state(tmp_path, old=False, reported=False)
    assert {run.data.tags["stage"] for run in runs(tmp_path, "tags.current = 'true'")} == {"train_multi", "sweep_pokes"}


def test_stage_runs_that_were_interrupted_are_published_again(tmp_path):
    publish_state(tmp_path, old=True)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    for run in runs(tmp_path, "tags.kind = 'stage'"):
        client.set_terminated(run.info.run_id, "KILLED")
    publish_state(tmp_path, old=True)
    again = runs(tmp_path, "tags.current = 'true'")
    assert len(again) == 4
    assert {run.info.status for run in again} == {"FINISHED"}


def test_broken_store_is_reported(tmp_path):
    (tmp_path / "mlflow.db").write_bytes(b"junk" * 99)
    with pytest.raises(TrackingUnavailable, match="The results are kept"):
        write(tmp_path, b0="k0")


@pytest.mark.parametrize("uri", ["http://localhost:notaport", "http://", "https://[::1", "http://127.0.0.1:99999"])
def test_mistyped_address_is_reported(uri):
    with pytest.raises(TrackingUnavailable, match="does not answer"):
        probe(uri)


@pytest.mark.parametrize("kind", ["silent_server", "dead_address"])
def test_unreachable_server_is_reported_within_seconds(kind, request, tmp_path, monkeypatch):
    uri = request.getfixturevalue(kind)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    start_s = time.monotonic()
    with pytest.raises(TrackingUnavailable, match="When MLflow answers again, send them with `reskin publish`"):
        write(tmp_path, b0="k0")
    assert time.monotonic() - start_s < 15  # The time limit is 2 s. The retries of MLflow would take 20 s.


def test_check_of_the_store_does_not_create_it(tmp_path):
    probe(None)
    probe(f"sqlite:///{tmp_path / 'somewhere.db'}")
    assert not (tmp_path / "somewhere.db").exists()


def test_locked_store_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "LOCK_TIMEOUT_S", 0.1)
    with closing(sqlite3.connect(tmp_path / "mlflow.db")) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(TrackingUnavailable, match="database is locked.*The results are kept"):
            write(tmp_path, b0="k0")
    write(tmp_path, b0="k0")


def test_failure_during_publishing_is_reported(tmp_path, monkeypatch):
    write(tmp_path, b0="k0")
    find, messages = tracking.Publisher.find, []

    def fail_to_find(self, *arguments, **tags):
        with closing(sqlite3.connect(tmp_path / "mlflow.db")) as other:
            other.execute("DROP TABLE IF EXISTS tags")
        return find(self, *arguments, **tags)

    monkeypatch.setattr(tracking.Publisher, "find", fail_to_find)
    handler = logging.Handler()
    handler.emit = messages.append
    logging.getLogger("mlflow.store.db.utils").addHandler(handler)
    with pytest.raises(TrackingUnavailable, match=r"failed \(.*no such table: tags\)\. The results are kept"):
        write(tmp_path, b0="k1")
    logging.getLogger("mlflow.store.db.utils").removeHandler(handler)
    assert messages == []


def test_publishing_to_a_slow_server_stops_and_can_be_continued_later(tmp_path, monkeypatch):
    # With -4 s plus 2 s per run, the time limit for two runs is 0 s.
    monkeypatch.setattr(tracking, "PATIENCE_S", -2.0 * 2)
    with pytest.raises(TrackingUnavailable, match="took longer than 0 s"):
        write(tmp_path, b0="k0", b1="k1")
    monkeypatch.undo()
    assert write(tmp_path, b0="k0", b1="k1")["new_n"] == 2


def test_universal_model_has_scores_with_and_without_labels(tmp_path):
    io.write_json(tmp_path / "reports/lab/numbers.json", {"new_board": new_board()})
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    tracking.publish_universal(client, tmp_path)
    experiment = client.get_experiment_by_name(tracking.UNIVERSAL_EXPERIMENT)
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.data.metrics["accuracy_pct_0_labels"] == pytest.approx(40.0)
    assert run.data.metrics["accuracy_pct"] == pytest.approx(80.0)
    (version,) = client.search_model_versions("name = 'reskin-universal'")
    assert "40 labels" in version.description
