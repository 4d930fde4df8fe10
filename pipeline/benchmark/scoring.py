"""Scores of a file of predictions, and the JSON file of scores that is an entry of the benchmark."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field

from pipeline.benchmark.folds import FORCE, PLACE, Dataset, read_dataset
from pipeline.benchmark.predictions import Predictions, check_units, read_predictions
from pipeline.formatting import rounded, show, tabulate
from pipeline.statistics import statistic
from reskin import io
from reskin.config import Strict
from reskin.metrics import coverage_pct, interval_score, median_error_mm, score

FORMAT: Literal["reskin-benchmark-scores-1"] = "reskin-benchmark-scores-1"
METRICS = {
    "accuracy_pct": "within 1 mm, %", "median_mm": "median error, mm", "mse_xy_mm2": "MSE_xy, mm²",
    "mse_f_N2": "MSE_F, N²", "r2_f": "R² of F", "coverage_pct": "place in 90 % interval, %",
    "interval_score_mm": "interval score, mm", "coverage_f_pct": "force in 90 % interval, %",
    "interval_score_f_N": "interval score of F, N",
}  # fmt: skip
MEANING = (
    "Each number is the mean over boards; the value of a board is the mean over its draws of presses. [low, high] is "
    "the 95 % interval over boards (Student's t); with fewer than four boards, (a; b) are the values of the boards. "
    "Within 1 mm: percentage of presses whose predicted x and y are both within 1 mm of the true place. MSE_xy: mean "
    "squared error of x and y, averaged over both. MSE_F: mean squared error of the force F. Interval score: mean "
    "width of the 90 % intervals, plus 20 times the mean distance of the true values from their intervals, which is 0 "
    "inside an interval; smaller is better."
)
Text = Annotated[str, Field(min_length=1, max_length=300)]


class About(Strict):
    """Description of an entry's method: name, authors, training data, and address of the code.

    trained_on: for example `labels` (labelled presses of the tested board), `other boards` (the training boards), or
    the names of other data.
    """

    method: Annotated[str, Field(min_length=1, max_length=60)]
    by: Text
    trained_on: Text
    code: Text


class Prediction(Strict):
    """The scored file of predictions: its SHA-256 and number of rows."""

    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    rows_n: Annotated[int, Field(ge=1)]


class TaskScores(Strict):
    """Scores with one number of labels.

    scores: for each metric, mean and spread over boards, as computed by `pipeline.statistics.statistic`. by_board:
    for each board and metric, the mean over draws, the number of draws and, for several draws, the standard deviation
    over draws.
    """

    labels_n: Annotated[int, Field(ge=0)]
    scores: dict[str, dict[str, Any]]
    by_board: dict[str, dict[str, dict[str, Any]]]


class Entry(Strict):
    """Content of a file of scores."""

    format: Literal["reskin-benchmark-scores-1"] = FORMAT
    version: str
    dataset: str
    source: Literal["simulated", "recorded"]
    about: About
    predictions: Prediction
    tasks: Annotated[tuple[TaskScores, ...], Field(min_length=1)]


def score_file(file: Path, about: About, data: Path | None = None) -> Entry:
    """Check and score a file of predictions.

    data: folder of the dataset's recordings; by default, the folder to which `reskin fetch` writes recordings.
    """
    predictions = read_predictions(file)
    own = predictions.folds
    return score_predictions(file, predictions, read_dataset(own.dataset, data, version=own.version), about)


def score_predictions(file: Path, predictions: Predictions, dataset: Dataset, about: About) -> Entry:
    """Check the units of predictions that were read from a file, and score the predictions."""
    check_units(file, predictions, dataset)
    own = dataset.folds
    return Entry(
        version=own.version,
        dataset=own.dataset,
        source=own.source,
        about=about,
        predictions=Prediction(sha256=io.sha256(file), rows_n=len(predictions.fold)),
        tasks=tuple(summarise(score_folds(predictions, dataset))),
    )


def score_folds(predictions: Predictions, dataset: Dataset) -> pd.DataFrame:
    """Score the predictions of each fold; return columns labels_n, board, draw and one per metric."""
    lines = []
    for fold in dict.fromkeys(predictions.fold.tolist()):
        draw, labels_n = predictions.folds.folds[fold]
        rows = predictions.fold == fold
        presses = dataset.presses[draw.board][predictions.press[rows]]
        true = np.column_stack([presses.place_mm, presses.force_N])
        force_N = np.full(rows.sum(), np.nan) if predictions.force_N is None else predictions.force_N[rows]
        scores = score(true, np.column_stack([predictions.place_mm[rows], force_N]))
        scores["median_mm"] = median_error_mm(presses.place_mm, predictions.place_mm[rows])
        limits = {name: ends[rows] for name, ends in predictions.intervals.items()}
        lines.append(
            {"labels_n": labels_n, "board": draw.board, "draw": draw.draw} | scores | _uncertainty(true, limits)
        )
    table = pd.DataFrame(lines)
    return table[[name for name in ("labels_n", "board", "draw", *METRICS) if name in table]]


def _uncertainty(true: Float[np.ndarray, "n 3"], limits: Mapping[str, Float[np.ndarray, "n 2"]]) -> dict[str, float]:
    """Score the given intervals; coverage and interval score of places are averaged over x and y."""
    scores = {}
    if PLACE[0] in limits:
        ends = np.stack([limits[name] for name in PLACE], axis=1)
        scores["coverage_pct"] = coverage_pct(true[:, :2], ends[..., 0], ends[..., 1])
        scores["interval_score_mm"] = interval_score(true[:, :2], ends[..., 0], ends[..., 1])
    if FORCE in limits:
        scores["coverage_f_pct"] = coverage_pct(true[:, 2], *limits[FORCE].T)
        scores["interval_score_f_N"] = interval_score(true[:, 2], *limits[FORCE].T)
    return scores


def summarise(table: pd.DataFrame) -> list[TaskScores]:
    """Average the scores of folds over the draws of each board, then summarise them over boards."""
    tasks = []
    metrics = [name for name in METRICS if name in table]
    for labels_n, rows in table.groupby("labels_n"):
        boards = {str(board): own[metrics] for board, own in rows.groupby("board", sort=False)}
        by_board = {board: {name: statistic(own[name]) for name in metrics} for board, own in boards.items()}
        means = {name: [board[name]["mean"] for board in by_board.values()] for name in metrics}
        scores = {name: statistic(values, boards=True, metric=name) for name, values in means.items()}
        tasks.append(TaskScores(labels_n=int(str(labels_n)), scores=rounded(scores), by_board=rounded(by_board)))
    return tasks


def table_of(entries: Sequence[Entry]) -> pd.DataFrame:
    """Tabulate entries of one dataset, sorted by number of labels, then from the most to the least accurate."""
    pairs = [(entry, task) for entry in entries for task in entry.tasks]
    shown = [name for name in METRICS if any(name in task.scores for _, task in pairs)]
    pairs.sort(key=lambda pair: (pair[1].labels_n, -pair[1].scores["accuracy_pct"]["mean"], pair[0].about.method))
    lines = [
        {"labels": str(task.labels_n), "method": entry.about.method, "trained on": entry.about.trained_on}
        | {METRICS[name]: show(task.scores.get(name)) for name in shown}
        | {"by": entry.about.by, "code": entry.about.code, "predictions": entry.predictions.sha256[:12]}
        for entry, task in pairs
    ]
    return tabulate(lines)
