"""SVG figures in a common style, whose marks show their values on hover.

Matplotlib is imported inside the functions that draw, so that modules that mainly compute do not load Matplotlib.
"""

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from html import escape
from typing import Any

import numpy as np

from pipeline.plot_layout import lay_out

MARKS_MAX_N = 150  # a line or scatter with more marks gets no titles, which would make the file too large
# Matplotlib writes the marks of an artist as <use> tags if there are many, and as <path> tags if there are few.
USE, PATH = re.compile(r"<(use) [^>]*/>"), re.compile(r"<(path) [^>]*/>")
GROUP = re.compile(r"<g[ >]|</g>")
# Titles by the id of an SVG group: one title per mark, in the order of marks, or one title for a line without marks.
Titles = Mapping[str, list[str]]
Format = Callable[[float], str]
FONTS = ("DejaVu Sans", "Verdana", "sans-serif")  # the fallback Verdana has letters of the same width
# Removed from the file: indentation, metadata, comments, and the digits of coordinates beyond a hundredth of a point.
REMOVED = re.compile(r"(?<=\n) +|<metadata>.*?</metadata>\n|<!--.*?-->\n", re.DOTALL)
COORDINATES = re.compile(r' (d|x|y|transform)="[^"]*"')
DIGITS_BEYOND_2 = re.compile(r"(?<=\.\d\d)\d+")
SVG_DPI = 72  # the unit of the file is the point, 1/72 inch
# In dark mode, lightness is inverted and hues are kept. White becomes the colour of the page in dark mode.
DARK = "@media screen and (prefers-color-scheme: dark) {svg {filter: invert(0.91) hue-rotate(180deg)}}"
# Otherwise browsers may round the widths of letters to pixels; texts are then too wide in a small figure, and are cut.
EXACT = "text {text-rendering: geometricPrecision}"
STYLE = {
    "svg.hashsalt": "reskin",
    "svg.fonttype": "none",
    "font.sans-serif": FONTS,
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
# Okabe & Ito 2008: colours that colour-blind readers can distinguish; their yellow is omitted, as it is pale on white.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# Colours of errors in maps: large errors are dark on a white page, and light on a dark page.
ERROR_COLOURS = "viridis_r"
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def name_marks(figure: Any) -> Titles:
    """Set an id for each line and scatter of a figure; return the texts that their marks show on hover, by id."""
    titles = {}
    for i, axes in enumerate(figure.axes):
        for j, (artist, texts) in enumerate(_titled_artists(axes)):
            artist.set_gid(f"marks_{i}_{j}")
            titles[f"marks_{i}_{j}"] = texts
    return titles


def put_titles(svg: str, titles: Titles) -> str:
    """Write titles into the SVG groups with the given ids; skip a group whose numbers of marks and titles differ."""
    for name, texts in titles.items():
        before, head, after = svg.partition(f'<g id="{name}">')
        if head:  # the group is missing if nothing was drawn
            end = _group_end(after)
            svg = before + head + _with_titles(after[:end], texts) + after[end:]
    return svg


def _with_titles(group: str, texts: list[str]) -> str:
    pattern = USE if USE.search(group) else PATH
    if len(pattern.findall(group)) != len(texts):
        return group
    remaining = iter(texts)
    return pattern.sub(lambda mark: f"{mark[0][:-2]}><title>{escape(next(remaining))}</title></{mark[1]}>", group)


def _group_end(text: str) -> int:
    """Return the position of the tag that closes a group; the text starts inside the group."""
    depth = 1
    for tag in GROUP.finditer(text):
        depth += -1 if tag[0] == "</g>" else 1
        if depth == 0:
            return tag.start()
    raise AssertionError("a group of the SVG is not closed")


def _titled_artists(axes: Any) -> Iterator[tuple[Any, list[str]]]:
    """Yield the lines and scatters of a panel, each with the texts that its marks show on hover."""
    x, y = _value_format(axes, "x"), _value_format(axes, "y")
    barred = {container.lines[0]: container for container in axes.containers if hasattr(container, "has_yerr")}
    caps = {cap for container in barred.values() for cap in container.lines[1]}
    for line in axes.lines:
        name = barred.get(line, line).get_label()
        if line.get_marker() in ("None", None, "", " "):
            if not name.startswith("_"):
                yield line, [name]
        elif line not in caps and len(line.get_xydata()) <= MARKS_MAX_N:
            texts = [_title(name, x(x_value), y(y_value)) for x_value, y_value in line.get_xydata()]
            yield line, _with_bars(texts, barred[line]) if line in barred else texts
    for scatter in axes.collections:
        if hasattr(scatter, "get_sizes") and 0 < len(scatter.get_offsets()) <= MARKS_MAX_N:
            yield scatter, _scatter_titles(scatter, x, y)


def _scatter_titles(scatter: Any, x: Format, y: Format) -> list[str]:
    values, bar = scatter.get_array(), scatter.colorbar
    offsets = np.asarray(scatter.get_offsets())
    texts = [_title(scatter.get_label(), x(x_value), y(y_value)) for x_value, y_value in offsets]
    if values is None or bar is None:
        return texts
    name = bar.ax.get_ylabel()
    return [f"{text}\n{name} = {_number(value)}" for text, value in zip(texts, values, strict=True)]


def _with_bars(texts: list[str], container: Any) -> list[str]:
    """Append the ends of each mark's error bar to its title."""
    side = 1 if container.has_yerr else 0
    ends = [ends[:, side] for bars in container.lines[2] for ends in bars.get_segments()]
    if len(ends) != len(texts):
        return texts
    bars = [f"\nbar from {_number(a)} to {_number(b)}" if a < b else "" for a, b in ends]
    return [text + bar for text, bar in zip(texts, bars, strict=True)]


def _title(name: str, *values: str) -> str:
    return "\n".join([*([] if name.startswith("_") else [name]), *values])


def _value_format(axes: Any, which: str) -> Format:
    """Return a function that writes a value on an axis: `label = value`, or the name of the nearest named tick."""
    axis, siblings = getattr(axes, f"{which}axis"), getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = [labelled.get_label_text() for labelled in (axis, *(getattr(other, f"{which}axis") for other in siblings))]
    name = " ".join(next((label for label in labels if label), which).split())
    fixed = type(axis.get_major_locator()).__name__ == "FixedLocator"  # ticks at fixed positions may have names
    positions = axis.get_majorticklocs() if fixed else ()
    texts = zip(positions, axis.get_major_formatter().format_ticks(positions), strict=True)
    ticks = {position: " ".join(text.split()) for position, text in texts if any(map(str.isalpha, text))}
    if ticks:
        return lambda value: ticks[min(ticks, key=lambda position: abs(position - value))]
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


def svg(figure: Any, *, column: bool = True) -> str:
    """Write a figure as SVG text whose marks show their values on hover.

    A row of panels is put in a column, unless `column` is False (see `pipeline.plot_layout`). The text contains no
    date and no version, so that equal data give equal bytes.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)  # this canvas measures texts at the size that they have in the file
    figure.dpi = SVG_DPI
    lay_out(figure, column=column)
    buffer, titles = io.StringIO(), name_marks(figure)
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = COORDINATES.sub(lambda found: DIGITS_BEYOND_2.sub("", found[0]), REMOVED.sub("", buffer.getvalue()))
    # For formulas, Matplotlib writes only one font family. The other families are added, because browsers without this
    # family could use a serif font.
    text = text.replace(f"'{FONTS[0]}'\"", f"'{FONTS[0]}', '{FONTS[1]}', {FONTS[2]}\"")
    return put_titles(text.replace("</style>", f"{DARK}{EXACT}</style>", 1), titles)
