"""Write the training runs, the scores and the final model of a scene to MLflow.

MLflow only shows results; no result depends on it. Everything that is written here is read from files that stages
wrote, so that `reskin publish` can write it at any time. What MLflow already has is not written again.

The final model of a scene is registered as `reskin-SCENE`, and alias `champion` marks its newest version:

    >>> import mlflow
    >>> model = mlflow.pyfunc.load_model("models:/reskin-quick@champion")  # doctest: +SKIP
    >>> model.predict(readings)  # field changes in uT -> x_mm, y_mm, force_N  # doctest: +SKIP
"""

import hashlib
import json
import logging
import os
import sqlite3
import time
import urllib.request
import warnings
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from pipeline.provenance import home, is_experiment
from pipeline.scenes import TABLE_2
from pipeline.stage import say
from pipeline.training.jobs import CACHE
from reskin import io
from reskin.errors import ReskinError, SchemaError
from reskin.metrics import METRICS
from reskin.models.recipe import HEADLINE
from reskin.models.trained import SUFFIX

if TYPE_CHECKING:
    from reskin.models.trained import Network

STAGES = ("train_single", "train_multi", "train_triplet", "adapt", "report")  # stages after which runs are written
PUBLISH = "RESKIN_PUBLISH"  # environment variable; with the value 0, stages write nothing to MLflow
SERVER = "MLFLOW_TRACKING_URI"
UI = "http://127.0.0.1:5000"  # where `mlflow ui` listens by default
SQLITE = "sqlite:///"
ANSWER_S = 2.0  # longest wait for a server or for a locked SQLite store
LIMIT_S, LIMIT_PER_RUN_S = 30.0, 1.0  # time limit for writing a scene; a local store takes 0.1 s per run
CHAMPION = "champion"
OUTPUTS = ["x_mm", "y_mm", "force_N"]
METHODS = {experiment: method for method, experiment in TABLE_2.items()}
FINAL = "final"  # name of the final model and of its folder
VIEW = "scores"  # name of the saved view of the table of runs
# Kinds of runs. The view sorts by this tag, so that mean scores come first, and hundreds of training runs last.
MEAN, MODEL, TRAINING = "mean", "model", "training"


class TrackingUnavailable(ReskinError):
    """MLflow's server or store cannot be used; the message says what to do."""

    exit_code = 3


@dataclass(frozen=True)
class Run:
    """A run as MLflow shows it.

    - key: identifies the run. A run with the same key and other content is replaced.
    - curve: steps and losses. files: artifacts. seconds: duration of the training, if it is known.
    - registered_as: name under which the model in `files` is registered; None if it is not registered.
    """

    name: str
    kind: str
    key: str
    params: Mapping[str, Any]
    metrics: Mapping[str, float]
    curve: tuple[tuple[int, float], ...] = ()
    files: tuple[Path, ...] = ()
    seconds: float | None = None
    registered_as: str | None = None

    @cached_property
    def content(self) -> str:
        return _digest([self.name, dict(self.params), dict(self.metrics), self.curve])


def after_stage(stage: str, scene: str) -> None:
    """Write what a stage has added to a scene; if MLflow cannot be used, print a warning."""
    if os.environ.get(PUBLISH) == "0" or stage not in STAGES:
        return
    try:
        sentence = publish(scene, reported=stage == "report")
        if stage == "report":
            say(sentence)
    except TrackingUnavailable as error:
        say(f"warning: {error}")


def publish(scene: str, *, reported: bool = True) -> str:
    """Write the runs of a scene that MLflow lacks; return a sentence with their number and a link to the runs.

    reported: whether the scene's report is up to date, so that its mean scores can be written too.
    """
    name = f"{scene} (dvc exp)" if is_experiment() else scene
    uri = os.environ.get(SERVER) or f"{SQLITE}{(home() / 'mlflow.db').resolve()}"
    if not Path(f"data/scores/{scene}").exists():
        return f"{name}: there are no results to write to MLflow. To compute them: dvc repro"
    try:
        _probe(uri)
        client = _client(uri)
        experiment_id = _experiment(client, name)
        trainings = list(read_trainings(scene))
        runs = trainings + (list(read_means(scene, trainings)) if reported else [])
        end_s = time.monotonic() + LIMIT_S + LIMIT_PER_RUN_S * len(runs)
        known, written_n = _known_runs(client, experiment_id), 0
        for run in runs:
            if time.monotonic() > end_s:
                raise TimeoutError(f"it is too slow: {written_n} of {len(runs)} runs were written")
            run_id, is_new = _write(client, experiment_id, run, known.get(run.key))
            written_n += is_new
            if run.registered_as:
                _register(client, run, run_id)
    except Exception as error:  # whatever happens in MLflow, the results of the stage are complete
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        remedy = "When it works again, send the results: reskin publish"
        if uri.startswith(SQLITE):
            store = uri.removeprefix(SQLITE)
            remedy = f"If no other program is using it, move {store} away. Then send the results: reskin publish"
        raise TrackingUnavailable(f"MLflow at {uri} cannot be used ({reason}). No result is lost. {remedy}") from error
    host = uri if uri.startswith("http") else UI
    # Without `workflowType`, MLflow's pages are about language models.
    query = f"workflowType=machine_learning&viewStateShareKey={VIEW}"
    page = f"{host.rstrip('/')}/#/experiments/{experiment_id}/runs?{query}"
    return f"{name}: {written_n} of {len(runs)} runs were new to MLflow. Scores of all runs: {page}"


