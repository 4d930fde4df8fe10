"""Write training runs and reports to MLflow, from the files that finished stages wrote.

No result depends on MLflow. A server that does not respond delays a stage only briefly.
"""

import hashlib
import http.client
import json
import os
import re
import sqlite3
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pipeline.statistics import over_folds, tidy
from reskin import io
from reskin.errors import ReskinError

VARIABLE = "MLFLOW_TRACKING_URI"
SQLITE = "sqlite:///"
STORE = "mlflow.db"
ARTIFACTS = "mlartifacts"
LOADER = "pipeline.pyfunc"
PARENT = "mlflow.parentRunId"
LAYOUT = 2  # version of the content of MLflow runs; runs of older versions are written again
METRICS_MAX_N = 1000  # largest number of metrics in one call to MLflow
TIMEOUT_S = 2.0  # time in which an HTTP server must answer
LOCK_TIMEOUT_S = 5.0  # how long to wait for a locked SQLite store; UIs and other writers lock it for much shorter
PATIENCE_S, PATIENCE_PER_RUN_S = 60.0, 2.0  # time limit for writing all runs; a local server takes 0.1 s per run
# Keys of numbers.json that are not metrics of the report's run: run times, provenance, and values that other MLflow
# runs contain.
NOT_METRICS = {"provenance", "runtime", "described", "variants"}

# A point of a sweep or experiment: the name of its curve, its step (a number of pokes, skins, ...), and the mean of
# each metric.
Point = tuple[str, int, Mapping[str, float]]
Curves = Mapping[str, Sequence[Point]]


class TrackingUnavailable(ReskinError):
    """The tracking server or store cannot be used; the message says what to do."""

    exit_code = 3


def server_uri() -> str | None:
    """Return the tracking server that the environment variable names; None if the embedded store is used."""
    return os.environ.get(VARIABLE) or None


def tracking_uri(root: Path) -> str:
    """Return the URI of the tracking server, or of the checkout's embedded store if no server is named."""
    return server_uri() or f"{SQLITE}{(root / STORE).resolve()}"


def probe(uri: str | None) -> None:
    """Raise `TrackingUnavailable` if an HTTP server does not answer within two seconds, or a SQLite file is locked."""
    if uri is None:
        return
    if uri.startswith(SQLITE):
        _probe_sqlite(uri.removeprefix(SQLITE))
    elif uri.startswith(("http://", "https://")):
        try:
            with urllib.request.urlopen(f"{uri.rstrip('/')}/health", timeout=TIMEOUT_S):
                return
        except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
            reason = getattr(error, "reason", error) or type(error).__name__
            raise TrackingUnavailable(
                f"MLflow at {uri} does not answer ({reason}). Results are computed anyway; "
                "`reskin publish` sends them when it is back."
            ) from None


def _probe_sqlite(file: str) -> None:
    if not os.path.exists(file):
        return
    try:
        with closing(sqlite3.connect(file, timeout=LOCK_TIMEOUT_S)) as store:
            store.execute("BEGIN IMMEDIATE")
            store.rollback()
    except sqlite3.Error as error:  # MLflow itself would try ten times, for minutes
        raise TrackingUnavailable(
            f"MLflow's store {file} cannot be written ({error}; waited up to {LOCK_TIMEOUT_S:.0f} s). "
            "Results are kept. If another program has locked it, run `reskin publish` when that has ended."
        ) from None


