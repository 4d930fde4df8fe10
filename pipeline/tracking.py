"""Write training runs and reports to MLflow, from the files that finished stages of the pipeline wrote.

MLflow only displays results; no result depends on it. If the MLflow server does not respond, a stage waits only briefly
and then continues without it.
"""

import hashlib
import http.client
import json
import os
import re
import sqlite3
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from pipeline.provenance import COSTS, SECONDS
from pipeline.scores import rows_of_cards
from pipeline.statistics import over_folds
from pipeline.views import TRAIN_S, UI, link, missing_tags
from reskin import io
from reskin.errors import ReskinError
from reskin.metrics import METRICS

if TYPE_CHECKING:
    import numpy as np

VARIABLE = "MLFLOW_TRACKING_URI"
PUBLISH = "RESKIN_PUBLISH"  # environment variable; with the value 0, stages write nothing to MLflow
SQLITE = "sqlite:///"
STORE = "mlflow.db"
ARTIFACTS = "mlartifacts"
PARENT = "mlflow.parentRunId"
CHAMPION = "champion"  # alias of the version of a registered model that users should load
UNIVERSAL = "reskin-universal"  # name under which the universal model is registered
UNIVERSAL_EXPERIMENT = "universal model"
LAYOUT = 4  # version of the form in which runs are written to MLflow; runs of older versions are written again
DIGITS_N = 6  # significant digits of metrics, as in numbers.json; MLflow's page shows all digits
METRICS_MAX_N = 1000  # largest number of metrics that are sent in one call to MLflow
TIMEOUT_S = 2.0  # time in which an HTTP server must answer
LOCK_TIMEOUT_S = 5.0  # longest wait for a locked SQLite store; UIs and other writers lock it only briefly
PATIENCE_S, PATIENCE_PER_RUN_S = 60.0, 2.0  # time limit for writing all runs; a local server takes 0.1 s per run
# Keys of numbers.json that are not metrics of the report's run: run times, provenance, counts of data, and values that
# other MLflow runs contain.
NOT_METRICS = {"provenance", "runtime", "described", "variants", "capture", "trainings"}

# A point of a sweep or experiment: the name of its curve, its step (a number of pokes, skins, ...), and the mean of
# each metric.
Point = tuple[str, int, Mapping[str, float]]
Curves = Mapping[str, Sequence[Point]]


class Span(NamedTuple):
    """When something ran: Unix time of its start, and its duration."""

    start_s: float
    duration_s: float

    @classmethod
    def now(cls) -> "Span":
        """Return a span that starts now and has no duration, for a result whose time is unknown."""
        return cls(time.time(), 0.0)

    @property
    def start_ms(self) -> int:
        return round(1e3 * self.start_s)

    @property
    def end_ms(self) -> int:
        return round(1e3 * (self.start_s + self.duration_s))


@dataclass(frozen=True)
class Times:
    """Times at which the training runs and the stages of a scene ran, as far as this checkout knows them.

    - trainings: when each training run ran, by stage and name of the training run.
    - stages: when each stage ran, by stage.
    - by_key_s: duration of each training run in seconds, by the key of the training run.
    """

    trainings: Mapping[tuple[str, str], Span] = field(default_factory=dict)
    stages: Mapping[str, Span] = field(default_factory=dict)
    by_key_s: Mapping[str, float] = field(default_factory=dict)


def read_times(scene: str) -> Times:
    """Read the times that stages recorded in the working directory.

    Stages that ran on another machine have no times here, because times are not part of a stage's outputs.
    """
    trainings: dict[tuple[str, str], Span] = {}
    stages: dict[str, Span] = {}
    by_key_s: dict[str, float] = {}
    for file in sorted((SECONDS / scene).glob("*.json")):
        for run in io.read_json(file):
            if "started_s" in run:  # files of earlier versions lack it
                trainings[file.stem, run["name"]] = Span(run["started_s"], run["train_s"])
    for file in sorted((COSTS / scene).glob("*.json")):
        cost, end_s = io.read_json(file), file.stat().st_mtime  # written when the stage ended
        stages[file.stem] = Span(end_s - cost["seconds"], cost["seconds"])
        by_key_s |= cost.get("trainings_s", {})
    return Times(trainings, stages, by_key_s)


