"""Figures of a scene as SVG text by file name: scores on held-out boards, maps of position errors, sweeps.

Our scores are filled marks with thin bars and caps. The paper's scores are hollow diamonds on wide pale bars.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.formatting import COLUMNS, TITLES, n_of, two_digits
from pipeline.paper import ADAPTED_POKES_N, TABLE_2, Number
from pipeline.plot import COLOURS, ERROR_COLOURS, MARKERS, drawing, svg
from pipeline.plot_layout import WIDTH_IN
from pipeline.report.table_2 import table_2_rows
from pipeline.statistics import Stat

HEADLINE = "headline.svg"
FORCE = "headline_force.svg"
HEADLINES = {HEADLINE: ("accuracy_pct", "mse_xy_mm2"), FORCE: ("mse_f_N2", "r2_f")}  # metrics of places and of forces
UNSEEN = {HEADLINE: ("accuracy_pct",), FORCE: ("rms_f_N",)}  # metrics for boards that were never seen in training
OFFSET = 0.17  # distance of both marks of a row from the row's middle, as a fraction of the row's height
WORST_MM = 2.0  # upper end of the colour scale of all error maps: twice the largest error that counts as correct
GRID_MM = 16.0  # the paper's grid of places extends from 0 to this in x and y
TICK_MM = 4.0  # distance between ticks of axes: two places of the grid
MARK_PT = 18.0  # side of a mark that nearly fills a cell of the grid
CHIP_MM = 3.0  # side of a chip
MARGIN_MM = 0.5  # margin of the axes around the skin
# Metrics in figures, with their possible range.
RANGES = {
    "accuracy_pct": (0.0, 100.0), "mse_xy_mm2": (0.0, np.inf), "mse_f_N2": (0.0, np.inf), "r2_f": (-np.inf, 1.0),
}  # fmt: skip
MANY_N = 4  # a legend with so many entries has several columns if it has no note
SWEPT = ("accuracy_pct", "mse_xy_mm2")
R2_MIN = -1.0  # models with a smaller R² are much worse than a constant, and are outside the axis
# The axis of the number of pokes is linear below this number, because a logarithmic axis cannot show 0.
LINEAR_BELOW_N = 65
SENSOR_METHODS = ("multi", "triplet", "adapted")
PAPER = {"fmt": "D", "color": "black", "markerfacecolor": "white", "markersize": 6, "ecolor": "#00000030"}
PAPER |= {"elinewidth": 8, "zorder": 1.5}
PAPER_NAME = "paper's table 2: mean ± standard deviation"
# The in-context models in figures of boards that were never seen in training (experiment new_board).
SPLIT = "checkerboard"
IN_CONTEXT = {
    "rig": "trained on simulation and the rig's other board",
    "shipped": "trained on simulation (the model that we ship)",
}
# Names of those rows of the paper's table 2 that are drawn beside our scores.
PAPERS_ROWS = {"single": "paper, one skin", "multi": "paper, 15 skins", "adapted": "paper, adapted"}
PLACE_LABEL, FORCE_LABEL = "place: within 1 mm / %", "force: rms error / N"
CONSTANT_ROW, CONSTANT_NAME = "constant force", "the mean force of all labels as the estimate of each press"

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Outline:
    """The outline of a skin, and the centres of the chips below it, in the coordinates of the labels."""

    corner_mm: tuple[float, float]  # smallest x and y of the skin
    sides_mm: tuple[float, float]
    chips_mm: Sequence[tuple[float, float]]


# Section 2 of the paper: the skin, "20mm x 20mm", around the grid, and its five chips.
PAPERS_SKIN = Outline((-2.0, -2.0), (20.0, 20.0), ((8.0, 8.0), (1.0, 8.0), (15.0, 8.0), (8.0, 1.0), (8.0, 15.0)))


def headline_figures(numbers: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the scores on held-out boards, if there are any, with places in one figure and forces in another.

    The figures show boards that were never seen in training, by number of labels; or, if there are none, the rows of
    table 2.
    """
    if rows := unseen_rows(numbers):
        drawn = {name: metrics for name, metrics in UNSEEN.items() if {*metrics} <= rows[0].keys()}
        return {name: unseen_boards(numbers, source, metrics) for name, metrics in drawn.items()}
    if numbers.get("table2"):
        return {name: table2_figure(numbers, source, metrics) for name, metrics in HEADLINES.items()}
    return {}


