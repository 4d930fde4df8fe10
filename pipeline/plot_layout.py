"""Lay out figures in one column of panels, so that they are legible on a phone and several fit beside each other."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from textwrap import fill
from typing import Any

WIDTH_IN = 4.7  # largest width of a figure whose panels are in one column
LEGIBLE_PT = 8.0  # smallest size of letters; a phone shows a figure of this width at about its size in points
PANEL_IN = (1.3, 2.3)  # smallest and largest height of a panel that was in a row of panels
EDGE_PT, HANDLE_PT = 10.0, 40.0  # widths: edge of a legend; edges and handle of one entry
SHORTEST_N = 12  # letters; shorter lines are not broken
GAP_PT = 2.0  # smallest distance between the labels of neighbouring ticks
PLAIN = (1e-3, 1e4)  # range of numbers that logarithmic axes show without an exponent
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def lay_out(figure: Any, *, column: bool = True) -> None:
    """Lay out a figure, and turn off its layout engine, so that saving the figure does not change the layout.

    Unless `column` is False, a row of panels becomes a column, and titles and legends are broken into lines that fit
    the figure's width. Figures with several rows and columns of panels keep them.
    """
    from matplotlib.text import Text

    for axes in figure.axes:
        _label_powers(axes)
    for text in figure.findobj(Text):
        text.set_fontsize(max(text.get_fontsize(), LEGIBLE_PT))
    _execute(figure)
    panels = [axes for axes in figure.axes if axes.get_subplotspec() is not None]
    grids = {id(axes.get_gridspec()): axes.get_gridspec() for axes in panels}
    if column and all(grid.nrows == 1 or grid.ncols == 1 for grid in grids.values()):
        _put_in_column(figure, panels, beside=len(grids) == 1 and next(iter(grids.values())).ncols > 1)
    figure.set_layout_engine(None)


def _execute(figure: Any) -> None:
    figure.get_layout_engine().execute(figure)


def _put_in_column(figure: Any, panels: Sequence[Any], *, beside: bool) -> None:
    """Limit the width of a figure; if its panels are `beside` each other, put them below each other."""
    heights_in = [_height_in(axes) for axes in panels]
    if beside:
        heights_in = [min(max(height, PANEL_IN[0]), PANEL_IN[1]) for height in heights_in]
        _stack(figure, panels, heights_in)
        figure.set_figheight(figure.get_figheight() * len(panels))  # ample, so that no panel collapses; set below
    changed = beside or figure.get_figwidth() > WIDTH_IN
    figure.set_figwidth(min(figure.get_figwidth(), WIDTH_IN))
    for legend in figure.legends:
        _narrow_legend(legend, figure.bbox.width)
    if changed:
        _set_heights(figure, panels, heights_in)  # before texts are broken into lines that depend on it
    _fit_texts(figure, panels)
    if changed:
        _set_heights(figure, panels, heights_in)
    _execute(figure)


def _set_heights(figure: Any, panels: Sequence[Any], heights_in: Sequence[float]) -> None:
    """Set the height of a figure such that the heights of its panels have the sum of `heights_in`."""
    _execute(figure)
    missing_in = sum(heights_in) - sum(map(_height_in, panels))
    figure.set_figheight(max(figure.get_figheight() + missing_in, 1.0))


def _fit_texts(figure: Any, panels: Sequence[Any]) -> None:
    """Break or rotate texts that are longer than the figure's current layout allows."""
    for axes in panels:
        _turn_overlapping_labels(axes)
    for text, width in _texts(figure):
        _break_lines(text, width)


def _stack(figure: Any, panels: Sequence[Any], heights_in: Sequence[float]) -> None:
    """Move panels from a row into a column; panels that shared the labels of the y axis get their own."""
    grid = figure.add_gridspec(len(panels), 1, height_ratios=heights_in)
    labels = {axes: _label_of(axes) for axes in panels}
    for i, axes in enumerate(panels):
        axes.set_subplotspec(grid[i, 0])
        axes.set_ylabel(labels[axes])
        if axes.yaxis.get_visible():
            axes.yaxis.set_tick_params(which="major", labelleft=True)


def _label_of(axes: Any) -> str:
    siblings = axes.get_shared_y_axes().get_siblings(axes)
    return next((text for one in (axes, *siblings) if (text := one.get_ylabel())), "")


