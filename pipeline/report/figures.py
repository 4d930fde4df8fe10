"""Figures: marks with their values on hover, error maps, sweeps, trade-offs, error against run time."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import ceil
from textwrap import fill
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.experiments.runtime import CANDIDATES, ERROR_MAX, REFERENCE, Choice, Key, Precision, Seconds
from pipeline.report.drawing import COLOURS, MARKERS, drawing, style, svg
from pipeline.report.formatting import COLUMNS, SHORT, scored, tabulate, to_markdown
from pipeline.report.paper import ADAPTED_POKES_N, TABLE_2

WORST_MM = 2.0  # end of the colour scale of all error maps: twice the distance that counts as right
GRID_MM = 16.0  # the paper's grid of places, from 0 to here
TICK_MM = 4.0  # every other place of it
MARK_PT = 18.0  # side of a mark that nearly fills such a place
SKIN_MM = (-2.0, 18.0)  # the skin around it: "20mm x 20mm" (paper section 2)
# The five chips under it, in the frame of the labels (paper section 2), and their package of 3 mm.
CHIPS_MM = ((8.0, 8.0), (1.0, 8.0), (15.0, 8.0), (8.0, 1.0), (8.0, 15.0))
CHIP_MM = 3.0


def error_grids(predictions: Iterable[pa.Table], recipe: str, scene: str) -> Iterator[tuple[str, str]]:
    """Draw the place errors of one recipe for every experiment: file name and SVG text."""
    for table in predictions:
        for experiment in table["question"].unique().to_pylist():
            chosen = pc.and_(pc.equal(table["question"], experiment), pc.equal(table["recipe"], recipe))
            true_mm, predicted_mm = (_places(table.filter(chosen), side) for side in ("true", "predicted"))
            title = f"{scene}, {experiment}: place error on held-out readings"
            yield f"error_grid_{experiment}.svg", error_grid(true_mm, predicted_mm, title=title)


def error_grid(true_mm: Float[np.ndarray, "f 2"], predicted_mm: Float[np.ndarray, "f 2"], *, title: str) -> str:
    """Draw the places of the indentations, coloured by the mean distance between true and predicted place.

    All maps have one colour scale. Where places lie on the paper's grid, they are drawn on a skin over its chips.
    """
    places, which = np.unique(np.round(true_mm, 2), axis=0, return_inverse=True)
    distance_mm = np.linalg.norm(predicted_mm - true_mm, axis=1)
    mean_mm = np.bincount(which.ravel(), distance_mm) / np.bincount(which.ravel())
    with drawing(5.2, 5.0) as figure:
        axes = figure.subplots()
        axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
        size = float(np.clip(12_000 / len(places), 6, 170))
        if places.min() >= 0 and places.max() <= GRID_MM:
            size = MARK_PT**2
            _draw_skin(axes)
        look = {"cmap": "viridis", "vmin": 0.0, "vmax": WORST_MM, "marker": "s", "linewidths": 0, "zorder": 1}
        points = axes.scatter(*places.T, c=mean_mm, s=size, **look)
        figure.colorbar(points, label="mean place error / mm", extend="max", shrink=0.8)
        if axes.get_legend_handles_labels()[0]:
            figure.legend(loc="outside lower left", ncols=2, frameon=False, fontsize=9)
        (x_mm, y_mm), most_mm = places[mean_mm.argmax()], mean_mm.max()
        worst = f"median of places {np.median(mean_mm):.2f} mm; worst {most_mm:.2f} mm at x = {x_mm:g}, y = {y_mm:g}"
        figure.suptitle(f"{title}\n{worst}", x=0.01, ha="left", fontsize=10)
        return svg(figure)


def _draw_skin(axes: Any) -> None:
    """Draw the skin below the places, and above them the outlines of its chips."""
    from matplotlib.patches import FancyBboxPatch, Rectangle
    from matplotlib.patheffects import withStroke

    start_mm, side_mm = SKIN_MM[0], SKIN_MM[1] - SKIN_MM[0]
    look: dict[str, Any] = {"facecolor": "0.92", "edgecolor": "0.5", "linewidth": 1.2, "zorder": 0}
    shape = "round,pad=0,rounding_size=1"
    axes.add_patch(FancyBboxPatch((start_mm, start_mm), side_mm, side_mm, shape, **look, label="skin"))
    around = [withStroke(linewidth=3.2, foreground="white")]  # so that chips stand out from any colour
    for i, (x_mm, y_mm) in enumerate(CHIPS_MM):
        corner_mm = (x_mm - CHIP_MM / 2, y_mm - CHIP_MM / 2)
        chip = Rectangle(corner_mm, CHIP_MM, CHIP_MM, fill=False, edgecolor="black", linewidth=1.4, zorder=2)
        chip.set(path_effects=around, label="" if i else "chip below it")
        axes.add_patch(chip)
    limits_mm, ticks_mm = (start_mm - 0.5, SKIN_MM[1] + 0.5), np.arange(0, GRID_MM + 1, TICK_MM)
    axes.set(xlim=limits_mm, ylim=limits_mm, xticks=ticks_mm, yticks=ticks_mm)
    axes.spines[["left", "bottom"]].set_visible(False)


def _places(table: pa.Table, side: str) -> Any:
    return np.stack([np.asarray(table[f"{side}_{axis}_mm"], np.float64) for axis in "xy"], axis=1)


DRAWN = {"accuracy_pct": (0.0, 100.0), "mse_xy_mm2": (0.0, np.inf)}  # what is drawn, and what is possible
LINEAR_BELOW_N = 65  # pokes: a logarithm has no place for none
METHODS = ("multi", "triplet", "adapted")
COSTS = {"training": ("train_s", "median time of a training / s"),
         "inference": ("inference_us", "median time of one reading / µs")}  # fmt: skip

Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Line:
    """Points of one line of a sweep: counts and scores, and how they are drawn."""

    name: str
    counts: Sequence[int]
    scores: Rows
    look: Mapping[str, Any]
    shift_pt: float = 0.0  # to the right, so that bars at one count stand beside each other


def learning_figures(numbers: Mapping[str, Any], source: str) -> Iterator[tuple[str, str]]:
    """Draw the sweeps that were asked for: file name and SVG text."""
    for name, draw in {"sweep_pokes": sweep_pokes, "sweep_sensors": sweep_sensors}.items():
        if name in numbers:
            yield f"{name}.svg", draw(numbers[name], source)


def learning_pages(runtime: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw and tabulate errors against costs: text by file name; no figure where nothing was timed here."""
    texts = {f"{name}.md": to_markdown(table) for name, table in learning_costs(runtime, source).items()}
    for name, (key, cost) in COSTS.items():
        if any(key in row for row in runtime.get("learning", [])):
            title = f"Error on new skins against {name} time ({source})"
            texts[f"{name}.svg"] = trade_off(runtime["learning"], key, title=title, cost=cost)
    if any("seconds" in row for row in runtime.get("adaptation", [])):
        texts["adaptation.svg"] = adaptation(runtime["adaptation"], source)
    return texts


