"""Classical methods on many folds at once. In: rows and tasks. Out: predictions and seconds, in the order of tasks.

Refuses to know questions, scores and files.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float32, Int64

from pipeline.core.seeds import rng_for
from pipeline.learning.classical import Classical, fit
from pipeline.learning.inputs import VIEW
from pipeline.learning.stopwatch import median_s
from pipeline.learning.trial import Measured


@dataclass(frozen=True)
class Task:
    """A method on one fold; `own` are labelled rows of a new skin, which together weigh as much as all others.

    Of more than `rows_max_n` training rows so many are drawn.
    """

    name: str
    asked: Classical
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    own: Int64[np.ndarray, " o"]
    rows_max_n: int
    seed: int


@dataclass(frozen=True)
class Answered:
    """Predictions (mm, mm, N) for the test rows, the training rows that were used, and seconds of fit and answer."""

    predicted: Float32[np.ndarray, "b 3"]
    rows_n: int
    seconds: float
    one_reading_s: float  # median, to answer for a single reading


@dataclass(frozen=True)
class _Seen:
    """What one task sees of the rows, small enough for another process."""

    inputs: Float32[np.ndarray, "a c"]
    target: Float32[np.ndarray, "a 3"]
    weight: Float32[np.ndarray, " a"] | None
    tested: Float32[np.ndarray, "b c"]


def run_tasks(tasks: Sequence[Task], rows: Measured, executor: Executor, tell: Callable[[str], None]) -> list[Answered]:
    """Fit and predict; every task by itself."""
    running = [executor.submit(_answer, task.asked, task.name, task.seed, _see(task, rows)) for task in tasks]
    answered = []
    for task, future in zip(tasks, running, strict=True):
        answered.append(future.result())
        tell(f"{len(answered)}/{len(tasks)} {task.name}")
    return answered


def _see(task: Task, rows: Measured) -> _Seen:
    train, weight, view = task.train, None, VIEW[task.asked.inputs]
    if len(train) > task.rows_max_n:
        drawn = rng_for(task.seed, "thin", task.name).choice(len(train), task.rows_max_n, replace=False)
        train = train[np.sort(drawn)]
    if len(task.own):
        share = len(train) / len(task.own)
        weight = np.concatenate([np.ones(len(train)), np.full(len(task.own), share)]).astype(np.float32)
        train = np.concatenate([train, task.own])
    return _Seen(view(rows.db_uT[train]), rows.target[train], weight, view(rows.db_uT[task.test]))


def _answer(asked: Classical, name: str, seed: int, seen: _Seen) -> Answered:
    start_s = time.monotonic()
    fitted = fit(asked, seen.inputs, seen.target, rng_for(seed, "baseline", name), weight=seen.weight)
    seconds = time.monotonic() - start_s
    answer_s = median_s(partial(fitted.predict, seen.tested[:1]))
    return Answered(fitted.predict(seen.tested), fitted.rows_n, seconds, answer_s)