def _height_in(axes: Any) -> float:
    return float(axes.get_position(original=True).height * axes.figure.get_figheight())


def _narrow_legend(legend: Any, width: float) -> None:
    """Put a legend of the figure below its panels, in as few columns as its width requires."""
    if legend._outside_loc == "right":
        legend.set_loc("outside lower left")
    _break_lines(legend.get_title(), width - 2 * EDGE_PT)
    columns_n = legend._ncols
    while columns_n > 1 and legend.get_window_extent().width > width:
        columns_n -= 1
        _set_columns(legend, columns_n)
    for text in legend.get_texts():
        _break_lines(text, width - HANDLE_PT)


def _set_columns(legend: Any, columns_n: int) -> None:
    """Rearrange the entries of a legend, because `Legend.set_ncols` has no effect on a legend that exists."""
    from matplotlib.offsetbox import HPacker, VPacker

    box = legend._legend_handle_box
    entries = [entry for column in box.get_children() for entry in column.get_children()]
    rows_n = -(-len(entries) // columns_n)
    gap_pt = legend.labelspacing * legend._fontsize
    columns: list[Any] = [
        VPacker(pad=0, sep=gap_pt, align="baseline", children=entries[i : i + rows_n])
        for i in range(0, len(entries), rows_n)
    ]
    new = HPacker(pad=0, sep=legend.columnspacing * legend._fontsize, align="baseline", children=columns)
    new.set_figure(legend.figure)
    whole = legend._legend_box
    whole._children[whole._children.index(box)] = new
    legend._legend_handle_box, legend._ncols = new, columns_n


def _texts(figure: Any) -> Iterator[tuple[Any, float]]:
    """Yield the titles of a figure and of its panels, each with the width that it can have."""
    for text in (figure._suptitle, figure._supxlabel):
        if text is not None:
            yield text, figure.bbox.width * 0.98
    for axes in figure.axes:
        left = axes.get_window_extent().x0
        yield axes._left_title, figure.bbox.width - left
        yield axes.title, figure.bbox.width - left
        yield axes.xaxis.label, figure.bbox.width - left
        if axes.get_subplotspec() is not None:
            yield axes.yaxis.label, axes.get_window_extent().height


def _break_lines(text: Any, width: float) -> None:
    """Break the lines of a text that are longer than `width`, in pixels of the figure; the text may be rotated."""

    def length() -> float:
        extent = text.get_window_extent()
        return float(extent.height if text.get_rotation() == 90 else extent.width)

    lines = text.get_text().split("\n")
    letters_n = max(map(len, lines))
    while letters_n > SHORTEST_N and length() > width:
        letters_n -= 1
        text.set_text("\n".join(fill(line, letters_n) for line in lines))


def _turn_overlapping_labels(axes: Any) -> None:
    labels = [label for label in axes.get_xticklabels() if label.get_text() and label.get_visible()]
    extents = sorted((label.get_window_extent().x0, label.get_window_extent().x1) for label in labels)
    if any(right + GAP_PT > left for (_, right), (left, _) in pairwise(extents)):
        axes.tick_params(axis="x", labelrotation=90)


def _label_powers(axes: Any) -> None:
    """Label logarithmic axes at powers of ten, and also between them if fewer than two powers are in the range."""
    from matplotlib.ticker import FuncFormatter, LogFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        if not isinstance(axis.get_major_formatter(), LogFormatter):
            continue
        low, high = sorted(axis.get_view_interval())
        formatter = FuncFormatter(lambda value, _: _power(value))
        few = axis.get_scale() == "log" and sum(low <= tick <= high for tick in axis.get_majorticklocs()) < 2
        if few:
            axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_major_formatter(formatter)
        axis.set_minor_formatter(formatter if few else NullFormatter())


def _power(value: float) -> str:
    """Write a number without an exponent, or as a power of ten if it is very small or large.

    >>> [_power(value) for value in (0.0, 0.01, 500, 1e5, 2e-6)]
    ['0', '0.01', '500', '10⁵', '2·10⁻⁶']
    """
    if value == 0 or PLAIN[0] <= abs(value) <= PLAIN[1]:
        return f"{value:g}"
    factor, _, exponent = f"{value:.0e}".partition("e")
    power = f"10{str(int(exponent)).translate(SUPERSCRIPTS)}"
    return power if factor == "1" else f"{factor}·{power}"