def table2_figure(numbers: Mapping[str, Any], source: str, metrics: Sequence[str] = HEADLINES[HEADLINE]) -> str:
    """Draw metrics of each row of table 2 on held-out boards, ours beside the paper's, with one panel per metric."""
    rows = [row for name, row in table_2_rows(numbers).items() if name in numbers["table2"]]
    y = np.arange(len(rows))[::-1].astype(float)
    # Non-breaking spaces keep "n = 6" on one line.
    names = [fill(f"{model.title} (n\xa0=\xa0{n_of(row)})", 32) for model, row in rows]
    row_in = max(0.5, 0.19 * max(name.count("\n") + 1 for name in names))  # so that neighbouring names do not touch
    with drawing(4.7, 1.2 + row_in * max(len(rows), 2) * len(metrics)) as figure:
        for axes, metric in zip(figure.subplots(len(metrics), 1, squeeze=False)[:, 0], metrics, strict=True):
            paper = [
                {metric: dict(zip(("mean", "sd"), model.paper[metric], strict=True))} if metric in model.paper else {}
                for model, _ in rows
            ]
            name = f"ours ({source}), bars: {spread_of({model.short: row for model, row in rows})}"
            _draw_scores(axes, metric, y + OFFSET, [row for _, row in rows], label=name, **_look(1))
            _draw_scores(axes, metric, y - OFFSET, paper, label=PAPER_NAME, **PAPER)
            _limit(axes, metric)
            axes.set_yticks(y, names, fontsize=8.5)
            axes.set_ylim(-0.6, len(rows) - 0.4)
        _finish(figure, f"Scores on held-out boards (scene {numbers['provenance']['scene']}, {source})")
        return svg(figure)


def _look(i: int) -> dict[str, Any]:
    """Return the look of our marks: filled, with thin bars with caps."""
    return {"fmt": MARKERS[0], "color": COLOURS[i], "markersize": 6, "capsize": 3, "elinewidth": 1.2}


def _draw_scores(axes: Any, metric: str, y: np.ndarray, rows: Rows, **look: Any) -> None:
    """Draw a metric of those rows that have it, with numbers beside the bars."""
    scored = [(row, row_y) for row, row_y in zip(rows, y, strict=True) if metric in row]
    if not scored:
        return
    (means, lengths), drawn_y = bars([row for row, _ in scored], metric), [row_y for _, row_y in scored]
    axes.errorbar(means, drawn_y, xerr=lengths, **look)
    for mean, length, row_y in zip(means, lengths[1], drawn_y, strict=True):
        beside = {"xytext": (5, 0), "textcoords": "offset points", "va": "center", "fontsize": 8.5}
        shown = f"{mean:.2f}" if metric == "r2_f" else two_digits(mean)
        axes.annotate(shown, (mean + length, row_y), color=look["color"], annotation_clip=True, **beside)


def _limit(axes: Any, metric: str) -> None:
    """Set label, limits and grid of the axis of a metric, with room for the numbers beside the bars."""
    from matplotlib.ticker import MaxNLocator

    low, high = axes.dataLim.x0, axes.dataLim.x1
    axes.set(xlabel=COLUMNS[metric].replace(", ", " / "))
    if metric == "r2_f":
        low = max(min(low, 0.0), R2_MIN)
        axes.set_xlim(low - 0.05, 1.0 + 0.15 * (1.0 - low))
        axes.axvline(0, color="0.6", linewidth=0.8)
    else:
        axes.set_xlim(0, 1.15 * (100.0 if metric == "accuracy_pct" else high))
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.set_xticks([tick for tick in axes.get_xticks() if axes.get_xlim()[0] <= tick <= RANGES[metric][1]])
    axes.grid(axis="x", alpha=0.25)


def spread_of(scores: Mapping[Any, Mapping[str, Any]]) -> str:
    """Say what the bars of scores show; name the scores whose bars are of another kind than most bars."""
    kinds = {name: _spread(row["accuracy_pct"]) for name, row in scores.items()}
    most = Counter(kinds.values()).most_common(1)[0][0]
    others = [f"{name}: {kind}" for name, kind in kinds.items() if kind != most]
    return "; ".join([most, *others])


