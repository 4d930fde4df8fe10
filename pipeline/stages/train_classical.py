"""Stage train_classical: classical methods on the folds of the pooled networks."""

from pathlib import Path

import numpy as np

from pipeline.core import io
from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.executors import make_executor
from pipeline.core.provenance import SECONDS
from pipeline.core.stage import run, say
from pipeline.evaluation.summary import score_groups
from pipeline.learning.baselines import Baselines, Task, baselines, run_tasks
from pipeline.learning.trial import Measured
from pipeline.trials.data import read_data

NO_ROWS = np.zeros(0, np.int64)


def read(settings: Settings) -> Baselines:
    """Read section train_classical."""
    return baselines(settings)


def train_classical(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Fit every method of section train_classical with one board held out."""
    data = read_data(read_settings("train_classical", scene, files), indentations, folds)
    asked, rows = (
        read(data.settings),
        data.rows,
    )
    pairs = [(fold, name) for fold in data.folds_of("lobo") for name in asked.methods]
    tasks = [
        Task(f"{name}.{f.name}", asked.methods[name], f.train, f.test, NO_ROWS, asked.rows_max_n, data.settings.seed)
        for f, name in pairs
    ]
    with make_executor() as executor:
        done = run_tasks(
            tasks,
            Measured(rows.db_uT, rows.target, rows.skin),
            executor,
            lambda line: say(f"{scene} classical: {line}"),
        )
    points = []
    for (fold, name), task, one in zip(pairs, tasks, done, strict=True):
        true, board, skin = (values[fold.test] for values in (rows.target, rows.board, rows.skin))
        method = {"name": name, "method": task.method.title, "inputs": task.method.inputs}
        scored = {"rows_n": one.rows_n, "scores": score_groups(true, one.predicted, board, skin)}
        points.append(method | {"fold": fold.name, "seed_i": 0} | scored)
    io.write_json(scores, points)
    took = [
        {"name": task.name, "train_s": one.seconds, "one_reading_s": one.one_reading_s}
        for task, one in zip(tasks, done, strict=True)
    ]
    io.write_json(SECONDS / scene / "train_classical.json", took)


if __name__ == "__main__":
    run(train_classical)
