"""Stage few_labels: what no, a few and more labelled pokes of a new board are worth, for every method."""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline import io
from pipeline.evaluation.summary import score_groups
from pipeline.learning import few_labels as few
from pipeline.learning.baselines import run_tasks
from pipeline.learning.card import went
from pipeline.learning.cell import Measured
from pipeline.learning.comparison import resolve_few_labels
from pipeline.learning.executors import make_executor
from pipeline.settings import Files, read_settings
from pipeline.stages._run import run, say
from pipeline.stages._train import Scenery, read_scenery, train_all


def few_labels(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Score networks, adapted networks and classical methods with every number of labels on the same rows."""
    at = read_scenery(read_settings("few_labels", scene, files), indentations, folds)
    asked = resolve_few_labels(at.asked.words("few_labels"), at.asked.named, f"{at.asked.where}: few_labels")
    study = few.Study(at.rows, at.of(few.QUESTION), at.asked.seed, asked)
    done: list[few.Done] = []
    for step in (few.networks, few.adapted, few.labelled):  # each goes on from what the last ones trained
        pairs = step(study, done)
        trained = train_all(at, [cell for _, cell in pairs], "few_labels")
        done = [*done, *((tried, cell, one) for (tried, cell), one in zip(pairs, trained, strict=True))]
    points = [_point(at, tried, one.predicted) | went(one) for tried, _, one in done]
    tasks = few.classical(study)
    rows = Measured(at.rows.db_uT, at.rows.target, at.rows.skin)
    with make_executor() as executor:
        fitted = run_tasks([task for _, task in tasks], rows, executor, lambda line: say(f"{scene} few_labels: {line}"))
    points += [_point(at, tried, one.predicted) for (tried, _), one in zip(tasks, fitted, strict=True)]
    io.write_json(scores, points)


def _point(at: Scenery, tried: few.Tried, predicted: np.ndarray) -> dict[str, Any]:
    test = tried.fold.test
    board, draw = tried.fold.name.rsplit("-draw", 1)
    words = {"method": tried.method, "inputs": tried.inputs, "labels_n": tried.labels_n, "fold": board}
    scores = score_groups(at.rows.target[test], predicted, at.rows.board[test], at.rows.skin[test])
    return words | {"seed_i": int(draw), "scores": scores}


if __name__ == "__main__":
    run(few_labels)