# --- What is written ---


def read_trainings(scene: str) -> Iterator[Run]:
    """Read the training runs of a scene from the model cards of its stages."""
    for file in sorted(Path(f"data/models/{scene}").glob("*/*.json")):
        card = io.read_json(file)
        if "recipe_name" not in card:
            continue
        final = card["question"] == FINAL
        params = {"method": METHODS.get(card["question"], card["question"]), "recipe": card["recipe_name"]}
        params |= {name: card[name] for name in ("fold", "seed_i", "seed")} | card["recipe"]
        params |= {f"adapt_{name}": value for name, value in card.get("tuning", {}).get("settings", {}).items()}
        params |= {"train_rows_n": card["train_rows_n"], "train_skins_n": len(card["train_skins"])}
        params |= {name: ", ".join(card[name]) for name in ("train_boards", "test_boards", "test_skins")}
        # The final model cannot be tested. Its scores are those of networks that were trained without the tested board.
        scores = pd.DataFrame(card["held_out"]).mean(axis=1) if final else pd.Series(card["scores"]["all"])
        yield Run(
            name=FINAL if final else file.stem,
            kind=MODEL if final else TRAINING,
            key=card["key"],
            params={name: str(value)[:500] for name, value in params.items()},
            metrics={name: scores[name] for name in METRICS if name in scores},
            curve=tuple(zip(card["curve_steps"], card["curve"], strict=True)),
            files=(file, file.with_suffix(SUFFIX)),
            seconds=_duration_s(card["key"]),
            registered_as=f"reskin-{scene}" if final and not is_experiment() else None,
        )


def _duration_s(key: str) -> float | None:
    """Return the duration of a training from its result in the cache; None if the result is deleted or damaged."""
    try:
        metadata = io.read_tensors(home() / CACHE / f"{key}{SUFFIX}", ("curve",))[1]
    except SchemaError:
        return None
    return float(metadata["seconds"])


def read_means(scene: str, trainings: list[Run]) -> Iterator[Run]:
    """Read the mean scores of a report: one run for each row of table 2, and one for each other experiment.

    The parameters of a method are those that all its trainings have in common.
    """
    file = Path(f"reports/{scene}/scores.json")
    scores = io.read_json(file) if file.exists() else {}
    table2 = scores.pop("table2", {})
    for experiment, values in scores.items():
        flat = pd.json_normalize(values).iloc[0]  # names such as each.accuracy_pct
        yield _mean(experiment, {"method": experiment}, {str(name): float(value) for name, value in flat.items()})
    for method, metrics in reversed(table2.items()):  # MLflow lists the newest run first
        # A control has its own recipe instead of its own method.
        kinds = ((method, HEADLINE), ("adapted", method))
        cells = [set(run.params.items()) for run in trainings if (run.params["method"], run.params["recipe"]) in kinds]
        common = dict(set.intersection(*cells)) if cells else {}
        yield _mean(f"mean of {method}", common | {"method": method, "trainings_n": len(cells)}, metrics)


def _mean(name: str, params: Mapping[str, Any], metrics: Mapping[str, float]) -> Run:
    return Run(name, MEAN, _digest([name, dict(params), dict(metrics)]), params, metrics)


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


# --- How it is written ---


def _probe(uri: str) -> None:
    """Raise an error if a server does not answer, or if a SQLite store is locked or broken.

    MLflow itself would try for minutes.
    """
    if uri.startswith("http"):
        with urllib.request.urlopen(f"{uri.rstrip('/')}/health", timeout=ANSWER_S):
            return
    file = uri.removeprefix(SQLITE)
    if uri.startswith(SQLITE) and os.path.exists(file):
        with closing(sqlite3.connect(file, timeout=ANSWER_S)) as store:
            store.execute("BEGIN IMMEDIATE")
            store.rollback()


def _client(uri: str) -> Any:
    """Return a client of MLflow with short time limits."""
    # MLflow reads these variables when it is imported.
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "5")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    for name, level in {"alembic": "WARNING", "mlflow": "WARNING", "mlflow.store.db.utils": "CRITICAL"}.items():
        logging.getLogger(name).setLevel(level)
    warnings.filterwarnings("ignore", ".*input example")
    import mlflow

    mlflow.set_tracking_uri(uri)
    return mlflow.MlflowClient()


