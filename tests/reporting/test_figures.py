import re
import xml.etree.ElementTree as ET

import numpy as np

from pipeline.reporting.figures import error_grid

PLACES_MM = np.array([[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]] * 3)


def draw(error_mm: float = 0.5) -> str:
    return error_grid(PLACES_MM, PLACES_MM + error_mm, title="lab (recorded), lobo")


def test_a_figure_is_svg_with_units_on_its_axes_and_its_source_in_the_title():
    text = draw()
    ET.fromstring(text)
    for word in ("x / mm", "y / mm", "mean place error / mm", "recorded"):
        assert word in text


def test_every_place_is_drawn_once_however_often_it_was_poked():
    marks = re.search(r'<g id="PathCollection_1">(.*?)</g>\s*<g id="(?:matplotlib|patch)', draw(), re.DOTALL)
    assert marks[1].count("<path d=") == 4


def test_chips_are_drawn_where_places_lie_on_the_papers_grid_and_nowhere_else():
    rectangles = draw().count('id="patch_')
    assert rectangles - error_grid(PLACES_MM - 20, PLACES_MM - 20, title="eflesh").count('id="patch_') == 5


def test_same_data_same_bytes_other_data_other_bytes():
    assert draw() == draw()
    assert draw() != error_grid(PLACES_MM, PLACES_MM + np.arange(12)[:, None], title="lab (recorded), lobo")
