"""Classical methods on many folds at once. In: rows and tasks. Out: predictions and seconds, in the order of tasks.

Refuses to know questions, scores and files.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Int64
from pydantic import Field

from pipeline.core.config import Settings, Strict, parse
from pipeline.core.executors import median_s
from pipeline.core.seeds import rng_for
from pipeline.learning.classical import Classical, fit
from pipeline.learning.inputs import VIEW
from pipeline.learning.recipe import Name, Steps
from pipeline.learning.trial import Measured


class Baselines(Strict):
    """Section train_classical: methods on the folds of question lobo, each on at most so many training rows."""

    rows_max_n: Annotated[int, Field(ge=1)]
    methods: dict[Name, Classical]


class BaselinesRow(Strict):
    """Section train_classical as a scene writes it: `methods` names a set of params.yaml."""

    rows_max_n: Steps
    methods: Name


@dataclass(frozen=True)
class Task:
    """A method on one fold; `few_labels` are labelled rows of a new skin, which together weigh as much as all others.

    More than `rows_max_n` training rows are thinned to this number at random.
    """

    name: str
    method: Classical
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    few_labels: Int64[np.ndarray, " o"]
    rows_max_n: int
    seed: int


@dataclass(frozen=True)
class Fit:
    """Predictions (mm, mm, N) for the test rows, the number of training rows, and times of fit and prediction."""

    predicted: Float32[np.ndarray, "b 3"]
    rows_n: int
    seconds: float
    one_reading_s: float  # median time of a prediction for a single reading


@dataclass(frozen=True)
class _Inputs:
    """The rows of one task, as its method sees them: small enough for another process."""

    train: Float32[np.ndarray, "a c"]
    target: Float32[np.ndarray, "a 3"]
    weight: Float32[np.ndarray, " a"] | None
    test: Float32[np.ndarray, "b c"]


def baselines(settings: Settings) -> Baselines:
    """Read section train_classical, with the set of methods that it names."""
    section, where = settings.words("train_classical"), f"{settings.where}: train_classical"
    row = parse(BaselinesRow, section, where)
    return parse(Baselines, dict(section) | {"methods": settings.row("methods", row.methods)}, where)


def run_tasks(tasks: Sequence[Task], rows: Measured, executor: Executor, tell: Callable[[str], None]) -> list[Fit]:
    running = [executor.submit(_fit, task.method, task.name, task.seed, _inputs(task, rows)) for task in tasks]
    fits = []
    for task, future in zip(tasks, running, strict=True):
        fits.append(future.result())
        tell(f"{len(fits)}/{len(tasks)} {task.name}")
    return fits


def _inputs(task: Task, rows: Measured) -> _Inputs:
    train, weight, view = task.train, None, VIEW[task.method.inputs]
    if len(train) > task.rows_max_n:
        kept = rng_for(task.seed, "thin", task.name).choice(len(train), task.rows_max_n, replace=False)
        train = train[np.sort(kept)]
    if len(task.few_labels):
        share = len(train) / len(task.few_labels)
        weight = np.concatenate([np.ones(len(train)), np.full(len(task.few_labels), share)]).astype(np.float32)
        train = np.concatenate([train, task.few_labels])
    return _Inputs(view(rows.db_uT[train]), rows.target[train], weight, view(rows.db_uT[task.test]))


def _fit(method: Classical, name: str, seed: int, inputs: _Inputs) -> Fit:
    start_s = time.monotonic()
    fitted = fit(method, inputs.train, inputs.target, rng_for(seed, "baseline", name), weight=inputs.weight)
    seconds = time.monotonic() - start_s
    one_reading_s = median_s(partial(fitted.predict, inputs.test[:1]))
    return Fit(fitted.predict(inputs.test), fitted.rows_n, seconds, one_reading_s)
