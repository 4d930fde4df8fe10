"""Sleeve: place estimates over the whole area of many boards under one skin (paper section 6).

Networks and nearest neighbours are trained on the first pokes of a skin, and tested on its last pokes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int, Int64, Shaped
from pydantic import Field

from pipeline.experiments.results import read_captures, read_losses, write_results
from pipeline.formatting import show
from pipeline.plot import COLOURS, ERROR_COLOURS, drawing, svg
from pipeline.scores import make_table, write_scores
from pipeline.settings import SectionWithTraining, Settings, Training
from pipeline.simulation import simulation_settings
from pipeline.statistics import statistic, tally
from pipeline.training.jobs import SceneData, collapse_record, preload_training, train_jobs
from pipeline.training.neighbours import predict_by_neighbours
from reskin.data.rows import Rows, Selection, gather
from reskin.errors import ParamsError
from reskin.metrics import METRICS, TRUTH, score
from reskin.models.inputs import VIEW
from reskin.models.job import TrainingJob
from reskin.models.recipe import HEADLINE
from reskin.schema import Readings

NEAR_MM = 4.0  # a place closer than this to a border between boards is near it (assumed: twice the skin's thickness)
PLACES = ("median_error_mm", "p95_error_mm")  # scores over all places, besides those of `reskin.metrics`


class Sleeve(SectionWithTraining):
    """Settings section `sleeve`: held-out fraction of the pokes, number of nearest neighbours, and training."""

    # Fraction of the pokes of each capture that is held out. The held-out pokes are the last pokes of the capture.
    test_fraction: Annotated[float, Field(gt=0, lt=1)]
    neighbours_n: Annotated[int, Field(ge=1)]
    training: Training


@dataclass(frozen=True)
class Area:
    """A skin, and the boards under it, in the coordinates of the labels (mm from the skin's corner)."""

    sides_mm: tuple[float, float]
    chips_mm: Float[np.ndarray, "k 2"]
    # Borders between boards: x of the borders parallel to the y axis, and y of the borders parallel to the x axis.
    borders_mm: tuple[tuple[float, ...], tuple[float, ...]]

    def near_border(self, place_mm: Float[np.ndarray, "f 2"]) -> Bool[np.ndarray, " f"]:
        """Return which places are closer than `NEAR_MM` to a border between two boards."""
        near = np.zeros(len(place_mm), bool)
        for coordinate_mm, borders_mm in zip(place_mm.T, self.borders_mm, strict=True):
            for border_mm in borders_mm:
                near |= np.abs(coordinate_mm - border_mm) < NEAR_MM
        return near


def sleeve(settings: Settings, section: Sleeve, indentations: Path, scores: Path, results: Path) -> None:
    """Train the networks on the first pokes of each capture; score them and nearest neighbours on the last pokes."""
    preload_training()
    captures, area = read_captures(indentations), area_of(settings)
    data = SceneData(settings.scene, settings, gather(captures, settings.section(Selection, "selection")), [])
    train, test = hold_out_last(data.rows, section.test_fraction)
    jobs = [
        TrainingJob("sleeve", name, recipe, "last", data.settings.seed, seed_i, train, test)
        for name, recipe in section.training.recipes.items()
        for seed_i in range(section.training.seeds_n)
    ]
    trained = train_jobs(data, jobs, "sleeve")
    predictions = {
        name: [result.predicted for job, result in zip(jobs, trained, strict=True) if job.recipe_name == name]
        for name in section.training.recipes
    }
    target = data.rows.target[train]
    for name in ("raw", "shape"):  # of dB
        trained_on, tested = (VIEW[name](data.rows.db_uT[rows]) for rows in (train, test))
        predicted = predict_by_neighbours(trained_on, target, tested, section.neighbours_n)
        predictions[f"knn-{name}"] = [predicted]
    true, indentation = data.rows.target[test], data.rows.indentation[test]
    near = area.near_border(true[:, :2])
    scored = [
        {"experiment": "sleeve", "method": name, "seed": seed_i, **score_places(true, predicted, near)}
        for name, by_seed in predictions.items()
        for seed_i, predicted in enumerate(by_seed)
    ]
    write_scores(scores, make_table(scored))
    trained_n, tested_n = (len(np.unique(data.rows.indentation[side])) for side in (train, test))
    numbers = {
        "chips_n": captures[0].chips_n, "rate_hz": rate_hz(captures), "area_mm": list(area.sides_mm),
        "pokes_n": trained_n + tested_n, "trained_n": trained_n, "tested_n": tested_n, "near_mm": NEAR_MM,
        "tested": {part: len(np.unique(indentation[rows])) for part, rows in (("near_seam", near), ("inside", ~near))},
    }  # fmt: skip
    plot_data = draw_errors(area, true, errors_mm(true, predictions[HEADLINE][0]), indentation)
    losses = read_losses(indentations, data.rows.dropped)
    write_results(results, numbers, plot_data, losses, tally(map(collapse_record, trained)))


def area_of(settings: Settings) -> Area:
    """Return the skin and boards of the simulated sleeve, from a scene's settings."""
    simulation = simulation_settings(settings)
    kind = simulation.boards[simulation.protocols["sleeve"].boards]
    tiles = kind.design.tiles
    boards_n, pitch_mm = ((1, 1), 0.0) if tiles is None else ((tiles.columns_n, tiles.rows_n), tiles.pitch_mm)
    return lay_out(kind.skin_mm, kind.design.places_mm, boards_n=boards_n, pitch_mm=pitch_mm)


def lay_out(
    sides_mm: tuple[float, float],
    chips_mm: Sequence[tuple[float, float]],
    *,
    boards_n: tuple[int, int],
    pitch_mm: float,
) -> Area:
    """Return an area in the coordinates of the labels.

    `chips_mm` are relative to the skin's middle. `boards_n` are the numbers of boards along x and y, whose centres are
    `pitch_mm` apart.
    """
    middle_mm = np.array(sides_mm) / 2
    x_mm, y_mm = (
        tuple(float(m + pitch_mm * (i - n / 2)) for i in range(1, n)) for m, n in zip(middle_mm, boards_n, strict=True)
    )
    return Area(sides_mm, np.array(chips_mm) + middle_mm, (x_mm, y_mm))


def hold_out_last(rows: Rows, test_fraction: float) -> tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"]]:
    """Return the row numbers of the first indentations of each capture (training) and of the last ones (test)."""
    held_out = np.zeros(len(rows), bool)
    for capture in np.unique(rows.capture):
        in_capture = rows.capture == capture
        indentations = np.unique(rows.indentation[in_capture])  # in order of time
        test_n = round(test_fraction * len(indentations))
        if not 0 < test_n < len(indentations):
            what = f"{test_n} of the {len(indentations)} pokes of {capture} would be held out"
            rule = "but training and test need at least one poke each"
            remedy = "Change sleeve.test_fraction, or use a capture with more pokes."
            raise ParamsError(f"experiment sleeve: {what}, {rule}. {remedy}")
        held_out |= in_capture & (rows.indentation >= indentations[-test_n])
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def rate_hz(captures: Sequence[Readings]) -> float:
    """Return the frame rate, from the times between successive readings of an indentation."""
    steps_n, steps_s = 0, 0.0
    for capture in captures:
        same = (np.diff(capture.indentation) == 0) & (np.diff(capture.reading_i) == 1)
        steps_n += int(same.sum())
        steps_s += float(np.diff(capture.t_s)[same].sum())
    if not steps_s > 0:
        what = "the frame rate is computed from successive readings of the same indentation, whose times must increase"
        raise ParamsError(
            f"experiment sleeve: {what}; got {steps_n} pairs of such readings. Record more readings per indentation."
        )
    return steps_n / steps_s


def errors_mm(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    """Return the distance in mm between the true and the predicted place of each reading."""
    return np.linalg.norm(predicted[:, :2].astype(float) - true[:, :2], axis=1)


def score_places(
    true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"], near: Bool[np.ndarray, " f"]
) -> dict[str, float]:
    """Score the predictions of one network over all places, near borders between boards (`near`), and elsewhere."""
    error_mm = errors_mm(true, predicted)
    parts = {f"median_error_{part}_mm": error_mm[rows] for part, rows in (("near_seam", near), ("inside", ~near))}
    medians = {name: float(np.median(of_part_mm)) for name, of_part_mm in parts.items() if len(of_part_mm)}
    whole = {"median_error_mm": float(np.median(error_mm)), "p95_error_mm": float(np.percentile(error_mm, 95))}
    return {**score(true, predicted), **whole, **medians}


def summarise(scores: pd.DataFrame, measured: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise the scores of each method over the seeds of its networks."""
    tested = measured["tested"]
    by_method: dict[str, dict[str, Any]] = {}
    for method, rows in scores.groupby("method", sort=False):
        stats = {name: statistic(rows[name]) for name in (*METRICS, *TRUTH, *PLACES) if rows[name].notna().all()}
        for part, tested_n in tested.items():
            if tested_n:
                median = {"median_error_mm": statistic(rows[f"median_error_{part}_mm"])}
                stats |= {part: median | {"pokes_n": tested_n}}
        by_method[str(method)] = stats
    counts = {name: value for name, value in measured.items() if name != "tested"}
    return {**counts, **by_method.pop(HEADLINE), "variants": by_method}


def draw_errors(
    area: Area, true: Float[np.ndarray, "f 3"], error_mm: Shaped[np.ndarray, " f"], indentation: Int[np.ndarray, " f"]
) -> dict[str, Any]:
    """Return the data for the figure.

    The data are the place and the mean error of every test indentation, the chips, and the borders between boards.
    """
    _, first, indentation_i = np.unique(indentation, return_index=True, return_inverse=True)
    mean_mm = np.bincount(indentation_i, error_mm) / np.bincount(indentation_i)
    (x_mm, y_mm), (chips_x_mm, chips_y_mm) = true[first, :2].T, area.chips_mm.T
    columns = {"x_mm": x_mm, "y_mm": y_mm, "error_mm": mean_mm, "chips_x_mm": chips_x_mm, "chips_y_mm": chips_y_mm}
    rounded: dict[str, Any] = {name: np.round(values.astype(float), 2).tolist() for name, values in columns.items()}
    borders = dict(zip(("borders_x_mm", "borders_y_mm"), map(list, area.borders_mm), strict=True))
    return rounded | borders | {"area_mm": list(area.sides_mm)}


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw a map of the skin: every tested poke, coloured by its error, with chips and borders between boards."""
    with drawing(6.6, f"Place errors of held-out pokes over {numbers['chips_n']} chips ({source})") as figure:
        axes = figure.subplots()
        axes.grid(visible=False)
        _draw_boards(axes, drawn)
        size, most_mm = np.clip(12_000 / len(drawn["x_mm"]), 10, 60), numbers["p95_error_mm"]["mean"]
        look = {"cmap": ERROR_COLOURS, "vmin": 0.0, "vmax": most_mm, "linewidths": 0, "zorder": 3}
        points = axes.scatter(drawn["x_mm"], drawn["y_mm"], c=drawn["error_mm"], s=size, **look)
        figure.colorbar(points, label="place error, first seed / mm", extend="max", shrink=0.8)
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
        median = numbers["median_error_mm"]
        axes.set_title(f"median {show(median)} mm over {median['n']} network seeds")
        figure.legend(loc="outside lower left", ncols=3)
        return {"sleeve.svg": svg(figure)}


def _draw_boards(axes: Any, drawn: Mapping[str, Any]) -> None:
    x_mm, y_mm = drawn["area_mm"]
    thin = {"color": "0.5", "linewidth": 0.8, "zorder": 1}
    axes.vlines(drawn["borders_x_mm"], 0, y_mm, **thin, label="border between boards")
    axes.hlines(drawn["borders_y_mm"], 0, x_mm, **thin)
    axes.plot([0, x_mm, x_mm, 0, 0], [0, 0, y_mm, y_mm, 0], color=COLOURS[0], marker="", label="edge of the skin")
    chips = {"marker": "+", "s": 45, "color": COLOURS[2], "linewidths": 1.2, "zorder": 4, "label": "chip"}
    axes.scatter(drawn["chips_x_mm"], drawn["chips_y_mm"], **chips)
    axes.set(xlim=(-1.5, x_mm + 1.5), ylim=(-1.5, y_mm + 1.5))
    axes.spines[["left", "bottom"]].set_visible(False)
