"""Tests of the layout of figures on narrow screens."""

import re
import xml.etree.ElementTree as ET
from itertools import pairwise

import pytest
from matplotlib.backends.backend_svg import FigureCanvasSVG

from pipeline.plot import DARK, EXACT, drawing, svg
from pipeline.plot_layout import LEGIBLE_PT, WIDTH_IN, lay_out

TITLE = "a title of a figure that is much longer than the width of a phone allows without a line break"


def laid_out(draw, width_in: float = 9.0, height_in: float = 3.0, **layout):
    with drawing(width_in, height_in) as figure:
        FigureCanvasSVG(figure)
        figure.dpi = 72
        draw(figure)
        lay_out(figure, **layout)
        return figure


def draw_row(figure):
    panels = figure.subplots(1, 3, sharey=True)
    for i, axes in enumerate(panels):
        axes.plot([1, 2], [i, 3], "o-", label=f"a line with a long name, {i}")
        axes.set_xlabel("force / N")
        axes.tick_params(labelsize=5)
    panels[0].set_ylabel("error of the force / mN")
    figure.legend(loc="outside right upper", ncols=3)
    figure.suptitle(TITLE, x=0.01, ha="left")


def test_row_of_panels_becomes_a_column_on_a_narrow_screen():
    figure = laid_out(draw_row, height_in=5.0)
    boxes = [axes.get_window_extent() for axes in figure.axes]
    assert figure.get_figwidth() == WIDTH_IN
    assert all(upper.y0 > lower.y1 for upper, lower in pairwise(boxes))
    assert len({round(box.x0) for box in boxes}) == 1
    assert [axes.get_ylabel() for axes in figure.axes] == ["error of the force / mN"] * 3


def test_texts_are_inside_the_figure_and_legible():
    figure = laid_out(draw_row)
    legend, title = figure.legends[0], figure._suptitle
    assert title.get_text().replace("\n", " ") == TITLE
    for artist in (legend, title):
        box = artist.get_window_extent()
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
    assert legend.get_window_extent().y1 <= min(axes.get_tightbbox().y0 for axes in figure.axes)
    sizes = [label.get_fontsize() for axes in figure.axes for label in axes.get_xticklabels()]
    assert min(sizes) >= LEGIBLE_PT


def test_labels_of_y_axes_are_no_longer_than_their_panels():
    def draw(figure):
        for axes in figure.subplots(1, 2):
            axes.set_ylabel("a mean of many values and their standard deviation / µT")

    for axes in laid_out(draw).axes:
        panel, label = axes.get_window_extent(), axes.yaxis.label.get_window_extent()
        assert panel.y0 - 1 < label.y0 < label.y1 < panel.y1 + 1


def test_panels_in_rows_and_columns_keep_their_arrangement():
    figure = laid_out(lambda figure: figure.subplots(2, 2), width_in=8.0)
    assert figure.get_figwidth() == 8.0
    assert len({round(axes.get_window_extent().x0) for axes in figure.axes}) == 2


def test_panels_stay_beside_each_other_if_this_is_requested():
    figure = laid_out(lambda figure: figure.subplots(1, 2), column=False)
    assert figure.get_figwidth() == 9.0
    assert len({round(axes.get_window_extent().y0) for axes in figure.axes}) == 1


def test_labels_that_would_overlap_are_turned():
    def draw(figure):
        axes = figure.subplots()
        axes.set_xticks(range(15), [f"B{i}" * 3 for i in range(15)])

    labels = laid_out(draw).axes[0].get_xticklabels()
    assert {label.get_rotation() for label in labels} == {90}


@pytest.mark.parametrize(
    ("limits", "shown"),
    [((1e-3, 1e2), {"0.001", "0.1", "10"}), ((1e-9, 1e-3), {"10⁻⁸", "10⁻⁴"}), ((150, 700), {"200", "500"})],
)
def test_numbers_on_logarithmic_axes_are_readable(limits, shown):
    with drawing(4.0, 3.0) as figure:
        figure.subplots().set(xscale="log", xlim=limits)
        text = svg(figure)
    texts = {
        "".join(element.itertext()).strip() for element in ET.fromstring(text).iter() if element.tag.endswith("text")
    }
    assert shown <= texts


def test_figures_have_styles_for_dark_mode_and_small_screens():
    with drawing(4.0, 3.0) as figure:
        figure.subplots()
        text = svg(figure)
    style = re.search(r"<style[^>]*>(.*?)</style>", text, re.DOTALL)[1]
    assert DARK in style
    assert EXACT in style
    ET.fromstring(text)
