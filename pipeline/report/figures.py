"""Figures of a scene as SVG text by file name: scores on held-out boards, maps of position errors, sweeps."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.report.drawing import COLOURS, MARKERS, drawing, svg
from pipeline.report.formatting import COLUMNS, SHORT, n_of, table_2_rows, universal_rows
from pipeline.report.paper import ADAPTED_POKES_N, TABLE_2

HEADLINE = "headline.svg"
OFFSET = 0.17  # fraction of a row's height by which our score is above the row's middle, and the paper's below it
WORST_MM = 2.0  # end of the colour scale of all error maps: twice the largest error that counts as correct
GRID_MM = 16.0  # the paper's grid of places extends from 0 to this in x and y
TICK_MM = 4.0  # distance between ticks of axes: two places of the grid
MARK_PT = 18.0  # side of a mark that nearly fills a cell of the grid
CHIP_MM = 3.0  # side of a chip
MARGIN_MM = 0.5  # of the axes around the skin
RANGES = {"accuracy_pct": (0.0, 100.0), "mse_xy_mm2": (0.0, np.inf)}  # metrics in figures, with their possible range
# The axis of the number of pokes is linear below this number, because a logarithmic axis cannot show 0.
LINEAR_BELOW_N = 65
BARS = (
    "Bars: 95 % interval over boards. Two or three boards: lowest to highest value.\n"
    "One board: sd over seeds. Paper: printed sd. Bars are cut at impossible values."
)
SENSOR_METHODS = ("multi", "triplet", "adapted")

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Outline:
    """The outline of a skin, and the centres of the chips below it, in the coordinates of the labels."""

    corner_mm: tuple[float, float]  # least x and y of the skin
    sides_mm: tuple[float, float]
    chips_mm: Sequence[tuple[float, float]]


# Section 2 of the paper: the skin, "20mm x 20mm", around the grid, and its five chips.
PAPERS_SKIN = Outline((-2.0, -2.0), (20.0, 20.0), ((8.0, 8.0), (1.0, 8.0), (15.0, 8.0), (8.0, 1.0), (8.0, 15.0)))


def headline_figures(numbers: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the scores on held-out boards, if there are any: by number of labels, or otherwise the rows of table 2."""
    if "labels" in numbers:
        return {HEADLINE: labels_figure(numbers, source)}
    return {HEADLINE: table2_figure(numbers, source)} if numbers.get("table2") else {}


def table2_figure(numbers: Mapping[str, Any], source: str) -> str:
    """Draw accuracy and MSE of each row of table 2 on held-out boards, ours beside the paper's."""
    table_rows = [row for name, row in table_2_rows(numbers).items() if name in numbers["table2"]]
    rows = universal_rows(numbers) + table_rows
    y = np.arange(len(rows))[::-1].astype(float)
    printed = [(row_y - OFFSET, model.paper) for row_y, (model, _) in zip(y, rows, strict=True) if model.paper]
    with drawing(8.6, 0.9 + 0.55 * len(rows)) as figure:
        panels = figure.subplots(1, len(RANGES), sharey=True)
        for axes, metric in zip(panels, RANGES, strict=True):
            ours = f"ours, {source} (95 % interval over boards)"
            _draw_scores(axes, metric, y + OFFSET, [row for _, row in rows], label=ours, fmt="o", colour=COLOURS[1])
            if printed:
                paper = [{metric: dict(zip(("mean", "sd"), scores[metric], strict=True))} for _, scores in printed]
                look = {"label": "paper (mean, sd)", "fmt": "s", "colour": COLOURS[0], "face": "white"}
                _draw_scores(axes, metric, np.array([row_y for row_y, _ in printed]), paper, **look)
            axes.set(xlabel=COLUMNS[metric].replace(", ", " / "), xlim=(0, 1.18 * axes.dataLim.x1))
            axes.grid(axis="x", alpha=0.25)
        # Non-breaking spaces keep "n = 6" on one line.
        names = [fill(f"{model.title} (n\xa0=\xa0{n_of(row)})", 34) for model, row in rows]
        panels[0].set_yticks(y, names, fontsize=9)
        panels[0].set_ylim(-0.6, len(rows) - 0.4)
        about = "n: number of held-out boards, or of pairs of skins"
        title = f"Scores on held-out boards ({numbers['provenance']['scene']}, {source}; {about})"
        _finish_headline(figure, title, ncols=2)
        return svg(figure)