def learning_costs(runtime: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate errors beside costs, where those were measured: of methods, of adaptation by its pokes, of rivals."""
    methods = [
        {"method": row["method"], "inputs": row["inputs"], "training, s": _time(row, "train_s")}
        | {"one reading, µs": _time(row, "inference_us"), "source": source}
        | scored(row)
        for row in runtime.get("learning", [])
    ]
    adaptations = [
        {"pokes": str(row["pokes_n"]), "adaptation, s": _time(row, "seconds"), "source": source} | scored(row)
        for row in sorted(runtime.get("adaptation", []), key=lambda row: row["pokes_n"])
    ]
    rivals = [
        {"method": row["method"], "until ready, s": _time(row, "train_s")}
        | {"one reading, µs": _time(row, "inference_us"), "source": source}
        | scored(row)
        for row in runtime.get("rivals_costs", [])
        if "train_s" in row
    ]
    lines = {"learning": methods, "adaptation": adaptations, "rivals_costs": rivals}
    return {name: tabulate(lines[name]) for name in lines if name in runtime}


def sweep_pokes(rows: Rows, source: str) -> str:
    """Draw scores against the number of unlabelled pokes (figure 6a), beside the two that the paper prints."""
    ordered = sorted(rows, key=lambda row: row["pokes_n"])
    paper = [{m: {"mean": mean, "sd": sd} for m, (mean, sd) in TABLE_2[row].items()} for row in ("triplet", "adapted")]
    hollow = {"color": COLOURS[2], "marker": MARKERS[1], "markerfacecolor": "white", "linestyle": "none"}
    lines = [
        Line("ours", [row["pokes_n"] for row in ordered], ordered, {"color": COLOURS[1], "marker": MARKERS[0]}),
        Line("paper (table 2)", [0, ADAPTED_POKES_N], paper, hollow, shift_pt=5.0),
    ]
    return _sweep(lines, f"Adapted to a new skin by unlabelled pokes ({source})", "pokes of the new skin", log=True)


def sweep_sensors(rows: Rows, source: str) -> str:
    """Draw scores against the number of training skins (figure 6b), a line for each method."""
    lines = []
    for i, method in enumerate(METHODS):
        swept = sorted((row for row in rows if row["method"] == method), key=lambda row: row["skins_n"])
        look = {"color": COLOURS[1 + i], "marker": MARKERS[i]}
        if swept:
            lines.append(Line(SHORT[method], [row["skins_n"] for row in swept], swept, look, shift_pt=4.0 * (i - 1)))
    title = f"Scores on boards held out, by the number of training skins ({source})"
    return _sweep(lines, title, "training skins", log=False)


def bars(scores: Rows, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Find means and the lengths of their bars (down, up): the interval over boards, cut at what is possible.

    Of a few boards bars reach from the least to the largest value; without boards (the paper) they are one sd.
    """
    means = np.array([row[metric]["mean"] for row in scores])
    ends = np.array([_ends(row[metric]) for row in scores]).clip(*DRAWN[metric])
    return means, np.stack([means - ends[:, 0], ends[:, 1] - means]).clip(min=0)  # rounded numbers


def _ends(stat: Mapping[str, Any]) -> tuple[float, float]:
    sd = stat.get("sd", stat.get("sd_seeds", 0.0))
    values = stat.get("values", (stat["mean"] - sd, stat["mean"] + sd))
    low, high = stat.get("ci95", (min(values), max(values)))
    return low, high


def _sweep(lines: Sequence[Line], title: str, xlabel: str, *, log: bool) -> str:
    from matplotlib.figure import Figure

    counts = sorted({count for line in lines for count in line.counts})
    with style():
        figure = Figure(figsize=(5.6, 6.4), layout="constrained")
        for axes, metric in zip(figure.subplots(len(DRAWN), 1), DRAWN, strict=True):
            if log:
                axes.set_xscale("symlog", linthresh=LINEAR_BELOW_N, linscale=0.5)
                axes.set_xlim(-LINEAR_BELOW_N / 4, 1.3 * counts[-1])
            else:
                axes.set_xlim(counts[0] - 1, counts[-1] + 1)
            axes.set_xticks(counts, [str(count) for count in counts], rotation=90 if log else 0)
            axes.set_xticks([], minor=True)
            axes.set(xlabel=xlabel, ylabel=COLUMNS[metric].replace(", ", " / "))
            axes.grid(alpha=0.25)
            _bars(axes, lines, metric)
        figure.align_ylabels()
        look = {"loc": "outside lower left", "ncols": 2, "frameon": False, "fontsize": 9, "alignment": "left"}
        figure.legend(*axes.get_legend_handles_labels(), title=_about_bars(lines), title_fontsize=9, **look)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        return svg(figure)


def _bars(axes: Any, lines: Sequence[Line], metric: str) -> None:
    from matplotlib.transforms import ScaledTranslation

    ends: list[float] = []
    for line in lines:
        means, lengths = bars(line.scores, metric)
        shift = ScaledTranslation(line.shift_pt / 72, 0, axes.figure.dpi_scale_trans)
        style = {"linewidth": 1, "markersize": 5, "capsize": 2, "elinewidth": 0.8, **line.look}
        axes.errorbar(line.counts, means, lengths, transform=axes.transData + shift, label=line.name, **style)
        ends += [*(means - lengths[0]), *(means + lengths[1])]
    # What is shifted does not set the limits by itself.
    room = 0.05 * (max(ends) - min(ends)) or 1.0
    axes.set_ylim(min(ends) - room, max(ends) + room)


def _about_bars(lines: Sequence[Line]) -> str:
    stats = [row["accuracy_pct"] for line in lines for row in line.scores]
    kinds = {f"95 % interval over {stat['n']} boards" for stat in stats if "ci95" in stat}
    kinds |= {f"least to largest of {stat['n']} boards" for stat in stats if "values" in stat}
    kinds |= {"sd over seeds (one board)" for stat in stats if "sd" not in stat and "sd_seeds" in stat}
    if not kinds:
        return "No bars: one training each."
    of_paper = " (paper: sd)" if any("n" not in stat for stat in stats) else ""
    return f"Bars: {', '.join(sorted(kinds))}{of_paper}; cut at what is possible."


def _time(row: Mapping[str, Any], name: str) -> str:
    return f"{row[name]:.3g}" if name in row else "–"


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
    with style():
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
    with style():
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


LOWEST = 1e-16  # rounding: no error is drawn below it, for the axis is logarithmic
COLUMNS_N = 3
COMPUTED = (
    "Computed: what the stage cost when its results were computed, its trainings added up as if one ran after another "
    "(two run side by side, so that less time passes). Last run: what passed when it ran last; trainings that were "
    "finished before are reused."
)
CAPTION_LETTERS = 38  # in the width of a panel, and in that of the legend
STUDIES = ("quadratures", "integrators")
Kind = TypeVar("Kind", Precision, Seconds)


@dataclass(frozen=True)
class Words:
    """What a figure says besides its data: a line at `limit`, a ring around each of `rings`."""

    title: str
    error: str
    note: str = ""
    limit: float | None = None
    rings: Mapping[str, Key] = field(default_factory=dict)


def pages(numbers: Mapping[str, Any], *, source: str) -> dict[str, str]:
    """Draw and tabulate the studies that were done: text by file name; nothing where nothing was timed here."""
    tables = cost_tables(numbers, source)
    texts = {f"{name}.md": to_markdown(costs_table) for name, costs_table in tables.items()}
    for study in STUDIES:
        if study in tables:
            rows = [_of(Precision, row) for row in numbers[study]]
            seconds = [_of(Seconds, row) for row in numbers[study] if "median_s" in row]
            if study == "quadratures":
                texts["quadratures.svg"] = quadratures(rows, seconds, Choice(**numbers["choice"]), source=source)
            else:
                texts["integrators.svg"] = integrators(rows, seconds)
    return texts


def _of(kind: type[Kind], row: Mapping[str, Any]) -> Kind:
    return kind(**{part.name: row[part.name] for part in fields(kind)})


def cost_tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate what stages cost, and the studies of which something was timed here, by name."""
    timed = [name for name in STUDIES if any("median_s" in row for row in numbers.get(name, []))]
    return {name: table(numbers[name], source) for name in timed} | {"stages": costs(numbers["stages"])}


def costs(stages: Mapping[str, Mapping[str, float]]) -> pd.DataFrame:
    """List what each stage cost when it was computed, and what its last run took."""
    rows = [
        {
            "stage": name,
            "computed, s": f"{cost['computed_s']:.1f}",
            "last run, s": f"{cost['seconds']:.1f}",
            "CPU of it, s": f"{cost['cpu_s']:.1f}" if "cpu_s" in cost else "–",  # older costs lack it
            "trainings": str(cost["trainings_n"]),
            "of them reused": str(cost["reused_n"]),
            "peak memory of a process, MB": f"{cost['peak_process_memory_MB']:.0f}",
        }
        for name, cost in stages.items()
    ]
    return tabulate(rows, meaning=COMPUTED)


def table(rows: Sequence[Mapping[str, Any]], source: str) -> pd.DataFrame:
    """List every way that was tried: its work, error and time, or why it failed."""
    return pd.DataFrame(
        {
            "study": row["study"],
            "method": row["method"],
            "setting": row["setting"],
            "nodes or right-hand sides": str(row["work_n"]),
            "error": "–" if row["error"] is None else f"{row['error']:.2g}",
            "median ms an indentation": f"{1e3 * row['median_s']:.3g}" if "median_s" in row else "–",
            "failed": row["failure"] or "",
            "source": source,
        }
        for row in rows
    )


def quadratures(rows: Sequence[Precision], seconds: Sequence[Seconds], choice: Choice, *, source: str) -> str:
    """Draw the study of quadratures, with its limit, the rule to be chosen and the one in use."""
    study = rows[0].study
    ringed = {"cheapest below it": choice.setting, "in use": choice.used_setting if choice.used_error else None}
    words = Words(
        title=f"Error of dB against run time ({source})",
        error="rms error / rms dB, worst skin and depth",
        note="Kernel alone and magpylib: the field only, their nodes were moved before. All else: flow and field.",
        limit=ERROR_MAX,
        rings={f"{what}: {setting}": (study, CANDIDATES, setting) for what, setting in ringed.items() if setting},
    )
    return draw(rows, seconds, words)


def integrators(rows: Sequence[Precision], seconds: Sequence[Seconds]) -> str:
    """Draw the study of integrators, a panel for each ratio of the slowest relaxation to the fastest."""
    words = Words(title="Error of the relaxed force against run time", error="rms error / rms force")
    return draw(rows, seconds, words)


def draw(rows: Sequence[Precision], seconds: Sequence[Seconds], words: Words) -> str:
    """Draw error against median time, log-log: a panel a study, a colour and a marker a method, failures below.

    Lines join what is best for its time.
    """
    from matplotlib.figure import Figure

    studies = list(dict.fromkeys(row.study for row in rows))
    methods = [name for name in dict.fromkeys(row.method for row in rows) if name != REFERENCE]
    columns_n = min(COLUMNS_N, len(studies))
    lines_n = ceil(len(studies) / columns_n)
    caption = "\n".join(fill(line, CAPTION_LETTERS * (1 + columns_n)) for line in (words.note, *failures(rows)))
    with style():
        size_in = (3.2 + 2.6 * columns_n, max(1.2 + 2.6 * lines_n + 0.15 * caption.count("\n"), 5.0))
        figure = Figure(figsize=size_in, layout="constrained")
        panels = figure.subplots(lines_n, columns_n, sharex=True, sharey=True, squeeze=False)
        points = _points_ms(rows, seconds)
        for axes, study in zip(panels.flat, studies, strict=False):
            axes.set(xscale="log", yscale="log")
            axes.grid(alpha=0.25)
            axes.set_title(study, loc="left", fontsize=9)
            _lines(axes, {key: point for key, point in points.items() if key[0] == study}, methods)
            _marks(axes, [row.error for row in rows if row.key[:2] == (study, REFERENCE)], points, words)
        _frame(figure, panels, len(studies), words.error)
        figure.suptitle(words.title, x=0.01, ha="left", fontsize=10)
        figure.supxlabel(caption, x=0.01, ha="left", fontsize=9)
        return svg(figure)


def failures(rows: Sequence[Precision]) -> list[str]:
    """List what failed: a line for each method and kind of failure, with the studies and settings where it did."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for row in rows:
        if row.failure is not None:
            kind = row.failure.split(":")[0]
            found.setdefault((row.method, kind), {}).setdefault(row.study, []).append(row.setting)
    return [
        f"Failed: {method}, {kind}: " + "; ".join(f"{study} ({', '.join(where)})" for study, where in places.items())
        for (method, kind), places in found.items()
    ]


def front(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Keep the points (time, error) than which none is both faster and more exact, by time."""
    kept: list[tuple[float, float]] = []
    for time, error in sorted(points):
        if not kept or error < kept[-1][1]:
            kept.append((time, error))
    return kept


def _points_ms(rows: Sequence[Precision], seconds: Sequence[Seconds]) -> dict[Key, tuple[float, float]]:
    times_ms = {time.key: 1e3 * time.median_s for time in seconds}
    timed = [row for row in rows if row.error is not None and row.method != REFERENCE]
    return {row.key: (times_ms[row.key], max(row.error or 0.0, LOWEST)) for row in timed}


def _lines(axes: Any, points: Mapping[Key, tuple[float, float]], methods: Sequence[str]) -> None:
    for i, method in enumerate(methods):
        of_method = [point for key, point in points.items() if key[1] == method]
        if of_method:
            colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
            axes.plot(*zip(*front(of_method), strict=True), color=colour, linewidth=1)
            axes.plot(*zip(*of_method, strict=True), marker, color=colour, markersize=4.5, label=method)


def _marks(
    axes: Any, reference: Sequence[float | None], points: Mapping[Key, tuple[float, float]], words: Words
) -> None:
    for error in reference:
        axes.axhline(error, color="0.5", linestyle=":", linewidth=1, label=f"{REFERENCE}'s own error, at most")
    if words.limit is not None:
        axes.axhline(words.limit, color="0.3", linestyle="--", linewidth=1, label=f"{100 * words.limit:.3g} %")
    for size, (label, key) in enumerate(words.rings.items()):
        axes.plot(*points[key], "so"[size % 2], color="0.2", fillstyle="none", markersize=11 + 2 * size, label=label)


def _frame(figure: Any, panels: Any, studies_n: int, error: str) -> None:
    # Words at the outer axes only, and each label of the legend once, though it stands in every panel.
    for axes in panels[-1]:
        axes.set_xlabel("median time an indentation / ms")
    for axes in panels[:, 0]:
        axes.set_ylabel(error)
    named: dict[str, Any] = {}
    for axes in panels.flat[:studies_n]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    for axes in panels.flat[studies_n:]:
        axes.set_axis_off()
    figure.legend(named.values(), named.keys(), loc="outside right upper", frameon=False, fontsize=8)
