"""Tests of the conversion of labels and readings to the axes of a board."""

import numpy as np

from pipeline.fitting.axes import BoardAxes
from reskin.universal.layout import paper_layout

LAYOUT = paper_layout()
AXES = BoardAxes(LAYOUT.setup(), LAYOUT.law, (90.0,) * 5, (8.0, 7.0), labels_mirrored=True, stated_by="a test")


def test_places_and_fields_are_converted_to_the_axes_of_the_board():
    label_mm = np.array([[8.0, 7.0], [9.0, 10.0]])
    np.testing.assert_allclose(AXES.place(label_mm), [[0, 0], [1, -3]])
    np.testing.assert_allclose(AXES.label(AXES.place(label_mm)), label_mm)
    rotated = AXES.field(np.tile([1.0, 2.0, 3.0], 5)[None])
    np.testing.assert_allclose(rotated, np.tile([-2.0, 1.0, 3.0], 5)[None])
