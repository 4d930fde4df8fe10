"""Figures of a scene as SVG text: scores on skins never seen in training, maps of place errors, sweeps.

Our scores are filled marks with thin bars. The paper's scores are hollow diamonds on wide pale bars. Our bars show the
95 % interval over boards, or with few boards the range of their values; other bars show one standard deviation.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.formatting import COLUMNS, TITLES, two_digits
from pipeline.paper import ADAPTED_POKES_N, TABLE_2
from pipeline.plot import COLOURS, ERROR_COLOURS, MARKERS, drawing, svg
from pipeline.report.tables import models
from pipeline.statistics import Stat

HEADLINE = "headline.svg"
# Labels of the metrics of the headline, with their possible ranges.
LABELS = {"accuracy_pct": "within 1 mm / %", "mse_f_N2": "force: MSE / N²", "rms_f_N": "force: rms error / N"}
RANGES = {"accuracy_pct": (0.0, 100.0), "mse_xy_mm2": (0.0, np.inf), "mse_f_N2": (0.0, np.inf)}
PAPER = {"fmt": "D", "color": "black", "markerfacecolor": "white", "ecolor": "#00000030", "capsize": 0}
PAPER |= {"elinewidth": 8, "zorder": 1.5}
PAPER_NAME = "paper's table 2, ± standard deviation"
# The in-context models in figures of boards that were never seen in training (experiment new_board).
SPLIT = "checkerboard"
IN_CONTEXT = {
    "rig": "trained on simulation and the rig's other board",
    "shipped": "trained on simulation (the model that we ship)",
}
CONSTANT = "mean force of the labels as estimate"
# Names of those rows of the paper's table 2 that are drawn below our scores on recorded boards.
PAPERS_ROWS = {"single": "paper, one skin", "multi": "paper, 15 skins", "adapted": "paper, adapted"}
SWEPT = ("accuracy_pct", "mse_xy_mm2")
# The axis of the number of pokes is linear below this number, because a logarithmic axis cannot show 0.
LINEAR_BELOW_N = 65
SENSOR_METHODS = ("multi", "triplet", "adapted")

Rows = Sequence[Mapping[str, Any]]
Bar = tuple[float, float, float]  # low end, mean, high end


@dataclass(frozen=True)
class Series:
    """Scores with one look: for each metric, a bar for each row of the figure, by the row's label."""

    name: str
    bars: Mapping[str, Mapping[str, Bar]]
    look: Mapping[str, Any]


def bar(value: Mapping[str, Any], metric: str) -> Bar:
    """Return a mean between the ends of its bar: interval over boards, range of few boards, or standard deviation."""
    stat = Stat.of(value)
    sd = (stat.sd_seeds or 0.0) if stat.sd is None else stat.sd
    ends = np.clip(stat.ends or (stat.mean - sd, stat.mean + sd), *RANGES.get(metric, (-np.inf, np.inf)))
    # Rounding of numbers.json could put the mean outside of its bar.
    return min(*ends, stat.mean), stat.mean, max(*ends, stat.mean)


def headline(numbers: Mapping[str, Any], source: str) -> str | None:
    """Draw place and force on skins never seen in training beside the paper's; None if the scene has no such scores.

    The rows are the numbers of labels on boards of experiment new_board, or else the models of table 2.
    """
    if unseen_rows(numbers):
        series = _unseen_series(numbers)
    elif numbers.get("table2"):
        series = _table_2_series(numbers)
    else:
        return None
    metrics = list(series[0].bars)
    labels = list(dict.fromkeys(label for one in series for rows in one.bars.values() for label in rows))
    labels.sort(key=lambda label: label in PAPERS_ROWS.values())  # stable: the paper's rows come last
    with drawing(1.1 + 0.2 * len(series) + 0.36 * len(labels), f"Skins never seen in training ({source})") as figure:
        for axes, metric in zip(figure.subplots(1, len(metrics), squeeze=False, sharey=True)[0], metrics, strict=True):
            drawn = [one for one in series if one.bars.get(metric)]
            for i, one in enumerate(drawn):
                rows = one.bars[metric]
                alone = [sum(label in other.bars.get(metric, {}) for other in drawn) == 1 for label in rows]
                shift = np.where(alone, 0.0, 0.36 * i - 0.18)
                _draw_rows(axes, [labels.index(label) for label in rows] + shift, list(rows.values()), one, metric)
            axes.set(xlabel=LABELS[metric], ylim=(len(labels) - 0.5, -0.5))
            axes.set_xlim(0, 125 if metric == "accuracy_pct" else 1.25 * axes.dataLim.x1)
            if metric == "accuracy_pct":
                axes.set_xticks(range(0, 101, 25))
            axes.grid(axis="y", visible=False)
        axes.set_yticks(range(len(labels)), labels)
        figure.legend(*_handles(figure), loc="outside lower left")
        return svg(figure)


