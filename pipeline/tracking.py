"""The diary: writes finished trainings to MLflow. The only module that says mlflow; nothing reads it back.

In: the cards and weights in `data/models`, and the report. Out: one experiment a scene, one parent run a stage and set
of trainings, one child a training, and one run `report` with the page, its tables and figures, and their numbers.
Published after training and from files, so a server that is away costs nothing but the entry, and `reskin publish`
sends later what is missing.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline import io
from pipeline.evaluation.summary import over_folds, pool_skins
from pipeline.server import TrackingAway, probe, server_uri

STORE = "mlflow.db"
ARTIFACTS = "mlartifacts"
ELSEWHERE = {"provenance", "runtime", "described", "variants"}  # of numbers.json: costs, and what trainings hold


def tracking_uri(root: Path) -> str:
    """The server of MLFLOW_TRACKING_URI, else the embedded store of the checkout."""
    return server_uri() or f"sqlite:///{(root / STORE).resolve()}"


# of a sweep or an experiment: its points, each the name of its curve, its step (pokes, skins, contacts), its means
Curves = Mapping[str, Sequence[tuple[str, int, Mapping[str, float]]]]


def publish(arms: Mapping[str, Path], curves: Curves, reports: Path, *, scene: str, root: Path) -> dict[str, int]:
    """Write every training of a scene to MLflow once, and its report; `arms` maps stage to models.

    A sweep or an experiment is one run whose metrics go over its steps: hundreds of children would hide the others.
    Returns counts of new, kept and superseded runs; raises `TrackingAway` if the server does not answer.
    """
    uri = tracking_uri(root)
    probe(uri)
    counts = {"new_n": 0, "kept_n": 0, "superseded_n": 0}
    with _client(uri) as client:
        experiment_id = _experiment(client, scene, root)
        current: set[str] = set()
        for stage, models in arms.items():
            cards = {file: io.read_json(file) for file in sorted(models.glob("*.json"))}
            keys = {file: run_key(card) for file, card in cards.items()}
            parent_key = hashlib.sha256("".join(sorted(keys.values())).encode()).hexdigest()[:32]
            parent_id = _open_parent(client, experiment_id, stage, scene, parent_key)
            for file, card in cards.items():
                fresh = _publish_one(client, experiment_id, stage, parent_id, file, card)
                counts["new_n" if fresh else "kept_n"] += 1
            current |= {parent_key, *keys.values()}
            _log_means(client, parent_id, list(cards.values()))
            client.set_terminated(parent_id)
        for stage, points in curves.items():
            key = hashlib.sha256(json.dumps([stage, points]).encode()).hexdigest()[:32]
            if _find(client, experiment_id, stage, key) is None:
                _publish_curve(client, _open_parent(client, experiment_id, stage, scene, key), points)
            current.add(key)
        current.add(_publish_report(client, experiment_id, scene, reports))
        counts["superseded_n"] = _mark_superseded(client, experiment_id, current)
    return counts


def run_key(card: Mapping[str, Any]) -> str:
    """Name a result by all that its card says, scores included, but for the commit: equal results are one."""
    words = {name: value for name, value in card.items() if name != "git"}
    return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:32]


@contextmanager
def _client(uri: str) -> Iterator[Any]:
    # Before the import: MLflow reads these once. Without limits a dead server costs minutes a call.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    import logging

    for name in ("alembic", "mlflow"):
        logging.getLogger(name).setLevel(logging.WARNING)
    import mlflow
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield mlflow.MlflowClient(tracking_uri=uri)
    except (MlflowException, SQLAlchemyError, OSError) as error:
        sentence = " ".join(str(error).split())[:200]
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


def _open_parent(client: Any, experiment_id: str, stage: str, scene: str, key: str) -> str:
    found = _find(client, experiment_id, stage, key)
    if found:
        _set_tags(client, found, {"current": "true"})
        return str(found.info.run_id)
    tags = {"run_key": key, "stage": stage, "scene": scene, "kind": "stage", "current": "true"}
    return str(client.create_run(experiment_id, tags=tags, run_name=stage).info.run_id)


def _publish_one(client: Any, experiment_id: str, stage: str, parent_id: str, file: Path, card: dict[str, Any]) -> bool:
    """Write one training; True if it was not there yet. A half-written run of a killed process is replaced."""
    parent_tag = "mlflow.parentRunId"
    key = run_key(card)
    found = _find(client, experiment_id, stage, key)
    if found and found.info.status == "FINISHED":
        _set_tags(client, found, {parent_tag: parent_id, "current": "true"})
        return False
    if found:
        client.delete_run(found.info.run_id)
    words = ("scene", "question", "recipe_name", "fold", "git")
    tags = {name: card[name] for name in words} | {
        "run_key": key, "cell": card["key"], "stage": stage, "kind": "training", "current": "true",
        parent_tag: parent_id, "mlflow.source.name": f"pipeline.stages.{stage}",
        "mlflow.source.git.commit": card["git"],
    }  # fmt: skip
    run_id = client.create_run(experiment_id, tags=tags, run_name=file.stem).info.run_id
    _log(client, run_id, card)
    for artifact in (file, file.with_suffix(".safetensors")):
        client.log_artifact(run_id, str(artifact), "model")
    client.set_terminated(run_id)
    return True


def _log(client: Any, run_id: str, card: dict[str, Any]) -> None:
    from mlflow.entities import Metric, Param

    known = {"fold": card["fold"], "seed_i": card["seed_i"], "seed": card["seed"], **card["recipe"]}
    known |= {name: card[name] for name in ("train_rows_n", "train_boards", "test_boards", "test_skins")}
    known |= {f"adapt_{name}": value for name, value in card.get("tuning", {}).get("settings", {}).items()}
    parameters = [Param(name, str(value)[:500]) for name, value in known.items()]
    curve = [Metric("train_loss", value, 0, step) for step, value in enumerate(card["curve"])]
    parts = (("", "all"), ("registered_", "registered"))
    scores = [Metric(f"{p}{name}", v, 0, 0) for p, part in parts for name, v in card["scores"][part].items()]
    client.log_batch(run_id, metrics=scores, params=parameters)
    _log_all(client, run_id, curve)


def _publish_curve(client: Any, run_id: str, points: Sequence[tuple[str, int, Mapping[str, float]]]) -> None:
    from mlflow.entities import Metric

    metrics = [Metric(f"{curve}.{name}", value, 0, step) for curve, step, own in points for name, value in own.items()]
    _log_all(client, run_id, metrics)
    client.set_terminated(run_id)


def _log_all(client: Any, run_id: str, metrics: Sequence[Any]) -> None:
    for start in range(0, len(metrics), 1000):  # MLflow takes at most 1000 metrics a call
        client.log_batch(run_id, metrics=metrics[start : start + 1000])


def _publish_report(client: Any, experiment_id: str, scene: str, reports: Path) -> str:
    """Write the report's numbers once, and its files; give its key: what it says but for costs and commits."""
    from mlflow.entities import Metric

    metrics = [Metric(name, value, 0, step) for name, value, step in metrics_of(io.read_json(reports / "numbers.json"))]
    said = [[one.key, one.value, one.step] for one in metrics]
    files = [file for part in ("figures", "tables") for file in sorted((reports / part).glob("*"))]
    said += [[file.name, io.sha256(file), 0] for file in files]
    key = hashlib.sha256(json.dumps(said).encode()).hexdigest()[:32]
    found = _find(client, experiment_id, "report", key)
    run_id = _open_parent(client, experiment_id, "report", scene, key)
    if found is None:
        _log_all(client, run_id, metrics)
    client.log_artifacts(run_id, str(reports))  # again: words on the page and costs may be new
    client.set_terminated(run_id)
    return key