def _draw_scores(
    axes: Any, metric: str, y: np.ndarray, rows: Rows, *, label: str, fmt: str, colour: str, face: str = ""
) -> None:
    means, lengths = bars(rows, metric)
    look = {"color": colour, "markerfacecolor": face or colour, "markersize": 6, "capsize": 3, "linewidth": 1.2}
    axes.errorbar(means, y, xerr=lengths, fmt=fmt, label=label, **look)
    for mean, length, row_y in zip(means, lengths[1], y, strict=True):
        beside = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "fontsize": 9, "color": colour}
        axes.annotate(f"{mean:.3g}", (mean + length, row_y), **beside)


def labels_figure(numbers: Mapping[str, Any], source: str) -> str:
    """Draw accuracy and MSE of each method on held-out boards, with one point per number of labels of the board."""
    rows = numbers["labels"]
    methods = list(dict.fromkeys((row["method"], row["inputs"]) for row in rows))
    counts = sorted({row["labels_n"] for row in rows})
    with drawing(8.6, 1.1 + 0.32 * len(methods)) as figure:
        panels = figure.subplots(1, len(RANGES), sharey=True)
        for axes, metric in zip(panels, RANGES, strict=True):
            for i, count in enumerate(counts):
                count_rows = [row for row in rows if row["labels_n"] == count]
                means = [row["as_labelled"][metric]["mean"] for row in count_rows]
                y = [-methods.index((row["method"], row["inputs"])) for row in count_rows]
                look = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)], "linestyle": "none"}
                axes.plot(means, y, label=f"{count} labels", markersize=6, **look)
            axes.set(xlabel=COLUMNS[metric].replace(", ", " / "), xlim=(0, 100 if metric == "accuracy_pct" else None))
            axes.grid(alpha=0.25)
        names = [f"{method} ({inputs})" for method, inputs in methods]
        panels[0].set_yticks([-i for i in range(len(methods))], names, fontsize=9)
        boards_n = rows[0]["as_labelled"]["accuracy_pct"]["n"]
        about = f"means over {boards_n} boards; intervals: see table"
        title = f"Scores on held-out boards, as labelled ({numbers['provenance']['scene']}, {source}; {about})"
        _finish_headline(figure, title, ncols=len(counts))
        return svg(figure)


def _finish_headline(figure: Any, title: str, *, ncols: int) -> None:
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=ncols, frameon=False, fontsize=9)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)


def error_grids(
    predictions: Iterable[pa.Table], recipe: str, scene: str, outline: Outline | None = None
) -> Iterator[tuple[str, str]]:
    """Draw the position errors of a recipe as a map for each experiment with predictions; yield file name and SVG."""
    for table in predictions:
        for experiment in table["question"].unique().to_pylist():
            wanted = pc.and_(pc.equal(table["question"], experiment), pc.equal(table["recipe"], recipe))
            true_mm, predicted_mm = (_places(table.filter(wanted), side) for side in ("true", "predicted"))
            title = f"{scene}, {experiment}: position error on held-out readings"
            yield f"error_grid_{experiment}.svg", error_grid(true_mm, predicted_mm, title=title, outline=outline)