def _draw_rows(axes: Any, y: np.ndarray, bars: Sequence[Bar], series: Series, metric: str) -> None:
    """Draw the bars of a series, with the mean beside each of them."""
    low, mean, high = np.array(bars).T
    axes.errorbar(mean, y, xerr=[mean - low, high - mean], label=series.name, **series.look)
    for row_y, row_mean, end in zip(y, mean, high, strict=True):
        text = f"{row_mean:.0f}" if metric == "accuracy_pct" else two_digits(row_mean)
        beside = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "fontsize": 8.0}
        axes.annotate(text, (end, row_y), color=series.look["color"], **beside)


def _table_2_series(numbers: Mapping[str, Any]) -> list[Series]:
    shown = {row: model for row, model in models(numbers).items() if row in numbers["table2"]}
    metrics = [metric for metric in LABELS if all(metric in numbers["table2"][row] for row in shown)]
    ours = {
        metric: {model.short: bar(numbers["table2"][row][metric], metric) for row, model in shown.items()}
        for metric in metrics
    }
    paper = {
        metric: {model.short: _papers_bar(model.paper, metric) for model in shown.values() if model.paper}
        for metric in metrics
    }
    return [Series("ours", ours, _look(1)), Series(PAPER_NAME, paper, PAPER)]


def _papers_bar(row: Mapping[str, tuple[float, float]], metric: str) -> Bar:
    """Return a score of the paper; the rms error is the root of its MSE."""
    printed = "mse_f_N2" if metric == "rms_f_N" else metric
    found = bar(dict(zip(("mean", "sd"), row[printed], strict=True)), printed)
    low, mean, high = np.sqrt(found) if printed != metric else found
    return low, mean, high


def _unseen_series(numbers: Mapping[str, Any]) -> list[Series]:
    rows = [row for row in unseen_rows(numbers) if row["labels_n"] != 1]
    metrics = [metric for metric in ("accuracy_pct", "rms_f_N") if all(metric in row for row in rows)]
    series = []
    for i, (method, name) in enumerate(IN_CONTEXT.items()):
        own = sorted((row for row in rows if row["method"] == method), key=lambda row: row["labels_n"])
        bars = {metric: {f"{row['labels_n']} labels": bar(row[metric], metric) for row in own} for metric in metrics}
        series += [Series(name, bars, _look(1 + i))] if own else []
    if "rms_f_N" in metrics and (constant := constant_force(numbers)) is not None:
        look = _look(4) | {"color": "0.45"}
        series.append(Series(CONSTANT, {"rms_f_N": {"constant force": bar(constant, "rms_f_N")}}, look))
    paper = {m: {name: _papers_bar(TABLE_2[row], m) for row, name in PAPERS_ROWS.items()} for m in metrics}
    return [*series, Series(f"{PAPER_NAME} (other skins and forces)", paper, PAPER)]


def _look(i: int) -> dict[str, Any]:
    return {"fmt": MARKERS[i - 1], "color": COLOURS[i]}


