"""Run one sweep of training runs on RESKIN_EXECUTOR and log every task: `python -m ... FOLDER`.

cluster.py runs it on this machine and in network namespaces. The results are written to FOLDER/found.json, the task log
to FOLDER/ran.txt.
"""

import hashlib
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.executors import end_workers, make_executor
from reskin.models.job import TrainingData, TrainingJob
from reskin.models.recipe import Recipe
from reskin.models.runner import _read_rows, run_jobs
from reskin.seeds import rng_for

BOARDS_N, SEEDS_N, ROWS_N, STEPS_N = 6, 6, 20_000, 200
TASKS_N = SEEDS_N * BOARDS_N // 3  # one task trains three networks together (a stack)
EMPTY_N = 300


class LoggingExecutor(Executor):
    """Executor that forwards calls to `inner`; the process that runs a call logs its begin and end."""

    def __init__(self, inner: Executor, log: Path) -> None:
        self._inner, self._log = inner, log

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return self._inner.submit(call_and_log, self._log, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._inner.shutdown(wait=wait, cancel_futures=cancel_futures)


def call_and_log(log: Path, fn: Callable[..., Any], *args: Any) -> Any:
    """Call a function; log its begin and end with the id and the CPU seconds of the process that runs it."""
    name = hashlib.sha256(repr(args[-1]).encode()).hexdigest()[:8]
    _note(log, "begun", name)
    before_n = _read_rows.cache_info().misses
    result = fn(*args)
    if _read_rows.cache_info().misses > before_n:
        _note(log, "read", str(os.getpid()))
    _note(log, "ended", name)
    return result


def _note(log: Path, word: str, name: str) -> None:
    with log.open("a") as stream:  # appending a short line is atomic, although several processes write to this file
        stream.write(f"{word} {name} {os.getpid()} {time.process_time():.4f}\n")


def empty_task() -> None:
    """Do nothing, to time the overhead of a task."""


def make_rows() -> TrainingData:
    rng = rng_for(0, "cluster")
    place_mm = 2.0 * rng.integers(0, 9, (ROWS_N, 2))
    target = np.column_stack([place_mm, rng.uniform(0, 3, ROWS_N)])
    db_uT = 50 * np.tanh(target @ rng.normal(0, 0.1, (3, 15))) + rng.normal(0, 3, (ROWS_N, 15))
    return TrainingData(db_uT.astype(np.float32), target.astype(np.float32), np.arange(ROWS_N) * BOARDS_N // ROWS_N)


def make_jobs(rows: TrainingData) -> list[TrainingJob]:
    recipe = Recipe(
        architecture="paper", inputs="raw", scaling="standard", triplet_weight=0.0, steps_n=STEPS_N, batch_n=128,
        rate_max=3e-3, gradient_norm_max=1.0, weight_decay=0.0,
    )  # fmt: skip
    return [
        TrainingJob("lobo", "paper", recipe, f"b{held}", 0, seed_i, np.flatnonzero(rows.skin != held),
              np.flatnonzero(rows.skin == held))
        for seed_i in range(SEEDS_N)
        for held in range(BOARDS_N)
    ]  # fmt: skip


def main() -> None:
    folder, empty = Path(sys.argv[1]).resolve(), "--empty" in sys.argv
    folder.mkdir(parents=True, exist_ok=True)
    rows, start_s = make_rows(), time.monotonic()
    found: dict[str, object] = {}
    with make_executor(imports="reskin.models.train") as executor:
        connect_end_s = time.monotonic()
        executor.submit(empty_task).result()  # afterwards, local workers have imported all modules
        ready_s = time.monotonic()
        logged = LoggingExecutor(executor, folder / "ran.txt")
        done = run_jobs(make_jobs(rows), rows, executor=logged, cache=folder / "cells", log=lambda line: None)
        sweep_end_s = time.monotonic()
        if empty:
            for future in [executor.submit(empty_task) for _ in range(EMPTY_N)]:
                future.result()
            found["empty_s"] = (time.monotonic() - sweep_end_s) / EMPTY_N
    found |= {"connect_s": connect_end_s - start_s, "sweep_s": sweep_end_s - ready_s}
    digest = hashlib.sha256()
    for trained in done:
        for name in sorted(trained.weights):
            digest.update(trained.weights[name].tobytes())
        digest.update(trained.predicted.tobytes())
    end_workers()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    found |= {"sha256": digest.hexdigest(), "children_cpu_s": used.ru_utime + used.ru_stime}
    numbers_n = BOARDS_N * ROWS_N  # each of the BOARDS_N folds uses every row, for training or for testing
    found["rows_bytes"] = sum(part.nbytes for part in (rows.db_uT, rows.target, rows.skin)) + 8 * numbers_n
    (folder / "found.json").write_text(json.dumps(found))


if __name__ == "__main__":
    try:
        main()
    except ValueError as error:
        sys.exit(f"error: {error}")
