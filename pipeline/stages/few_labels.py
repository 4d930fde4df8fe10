"""Stage few_labels: what no, a few and more labelled pokes of a new board are worth, for every method.

Refuses to know how a method learns (`trials`, `learning`).
"""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.executors import make_executor
from pipeline.stage import run, say
from pipeline.training import few_labels as few
from pipeline.training.few_labels import FewLabels
from pipeline.training.few_labels import few_labels as few_labels_of
from pipeline.training.trainings import SceneData, collapse_record, measured, read_data, score_test, train_all
from reskin import io
from reskin.config import Files, Settings, read_settings
from reskin.models.classical import run_tasks


def read(settings: Settings) -> FewLabels:
    """Read section few_labels."""
    return few_labels_of(settings)


def few_labels(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Score networks, adapted networks and classical methods with every number of labels on the same rows."""
    data = read_data(read_settings("few_labels", scene, files), indentations, folds)
    study = few.Study(data.rows, data.folds_of(few.QUESTION), data.settings.seed, read(data.settings))
    done: list[few.Done] = []
    for step in (few.networks, few.adapted, few.labelled):  # each goes on from what the last ones trained
        pairs = step(study, done)
        trained = train_all(data, [trial for _, trial in pairs], "few_labels")
        done = [*done, *((tried, trial, result) for (tried, trial), result in zip(pairs, trained, strict=True))]
    tasks = few.classical(study)
    with make_executor(imports="reskin.models.classical") as executor:
        fitted = run_tasks(
            [task for _, task in tasks], measured(data), executor, lambda line: say(f"{scene} few_labels: {line}")
        )
    points = [_point(data, tried, trained.predicted) | collapse_record(trained) for tried, _, trained in done]
    points += [_point(data, tried, answer.predicted) for (tried, _), answer in zip(tasks, fitted, strict=True)]
    io.write_json(scores, points)


def _point(data: SceneData, tried: few.Tried, predicted: np.ndarray) -> dict[str, Any]:
    board, draw = tried.fold.name.rsplit("-draw", 1)
    words = {"method": tried.method, "inputs": tried.inputs, "labels_n": tried.labels_n, "fold": board}
    return words | {"seed_i": int(draw), "scores": score_test(data, tried.fold.test, predicted)}


if __name__ == "__main__":
    run(few_labels)