def publish(models: Mapping[str, Path], curves: Curves, reports: Path, *, scene: str, root: Path) -> dict[str, int]:
    """Write every training run and the report of a scene to MLflow, each once.

    A sweep or an experiment is one MLflow run with metrics by step, because hundreds of child runs would hide the
    other runs. Tag `current` marks the runs of the current results. Results that are in MLflow already are only tagged.

    Parameters
    ----------
    models
        Folders of models and model cards, by stage.
    curves
        Points of sweeps and experiments, by stage.
    reports
        Folder of the scene's report.
    scene, root
        Name of the MLflow experiment; folder of the checkout.

    Returns
    -------
    dict
        Numbers of training runs that were written (`new_n`) and that MLflow had already (`kept_n`), and of MLflow runs
        that are no longer current (`superseded_n`).

    Raises
    ------
    TrackingUnavailable
        The server does not answer, or takes too long.
    """
    uri = tracking_uri(root)
    probe(uri)
    cards = {
        stage: {file: io.read_json(file) for file in sorted(folder.glob("*.json"))} for stage, folder in models.items()
    }
    trainings_n = sum(map(len, cards.values()))
    with _client(uri) as client:
        publisher = Publisher(client, scene, root, runs_n=trainings_n)
        new_n = sum(publisher.write_trainings(stage, stage_cards) for stage, stage_cards in cards.items())
        for stage, points in curves.items():
            publisher.write_curve(stage, points)
        publisher.write_report(reports)
        superseded_n = publisher.mark_superseded()
        return {"new_n": new_n, "kept_n": trainings_n - new_n, "superseded_n": superseded_n}


