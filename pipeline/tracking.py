"""Write finished trainings to MLflow, from files, so that it can be done later. Nothing reads it back."""

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
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pipeline.statistics import over_folds, tidy
from reskin import io
from reskin.errors import ReskinError

VARIABLE = "MLFLOW_TRACKING_URI"
TIMEOUT_S = 2.0
SQLITE = "sqlite:///"
LOCK_TIMEOUT_S = 5.0  # a UI that reads, or another publication that writes a run, is done long before
PATIENCE_S, PATIENCE_PER_RUN_S = 60.0, 2.0  # a server of one's own network takes 0.1 s a run


class TrackingAway(ReskinError):
    """The tracking server does not answer; the message says what to do."""

    exit_code = 3


def server_uri() -> str | None:
    """The tracking server that the user named, if any; without one the embedded store is used."""
    return os.environ.get(VARIABLE) or None


class Patience:
    """A limit on all that is written at once: a server that answers too slowly must not hold up a result."""

    def __init__(self, runs_n: int) -> None:
        self.limit_s = PATIENCE_S + PATIENCE_PER_RUN_S * runs_n
        self.until_s = time.monotonic() + self.limit_s

    def check(self) -> None:
        """Raise `TrackingAway` if it is used up."""
        if time.monotonic() > self.until_s:
            raise TrackingAway(
                f"MLflow took longer than {self.limit_s:.0f} s. Results are kept; `reskin publish` goes on from there."
            )


def probe(uri: str | None) -> None:
    """Raise `TrackingAway` if a server (http, https) does not answer within two seconds, or a SQLite file is held."""
    if uri is not None and uri.startswith(SQLITE):
        _probe_sqlite(uri.removeprefix(SQLITE))
    if uri is None or not uri.startswith(("http://", "https://")):
        return
    try:
        with urllib.request.urlopen(f"{uri.rstrip('/')}/health", timeout=TIMEOUT_S):
            return
    except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
        reason = getattr(error, "reason", error) or type(error).__name__
        raise TrackingAway(
            f"MLflow at {uri} does not answer ({reason}). Results are made all the same; "
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
        raise TrackingAway(
            f"MLflow's store {file} cannot be written ({error}; waited up to {LOCK_TIMEOUT_S:.0f} s). "
            "Results are kept. Does another program hold it? Then `reskin publish` sends them."
        ) from None


STORE = "mlflow.db"
ARTIFACTS = "mlartifacts"
LOADER = "pipeline.pyfunc"
LAYOUT = 2  # of what a run of a training holds; runs of an older one are written again
PARENT = "mlflow.parentRunId"
ELSEWHERE = {"provenance", "runtime", "described", "variants"}  # of numbers.json: costs, and what trainings hold


def tracking_uri(root: Path) -> str:
    """The server of MLFLOW_TRACKING_URI, else the embedded store of the checkout."""
    return server_uri() or f"sqlite:///{(root / STORE).resolve()}"


# Of a sweep or an experiment its points: the name of the curve, the step (pokes, skins, contacts), means by name.
Curves = Mapping[str, Sequence[tuple[str, int, Mapping[str, float]]]]


def publish(arms: Mapping[str, Path], curves: Curves, reports: Path, *, scene: str, root: Path) -> dict[str, int]:
    """Write every training of a scene to MLflow once, and its report; `arms` maps stage to models.

    A sweep or an experiment is one run whose metrics go over its steps: hundreds of children would hide the others.
    `current` follows what lies there now: results that were restored, and were written before, are tagged and not
    written again. Returns counts of new, kept and superseded runs; raises `TrackingAway` if the server does not answer.
    """
    uri = tracking_uri(root)
    probe(uri)
    counts = {"new_n": 0, "kept_n": 0, "superseded_n": 0}
    with _client(uri) as client:
        patience = Patience(sum(len(list(models.glob("*.json"))) for models in arms.values()))
        diary = Diary(client, _experiment(client, scene, root), scene, patience)
        current: set[str] = set()
        for stage, models in arms.items():
            keys, fresh = _publish_arm(diary, stage, models)
            current |= keys
            counts["new_n"] += sum(fresh)
            counts["kept_n"] += len(fresh) - sum(fresh)
        current |= {_publish_curve(diary, stage, points) for stage, points in curves.items()}
        current |= _publish_report(diary, reports, _digest(sorted(current)))
        counts["superseded_n"] = _mark_superseded(client, diary.experiment_id, current)
    return counts


@dataclass(frozen=True)
class Diary:
    """A scene's experiment in a store that answers."""

    client: Any
    experiment_id: str
    scene: str
    patience: Patience

    def find(self, stage: str, **tags: str) -> Any:
        """Find a stage's newest run with these tags."""
        query = " and ".join(f"tags.{name} = '{value}'" for name, value in {"stage": stage, **tags}.items())
        found = self.client.search_runs([self.experiment_id], query, max_results=1)
        return found[0] if found else None

    def open(
        self, stage: str, key: str, *, name: str = "", parent: str = "", tags: Mapping[str, str] = MappingProxyType({})
    ) -> tuple[str, bool]:
        """Give a run, and whether it is yet to be written; one that a killed process left is replaced."""
        self.patience.check()
        found = self.find(stage, run_key=key)
        current = {"current": "true"} | ({PARENT: parent} if parent else {})
        if found and found.info.status == "FINISHED":
            self.tag(found, current)
            return str(found.info.run_id), False
        if found:
            self.client.delete_run(found.info.run_id)
        all_tags = {"run_key": key, "stage": stage, "scene": self.scene, "kind": "stage", **current, **tags}
        run = self.client.create_run(self.experiment_id, tags=all_tags, run_name=name or stage)
        return str(run.info.run_id), True

    def tag(self, run: Any, tags: Mapping[str, str]) -> None:
        for name, value in tags.items():
            if run.data.tags.get(name) != value:
                self.client.set_tag(run.info.run_id, name, value)


def run_key(card: Mapping[str, Any]) -> str:
    """Name a result by its whole card, scores included, but for the commit: equal results are one."""
    return _digest({name: value for name, value in card.items() if name != "git"} | {"published_as": LAYOUT})


def _digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:32]