def error_grid(
    true_mm: Float[np.ndarray, "f 2"], predicted_mm: Float[np.ndarray, "f 2"], *, title: str,
    outline: Outline | None = None,
) -> str:  # fmt: skip
    """Draw the places of the indentations, coloured by the mean distance between true and predicted position.

    All maps have the same colour scale. The skin and its chips are drawn too, if their `outline` is given or if the
    places are on the paper's grid.
    """
    places, place_indices = np.unique(np.round(true_mm, 2), axis=0, return_inverse=True)
    distance_mm = np.linalg.norm(predicted_mm - true_mm, axis=1)
    mean_mm = np.bincount(place_indices.ravel(), distance_mm) / np.bincount(place_indices.ravel())
    with drawing(5.2, 5.0) as figure:
        axes = figure.subplots()
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
        size = float(np.clip(12_000 / len(places), 6, 170))
        if outline is not None:
            _draw_skin(axes, outline)
        elif places.min() >= 0 and places.max() <= GRID_MM:
            size = MARK_PT**2
            _draw_skin(axes, PAPERS_SKIN)
            ticks_mm = np.arange(0, GRID_MM + 1, TICK_MM)
            axes.set(xticks=ticks_mm, yticks=ticks_mm)
        look = {"cmap": "viridis", "vmin": 0.0, "vmax": WORST_MM, "marker": "s", "linewidths": 0, "zorder": 1}
        points = axes.scatter(*places.T, c=mean_mm, s=size, **look)
        figure.colorbar(points, label="mean position error / mm", extend="max", shrink=0.8)
        if axes.get_legend_handles_labels()[0]:
            figure.legend(loc="outside lower left", ncols=2, frameon=False, fontsize=9)
        (x_mm, y_mm), worst_mm = places[mean_mm.argmax()], mean_mm.max()
        summary = (
            f"median over places {np.median(mean_mm):.2f} mm; worst {worst_mm:.2f} mm at x = {x_mm:g}, y = {y_mm:g}"
        )
        figure.suptitle(f"{title}\n{summary}", x=0.01, ha="left", fontsize=10)
        return svg(figure)


def _draw_skin(axes: Any, outline: Outline) -> None:
    """Draw the skin behind the marks of places, and the outlines of its chips in front of them."""
    from matplotlib.patches import FancyBboxPatch, Rectangle
    from matplotlib.patheffects import withStroke

    look: dict[str, Any] = {"facecolor": "0.92", "edgecolor": "0.5", "linewidth": 1.2, "zorder": 0}
    shape = "round,pad=0,rounding_size=1"
    axes.add_patch(FancyBboxPatch(outline.corner_mm, *outline.sides_mm, shape, **look, label="skin"))
    halo = [withStroke(linewidth=3.2, foreground="white")]  # makes outlines visible on any colour
    for i, (x_mm, y_mm) in enumerate(outline.chips_mm):
        corner_mm = (x_mm - CHIP_MM / 2, y_mm - CHIP_MM / 2)
        chip = Rectangle(corner_mm, CHIP_MM, CHIP_MM, fill=False, edgecolor="black", linewidth=1.4, zorder=2)
        chip.set(path_effects=halo, label="" if i else "chip below the skin")
        axes.add_patch(chip)
    limits_mm = [
        (start_mm - MARGIN_MM, start_mm + side_mm + MARGIN_MM)
        for start_mm, side_mm in zip(outline.corner_mm, outline.sides_mm, strict=True)
    ]
    axes.set(xlim=limits_mm[0], ylim=limits_mm[1])
    axes.spines[["left", "bottom"]].set_visible(False)


def _places(table: pa.Table, side: str) -> Any:
    """Return x and y in mm of every row; `side`: `true` or `predicted`."""
    return np.stack([np.asarray(table[f"{side}_{axis}_mm"], np.float64) for axis in "xy"], axis=1)


@dataclass(frozen=True)
class Line:
    """One line of a sweep: its counts and scores, and how they are drawn."""

    name: str
    counts: Sequence[int]
    scores: Rows
    look: Mapping[str, Any]
    shift_pt: float = 0.0  # shift to the right, so that bars at the same count do not overlap


def learning_figures(numbers: Mapping[str, Any], source: str) -> Iterator[tuple[str, str]]:
    """Draw each sweep that the scene ran; yield file name and SVG text."""
    for name, draw in {"sweep_pokes": sweep_pokes, "sweep_sensors": sweep_sensors}.items():
        if name in numbers:
            yield f"{name}.svg", draw(numbers[name], source)


