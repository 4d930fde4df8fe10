"""SVG figures in a common style, whose marks show their values on hover.

Matplotlib is imported in the functions that draw, so that modules that mainly compute do not load it.
"""

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np

MARKS_MAX_N = 150  # marks of one artist; with more, titles would make the file too large
USE, PATH = re.compile(r"<(use) [^>]*/>"), re.compile(r"<(path) [^>]*/>")  # a few marks are written as separate paths
GROUP = re.compile(r"<g[ >]|</g>")
Titles = Mapping[str, list[str]]  # by id of a group: a title for each mark, in order; one for a line without marks
Format = Callable[[float], str]
FONTS = ("DejaVu Sans", "Verdana", "sans-serif")  # Verdana, used if the first is not installed, has the same width
# Not written: indentation, metadata, comments, and coordinates finer than a hundredth of a point.
REMOVED = re.compile(r"(?<=\n) +|<metadata>.*?</metadata>\n|<!--.*?-->\n", re.DOTALL)
COORDINATES = re.compile(r' (d|x|y|transform)="[^"]*"')
DIGITS_BEYOND_2 = re.compile(r"(?<=\.\d\d)\d+")
SVG_DPI = 72  # of points, in which the format counts
STYLE = {
    "svg.hashsalt": "reskin",
    "svg.fonttype": "none",
    "font.sans-serif": FONTS,
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
# Okabe & Ito 2008, distinguishable by colour-blind readers; their yellow is left out, as it is pale on white.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def name_marks(figure: Any) -> Titles:
    """Set an id for each line and scatter of a figure; return the titles of their marks by id."""
    titles = {}
    for i, axes in enumerate(figure.axes):
        for j, (artist, texts) in enumerate(_titled_artists(axes)):
            artist.set_gid(f"marks_{i}_{j}")
            titles[f"marks_{i}_{j}"] = texts
    return titles


def put_titles(svg: str, titles: Titles) -> str:
    """Write the titles into the groups with their ids, except where the number of drawn marks differs."""
    for name, texts in titles.items():
        before, head, after = svg.partition(f'<g id="{name}">')
        if head:  # else nothing was drawn
            end = _group_end(after)
            svg = before + head + _with_titles(after[:end], texts) + after[end:]
    return svg


def _with_titles(group: str, texts: list[str]) -> str:
    pattern = USE if USE.search(group) else PATH
    if len(pattern.findall(group)) != len(texts):
        return group
    waiting = iter(texts)
    return pattern.sub(lambda mark: f"{mark[0][:-2]}><title>{escape(next(waiting))}</title></{mark[1]}>", group)


def _group_end(text: str) -> int:
    """Return where the group that contains the start of the text ends."""
    depth = 1
    for tag in GROUP.finditer(text):
        depth += -1 if tag[0] == "</g>" else 1
        if depth == 0:
            return tag.start()
    raise AssertionError("every group of an SVG ends")


def _titled_artists(axes: Any) -> Iterator[tuple[Any, list[str]]]:
    """Yield the lines and scatters of a panel with the titles of their marks."""
    x, y = _value_format(axes, "x"), _value_format(axes, "y")
    barred = {container.lines[0]: container for container in axes.containers if hasattr(container, "has_yerr")}
    caps = {cap for container in barred.values() for cap in container.lines[1]}
    for line in axes.lines:
        name = barred.get(line, line).get_label()
        if line.get_marker() in ("None", None, "", " "):
            if not name.startswith("_"):
                yield line, [name]
        elif line not in caps and len(line.get_xydata()) <= MARKS_MAX_N:
            texts = [_title(name, x(at), y(of)) for at, of in line.get_xydata()]
            yield line, _with_bars(texts, barred[line]) if line in barred else texts
    for scatter in axes.collections:
        if hasattr(scatter, "get_sizes") and 0 < len(scatter.get_offsets()) <= MARKS_MAX_N:
            yield scatter, _scatter_titles(scatter, x, y)


def _scatter_titles(scatter: Any, x: Format, y: Format) -> list[str]:
    values, bar = scatter.get_array(), scatter.colorbar
    texts = [_title(scatter.get_label(), x(at), y(of)) for at, of in np.asarray(scatter.get_offsets())]
    if values is None or bar is None:
        return texts
    name = bar.ax.get_ylabel()
    return [f"{text}\n{name} = {_number(value)}" for text, value in zip(texts, values, strict=True)]


def _with_bars(texts: list[str], container: Any) -> list[str]:
    """Add the ends of the error bar of each mark."""
    side = 1 if container.has_yerr else 0
    ends = [ends[:, side] for bars in container.lines[2] for ends in bars.get_segments()]
    if len(ends) != len(texts):
        return texts
    bars = [f"\nbar from {_number(a)} to {_number(b)}" if a < b else "" for a, b in ends]
    return [text + bar for text, bar in zip(texts, bars, strict=True)]


def _title(name: str, *values: str) -> str:
    return "\n".join([*([] if name.startswith("_") else [name]), *values])


def _value_format(axes: Any, which: str) -> Format:
    """Return a function that writes a value with its axis's label, or the nearest tick's name if ticks have names."""
    axis, siblings = getattr(axes, f"{which}axis"), getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = [one.get_label_text() for one in (axis, *(getattr(other, f"{which}axis") for other in siblings))]
    name = " ".join(next((label for label in labels if label), which).split())
    fixed = type(axis.get_major_locator()).__name__ == "FixedLocator"  # ticks that were set may have names
    places = axis.get_majorticklocs() if fixed else ()
    texts = zip(places, axis.get_major_formatter().format_ticks(places), strict=True)
    ticks = {place: " ".join(text.split()) for place, text in texts if any(map(str.isalpha, text))}
    if ticks:
        return lambda value: ticks[min(ticks, key=lambda place: abs(place - value))]
    return lambda value: f"{name} = {_number(value)}"


def _number(value: float) -> str:
    return f"{value:.4g}"


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """Yield an empty figure to draw on, in the style of all figures."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def svg(figure: Any) -> str:
    """Write a figure as SVG text whose marks show their values on hover.

    It contains no date and no version, so the same data give the same bytes.
    """
    buffer, titles = io.StringIO(), name_marks(figure)
    _lay_out(figure)
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = COORDINATES.sub(lambda found: DIGITS_BEYOND_2.sub("", found[0]), REMOVED.sub("", buffer.getvalue()))
    # Formulas name only one font family; without it, browsers would use a serif font.
    return put_titles(text.replace(f"'{FONTS[0]}'\"", f"'{FONTS[0]}', '{FONTS[1]}', {FONTS[2]}\""), titles)


def _lay_out(figure: Any) -> None:
    """Lay out the axes once and turn the layout engine off, so that saving does not draw the figure a second time."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)  # so that texts are measured as they will be written
    figure.dpi = SVG_DPI
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine(None)