class Publisher:
    """Writes the MLflow runs of one scene, each once, and remembers the keys of runs that contain current results.

    The tag `run_key`, a digest of a run's content, identifies the run.
    """

    def __init__(self, client: Any, scene: str, root: Path, *, runs_n: int) -> None:
        self.client = client
        self.scene = scene
        self.experiment_id = _experiment(client, scene, root)
        self.current: set[str] = set()
        self.limit_s = PATIENCE_S + PATIENCE_PER_RUN_S * runs_n
        self.end_s = time.monotonic() + self.limit_s

    def find(self, stage: str, **tags: str) -> Any:
        """Return a stage's newest run with these tags; None if no run has them."""
        query = " and ".join(f"tags.{name} = '{value}'" for name, value in {"stage": stage, **tags}.items())
        runs = self.client.search_runs([self.experiment_id], query, max_results=1)
        return runs[0] if runs else None

    def open_run(
        self, stage: str, key: str, *, name: str = "", parent: str = "", tags: Mapping[str, str] = MappingProxyType({})
    ) -> tuple[str, bool]:
        """Find or create the run with this key; return its id, and whether its content must still be written.

        A run that a killed process left unfinished is replaced.
        """
        if time.monotonic() > self.end_s:
            raise TrackingUnavailable(
                f"MLflow took longer than {self.limit_s:.0f} s. Results are kept; `reskin publish` sends the rest."
            )
        self.current.add(key)
        existing = self.find(stage, run_key=key)
        current = {"current": "true"} | ({PARENT: parent} if parent else {})
        if existing and existing.info.status == "FINISHED":
            self.set_tags(existing, current)
            return str(existing.info.run_id), False
        if existing:
            self.client.delete_run(existing.info.run_id)
        all_tags = {"run_key": key, "stage": stage, "scene": self.scene, "kind": "stage", **current, **tags}
        run = self.client.create_run(self.experiment_id, tags=all_tags, run_name=name or stage)
        return str(run.info.run_id), True

    def set_tags(self, run: Any, tags: Mapping[str, str]) -> None:
        """Set those tags of a run whose values differ from `tags`."""
        for name, value in tags.items():
            if run.data.tags.get(name) != value:
                self.client.set_tag(run.info.run_id, name, value)

    def log(self, run_id: str, rows: Iterable[tuple[str, float, int]], params: Mapping[str, Any] | None = None) -> None:
        """Write metrics, given as rows (name, value, step), and parameters to a run."""
        from mlflow.entities import Metric, Param

        metrics = [Metric(name, value, 0, step) for name, value, step in rows]
        texts = [Param(name, str(value)[:500]) for name, value in (params or {}).items()]
        for start in range(0, len(metrics), METRICS_MAX_N):
            self.client.log_batch(run_id, metrics[start : start + METRICS_MAX_N], texts if not start else ())

    def write_trainings(self, stage: str, cards: Mapping[Path, dict[str, Any]]) -> int:
        """Write a stage's training runs as children of an MLflow run of the stage; return how many are new."""
        keys = [run_key(card) for card in cards.values()]
        parent_key = hashlib.sha256("".join(sorted(keys)).encode()).hexdigest()[:32]
        parent_id, unwritten = self.open_run(stage, parent_key)
        new_n = sum(self.write_training(stage, parent_id, file, card) for file, card in cards.items())
        if unwritten:
            means = []
            for (experiment, recipe), rows in tidy(list(cards.values())).groupby(["question", "recipe"]):
                for name, summary in over_folds(rows).items():
                    means += [(f"{experiment}.{recipe}.{name}.{key}", value, 0) for key, value in summary.items()]
            self.log(parent_id, means)
            self.client.set_terminated(parent_id)
        return new_n

    def write_training(self, stage: str, parent_id: str, file: Path, card: dict[str, Any]) -> bool:
        """Write one training run: settings, scores, loss curve, datasets and model; return whether it is new."""
        tags = {name: card[name] for name in ("scene", "question", "recipe_name", "fold", "git")}
        tags |= {"cell": card["key"], "kind": "training"}
        tags |= {"board": ", ".join(card["test_boards"]), "skin": ", ".join(card["test_skins"])}
        tags |= {"mlflow.source.name": f"python -m pipeline {stage}", "mlflow.source.git.commit": card["git"]}
        run_id, unwritten = self.open_run(stage, run_key(card), name=file.stem, parent=parent_id, tags=tags)
        if not unwritten:
            return False
        settings = {"method": card["recipe_name"]}
        settings |= {name: card[name] for name in ("question", "fold", "seed_i", "seed")} | card["recipe"]
        settings |= {name: card[name] for name in ("train_rows_n", "train_boards", "test_boards", "test_skins")}
        settings |= {f"adapt_{name}": value for name, value in card.get("tuning", {}).get("settings", {}).items()}
        metrics = [(name, value, 0) for name, value in card["scores"]["all"].items()]
        metrics += [(f"registered_{name}", value, 0) for name, value in card["scores"]["registered"].items()]
        metrics += [("train_loss", value, step) for step, value in enumerate(card["curve"])]
        self.log(run_id, metrics, settings)
        self.client.log_inputs(run_id, datasets=_datasets(card))
        for artifact in (file, file.with_suffix(".safetensors")):
            self.client.log_artifact(run_id, str(artifact), "model")
        # File MLmodel names the loader and the file of the weights. MLflow reads it as YAML; JSON is valid YAML.
        flavor = {"python_function": {"loader_module": LOADER, "data": f"{file.stem}.safetensors"}}
        about = {"artifact_path": "model", "flavors": flavor, "run_id": run_id}
        self.client.log_text(run_id, json.dumps(about, indent=2), "model/MLmodel")
        self.client.set_terminated(run_id)
        return True

    def write_curve(self, stage: str, points: Sequence[Point]) -> None:
        """Write the points of a sweep or an experiment as one MLflow run."""
        run_id, unwritten = self.open_run(stage, _digest([stage, points]))
        if unwritten:
            rows = ((f"{curve}.{name}", value, step) for curve, step, means in points for name, value in means.items())
            self.log(run_id, rows)
            self.client.set_terminated(run_id)

    def write_report(self, reports: Path) -> None:
        """Write the report's numbers and files to a run; its key depends on numbers, figures and tables, not on costs.

        Tag `inputs` identifies the results that a report shows. If earlier results were restored without their report
        (`dvc checkout` does not restore reports), the run of their report becomes the current one again.
        """
        inputs = _digest(sorted(self.current))
        earlier = self.find("report", inputs=inputs)
        existing = key = None
        metrics: list[tuple[str, float, int]] = []
        if (reports / "numbers.json").exists():
            metrics = metrics_of(io.read_json(reports / "numbers.json"))
            files = [file for part in ("figures", "tables") for file in sorted((reports / part).glob("*"))]
            key = _digest([*metrics, *((file.name, io.sha256(file), 0) for file in files)])
            existing = self.find("report", run_key=key)
        other_inputs = existing is not None and existing.data.tags.get("inputs") != inputs
        if earlier is not None and (key is None or other_inputs):
            self.set_tags(earlier, {"current": "true"})
            self.current.add(earlier.data.tags["run_key"])
        elif key is not None:
            run_id, unwritten = self.open_run("report", key)
            if unwritten:
                self.log(run_id, metrics)
            self.client.set_tag(run_id, "inputs", inputs)
            self.client.log_artifacts(run_id, str(reports))  # always, because page texts and costs may have changed
            self.client.set_terminated(run_id)

    def mark_superseded(self) -> int:
        """Set tag `current` of superseded runs to false, so that `tags.current = 'true'` shows each result once.

        Return the number of these runs.
        """
        marked_n, token = 0, None
        while True:
            page = self.client.search_runs(
                [self.experiment_id], "tags.current = 'true'", max_results=1000, page_token=token
            )
            for run in page:
                if run.data.tags["run_key"] not in self.current:
                    self.client.set_tag(run.info.run_id, "current", "false")
                    marked_n += 1
            token = page.token
            if not token:
                return marked_n