def metrics_of(numbers: Mapping[str, Any]) -> list[tuple[str, float, int]]:
    """Flatten numbers.json to name, value and step: a list of rows that begin with a count is a curve over it.

    Other lists, words, costs and what other runs hold are left out.
    """
    asked = {name: value for name, value in numbers.items() if name not in ELSEWHERE}
    return [(re.sub(r"[^A-Za-z0-9_.\- ]", "_", name), value, step) for name, value, step in _flat(asked, "", 0)]


def _flat(value: Any, name: str, step: int) -> Iterator[tuple[str, float, int]]:
    if isinstance(value, dict):
        for key, own in value.items():
            yield from _flat(own, f"{name}.{key}" if name else key, step)
    elif isinstance(value, list):
        for row in value:
            axis = next(iter(row), "") if isinstance(row, dict) else ""
            if axis.endswith("_n"):
                rest = {key: own for key, own in row.items() if key != axis}
                yield from _flat(rest, name, int(row[axis]))
    elif isinstance(value, int | float):
        yield name, float(value), step


def _set_tags(client: Any, run: Any, tags: dict[str, str]) -> None:
    for name, value in tags.items():
        if run.data.tags.get(name) != value:
            client.set_tag(run.info.run_id, name, value)


def _log_means(client: Any, run_id: str, cards: list[dict[str, Any]]) -> None:
    """Write to the parent what its children say together: mean and sd of each question and recipe."""
    from mlflow.entities import Metric

    metrics = []
    for question, recipe in sorted({(card["question"], card["recipe_name"]) for card in cards}):
        own = [card for card in cards if (card["question"], card["recipe_name"]) == (question, recipe)]
        for name, summary in over_folds(pool_skins(own) if "tuning" in own[0] else own).items():
            metrics += [Metric(f"{question}.{recipe}.{name}.{key}", value, 0, 0) for key, value in summary.items()]
    client.log_batch(run_id, metrics=metrics)


def _find(client: Any, experiment_id: str, stage: str, key: str) -> Any:
    found = client.search_runs([experiment_id], f"tags.run_key = '{key}' and tags.stage = '{stage}'", max_results=1)
    return found[0] if found else None


def _mark_superseded(client: Any, experiment_id: str, current: set[str]) -> int:
    """Tag runs that the scene's newest results replace, so that `tags.current = 'true'` shows each once."""
    marked_n = 0
    token = None
    while True:
        page = client.search_runs([experiment_id], "tags.current = 'true'", max_results=1000, page_token=token)
        for run in page:
            if run.data.tags["run_key"] not in current:
                client.set_tag(run.info.run_id, "current", "false")
                marked_n += 1
        token = page.token
        if not token:
            return marked_n
