import io
import re
import xml.etree.ElementTree as ET

import numpy as np

from pipeline.report.drawing import drawing, svg
from pipeline.report.figures import error_grid

PLACES_MM = np.array([[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]] * 3)


def draw(error_mm: float = 0.5) -> str:
    return error_grid(PLACES_MM, PLACES_MM + error_mm, title="lab (recorded), lobo")


def test_a_figure_is_svg_with_units_on_its_axes_and_its_source_in_the_title():
    text = draw()
    ET.fromstring(text)
    for word in ("x / mm", "y / mm", "mean place error / mm", "recorded"):
        assert word in text


def test_every_place_is_drawn_once_however_often_it_was_poked():
    assert draw().count("<title>x / mm") == 4


def test_a_skin_and_its_chips_are_drawn_where_places_lie_on_the_papers_grid_and_nowhere_else():
    elsewhere = error_grid(PLACES_MM - 20, PLACES_MM - 20, title="eflesh")
    # Five chips and a skin, and these two in the legend; axes without a spine on two sides.
    assert draw().count('id="patch_') - elsewhere.count('id="patch_') == 5 + 1 + 2 - 2
    assert "chip" in draw()
    assert "chip" not in elsewhere


def test_the_worst_place_is_named():
    errors_mm = np.zeros_like(PLACES_MM)
    errors_mm[PLACES_MM[:, 0] + PLACES_MM[:, 1] == 4, 0] = 3.0
    assert "worst 3.00 mm at x = 2, y = 2" in error_grid(PLACES_MM, PLACES_MM + errors_mm, title="t")


def test_what_nobody_sees_is_left_out_and_words_keep_their_digits():
    with drawing(3.0, 2.0) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0.123456, 2], "o")
        axes.set_title("bias 0.00899")
        text = svg(figure)
    assert "bias 0.00899" in text
    assert "= 0.1235" in text
    assert "<metadata>" not in text
    assert re.search(r' (?:d|x|y|transform)="[^"]*\.\d{3}', text) is None
    assert re.search(r"^ ", text, re.MULTILINE) is None


def test_letters_of_formulas_have_another_family_to_fall_back_on():
    with drawing(3.0, 2.0) as figure:
        figure.subplots().set_yscale("log")
        families = re.findall(r"font-family: ([^\";]*)", svg(figure))
    assert families
    assert all(family.endswith("sans-serif") for family in families)


def test_same_data_same_bytes_other_data_other_bytes():
    assert draw() == draw()
    assert draw() != error_grid(PLACES_MM, PLACES_MM + np.arange(12)[:, None], title="lab (recorded), lobo")


def test_axes_lie_where_matplotlib_lays_them_out_when_it_saves():
    def places(save) -> list[tuple[float, ...]]:
        with drawing(5.0, 3.0) as figure:
            for axes, scale in zip(figure.subplots(1, 2), ("linear", "log"), strict=True):
                axes.plot([1, 10, 1000])
                axes.set(ylabel="force / N", title="a long title of a panel", yscale=scale)
            save(figure)
            return [axes.get_position().bounds for axes in figure.axes]

    assert places(svg) == places(lambda figure: figure.savefig(io.BytesIO(), format="svg"))
