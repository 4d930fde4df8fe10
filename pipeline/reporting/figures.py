"""Figures of a scene: predictions -> SVG text. Same data, same bytes. Sees no model and no path."""

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from pipeline.reporting.hover import name_marks, put_titles

mpl.use("Agg")
WORST_MM = 2.0  # end of the colour scale of all error maps: twice the distance that counts as right
GRID_MM = 16.0  # the paper's grid of places, from 0 to here
TICK_MM = 4.0  # every other place of it
MARK_PT = 18.0  # side of a mark that nearly fills such a place
SKIN_MM = (-2.0, 18.0)  # the skin around it: "20mm x 20mm" (paper section 2)
# The five chips under it, in the frame of the labels (paper section 2), and their package of 3 mm.
CHIPS_MM = ((8.0, 8.0), (1.0, 8.0), (15.0, 8.0), (8.0, 1.0), (8.0, 15.0))
CHIP_MM = 3.0
FONTS = ("DejaVu Sans", "Verdana", "sans-serif")  # Verdana is as wide, where the first is not installed
# What nobody sees: indentation, metadata, comments, and places finer than a hundredth of a point.
SPARED = re.compile(r"(?<=\n) +|<metadata>.*?</metadata>\n|<!--.*?-->\n", re.DOTALL)
PLACES = re.compile(r' (d|x|y|transform)="[^"]*"')
PAST_DIGITS = re.compile(r"(?<=\.\d\d)\d+")
SVG_DPI = 72  # of points, in which the format counts
STYLE = {
    "svg.hashsalt": "reskin",
    "svg.fonttype": "none",
    "font.sans-serif": FONTS,
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def error_grids(predictions: Iterable[pa.Table], recipe: str, scene: str) -> Iterator[tuple[str, str]]:
    """Draw the place errors of one recipe for every question: file name and SVG text."""
    for table in predictions:
        for question in table["question"].unique().to_pylist():
            chosen = pc.and_(pc.equal(table["question"], question), pc.equal(table["recipe"], recipe))
            true_mm, predicted_mm = (_places(table.filter(chosen), side) for side in ("true", "predicted"))
            title = f"{scene}, {question}: place error on held-out readings"
            yield f"error_grid_{question}.svg", error_grid(true_mm, predicted_mm, title=title)


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


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """Give an empty figure to draw on, in the style of all figures."""
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def svg(figure: Any) -> str:
    """Write a figure as SVG text; its marks say their values on hover.

    Without date and version, so that the same data give the same bytes.
    """
    buffer, titles = io.StringIO(), name_marks(figure)
    _lay_out(figure)
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = PLACES.sub(lambda found: PAST_DIGITS.sub("", found[0]), SPARED.sub("", buffer.getvalue()))
    # Formulas name one family only, and would be written in serifs where it is not installed.
    return put_titles(text.replace(f"'{FONTS[0]}'\"", f"'{FONTS[0]}', '{FONTS[1]}', {FONTS[2]}\""), titles)


def _lay_out(figure: Any) -> None:
    """Give all axes their places as saving would, which draws the figure once more for it."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)  # texts are measured as they are written
    figure.dpi = SVG_DPI
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine(None)


def _places(table: pa.Table, side: str) -> Any:
    return np.stack([np.asarray(table[f"{side}_{axis}_mm"], np.float64) for axis in "xy"], axis=1)