def _spread(value: Mapping[str, Any]) -> str:
    stat = Stat.of(value)
    if stat.ends:
        return "from lowest to highest board" if stat.few else "95 % interval over boards"
    if stat.sd_seeds is not None:
        return "standard deviation over seeds"
    return "no bar" if stat.sd is None else "standard deviation"


def unseen_rows(numbers: Mapping[str, Any], methods: Collection[str] = tuple(IN_CONTEXT)) -> list[Mapping[str, Any]]:
    """Return the rows of experiment new_board for split `checkerboard` and the most unlabelled presses."""
    rows = [row for row in numbers.get("new_board", ()) if (row["split"], row["method"] in methods) == (SPLIT, True)]
    most_n = max((row["pokes_n"] for row in rows), default=0)
    return [row for row in rows if row["pokes_n"] == most_n]


def constant_force(numbers: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the rms error in N of the mean force of the labels as estimate, with the most labels; None if unknown."""
    rows = [row for row in unseen_rows(numbers, ("constant",)) if "rms_f_N" in row]
    return max(rows, key=lambda row: row["labels_n"])["rms_f_N"] if rows else None


def unseen_boards(
    numbers: Mapping[str, Any],
    source: str,
    metrics: Sequence[str] = ("accuracy_pct", "rms_f_N"),
    *,
    large: bool = False,
) -> str:
    """Draw places within 1 mm and rms errors of forces on boards never seen in training, by number of labels.

    Each mark is one board, and each number is the mean of the boards. Below are the force errors of a constant
    estimate, and scores of the paper's table 2 with other marks. A metric that the results lack has no panel. With
    `large`, for README.md, panels are beside each other and have large letters.
    """
    rows = [row for row in unseen_rows(numbers) if row["labels_n"] != 1]
    metrics = [metric for metric in metrics if all(metric in row for row in rows)]
    labels = sorted({row["labels_n"] for row in rows})
    paper_n, constant_N = len(PAPERS_ROWS), constant_force(numbers)
    constant = "rms_f_N" in metrics and constant_N is not None
    y = {f"{n} labels": paper_n + constant + 1.3 * (len(labels) - i) for i, n in enumerate(labels)}
    y |= {CONSTANT_ROW: paper_n + 1.0} if constant else {}
    y |= {name: paper_n - i - 0.5 for i, name in enumerate(PAPERS_ROWS.values())}
    letters_pt, size_in = (13.0, (8.33, 5.5)) if large else (9.0, (4.7, 4.0))
    with drawing(*size_in) as figure:
        panels = figure.subplots(1, len(metrics), squeeze=False, sharey=True)[0]
        for axes, metric in zip(panels, metrics, strict=True):
            for i, (method, name) in enumerate(IN_CONTEXT.items()):
                look = {"color": COLOURS[1 + i], "marker": MARKERS[i], "markersize": letters_pt * 0.65, "linewidth": 1}
                for row in (row for row in rows if row["method"] == method):
                    values = list(row[metric]["by_board"].values())
                    row_y = y[f"{row['labels_n']} labels"] + 1.3 * OFFSET * (1 - 2 * i)
                    _draw_boards(axes, metric, values, row_y, letters_pt, label=name, **look)
            if metric == "rms_f_N" and constant_N is not None:
                look = {"color": "0.45", "marker": "x", "markersize": letters_pt * 0.65, "linewidth": 1}
                errors_N = list(constant_N["by_board"].values())
                _draw_boards(axes, metric, errors_N, y[CONSTANT_ROW], letters_pt, label=CONSTANT_NAME, **look)
            _draw_papers_row(axes, metric, [y[name] for name in PAPERS_ROWS.values()], letters_pt)
            axes.set_xlabel(PLACE_LABEL if metric == "accuracy_pct" else FORCE_LABEL, size=letters_pt)
            axes.set_xlim(0, 105 if metric == "accuracy_pct" else 1.15 * axes.dataLim.x1)
            axes.set_ylim(-0.1, max(y.values()) + 0.7)
            axes.axhline(paper_n + 0.4, color="0.6", linewidth=0.8, linestyle=":")
            axes.grid(axis="x", alpha=0.25)
            axes.tick_params(labelsize=letters_pt)
        panels[0].set_yticks([*y.values()], [*y])
        test = (
            f"The model was calibrated to {rows[0]['pokes_n']} unlabelled presses of the board. Labels are at random "
            "places, tests at other places. Means over draws of presses and labels."
        )
        boards_n = len(rows[0][metrics[0]]["by_board"])
        space = " " if large else "\n"
        title = f"{boards_n} boards never seen in training ({source}):{space}marks are boards, numbers their means"
        _finish(figure, title, letters_pt, note=fill(test, 88) if large else test)
        return svg(figure, column=not large)


def _draw_boards(axes: Any, metric: str, values: Sequence[float], y: float, letters_pt: float, **look: Any) -> None:
    """Draw a mark for each board, a line through them, and the mean of the boards on the right."""
    axes.plot(values, [y] * len(values), **look)
    mean = f"{np.mean(values):.{0 if metric == 'accuracy_pct' else 1}f}"
    beside = {"xytext": (0.7 * letters_pt, 0), "textcoords": "offset points", "va": "center"}
    axes.annotate(mean, (max(values), y), color=look["color"], fontsize=0.8 * letters_pt, **beside)


def _draw_papers_row(axes: Any, metric: str, y: Sequence[float], letters_pt: float) -> None:
    """Draw a metric of the paper's table 2, for other skins, below ours; the bars of rms errors are not symmetric."""
    printed = "mse_f_N2" if metric == "rms_f_N" else metric
    means, lengths = bars([{printed: {"mean": mean, "n": 1, "sd": sd}} for mean, sd in papers_row(printed)], printed)
    low, middle, high = (means - lengths[0], means, means + lengths[1])
    if metric == "rms_f_N":
        low, middle, high = np.sqrt(low), np.sqrt(middle), np.sqrt(high)
    look = PAPER | {"markersize": letters_pt * 0.65, "elinewidth": letters_pt * 0.9}
    name = (
        f"{PAPER_NAME} (other skins, forces and test)"  # the paper's rows are not scores of the tests drawn above them
    )
    axes.errorbar(middle, y, xerr=np.stack([middle - low, high - middle]), label=name, **look)


def papers_row(metric: str) -> list[Number]:
    """Return a metric of those rows of the paper's table 2 that a figure of unseen boards shows."""
    return [TABLE_2[row][metric] for row in PAPERS_ROWS]


def _finish(figure: Any, title: str, letters_pt: float = 9.0, *, note: str = "") -> None:
    """Write the title; put the legend of all panels and a note below them."""
    handles = {
        label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    look = {"loc": "outside lower left", "frameon": False, "fontsize": letters_pt, "alignment": "left"}
    columns_n = 1 if note or len(handles) < MANY_N else 3
    figure.legend(handles.values(), handles.keys(), title=note, title_fontsize=letters_pt, ncols=columns_n, **look)
    figure.suptitle(title, x=0.01, ha="left", fontsize=letters_pt + 1)


HELD_OUT = {  # what is held out in a map of position errors, by experiment
    "single_random": "one skin, random readings held out",
    "single_indentation": "one skin, random indentations held out",
    "single_pass": "one skin, random passes held out",
    "single_temporal": "one skin, last passes held out",
    "transfer": "trained on one skin, tested on other skins",
    "lobo": "held-out boards, trained without the triplet loss",
    "triplet": "held-out boards, trained with the triplet loss",
    "adapt": "held-out boards, trained with the triplet loss and adapted",
}


def error_grids(
    predictions: Iterable[pa.Table], recipe: str, scene: str, outline: Outline | None = None
) -> Iterator[tuple[str, str]]:
    """Draw the position errors of a recipe as a map for each experiment with predictions; yield file name and SVG."""
    for table in predictions:
        for experiment in table["question"].unique().to_pylist():
            wanted = pc.and_(pc.equal(table["question"], experiment), pc.equal(table["recipe"], recipe))
            true_mm, predicted_mm = (_places(table.filter(wanted), side) for side in ("true", "predicted"))
            title = f"Position error: {HELD_OUT.get(experiment, experiment)}; scene {scene}"
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
    with drawing(WIDTH_IN, 4.8) as figure:
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
        look = {"cmap": ERROR_COLOURS, "vmin": 0.0, "vmax": WORST_MM, "marker": "s", "linewidths": 0, "zorder": 1}
        points = axes.scatter(*places.T, c=mean_mm, s=size, **look)
        figure.colorbar(points, label="mean position error / mm", extend="max", shrink=0.8)
        if axes.get_legend_handles_labels()[0]:
            figure.legend(loc="outside lower left", ncols=2, frameon=False, fontsize=9)
        (x_mm, y_mm), worst_mm = places[mean_mm.argmax()], mean_mm.max()
        summary = f"median over places {np.median(mean_mm):.2f} mm, worst {worst_mm:.2f} mm at ({x_mm:g}, {y_mm:g}) mm"
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
    """One line of a sweep: its counts and scores, and the style in which they are drawn."""

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
    lines = [
        Line(
            f"ours, bars: {spread_of(dict(enumerate(ordered)))}",
            [row["pokes_n"] for row in ordered],
            ordered,
            _look(1) | {"fmt": "o-"},
        ),
        Line(PAPER_NAME, [0, ADAPTED_POKES_N], paper, PAPER, shift_pt=7.0),
    ]
    return _sweep(lines, f"Scores after adaptation with unlabelled pokes ({source})", "pokes of the new skin", log=True)


def sweep_sensors(rows: Rows, source: str) -> str:
    """Draw scores against the number of training skins (figure 6b), with one line per method."""
    lines = []
    for i, method in enumerate(SENSOR_METHODS):
        swept = sorted((row for row in rows if row["method"] == method), key=lambda row: row["skins_n"])
        look = _look(1 + i) | {"fmt": f"{MARKERS[i]}-"}
        if swept:
            lines.append(Line(TITLES[method], [row["skins_n"] for row in swept], swept, look, shift_pt=4.0 * (i - 1)))
    title = (
        f"Scores on held-out boards by number of training skins ({source}; bars: {spread_of(dict(enumerate(rows)))})"
    )
    return _sweep(lines, title, "training skins", log=False)


def bars(scores: Rows, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute means and the lengths of their error bars (down, up), which show the interval over boards.

    With few boards, bars reach from the smallest to the largest value. For statistics that are not over boards, such as
    the paper's, bars extend by one standard deviation to each side. All bars are clipped to possible values.
    """
    means = np.array([row[metric]["mean"] for row in scores])
    ends = np.array([_ends(row[metric]) for row in scores]).clip(*RANGES[metric])
    return means, np.stack([means - ends[:, 0], ends[:, 1] - means]).clip(min=0)  # rounding could make lengths negative


def _ends(value: Mapping[str, Any]) -> tuple[float, float]:
    """Return the lower and the upper end of an error bar."""
    stat = Stat.of(value)
    sd = (stat.sd_seeds or 0.0) if stat.sd is None else stat.sd
    ends = stat.ends or (stat.mean - sd, stat.mean + sd)
    return min(ends), max(ends)


def _sweep(lines: Sequence[Line], title: str, xlabel: str, *, log: bool) -> str:
    counts = sorted({count for line in lines for count in line.counts})
    with drawing(4.7, 5.8) as figure:
        for axes, metric in zip(figure.subplots(len(SWEPT), 1), SWEPT, strict=True):
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
        _finish(figure, title)
        return svg(figure)


def _draw_lines(axes: Any, lines: Sequence[Line], metric: str) -> None:
    from matplotlib.transforms import ScaledTranslation

    ends: list[float] = []
    for line in lines:
        means, lengths = bars(line.scores, metric)
        shift = ScaledTranslation(line.shift_pt / 72, 0, axes.figure.dpi_scale_trans)
        axes.errorbar(
            line.counts, means, lengths, transform=axes.transData + shift, label=line.name, linewidth=1, **line.look
        )
        ends += [*(means - lengths[0]), *(means + lengths[1])]
    # The limits are set here, because Matplotlib does not compute them from shifted data.
    margin = 0.05 * (max(ends) - min(ends)) or 1.0
    axes.set_ylim(min(ends) - margin, max(ends) + margin)
