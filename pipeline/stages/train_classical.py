"""Stage train_classical: classical methods on the folds of the pooled networks. Refuses to know torch."""

from pathlib import Path

import numpy as np

from pipeline.executors import make_executor
from pipeline.stage import run, say
from pipeline.training.trainings import measured, note_seconds, read_data, score_test
from reskin import io
from reskin.config import Files, Settings, read_settings
from reskin.models.classical import Baselines, Task, baselines, run_tasks

NO_ROWS = np.zeros(0, np.int64)


def read(settings: Settings) -> Baselines:
    """Read section train_classical."""
    return baselines(settings)


def train_classical(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Fit every method of section train_classical with one board held out."""
    data = read_data(read_settings("train_classical", scene, files), indentations, folds)
    settings, seed = read(data.settings), data.settings.seed
    pairs = [(fold, name, method) for fold in data.folds_of("lobo") for name, method in settings.methods.items()]
    tasks = [
        Task(f"{name}.{fold.name}", method, fold.train, fold.test, NO_ROWS, settings.rows_max_n, seed)
        for fold, name, method in pairs
    ]
    with make_executor(imports="reskin.models.classical") as executor:
        fitted = run_tasks(tasks, measured(data), executor, lambda line: say(f"{scene} classical: {line}"))
    points = [
        {"name": name, "method": method.title, "inputs": method.inputs, "fold": fold.name, "seed_i": 0}
        | {"rows_n": answer.rows_n, "scores": score_test(data, fold.test, answer.predicted)}
        for (fold, name, method), answer in zip(pairs, fitted, strict=True)
    ]
    io.write_json(scores, points)
    note_seconds(scene, "train_classical", tasks, fitted)


if __name__ == "__main__":
    run(train_classical)
