"""Figures of an error against what it costs: methods, and pokes of an adaptation. In: rows. Out: SVG text.

Same rows, same bytes. Refuses to know how errors and times were found, and paths.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float

from pipeline.reporting.figures import STYLE, svg
from pipeline.reporting.work_precision import COLOURS, MARKERS, front

LETTER = np.array([0.016, 0.04])  # width and height of a letter of a label, in parts of the axes
MARK = np.array([0.026, 0.04])
LOWER_LEFT = np.array([-1.0, -1.0])  # of a member of the front no point stands there
LEFT = np.array([-1.0, 0.0])
ROOM = 1.6  # factor beyond the outermost points on a logarithmic axis
STEP = 0.01  # between places of labels, of the width and height of the axes


@dataclass(frozen=True)
class Point:
    """One method or setting: its name, the label at its mark, what it costs, its error, and how it is drawn."""

    name: str
    label: str
    place: tuple[float, float]
    look: Mapping[str, Any]


def trade_off(rows: Sequence[Mapping[str, Any]], key: str, *, title: str, cost: str) -> str:
    """Draw errors of methods against the cost `key`, log-log; a step joins the Pareto front, its members numbered."""
    points = trade_off_points(rows, key)
    members = [point for point in points if point.label]
    with mpl.rc_context(STYLE):
        figure, axes = _axes(title, xscale="log", xlabel=cost)
        _limit(axes, points)
        for point in points:
            mark = axes.plot(*point.place, **point.look, linestyle="none")[0]
            mark.set_label(f"{point.label}  {point.name}" if point.label else point.name)
        steps = zip(*(point.place for point in members), strict=True)
        axes.step(*steps, where="post", color="0.4", linewidth=1, zorder=1, label="Pareto front (numbers)")
        _label(axes, points, LOWER_LEFT)
        figure.legend(loc="outside right upper", frameon=False, fontsize=8)
        return svg(figure)


def trade_off_points(rows: Sequence[Mapping[str, Any]], key: str) -> list[Point]:
    """List the timed methods, those of the Pareto front first, by cost, and numbered; one look for each."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    inputs = list(dict.fromkeys(row["inputs"] for row in rows))
    timed = sorted((row for row in rows if key in row), key=lambda row: (row[key], row["mse_xy_mm2"]["mean"]))
    places = [(row[key], row["mse_xy_mm2"]["mean"]) for row in timed]
    best = front(places)
    points = []
    for row, place in zip(timed, places, strict=True):
        look = look_of(methods.index(row["method"]))
        if row["inputs"] != inputs[0]:
            look["markerfacecolor"] = "white"
        label = str(best.index(place) + 1) if place in best else ""
        points.append(Point(f"{row['method']} ({row['inputs']})", label, place, look))
    return sorted(points, key=lambda point: not point.label)


def adaptation(rows: Sequence[Mapping[str, Any]], source: str) -> str:
    """Draw the error after adaptation against its seconds, every point with its number of pokes."""
    timed = sorted((row for row in rows if "seconds" in row), key=lambda row: row["pokes_n"])
    points = [Point("", str(row["pokes_n"]), (row["seconds"], row["mse_xy_mm2"]["mean"]), look_of(1)) for row in timed]
    with mpl.rc_context(STYLE):
        title = f"Error on a new skin against adaptation time ({source})"
        figure, axes = _axes(title, xscale="linear", xlabel="median time of an adaptation / s")
        _limit(axes, points)
        for point in points:
            axes.plot(*point.place, **point.look, linestyle="none")
        _label(axes, points, LEFT)
        figure.supxlabel("A number: unlabelled pokes of the new skin.", x=0.01, ha="left", fontsize=9)
        return svg(figure)


def _axes(title: str, *, xscale: str, xlabel: str) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.6, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.set(xscale=xscale, yscale="log", xlabel=xlabel, ylabel="MSE_xy / mm²")
    axes.grid(alpha=0.25)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure, axes


def _limit(axes: Any, points: Sequence[Point]) -> None:
    """Leave room around the points for their labels; a linear axis begins at 0."""
    costs, errors = np.array([point.place for point in points]).T
    axes.set_ylim(errors.min() / ROOM, errors.max() * ROOM)
    if axes.get_xscale() == "log":
        axes.set_xlim(costs.min() / ROOM, costs.max() * ROOM)
    else:
        axes.set_xlim(0.0, 1.15 * costs.max())


def _label(axes: Any, points: Sequence[Point], side: np.ndarray) -> None:
    """Write labels on one side of their points; one that finds no place there has a line to its point."""
    to_parts = axes.transScale + axes.transLimits
    parts = to_parts.transform([point.place for point in points])
    labelled = [point for point in points if point.label]
    size = LETTER * (max(len(point.label) for point in labelled), 1)
    wished = to_parts.transform([point.place for point in labelled]) + side * (size + MARK) / 2
    places = place_labels(parts, wished, label=size, mark=MARK)
    for point, place, wish in zip(labelled, places, wished, strict=True):
        moved = (np.abs(place - wish) > size / 2).any()
        line = {"arrowprops": {"arrowstyle": "-", "color": "0.6", "linewidth": 0.6, "shrinkA": 0}} if moved else {}
        where = {"xytext": place, "textcoords": "axes fraction", "ha": "center", "va": "center", "fontsize": 8}
        axes.annotate(point.label, point.place, **where, **line)


def look_of(i: int) -> dict[str, Any]:
    """A colour and a marker for each of the first 49 methods, no two alike."""
    marker = MARKERS[(i + i // len(COLOURS)) % len(MARKERS)]
    return {"color": COLOURS[i % len(COLOURS)], "marker": marker, "markersize": 6}


def place_labels(
    points: Float[np.ndarray, "b 2"],
    wished: Float[np.ndarray, "o 2"],
    *,
    label: Float[np.ndarray, "2"],
    mark: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "o 2"]:
    """Give each label, in order, the free place nearest to where it is wished (middle of the label).

    All in parts of the width and height of the axes; `label` and `mark` are the sizes of a label and of a point's mark.
    """
    sides = [np.arange(size / 2, 1 - size / 2, STEP) for size in label]
    candidates = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    free = ~(np.abs(candidates[:, None] - points) < (label + mark) / 2).all(axis=2).any(axis=1)
    placed = np.empty_like(wished)
    for i, wish in enumerate(wished):
        distance = np.linalg.norm((candidates - wish) / label, axis=1)
        placed[i] = candidates[np.argmin(np.where(free, distance, np.inf))]
        free &= ~(np.abs(candidates - placed[i]) < label).all(axis=1)
    return placed