def _handles(figure: Any) -> tuple[list[Any], list[str]]:
    """Return the entries of a legend of all panels."""
    found = {
        name: artist for axes in figure.axes for artist, name in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    return list(found.values()), list(found)


def unseen_rows(numbers: Mapping[str, Any], methods: Collection[str] = tuple(IN_CONTEXT)) -> list[Mapping[str, Any]]:
    """Return the rows of experiment new_board for split `checkerboard` and the most unlabelled presses."""
    rows = [row for row in numbers.get("new_board", ()) if (row["split"], row["method"] in methods) == (SPLIT, True)]
    most_n = max((row["pokes_n"] for row in rows), default=0)
    return [row for row in rows if row["pokes_n"] == most_n]


def constant_force(numbers: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the rms error in N of the mean force of the labels as estimate, with the most labels; None if unknown."""
    rows = [row for row in unseen_rows(numbers, ("constant",)) if "rms_f_N" in row]
    return max(rows, key=lambda row: row["labels_n"])["rms_f_N"] if rows else None


# --- Maps of place errors ---

WORST_MM = 2.0  # upper end of the colour scale of all maps: twice the largest error that counts as correct
GRID_MM = 16.0  # the paper's grid of places extends from 0 to this in x and y
CHIP_MM, MARGIN_MM = 3.0, 0.5  # side of a chip; margin of the axes around the skin
MAPS = {  # title of the map by experiment; the other experiments have no map
    "single_temporal": "Place error: one skin, last passes held out",
    "transfer": "Place error: trained on one skin, tested on others",
    "lobo": "Place error: held-out boards",
    "adapt": "Place error: held-out boards, adapted networks",
}


@dataclass(frozen=True)
class Outline:
    """The outline of a skin, and the centres of the chips below it, in the coordinates of the labels."""

    corner_mm: tuple[float, float]  # smallest x and y of the skin
    sides_mm: tuple[float, float]
    chips_mm: Sequence[tuple[float, float]]


# Section 2 of the paper: the skin, "20mm x 20mm", around the grid, and its five chips.
PAPERS_SKIN = Outline((-2.0, -2.0), (20.0, 20.0), ((8.0, 8.0), (1.0, 8.0), (15.0, 8.0), (8.0, 1.0), (8.0, 15.0)))


def error_grids(
    predictions: Iterable[pa.Table], recipe: str, source: str, outline: Outline | None = None
) -> Iterator[tuple[str, str]]:
    """Draw the place errors of a recipe for each experiment that has a map; yield file name and SVG."""
    for table in predictions:
        for experiment in table["question"].unique().to_pylist():
            if experiment in MAPS:
                wanted = pc.and_(pc.equal(table["question"], experiment), pc.equal(table["recipe"], recipe))
                true_mm, predicted_mm = (_places(table.filter(wanted), side) for side in ("true", "predicted"))
                map_svg = error_grid(true_mm, predicted_mm, title=f"{MAPS[experiment]} ({source})", outline=outline)
                yield f"error_grid_{experiment}.svg", map_svg


def _places(table: pa.Table, side: str) -> Any:
    """Return x and y in mm of every row; `side`: `true` or `predicted`."""
    return np.stack([np.asarray(table[f"{side}_{axis}_mm"], np.float64) for axis in "xy"], axis=1)


def error_grid(
    true_mm: Float[np.ndarray, "f 2"], predicted_mm: Float[np.ndarray, "f 2"], *, title: str,
    outline: Outline | None = None,
) -> str:  # fmt: skip
    """Draw the places of the indentations, coloured by the mean distance between true and predicted place.

    All maps have the same colour scale. The skin and its chips are drawn too, if their `outline` is given or if the
    places are on the paper's grid.
    """
    places, place_indices = np.unique(np.round(true_mm, 2), axis=0, return_inverse=True)
    distance_mm = np.linalg.norm(predicted_mm - true_mm, axis=1)
    mean_mm = np.bincount(place_indices.ravel(), distance_mm) / np.bincount(place_indices.ravel())
    if outline is None and places.min() >= 0 and places.max() <= GRID_MM:
        outline = PAPERS_SKIN
    with drawing(4.2, title) as figure:
        axes = figure.subplots()
        axes.grid(visible=False)
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
        look = {"cmap": ERROR_COLOURS, "vmin": 0.0, "vmax": WORST_MM, "marker": "s", "linewidths": 0}
        points = axes.scatter(*places.T, c=mean_mm, s=np.clip(12_000 / len(places), 6, 150), **look)
        figure.colorbar(points, label="mean error at this place / mm", extend="max", shrink=0.8)
        if outline is not None:
            _draw_skin(axes, outline)
            figure.legend(*_handles(figure), loc="outside lower left", ncols=2)
        (x_mm, y_mm), worst_mm = places[mean_mm.argmax()], mean_mm.max()
        axes.set_title(f"median {np.median(mean_mm):.2f} mm, worst {worst_mm:.2f} mm at ({x_mm:g}, {y_mm:g}) mm")
        return svg(figure)


def _draw_skin(axes: Any, outline: Outline) -> None:
    """Draw the skin behind the marks of places, and the outlines of its chips in front of them."""
    from matplotlib.patches import Rectangle

    look: dict[str, Any] = {"facecolor": "0.92", "edgecolor": "0.5", "zorder": 0, "label": "skin"}
    axes.add_patch(Rectangle(outline.corner_mm, *outline.sides_mm, **look))
    for i, (x_mm, y_mm) in enumerate(outline.chips_mm):
        corner_mm = (x_mm - CHIP_MM / 2, y_mm - CHIP_MM / 2)
        look = {"fill": False, "linewidth": 1.4, "zorder": 2, "label": "" if i else "chip below the skin"}
        axes.add_patch(Rectangle(corner_mm, CHIP_MM, CHIP_MM, **look))
    low_mm, sides_mm = np.array(outline.corner_mm) - MARGIN_MM, np.array(outline.sides_mm) + 2 * MARGIN_MM
    axes.set(xlim=(low_mm[0], low_mm[0] + sides_mm[0]), ylim=(low_mm[1], low_mm[1] + sides_mm[1]))
    axes.spines[["left", "bottom"]].set_visible(False)


# --- Sweeps ---


@dataclass(frozen=True)
class Line:
    """One line of a sweep: its counts and scores, and the style in which they are drawn."""

    name: str
    counts: Sequence[float]
    scores: Rows
    look: Mapping[str, Any]


def score_figures(numbers: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the headline and the sweeps, as far as the scene has their scores: SVG text by file name."""
    drawn = {HEADLINE: headline(numbers, source)}
    for name, draw in {"sweep_pokes": sweep_pokes, "sweep_sensors": sweep_sensors}.items():
        drawn[f"{name}.svg"] = draw(numbers[name], source) if name in numbers else None
    return {name: text for name, text in drawn.items() if text is not None}


def sweep_pokes(rows: Rows, source: str) -> str:
    """Draw scores against the number of unlabelled pokes (figure 6a), with the paper's scores for two numbers."""
    ordered = sorted(rows, key=lambda row: row["pokes_n"])
    paper = [{m: {"mean": mean, "sd": sd} for m, (mean, sd) in TABLE_2[row].items()} for row in ("triplet", "adapted")]
    counts = [row["pokes_n"] for row in ordered]
    lines = [Line("ours", counts, ordered, _look(1)), Line(PAPER_NAME, [0, ADAPTED_POKES_N], paper, PAPER)]
    return _sweep(lines, f"Adaptation with unlabelled pokes ({source})", "pokes of the new skin", log=True)


def sweep_sensors(rows: Rows, source: str) -> str:
    """Draw scores against the number of training skins (figure 6b), with one line per method."""
    lines = []
    for i, method in enumerate(SENSOR_METHODS):
        swept = sorted((row for row in rows if row["method"] == method), key=lambda row: row["skins_n"])
        counts = [row["skins_n"] + 0.12 * (i - 1) for row in swept]  # shifted, so that bars do not overlap
        lines += [Line(TITLES[method], counts, swept, _look(1 + i))] if swept else []
    return _sweep(lines, f"Held-out boards by number of training skins ({source})", "training skins", log=False)


def _sweep(lines: Sequence[Line], title: str, xlabel: str, *, log: bool) -> str:
    counts = sorted({round(count) for line in lines for count in line.counts})
    with drawing(5.0, title) as figure:
        panels = figure.subplots(len(SWEPT), 1, sharex=True)
        for axes, metric in zip(panels, SWEPT, strict=True):
            for line in lines:
                low, mean, high = np.array([bar(row[metric], metric) for row in line.scores]).T
                style = {} if line.look is PAPER else {"linestyle": "-"}
                axes.errorbar(line.counts, mean, [mean - low, high - mean], label=line.name, **line.look, **style)
            axes.set_ylabel(COLUMNS[metric].replace(", ", " / "))
        if log:
            axes.set_xscale("symlog", linthresh=LINEAR_BELOW_N, linscale=0.5)
            axes.set_xlim(-LINEAR_BELOW_N / 4, 1.3 * counts[-1])
        axes.set_xticks(counts, [str(count) for count in counts], rotation=90 if log else 0)
        axes.set_xticks([], minor=True)
        axes.set_xlabel(xlabel)
        figure.align_ylabels()
        figure.legend(*_handles(figure), loc="outside lower left")
        return svg(figure)