@contextmanager
def _client(uri: str) -> Iterator[Any]:
    # Before the import: MLflow reads these once. Without limits a dead server costs minutes a call.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    import logging

    # What fails is passed on in a sentence: the traceback that MLflow writes of it would only hide that.
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
        raise TrackingAway(
            f"MLflow at {uri} failed ({sentence}). Results are kept; `reskin publish` sends them later."
        ) from None


def _experiment(client: Any, scene: str, root: Path) -> str:
    found = client.get_experiment_by_name(scene)
    if found is not None:
        return str(found.experiment_id)
    location = None if server_uri() else (root / ARTIFACTS / scene).resolve().as_uri()
    # The kind tells the UI to show trainings, not chats.
    kind = {"mlflow.experimentKind": "custom_model_development"}
    return str(client.create_experiment(scene, artifact_location=location, tags=kind))


def _publish_arm(diary: Diary, stage: str, models: Path) -> tuple[set[str], list[bool]]:
    """Write a stage's trainings below a run of the stage; give all keys, and of each training whether it is new."""
    cards = {file: io.read_json(file) for file in sorted(models.glob("*.json"))}
    keys = [run_key(card) for card in cards.values()]
    parent_key = hashlib.sha256("".join(sorted(keys)).encode()).hexdigest()[:32]
    parent_id, unwritten = diary.open(stage, parent_key)
    fresh = [_publish_training(diary, stage, parent_id, file, card) for file, card in cards.items()]
    if unwritten:
        _log_means(diary.client, parent_id, list(cards.values()))
        diary.client.set_terminated(parent_id)
    return {parent_key, *keys}, fresh


def _publish_training(diary: Diary, stage: str, parent_id: str, file: Path, card: dict[str, Any]) -> bool:
    """Write one training; True if it was not there yet."""
    from mlflow.entities import Param

    client, key = diary.client, run_key(card)
    tags = {name: card[name] for name in ("scene", "question", "recipe_name", "fold", "git")}
    tags |= {"cell": card["key"], "kind": "training"}
    tags |= {"board": ", ".join(card["test_boards"]), "skin": ", ".join(card["test_skins"])}
    tags |= {"mlflow.source.name": f"python -m pipeline {stage}", "mlflow.source.git.commit": card["git"]}
    run_id, unwritten = diary.open(stage, key, name=file.stem, parent=parent_id, tags=tags)
    if not unwritten:
        return False
    settings = {"method": card["recipe_name"]}
    settings |= {name: card[name] for name in ("question", "fold", "seed_i", "seed")} | card["recipe"]
    settings |= {name: card[name] for name in ("train_rows_n", "train_boards", "test_boards", "test_skins")}
    settings |= {f"adapt_{name}": value for name, value in card.get("tuning", {}).get("settings", {}).items()}
    metrics = [(name, value, 0) for name, value in card["scores"]["all"].items()]
    metrics += [(f"registered_{name}", value, 0) for name, value in card["scores"]["registered"].items()]
    metrics += [("train_loss", value, step) for step, value in enumerate(card["curve"])]
    _log(client, run_id, metrics, [Param(name, str(value)[:500]) for name, value in settings.items()])
    client.log_inputs(run_id, datasets=_datasets(card))
    for artifact in (file, file.with_suffix(".safetensors")):
        client.log_artifact(run_id, str(artifact), "model")
    # By this file MLflow finds a loader and the weights beside it. It is YAML, of which JSON is a part.
    flavor = {"python_function": {"loader_module": LOADER, "data": f"{file.stem}.safetensors"}}
    about = {"artifact_path": "model", "flavors": flavor, "run_id": run_id}
    client.log_text(run_id, json.dumps(about, indent=2), "model/MLmodel")
    client.set_terminated(run_id)
    return True