def _experiment(client: Any, name: str) -> str:
    """Find or create an experiment, with a saved view whose columns are the scores; return its id.

    Without a saved view, MLflow's table of runs shows no scores.
    """
    found = client.get_experiment_by_name(name)
    if found is None:
        location = None if os.environ.get(SERVER) else (home() / "mlartifacts" / name).resolve().as_uri()
        kind = {"mlflow.experimentKind": "custom_model_development"}  # not an experiment with language models
        found = client.get_experiment(client.create_experiment(name, artifact_location=location, tags=kind))
    scores, name_column = [f"metrics.`{metric}`" for metric in METRICS], "attributes.`Run Name`"
    columns = [*scores, "params.`method`", "params.`recipe`", "params.`fold`", "attributes.`Duration`"]
    state = {"orderByKey": "tags.`kind`", "orderByAsc": True, "selectedColumns": columns}
    state["columnOrder"] = [name_column, *columns]
    state["columnWidths"] = {name_column: 170} | dict.fromkeys(scores, 95)  # px
    made_ms = found.creation_time or 0
    view = {"name": "Scores", "createdAt": made_ms, "updatedAt": made_ms, "state": json.dumps(state)}
    tag, value = f"mlflow.sharedViewState.{VIEW}", json.dumps(view)
    if found.tags.get(tag) != value:
        client.set_experiment_tag(found.experiment_id, tag, value)
    return str(found.experiment_id)


def _known_runs(client: Any, experiment_id: str) -> dict[str, Any]:
    """Return the runs that the experiment has, by key."""
    runs: list[Any] = []
    token = None
    while True:
        page = client.search_runs([experiment_id], "tags.key != ''", max_results=1000, page_token=token)
        runs, token = runs + page, page.token
        if not token:
            return {run.data.tags["key"]: run for run in runs}


def _write(client: Any, experiment_id: str, run: Run, known: Any) -> tuple[str, bool]:
    """Write a run unless MLflow has it; return its id, and whether it was written.

    A run that a killed process left unfinished is replaced, and so is a training that was scored again.
    """
    from mlflow.entities import Metric, Param

    if known and known.info.status == "FINISHED" and known.data.tags.get("content") == run.content:
        return known.info.run_id, False
    if known:
        client.delete_run(known.info.run_id)
    end_ms = round(1e3 * time.time())
    start_ms = end_ms - round(1e3 * (run.seconds or 0.0))
    tags = {"kind": run.kind, "key": run.key, "content": run.content}
    run_id = client.create_run(experiment_id, start_ms, tags, run.name).info.run_id
    metrics = [Metric(name, float(f"{value:.6g}"), end_ms, 0) for name, value in run.metrics.items()]
    metrics += [Metric("train_s", run.seconds, end_ms, 0)] if run.seconds is not None else []
    metrics += [Metric("loss", loss, end_ms, step) for step, loss in run.curve]
    client.log_batch(run_id, metrics, [Param(name, str(value)) for name, value in run.params.items()])
    for file in run.files:
        client.log_artifact(run_id, str(file))
    client.set_terminated(run_id, end_time=end_ms)
    return run_id, True


# --- The registered model ---


class FinalModel:
    """A trained network with the method `predict` that MLflow calls."""

    def __init__(self, network: "Network") -> None:
        self.network = network

    def predict(self, model_input: pd.DataFrame, params: Mapping[str, Any] | None = None) -> pd.DataFrame:
        """Predict x_mm, y_mm and force_N.

        model_input: one row per reading, with the change of each channel's field since the no-load reading in uT, in
        columns Bx0, By0, Bz0, Bx1, ... params: not used.
        """
        return pd.DataFrame(self.network(np.asarray(model_input, np.float32)), columns=OUTPUTS)


def _load_pyfunc(path: str) -> FinalModel:
    """Load the model from the folder of its weights and card; MLflow calls this function by its name."""
    from reskin.models.trained import read_network

    return FinalModel(read_network(Path(path) / f"{FINAL}{SUFFIX}"))


def _register(client: Any, run: Run, run_id: str) -> None:
    """Register the model of a run, unless it is registered, and let alias `champion` refer to it."""
    versions = client.search_model_versions(f"name = '{run.registered_as}'")
    version = next((each.version for each in versions if each.run_id == run_id), None)
    if version is None:
        import mlflow
        from mlflow.models import Model, ModelSignature
        from mlflow.types import ColSpec, Schema

        channels_n = io.read_json(run.files[0])["input"]["channels_n"]
        inputs = [f"B{axis}{chip_i}" for chip_i in range(channels_n // 3) for axis in "xyz"]
        schemas = (Schema([ColSpec("double", name) for name in names]) for names in (inputs, OUTPUTS))
        version = Model.log(
            None,
            mlflow.pyfunc,
            name="model",
            run_id=run_id,
            registered_model_name=run.registered_as,
            loader_module=__name__,  # so that no pickle is written or loaded
            data_path=str(run.files[0].parent),
            signature=ModelSignature(*schemas),
            metadata={"input": "change of the field since the no-load reading, in uT", "output": "mm, mm, N"},
            pip_requirements=["numpy", "pandas", "torch"],  # otherwise, MLflow would look for them for ten seconds
        ).registered_model_version
    client.set_registered_model_alias(run.registered_as, CHAMPION, version)