@dataclass(frozen=True)
class Results:
    """The results of a scene's stages that are written to MLflow.

    - models: folders with models and their model cards (JSON descriptions), by stage.
    - curves: points of sweeps and experiments, by stage.
    - reports: folder of the scene's report.
    - scores: mean scores of the paper's recipe, by stage.
    - final: file with the weights of the final model, if there is one.
    - readings: tables of readings, from which an example of a model's input is taken.
    - times: when stages and training runs ran.
    """

    models: Mapping[str, Path]
    curves: Curves
    reports: Path
    scores: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    final: Path | None = None
    readings: Sequence[Path] = ()
    times: Times = field(default_factory=Times)


class TrackingUnavailable(ReskinError):
    """The tracking server or store cannot be used; the message says what to do."""

    exit_code = 3


def server_uri() -> str | None:
    """Return the tracking server that the environment variable names; None means the embedded store."""
    return os.environ.get(VARIABLE) or None


def publishing() -> bool:
    """Return whether stages write to MLflow."""
    return os.environ.get(PUBLISH) != "0"


def tracking_uri(root: Path) -> str:
    """Return the URI of the tracking server, or of the checkout's embedded store if no server is named."""
    return server_uri() or f"{SQLITE}{(root / STORE).resolve()}"


def probe(uri: str | None) -> None:
    """Check that MLflow can be used; raise `TrackingUnavailable` if not.

    An HTTP server must answer within two seconds, and a SQLite file must not be locked.
    """
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
                f"MLflow at {uri} does not answer ({reason}). The results are computed anyway. When MLflow answers "
                "again, send them with `reskin publish`."
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
            "The results are kept. If another program has locked the store, wait until this program has ended, then "
            "run `reskin publish`."
        ) from None


def publish(results: Results, *, scene: str, root: Path, register: bool = True) -> dict[str, int]:
    """Write every training run and the report of a scene to MLflow, unless they are already there.

    A sweep or an experiment is a single MLflow run with metrics by step, because hundreds of child runs would hide the
    other runs. Tag `current` marks the runs of the current results. Results that are already in MLflow are only tagged.

    Parameters
    ----------
    results
        Files of the scene.
    scene, root
        Name of the MLflow experiment; folder of the checkout.
    register
        Whether to register the scene's final model and the universal model, with alias `champion`.

    Returns
    -------
    dict
        Number of training runs that were written (`new_n`), number that MLflow already had (`kept_n`), and number of
        MLflow runs that are no longer current (`superseded_n`).

    Raises
    ------
    TrackingUnavailable
        The server does not answer, or takes too long.
    """
    uri = tracking_uri(root)
    probe(uri)
    cards = {
        stage: {file: io.read_json(file) for file in sorted(folder.glob("*.json"))}
        for stage, folder in results.models.items()
    }
    trainings_n = sum(map(len, cards.values()))
    with _client(uri) as client:
        publisher = Publisher(client, scene, root, results, runs_n=trainings_n)
        new_n = sum(publisher.write_trainings(stage, stage_cards) for stage, stage_cards in cards.items())
        for stage, points in results.curves.items():
            publisher.write_curve(stage, points)
        if results.final is not None and results.final.exists():
            publisher.write_final(results.final, register=register)
        publisher.write_report(results.reports)
        superseded_n = publisher.mark_superseded()
        if register:
            publish_universal(client, root)
        return {"new_n": new_n, "kept_n": trainings_n - new_n, "superseded_n": superseded_n}