def _datasets(card: Mapping[str, Any]) -> list[Any]:
    """Say which skins a network was trained on, and which it was tested on."""
    from mlflow.entities import Dataset, DatasetInput, InputTag

    inputs = []
    for context in ("train", "test"):
        skins = card[f"{context}_skins"]
        source = {"uri": f"data/indentations/{card['scene']}", "skins": skins}
        profile = {"skins_n": len(skins)} | ({"rows_n": card["train_rows_n"]} if context == "train" else {})
        words = {
            "name": f"{card['scene']}, {card['fold']}, {context}",
            "source_type": "local",
            "digest": _digest(source)[:8],
        }
        dataset = Dataset(**words, source=json.dumps(source), profile=json.dumps(profile))
        inputs.append(DatasetInput(dataset, [InputTag("mlflow.data.context", context)]))
    return inputs


def _publish_curve(diary: Diary, stage: str, points: Sequence[tuple[str, int, Mapping[str, float]]]) -> str:
    """Write the points of a sweep or an experiment once; give their key."""
    key = _digest([stage, points])
    run_id, unwritten = diary.open(stage, key)
    if unwritten:
        rows = ((f"{curve}.{name}", value, step) for curve, step, means in points for name, value in means.items())
        _log(diary.client, run_id, rows)
        diary.client.set_terminated(run_id)
    return key


def _log(client: Any, run_id: str, rows: Iterable[tuple[str, int | float, int]], params: Sequence[Any] = ()) -> None:
    from mlflow.entities import Metric

    metrics = [Metric(name, value, 0, step) for name, value, step in rows]
    for start in range(0, len(metrics), 1000):  # MLflow takes at most 1000 metrics a call
        client.log_batch(run_id, metrics[start : start + 1000], params if not start else ())


def _publish_report(diary: Diary, reports: Path, inputs: str) -> set[str]:
    """Write the report's numbers once, and its files; give its key: its numbers, figures and tables, but for costs.

    `inputs` names the results that it shows. Where those were restored and the report was not (`dvc checkout` brings
    no report back), the report that was written with them is the current one.
    """
    before = diary.find("report", inputs=inputs)
    there = key = None
    metrics: list[tuple[str, float, int]] = []
    if (reports / "numbers.json").exists():
        metrics = metrics_of(io.read_json(reports / "numbers.json"))
        files = [file for part in ("figures", "tables") for file in sorted((reports / part).glob("*"))]
        key = _digest([*metrics, *((file.name, io.sha256(file), 0) for file in files)])
        there = diary.find("report", run_key=key)
    restored = before is not None and (key is None or (there is not None and there.data.tags.get("inputs") != inputs))
    if restored:
        diary.tag(before, {"current": "true"})
        return {before.data.tags["run_key"]}
    if key is None:
        return set()
    run_id, unwritten = diary.open("report", key)
    if unwritten:
        _log(diary.client, run_id, metrics)
    diary.client.set_tag(run_id, "inputs", inputs)
    diary.client.log_artifacts(run_id, str(reports))  # again: text on the page and costs may be new
    diary.client.set_terminated(run_id)
    return {key}


def metrics_of(numbers: Mapping[str, Any]) -> list[tuple[str, float, int]]:
    """Flatten numbers.json to name, value and step: a list of rows that begin with a count is a curve over it.

    Other lists, words, costs and what other runs hold are left out.
    """
    shown = {name: value for name, value in numbers.items() if name not in ELSEWHERE}
    return [(re.sub(r"[^A-Za-z0-9_.\- ]", "_", name), value, step) for name, value, step in _flat(shown, "", 0)]


def _flat(value: Any, name: str, step: int) -> Iterator[tuple[str, float, int]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _flat(item, f"{name}.{key}" if name else key, step)
    elif isinstance(value, list):
        for row in value:
            axis = next(iter(row), "") if isinstance(row, dict) else ""
            if axis.endswith("_n"):
                rest = {key: item for key, item in row.items() if key != axis}
                yield from _flat(rest, name, int(row[axis]))
    elif isinstance(value, int | float):
        yield name, float(value), step


def _log_means(client: Any, run_id: str, cards: list[dict[str, Any]]) -> None:
    """Write to the parent mean and sd over its children, for each experiment and recipe."""
    means = []
    for (experiment, recipe), rows in tidy(cards).groupby(["question", "recipe"]):
        for name, summary in over_folds(rows).items():
            means += [(f"{experiment}.{recipe}.{name}.{key}", value, 0) for key, value in summary.items()]
    _log(client, run_id, means)


def _mark_superseded(client: Any, experiment_id: str, current: set[str]) -> int:
    """Tag runs that the scene's newest results replace, so that `tags.current = 'true'` shows each once."""
    marked_n, token = 0, None
    while True:
        page = client.search_runs([experiment_id], "tags.current = 'true'", max_results=1000, page_token=token)
        for run in page:
            if run.data.tags["run_key"] not in current:
                client.set_tag(run.info.run_id, "current", "false")
                marked_n += 1
        token = page.token
        if not token:
            return marked_n
