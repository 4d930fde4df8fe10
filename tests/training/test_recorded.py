"""Tests of section `compare`, which states how the recorded boards of a scene are oriented."""

import numpy as np
import pytest

from pipeline.settings import Settings
from pipeline.training.recorded import Compare
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.layouts import FOLDER
from reskin.universal.layout import read_layout
from tests.fitting.recorded import LAB

SQUARE = read_yaml(FOLDER / "reskin.yaml") | {"name": "square", "centre_mm": [10.0, 12.0]}


def section(**content: object) -> Compare:
    return Settings("mine", "mine.yaml", {"compare": content}, {}).section(Compare, "compare")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"layout": "my_board.yaml"},
            "my_board.yaml is the name of a file, .* Replace the name by the content",
        ),
        ({"layout": "reskim"}, "reskim: this is neither a YAML file.*Did you mean reskin"),
        ({"skin_mm": [20.0, 20.0]}, "skin_mm is not a known parameter"),
        ({"layout": SQUARE | {"gap": 1.0}}, "compare: layout.gap is not a known parameter"),
    ],
)
def test_layout_that_a_scene_states_wrongly_is_refused(changes, message):
    with pytest.raises(ParamsError, match=message):
        section(**{"layout": SQUARE, "labels_mirrored": False} | changes)


def test_labels_have_their_middle_at_the_centre_of_the_layout():
    axes = section(layout=SQUARE, labels_mirrored=False).axes
    assert axes.labels_middle_mm == (10.0, 12.0)
    np.testing.assert_array_equal(axes.place(np.array([[10.0, 12.0]])), [[0.0, 0.0]])


def test_scene_lab_names_the_layout_of_the_paper():
    assert section(**read_yaml(LAB)["compare"]).layout == read_layout("reskin")
