"""Drawing: SVG figures in one style, whose marks say their values on hover.

Matplotlib is imported by the functions that draw, so that modules which also compute do not load it.
"""

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from html import escape
from typing import Any

import numpy as np

MOST = 150  # marks of one kind: of more, a title each would weigh more than it tells
USE, PATH = re.compile(r"<(use) [^>]*/>"), re.compile(r"<(path) [^>]*/>")  # few marks are written out one by one
GROUP = re.compile(r"<g[ >]|</g>")
Titles = Mapping[str, list[str]]  # by id of a group: a title for each of its marks, in order, or one for a line without
Say = Callable[[float], str]
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
# Okabe & Ito 2008, told apart by colour-blind readers; their yellow is left out, which is pale on white.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def style() -> AbstractContextManager[None]:
    """Give the context in which all figures are drawn."""
    import matplotlib as mpl

    return mpl.rc_context(STYLE)


def name_marks(figure: Any) -> Titles:
    """Give an id to each line and each cloud of marks, and say what its marks are."""
    titles = {}
    for i, axes in enumerate(figure.axes):
        for j, (artist, texts) in enumerate(_described(axes)):
            artist.set_gid(f"marks_{i}_{j}")
            titles[f"marks_{i}_{j}"] = texts
    return titles


def put_titles(svg: str, titles: Titles) -> str:
    """Write the titles into the groups of their ids; none where more or fewer marks were drawn than described."""
    for name, texts in titles.items():
        before, head, after = svg.partition(f'<g id="{name}">')
        if head:  # else nothing was drawn
            end = _end_of(after)
            svg = before + head + _with_titles(after[:end], texts) + after[end:]
    return svg


def _with_titles(group: str, texts: list[str]) -> str:
    pattern = USE if USE.search(group) else PATH
    if len(pattern.findall(group)) != len(texts):
        return group
    waiting = iter(texts)
    return pattern.sub(lambda mark: f"{mark[0][:-2]}><title>{escape(next(waiting))}</title></{mark[1]}>", group)


def _end_of(text: str) -> int:
    """Find where the group ends in which a text begins."""
    depth = 1
    for tag in GROUP.finditer(text):
        depth += -1 if tag[0] == "</g>" else 1
        if depth == 0:
            return tag.start()
    raise AssertionError("every group of an SVG ends")


def _described(axes: Any) -> Iterator[tuple[Any, list[str]]]:
    """Yield the lines of a panel, and its clouds of marks, with the titles of each."""
    x, y = _say_along(axes, "x"), _say_along(axes, "y")
    barred = {container.lines[0]: container for container in axes.containers if hasattr(container, "has_yerr")}
    caps = {cap for container in barred.values() for cap in container.lines[1]}
    for line in axes.lines:
        name = barred.get(line, line).get_label()
        if line.get_marker() in ("None", None, "", " "):
            if not name.startswith("_"):
                yield line, [name]
        elif line not in caps and len(line.get_xydata()) <= MOST:
            texts = [_title(name, x(at), y(of)) for at, of in line.get_xydata()]
            yield line, _with_bars(texts, barred[line]) if line in barred else texts
    for cloud in axes.collections:
        if hasattr(cloud, "get_sizes") and 0 < len(cloud.get_offsets()) <= MOST:
            yield cloud, _of_cloud(cloud, x, y)


def _of_cloud(cloud: Any, x: Say, y: Say) -> list[str]:
    values, bar = cloud.get_array(), cloud.colorbar
    texts = [_title(cloud.get_label(), x(at), y(of)) for at, of in np.asarray(cloud.get_offsets())]
    if values is None or bar is None:
        return texts
    name = bar.ax.get_ylabel()
    return [f"{text}\n{name} = {_number(value)}" for text, value in zip(texts, values, strict=True)]


def _with_bars(texts: list[str], container: Any) -> list[str]:
    """Add from where to where the bar of each mark reaches."""
    side = 1 if container.has_yerr else 0
    ends = [ends[:, side] for bars in container.lines[2] for ends in bars.get_segments()]
    if len(ends) != len(texts):
        return texts
    said = [f"\nbar from {_number(a)} to {_number(b)}" if a < b else "" for a, b in ends]
    return [text + bar for text, bar in zip(texts, said, strict=True)]


def _title(name: str, *values: str) -> str:
    return "\n".join([*([] if name.startswith("_") else [name]), *values])


def _say_along(axes: Any, which: str) -> Say:
    """Make what says a value along an axis: beside the axis' name, or as its nearest tick where ticks have names."""
    axis, siblings = getattr(axes, f"{which}axis"), getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    labels = [one.get_label_text() for one in (axis, *(getattr(other, f"{which}axis") for other in siblings))]
    name = " ".join(next((label for label in labels if label), which).split())
    were_set = type(axis.get_major_locator()).__name__ == "FixedLocator"  # one by one: perhaps with names
    places = axis.get_majorticklocs() if were_set else ()
    texts = zip(places, axis.get_major_formatter().format_ticks(places), strict=True)
    ticks = {place: " ".join(text.split()) for place, text in texts if any(map(str.isalpha, text))}
    if ticks:
        return lambda value: ticks[min(ticks, key=lambda place: abs(place - value))]
    return lambda value: f"{name} = {_number(value)}"


def _number(value: float) -> str:
    return f"{value:.4g}"


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """Give an empty figure to draw on, in the style of all figures."""
    from matplotlib.figure import Figure

    with style():
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
