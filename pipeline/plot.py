"""Figures in a common style, as SVG text that is equal for equal data.

All figures have the same width, at which a phone shows them legibly and several fit beside each other on a screen. They
have a white background of their own, so that they look the same on light and dark pages. Matplotlib is imported inside
the functions that draw, so that modules that mainly compute do not load Matplotlib.
"""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from typing import Any

from matplotlib import cycler

WIDTH_IN = 4.7
# Okabe & Ito 2008: colours that colour-blind readers can distinguish; their yellow is omitted, as it is pale on white.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
ERROR_COLOURS = "viridis_r"  # colours of errors in maps: large errors are dark
FONTS = ("DejaVu Sans", "Verdana", "sans-serif")  # the fallback Verdana has letters of the same width
STYLE = {
    "axes.formatter.min_exponent": 4,  # 0.001 instead of a power of ten
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=2 * COLOURS, marker=MARKERS + MARKERS[1:] + MARKERS[:1]),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 9.0,
    "errorbar.capsize": 2.0,
    "figure.titlesize": 10.0,
    "font.sans-serif": FONTS,
    "font.size": 9.0,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "svg.fonttype": "none",  # texts remain texts
    "svg.hashsalt": "reskin",
}
METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))  # None: left out, so that equal data give equal text
# Indentation; digits of coordinates beyond a hundredth of a point; ids and references to them; the font of formulas.
INDENTATION = re.compile(r"(?<=\n) +")
COORDINATES, BEYOND_2 = re.compile(r' (d|x|y|transform)="[^"]*"'), re.compile(r"(?<=\.\d\d)\d+")
IDS = re.compile(r'(?<= id=")|(?<=href="#)|(?<=url\(#)')
FORMULA_FONT = re.compile(f"(?<=font-family: )'{FONTS[0]}'(?=[;\"])")


@contextmanager
def drawing(height_in: float, title: str) -> Iterator[Any]:
    """Yield an empty figure with a title to draw on, in the style of all figures."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        figure.suptitle(title, x=0.01, ha="left")
        yield figure


def svg(figure: Any) -> str:
    """Write a figure as SVG text, which can be a file or a part of an HTML page.

    The ids start with a hash of the figure, because those of different figures of a page must differ.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=METADATA)
    text = INDENTATION.sub("", buffer.getvalue()[buffer.getvalue().index("<svg") :])
    text = COORDINATES.sub(lambda found: BEYOND_2.sub("", found[0]), text)
    text = FORMULA_FONT.sub(", ".join(f"'{font}'" for font in FONTS[:-1]) + f", {FONTS[-1]}", text)
    return IDS.sub(f"f{sha256(text.encode()).hexdigest()[:6]}-", text)
