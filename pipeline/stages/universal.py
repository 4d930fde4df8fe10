"""Stages few_labels and calibrated: score methods on held-out boards, for different numbers of labels.

A label is a press of the held-out board whose place and force are known. Both stages use the same folds and test
rows, so that their scores can be compared.
"""

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.executors import make_executor
from pipeline.experiments.results import read_captures
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.training import few_labels as few
from pipeline.training.calibrated import Calibrated, Frame, read_model, rest_by_skin
from pipeline.training.calibrated import score_fold as score_calibrated
from pipeline.training.few_labels import FewLabels
from pipeline.training.jobs import SceneData, collapse_record, read_data, score_test, train_jobs, training_data
from pipeline.training.recorded import Compare
from reskin import io
from reskin.models.classical import run_classical_jobs


def few_labels(settings: Settings, section: FewLabels, indentations: Path, folds: Path, scores: Path) -> None:
    """Score networks, adapted networks and classical methods, for every number of labels.

    All methods are scored on the same test rows.
    """
    data = read_data(settings, indentations, folds)
    study = few.Study(data.rows, data.folds_of(few.EXPERIMENT), settings.seed, section)
    trained_entries: list[few.TrainedEntry] = []
    # Each of these steps uses the networks of the steps before it.
    for step in (few.network_jobs, few.adaptation_jobs, few.fine_tuning_jobs):
        pairs = step(study, trained_entries)
        trained = train_jobs(data, [job for _, job in pairs], "few_labels")
        trained_entries = [
            *trained_entries,
            *((entry, job, result) for (entry, job), result in zip(pairs, trained, strict=True)),
        ]
    tasks = few.classical_jobs(study)
    with make_executor(imports="sklearn.ensemble") as executor:
        fitted = run_classical_jobs(
            [task for _, task in tasks],
            training_data(data),
            executor,
            lambda line: say(f"{data.scene} few_labels: {line}"),
        )
    points = [
        _point(data, entry, trained.predicted) | collapse_record(trained) for entry, _, trained in trained_entries
    ]
    points += [_point(data, entry, result.predicted) for (entry, _), result in zip(tasks, fitted, strict=True)]
    io.write_json(scores, points)


def _point(data: SceneData, entry: few.Entry, predicted: np.ndarray) -> dict[str, Any]:
    point = {"method": entry.method, "inputs": entry.inputs, "labels_n": entry.labels_n, "fold": entry.fold.board}
    return point | {"seed_i": entry.fold.draw_i, "scores": score_test(data, entry.fold.test, predicted)}


def calibrated(
    settings: Settings, section: Calibrated, indentations: Path, folds: Path, model: Path, scores: Path
) -> None:
    """Calibrate a finished universal model to every held-out board, and score it on the test rows of `few_labels`."""
    data, compare = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    universal_model = read_model(model, compare.layout, settings)
    frame = Frame(compare.labels_middle_mm, compare.labels_mirrored)
    rest_uT = rest_by_skin(read_captures(indentations, tuple(settings.captures_in(indentations))))
    points = []
    for fold in data.folds_of(few.EXPERIMENT):
        points += score_calibrated(data, fold, universal_model, frame, rest_uT, section)
        say(f"{settings.scene} calibrated: {fold.name} done")
    io.write_json(scores, points)
