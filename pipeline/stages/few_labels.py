"""Stage few_labels: what no, a few and more labelled pokes of a new board are worth, for every method."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core import io
from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.executors import make_executor
from pipeline.core.stage import run, say
from pipeline.evaluation.summary import score_groups
from pipeline.learning import few_labels as few
from pipeline.learning.baselines import run_tasks
from pipeline.learning.card import collapse_record
from pipeline.learning.few_labels import FewLabels
from pipeline.learning.few_labels import few_labels as few_labels_of
from pipeline.learning.trial import Measured
from pipeline.trials.data import SceneData, read_data, train_all


def read(settings: Settings) -> FewLabels:
    """Read section few_labels."""
    return few_labels_of(settings)


def few_labels(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Score networks, adapted networks and classical methods with every number of labels on the same rows."""
    data = read_data(read_settings("few_labels", scene, files), indentations, folds)
    asked = read(data.settings)
    study = few.Study(data.rows, data.folds_of(few.QUESTION), data.settings.seed, asked)
    done: list[few.Done] = []
    for step in (few.networks, few.adapted, few.labelled):  # each goes on from what the last ones trained
        pairs = step(study, done)
        trained = train_all(data, [trial for _, trial in pairs], "few_labels")
        done = [*done, *((tried, trial, one) for (tried, trial), one in zip(pairs, trained, strict=True))]
    points = [_point(data, tried, one.predicted) | collapse_record(one) for tried, _, one in done]
    tasks = few.classical(study)
    rows = Measured(data.rows.db_uT, data.rows.target, data.rows.skin)
    with make_executor() as executor:
        fitted = run_tasks([task for _, task in tasks], rows, executor, lambda line: say(f"{scene} few_labels: {line}"))
    points += [_point(data, tried, one.predicted) for (tried, _), one in zip(tasks, fitted, strict=True)]
    io.write_json(scores, points)


def _point(data: SceneData, tried: few.Tried, predicted: np.ndarray) -> dict[str, Any]:
    test = tried.fold.test
    board, draw = tried.fold.name.rsplit("-draw", 1)
    words = {"method": tried.method, "inputs": tried.inputs, "labels_n": tried.labels_n, "fold": board}
    scores = score_groups(data.rows.target[test], predicted, data.rows.board[test], data.rows.skin[test])
    return words | {"seed_i": int(draw), "scores": scores}


if __name__ == "__main__":
    run(few_labels)