def run_key(card: Mapping[str, Any]) -> str:
    """Return a digest of a model card without its commit, so that equal results of two commits are the same run."""
    return _digest({name: value for name, value in card.items() if name != "git"} | {"published_as": LAYOUT})


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


@contextmanager
def _client(uri: str) -> Iterator[Any]:
    """Yield a client with short time-outs, whose errors are raised as `TrackingUnavailable`."""
    # MLflow reads these variables once, when it is imported. Without limits, a call to a dead server takes minutes.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    import logging

    # Errors are raised as one sentence. Tracebacks that MLflow would log as well would hide that sentence.
    levels = {"alembic": "WARNING", "mlflow": "WARNING", "mlflow.store.db.utils": "CRITICAL"}
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)
    import mlflow
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield mlflow.MlflowClient(tracking_uri=uri)
    except (MlflowException, SQLAlchemyError, OSError) as error:
        sentence = " ".join(str(error).partition("[SQL:")[0].split())[:200]
        raise TrackingUnavailable(
            f"MLflow at {uri} failed ({sentence}). Results are kept; `reskin publish` sends them later."
        ) from None


def _experiment(client: Any, scene: str, root: Path) -> str:
    """Find or create the experiment of a scene; return its id."""
    existing = client.get_experiment_by_name(scene)
    if existing is not None:
        return str(existing.experiment_id)
    location = None if server_uri() else (root / ARTIFACTS / scene).resolve().as_uri()
    # With this kind of experiment, the UI shows training runs instead of chats.
    kind = {"mlflow.experimentKind": "custom_model_development"}
    return str(client.create_experiment(scene, artifact_location=location, tags=kind))


def _datasets(card: Mapping[str, Any]) -> list[Any]:
    """Describe the skins that a network was trained and tested on as datasets."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    inputs = []
    for context in ("train", "test"):
        skins = card[f"{context}_skins"]
        source = {"uri": f"data/indentations/{card['scene']}", "skins": skins}
        profile = {"skins_n": len(skins)} | ({"rows_n": card["train_rows_n"]} if context == "train" else {})
        dataset = Dataset(
            name=f"{card['scene']}, {card['fold']}, {context}",
            digest=_digest(source)[:8],
            source_type="local",
            source=json.dumps(source),
            profile=json.dumps(profile),
        )
        inputs.append(DatasetInput(dataset, [InputTag("mlflow.data.context", context)]))
    return inputs


def metrics_of(numbers: Mapping[str, Any]) -> list[tuple[str, float, int]]:
    """Flatten numbers.json to rows (name, value, step).

    A list of rows whose first key is a count becomes a curve over this count. Other lists, texts, costs and the content
    of training runs are left out.
    """
    published = {name: value for name, value in numbers.items() if name not in NOT_METRICS}
    return [(re.sub(r"[^A-Za-z0-9_.\- ]", "_", name), value, step) for name, value, step in _flatten(published, "", 0)]


def _flatten(value: Any, name: str, step: int) -> Iterator[tuple[str, float, int]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flatten(item, f"{name}.{key}" if name else key, step)
    elif isinstance(value, list):
        for row in value:
            axis = next(iter(row), "") if isinstance(row, dict) else ""
            if axis.endswith("_n"):
                rest = {key: item for key, item in row.items() if key != axis}
                yield from _flatten(rest, name, int(row[axis]))
    elif isinstance(value, int | float):
        yield name, float(value), step