def publish_universal(client: Any, root: Path) -> None:
    """Write and register the universal model that comes with the project."""
    from reskin.universal.model import FILE

    publisher = Publisher(client, UNIVERSAL_EXPERIMENT, root, Results({}, {}, root), runs_n=1)
    publisher.write_universal(FILE, root / "reports/lab/numbers.json")
    publisher.mark_superseded()


def scores_link(scene: str, root: Path) -> str:
    """Return the address of the view of the scores of a scene's training runs."""
    with _client(tracking_uri(root)) as client:
        server = server_uri() or ""
        host = server if server.startswith("http") else UI
        return link(_experiment(client, scene, root), host=host)


class Publisher:
    """Writes the results of a scene to MLflow, each result only once.

    Tag `run_key` of an MLflow run identifies its content, of which it is a digest. A publisher remembers the keys of
    all runs that contain current results, so that all other runs can be marked as superseded.
    """

    def __init__(self, client: Any, scene: str, root: Path, results: Results, *, runs_n: int) -> None:
        self.client = client
        self.scene = scene
        self.results = results
        self.experiment_id = _experiment(client, scene, root)
        self.current: set[str] = set()
        self.limit_s = PATIENCE_S + PATIENCE_PER_RUN_S * runs_n
        self.end_s = time.monotonic() + self.limit_s

    @cached_property
    def marked(self) -> dict[str, Any]:
        """The MLflow runs that were marked as current before this publisher started, by key.

        All runs are read at once, because a query for each run would take 10 ms.
        """
        runs, token = [], None
        while True:
            page = self.client.search_runs(
                [self.experiment_id], "tags.current = 'true'", max_results=1000, page_token=token
            )
            runs += page
            token = page.token
            if not token:
                return {run.data.tags["run_key"]: run for run in runs}

    def find(self, stage: str, **tags: str) -> Any:
        """Return a stage's newest run with these tags; None if no run has them."""
        query = " and ".join(f"tags.{name} = '{value}'" for name, value in {"stage": stage, **tags}.items())
        runs = self.client.search_runs([self.experiment_id], query, max_results=1)
        return runs[0] if runs else None

    def open_run(
        self,
        stage: str,
        key: str,
        span: Span,
        *,
        name: str = "",
        parent: str = "",
        tags: Mapping[str, str] = MappingProxyType({}),
    ) -> tuple[str, bool]:
        """Find or create the run with this key; return its id, and whether its content must still be written.

        A run that a killed process left unfinished is replaced.
        """
        if time.monotonic() > self.end_s:
            raise TrackingUnavailable(
                f"MLflow took longer than {self.limit_s:.0f} s. The results are kept. To send those that MLflow still "
                "lacks, run `reskin publish`."
            )
        self.current.add(key)
        existing = self.marked.get(key) or self.find(stage, run_key=key)
        current = {"current": "true"} | ({PARENT: parent} if parent else {})
        if existing and existing.info.status == "FINISHED":
            self.set_tags(existing, current)
            return str(existing.info.run_id), False
        if existing:
            self.client.delete_run(existing.info.run_id)
        all_tags = {"run_key": key, "stage": stage, "scene": self.scene, "kind": "stage", **current, **tags}
        run = self.client.create_run(self.experiment_id, span.start_ms, tags=all_tags, run_name=name or stage)
        return str(run.info.run_id), True

    def set_tags(self, run: Any, tags: Mapping[str, str]) -> None:
        """Set tags of a run, except those that already have the given value."""
        for name, value in tags.items():
            if run.data.tags.get(name) != value:
                self.client.set_tag(run.info.run_id, name, value)

    def log(
        self,
        run_id: str,
        rows: Iterable[tuple[str, float, int]],
        span: Span,
        *,
        params: Mapping[str, Any] | None = None,
        tags: Mapping[str, str] | None = None,
    ) -> None:
        """Write metrics, parameters and tags to a run.

        Each element of `rows` is one value of a metric: (name, value, step). Values are rounded. MLflow needs a time
        for each value, so the points of a curve are spread over the run's duration, in proportion to their steps.
        """
        from mlflow.entities import Metric, Param, RunTag

        rows = list(rows)
        last_step = max((step for _, _, step in rows), default=0) or 1
        metrics = [
            Metric(
                name,
                float(f"{value:.{DIGITS_N}g}"),
                round(span.start_ms + 1e3 * span.duration_s * step / last_step),
                step,
            )
            for name, value, step in rows
        ]
        texts = [Param(name, str(value)[:500]) for name, value in (params or {}).items()]
        marks = [RunTag(name, value) for name, value in (tags or {}).items()]
        for start in range(0, max(len(metrics), 1), METRICS_MAX_N):
            first = not start
            self.client.log_batch(
                run_id, metrics[start : start + METRICS_MAX_N], texts if first else (), marks if first else ()
            )

    def end(self, run_id: str, span: Span) -> None:
        """Mark a run as finished."""
        self.client.set_terminated(run_id, end_time=span.end_ms)

    def write_trainings(self, stage: str, cards: Mapping[Path, dict[str, Any]]) -> int:
        """Write one MLflow run for a stage, and one child run for each of its training runs.

        Returns the number of training runs that MLflow did not have before.
        """
        scores = self.results.scores.get(stage, {})
        keys = [run_key(card) for card in cards.values()]
        parent_key = _digest([*sorted(keys), scores, LAYOUT])
        spans = [self.results.times.trainings[stage, file.stem] for file in cards if self._is_timed(stage, file)]
        start_s = min((span.start_s for span in spans), default=time.time())
        whole = Span(start_s, max((span.start_s + span.duration_s for span in spans), default=start_s) - start_s)
        parent_id, unwritten = self.open_run(stage, parent_key, whole)
        new_n = sum(self.write_training(stage, parent_id, file, card) for file, card in cards.items())
        if unwritten:
            rows = [(name, value, 0) for name, value in scores.items()]
            rows += [(TRAIN_S, sum(span.duration_s for span in spans), 0)] if spans else []
            for (experiment, recipe), group in rows_of_cards(list(cards.values())).groupby(["experiment", "recipe"]):
                means = {name: stat.mean for name, stat in over_folds(group).items()}
                rows += [(f"{name}.{experiment}.{recipe}", value, 0) for name, value in means.items()]
            self.log(parent_id, rows, whole)
            self.end(parent_id, whole)
        return new_n

    def _is_timed(self, stage: str, file: Path) -> bool:
        return (stage, file.stem) in self.results.times.trainings

    def write_training(self, stage: str, parent_id: str, file: Path, card: dict[str, Any]) -> bool:
        """Write one training run with its settings, scores, loss curve, datasets and model.

        Returns whether MLflow did not have this training run before.
        """
        span = self.results.times.trainings.get((stage, file.stem), Span.now())
        tags = {"cell": card["key"], "board": ", ".join(card["test_boards"]), "skin": ", ".join(card["test_skins"])}
        tags |= {"mlflow.source.name": f"python -m pipeline {stage}"}
        run_id, unwritten = self.open_run(
            stage, run_key(card), span, name=file.stem, parent=parent_id, tags=_tags_of(card, "training") | tags
        )
        if not unwritten:
            return False
        scores = card["scores"]
        rows = [(name, value, 0) for name, value in scores["all"].items() if name in METRICS]
        # Subtracting one offset per board from the places does not change the scores of the force.
        rows += [(f"registered_{name}", scores["registered"][name], 0) for name in METRICS[:2]]
        rows += [(TRAIN_S, span.duration_s, 0)] if self._is_timed(stage, file) else []
        self.write_model(run_id, file.with_suffix(".safetensors"), card, rows, span)
        return True

    def write_model(
        self, run_id: str, weights: Path, card: Mapping[str, Any], rows: Iterable[tuple[str, float, int]], span: Span
    ) -> None:
        """Write a network with its settings, loss curve, datasets and the metrics `rows` to a run, and end the run."""
        curve = zip(_curve_steps(card), card["curve"], strict=True)
        rows = [*rows, *(("loss", value, step) for step, value in curve)]
        about = self.write_artifacts(run_id, weights, self.example_uT(card["input"]["channels_n"]), span)
        self.log(run_id, rows, span, params=_settings_of(card), tags=about)
        self.client.log_inputs(run_id, datasets=_datasets(card))
        self.end(run_id, span)

    def write_artifacts(self, run_id: str, weights: Path, example_uT: "np.ndarray", span: Span) -> dict[str, str]:
        """Write a model in MLflow's format to the artifacts of a run; return the tag that makes MLflow list it."""
        from pipeline.pyfunc import FOLDER, write_model_files

        created = datetime.fromtimestamp(span.end_ms / 1e3, UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
        with tempfile.TemporaryDirectory() as temporary:
            about = write_model_files(Path(temporary), weights, example_uT, run_id=run_id, created=created)
            self.client.log_artifacts(run_id, temporary, FOLDER)
        listed = {name: about[name] for name in ("artifact_path", "flavors", "run_id", "utc_time_created")}
        return {"mlflow.log-model.history": json.dumps([listed])}

    @cached_property
    def _read_example(self) -> "np.ndarray | None":
        from pipeline.pyfunc import read_example

        return read_example(self.results.readings)

    def example_uT(self, channels_n: int) -> "np.ndarray":
        """Return an example of a model's input; it has no rows if the scene's readings are missing."""
        import numpy as np

        example_uT = self._read_example
        if example_uT is None or example_uT.shape[1] != channels_n:
            return np.empty((0, channels_n))
        return example_uT

    def write_final(self, weights: Path, *, register: bool) -> None:
        """Write the final model of a scene, which is trained on all boards.

        If `register`, the model is also registered, under the name `reskin-SCENE`. The final model itself cannot be
        tested, because no board is held out. The scores in the run are therefore scores of other networks of the same
        recipe, each of which was trained without the tested board. They are means over boards.
        """
        card = io.read_json(weights.with_suffix(".json"))
        train_s = self.results.times.by_key_s.get(card["key"])
        stage = self.results.times.stages.get("train_multi", Span.now())
        end_s = stage.start_s + stage.duration_s
        span = Span(end_s - (train_s or 0.0), train_s or 0.0)
        tags = {"mlflow.source.name": "python -m pipeline train_multi"}
        run_id, unwritten = self.open_run(
            "final", run_key(card), span, name="final", tags=_tags_of(card, "final") | tags
        )
        if unwritten:
            by_board = list(card["held_out"].values())
            known = [name for name in METRICS if by_board and all(name in scores for scores in by_board)]
            rows = [(name, sum(scores[name] for scores in by_board) / len(by_board), 0) for name in known]
            rows += [(TRAIN_S, train_s, 0)] if train_s is not None else []
            self.write_model(run_id, weights, card, rows, span)
        if register:
            boards = ", ".join(card["train_boards"])
            self.register(
                f"reskin-{self.scene}", run_id, f"Network trained on all boards of scene {self.scene}: {boards}."
            )

    def write_universal(self, weights: Path, tested: Path) -> None:
        """Write and register the universal model, with its scores on the recorded boards of scene lab.

        The step of a metric is the number of labelled presses to which the model was calibrated. MLflow's tables show
        the last step. Metrics that end in `_0_labels` are the scores without labels.
        """
        from pipeline.pyfunc import simulated_example
        from pipeline.report.figures import unseen_rows

        card = io.read_json(weights.with_suffix(".json"))
        scores = unseen_rows(io.read_json(tested) if tested.exists() else {}, ["shipped"])
        by_labels = {row["labels_n"]: row for row in scores}
        rows = [
            (name, row[name]["mean"], labels_n)
            for labels_n, row in sorted(by_labels.items())
            for name in METRICS
            if name in row
        ]
        rows += [(f"{name}_0_labels", value, 0) for name, value, labels_n in rows if labels_n == 0]
        seconds = float(sum(card["made_in_s"].values()))
        span = Span(time.time() - seconds, seconds)
        key = _digest([io.sha256(weights), io.sha256(weights.with_suffix(".json")), rows, LAYOUT])
        run_id, unwritten = self.open_run(UNIVERSAL, key, span, name=UNIVERSAL, tags={"kind": "final"})
        if unwritten:
            about = self.write_artifacts(run_id, weights, simulated_example(), span)
            texts = ("source", "tested_on", "not_for", "map", "network", "recorded_knowledge")
            params = {name: card[name] for name in texts if name in card} | card["training"]
            self.log(run_id, [*rows, (TRAIN_S, seconds, 0)], span, params=params, tags=about)
            self.end(run_id, span)
        tested_on = (
            f"The metrics are scores on recorded boards of scene lab, after calibration to {scores[0]['pokes_n']} "
            f"unlabelled presses and {max(by_labels)} labels. Metrics whose names end in _0_labels are scores without "
            "labels."
            if by_labels
            else "This checkout has no scores of the model on recorded boards."
        )
        use = f"Model for any skin on the paper's board. It is not for {card['not_for']}."
        self.register(UNIVERSAL, run_id, f"{use} {tested_on}")

    def register(self, name: str, run_id: str, description: str) -> None:
        """Register the model of a run as a version of `name`, and let alias `champion` refer to this version."""
        from pipeline.pyfunc import FOLDER

        found = self.client.search_registered_models(f"name = '{name}'")
        model = found[0] if found else self.client.create_registered_model(name, description=description)
        versions = self.client.search_model_versions(f"name = '{name}'")
        version = next((existing.version for existing in versions if existing.run_id == run_id), None)
        if version is None:
            source = f"runs:/{run_id}/{FOLDER}"
            version = self.client.create_model_version(name, source, run_id, description=description).version
        if str(model.aliases.get(CHAMPION)) != str(version):
            self.client.set_registered_model_alias(name, CHAMPION, str(version))

    def write_curve(self, stage: str, points: Sequence[Point]) -> None:
        """Write the points of a sweep or an experiment as one MLflow run."""
        span = self.results.times.stages.get(stage, Span.now())
        run_id, unwritten = self.open_run(stage, _digest([stage, points, LAYOUT]), span)
        if unwritten:
            rows = ((f"{curve}.{name}", value, step) for curve, step, means in points for name, value in means.items())
            self.log(run_id, rows, span)
            self.end(run_id, span)

    def write_report(self, reports: Path) -> None:
        """Write the numbers and the files of the report to a run.

        The key of the run depends on the numbers, figures and tables, but not on run times and other costs. Tag
        `inputs` identifies the results that the report shows. `dvc checkout` can restore earlier results without their
        report; the earlier run with the same tag `inputs` then becomes current again.
        """
        inputs = _digest(sorted(self.current))
        earlier = self.find("report", inputs=inputs)
        existing = key = None
        span = self.results.times.stages.get("report", Span.now())
        if (reports / "numbers.json").exists():
            numbers = io.read_json(reports / "numbers.json")
            files = [file for part in ("figures", "tables") for file in sorted((reports / part).glob("*"))]
            key = _digest([*metrics_of(numbers), *((file.name, io.sha256(file), 0) for file in files), LAYOUT])
            existing = self.find("report", run_key=key)
        other_inputs = existing is not None and existing.data.tags.get("inputs") != inputs
        if earlier is not None and (key is None or other_inputs):
            self.set_tags(earlier, {"current": "true"})
            self.current.add(earlier.data.tags["run_key"])
        elif key is not None:
            run_id, unwritten = self.open_run("report", key, span)
            if unwritten:
                scores = reports / "scores.json"
                self.log(run_id, metrics_of(io.read_json(scores)) if scores.exists() else (), span)
            if existing is None or other_inputs:
                self.client.set_tag(run_id, "inputs", inputs)
            self.client.log_artifacts(run_id, str(reports))  # always, because page texts and costs may have changed
            if unwritten:
                self.end(run_id, span)

    def mark_superseded(self) -> int:
        """Set tag `current` to false in all runs that no longer contain a current result; return their number.

        The filter `tags.current = 'true'` of MLflow's page then shows each result only once.
        """
        superseded = [run for key, run in self.marked.items() if key not in self.current]
        for run in superseded:
            self.client.set_tag(run.info.run_id, "current", "false")
        return len(superseded)


def _tags_of(card: Mapping[str, Any], kind: str) -> dict[str, str]:
    named = {name: card[name] for name in ("scene", "question", "recipe_name", "fold", "git")}
    return named | {"kind": kind, "mlflow.source.git.commit": card["git"]}


def _settings_of(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a training run."""
    settings = {"method": f"{card['question']}.{card['recipe_name']}"}
    settings |= {name: card[name] for name in ("question", "fold", "seed_i", "seed")} | card["recipe"]
    settings |= {name: card[name] for name in ("train_rows_n", "train_boards", "test_boards", "test_skins")}
    return settings | {f"adapt_{name}": value for name, value in card.get("tuning", {}).get("settings", {}).items()}


def _curve_steps(card: Mapping[str, Any]) -> list[int]:
    """Return the training step at which each point of the loss curve ends.

    Model cards of earlier versions do not contain these steps. The points are then numbered from 1.
    """
    points_n = len(card["curve"])
    return list(card.get("curve_steps", range(1, points_n + 1)))


def run_key(card: Mapping[str, Any]) -> str:
    """Return a digest of a model card, which identifies the MLflow run of the model.

    The commit in the card is ignored, so that equal results of two commits belong to the same run.
    """
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

    # Errors are raised as one sentence. MLflow would also log tracebacks, which would hide that sentence.
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
            f"MLflow at {uri} failed ({sentence}). The results are kept. To send them later, run `reskin publish`."
        ) from None


def _experiment(client: Any, scene: str, root: Path) -> str:
    """Find or create the experiment of a scene; return its id."""
    existing = client.get_experiment_by_name(scene)
    if existing is None:
        location = None if server_uri() else (root / ARTIFACTS / scene).resolve().as_uri()
        # With this kind of experiment, the UI shows training runs instead of chats.
        kind = {"mlflow.experimentKind": "custom_model_development"}
        existing = client.get_experiment(client.create_experiment(scene, artifact_location=location, tags=kind))
    experiment_id = str(existing.experiment_id)
    for name, value in missing_tags(existing.tags, experiment_id, existing.creation_time or 0):
        client.set_experiment_tag(experiment_id, name, value)
    return experiment_id


def _datasets(card: Mapping[str, Any]) -> list[Any]:
    """Describe, as MLflow datasets, the skins on which a network was trained and tested."""
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
    """Flatten the nested content of numbers.json to rows (name, value, step), one for each value of a metric.

    A list of rows whose first key is a count becomes a curve, in which this count is the step. Other lists, texts,
    costs, counts and the content of training runs are left out.
    """
    published = {name: value for name, value in numbers.items() if name not in NOT_METRICS}
    rows = ((re.sub(r"[^A-Za-z0-9_.\- ]", "_", name), value, step) for name, value, step in _flatten(published, "", 0))
    return [(name, value, step) for name, value, step in rows if not _is_count(name)]


def _is_count(name: str) -> bool:
    """Return whether a metric is a count, such as `drift.skins_n`, or the number of values of a mean.

    >>> [_is_count(name) for name in ("drift.skins_n", "table2.multi.r2_f.n", "table2.multi.mse_f_N2.mean")]
    [True, True, False]
    """
    return any(part == "n" or part.endswith("_n") for part in name.split("."))


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