def sweep_pokes(rows: Rows, source: str) -> str:
    """Draw scores against the number of unlabelled pokes (figure 6a), with the paper's scores for two numbers."""
    ordered = sorted(rows, key=lambda row: row["pokes_n"])
    paper = [{m: {"mean": mean, "sd": sd} for m, (mean, sd) in TABLE_2[row].items()} for row in ("triplet", "adapted")]
    hollow = {"color": COLOURS[2], "marker": MARKERS[1], "markerfacecolor": "white", "linestyle": "none"}
    lines = [
        Line("ours", [row["pokes_n"] for row in ordered], ordered, {"color": COLOURS[1], "marker": MARKERS[0]}),
        Line("paper (table 2)", [0, ADAPTED_POKES_N], paper, hollow, shift_pt=5.0),
    ]
    return _sweep(lines, f"Scores after adaptation with unlabelled pokes ({source})", "pokes of the new skin", log=True)


def sweep_sensors(rows: Rows, source: str) -> str:
    """Draw scores against the number of training skins (figure 6b), with one line per method."""
    lines = []
    for i, method in enumerate(SENSOR_METHODS):
        swept = sorted((row for row in rows if row["method"] == method), key=lambda row: row["skins_n"])
        look = {"color": COLOURS[1 + i], "marker": MARKERS[i]}
        if swept:
            lines.append(Line(SHORT[method], [row["skins_n"] for row in swept], swept, look, shift_pt=4.0 * (i - 1)))
    title = f"Scores on held-out boards by number of training skins ({source})"
    return _sweep(lines, title, "training skins", log=False)


def bars(scores: Rows, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute means and the lengths of their error bars (down, up), which show the interval over boards.

    With few boards, bars reach from the smallest to the largest value. For statistics that are not over boards,
    such as the paper's, bars extend one standard deviation to each side. All bars are clipped to possible values.
    """
    means = np.array([row[metric]["mean"] for row in scores])
    ends = np.array([_ends(row[metric]) for row in scores]).clip(*RANGES[metric])
    return means, np.stack([means - ends[:, 0], ends[:, 1] - means]).clip(min=0)  # rounding could make lengths negative


def _ends(stat: Mapping[str, Any]) -> tuple[float, float]:
    """Return the lower and the upper end of an error bar."""
    sd = stat.get("sd", stat.get("sd_seeds", 0.0))
    values = stat.get("values", (stat["mean"] - sd, stat["mean"] + sd))
    low, high = stat.get("ci95", (min(values), max(values)))
    return low, high


def _sweep(lines: Sequence[Line], title: str, xlabel: str, *, log: bool) -> str:
    counts = sorted({count for line in lines for count in line.counts})
    with drawing(5.6, 6.4) as figure:
        for axes, metric in zip(figure.subplots(len(RANGES), 1), RANGES, strict=True):
            if log:
                axes.set_xscale("symlog", linthresh=LINEAR_BELOW_N, linscale=0.5)
                axes.set_xlim(-LINEAR_BELOW_N / 4, 1.3 * counts[-1])
            else:
                axes.set_xlim(counts[0] - 1, counts[-1] + 1)
            axes.set_xticks(counts, [str(count) for count in counts], rotation=90 if log else 0)
            axes.set_xticks([], minor=True)
            axes.set(xlabel=xlabel, ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.grid(alpha=0.25)
            _draw_lines(axes, lines, metric)
        figure.align_ylabels()
        look = {"loc": "outside lower left", "ncols": 2, "frameon": False, "fontsize": 9, "alignment": "left"}
        figure.legend(*axes.get_legend_handles_labels(), title=BARS, title_fontsize=9, **look)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return svg(figure)


def _draw_lines(axes: Any, lines: Sequence[Line], metric: str) -> None:
    from matplotlib.transforms import ScaledTranslation

    ends: list[float] = []
    for line in lines:
        means, lengths = bars(line.scores, metric)
        shift = ScaledTranslation(line.shift_pt / 72, 0, axes.figure.dpi_scale_trans)
        look = {"linewidth": 1, "markersize": 5, "capsize": 2, "elinewidth": 0.8, **line.look}
        axes.errorbar(line.counts, means, lengths, transform=axes.transData + shift, label=line.name, **look)
        ends += [*(means - lengths[0]), *(means + lengths[1])]
    # The limits are set here, because Matplotlib does not compute them from shifted data.
    margin = 0.05 * (max(ends) - min(ends)) or 1.0
    axes.set_ylim(min(ends) - margin, max(ends) + margin)
