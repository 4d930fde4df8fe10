"""Tests of section `compare`, which states how the recorded boards of a scene are oriented."""

import numpy as np
import pytest

from pipeline.settings import Settings
from pipeline.training.recorded import Compare
from reskin.config import read_yaml
from reskin.errors import ParamsError
from reskin.universal.layout import FOLDER, paper_layout
from tests.universal.recorded import DESIGN, LAB

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
        ({"skin_mm": [20.0, 20.0]}, "skin_mm cannot be set together with layout"),
        ({"layout": SQUARE | {"gap": 1.0}}, "compare.layout: gap is not a known parameter"),
    ],
)
def test_layout_that_a_scene_states_wrongly_is_refused(changes, message):
    with pytest.raises(ParamsError, match=message):
        section(**{"layout": SQUARE, "labels_mirrored": False} | changes)


def test_layout_of_a_scene_is_the_layout_of_its_models():
    of_layout = section(layout=SQUARE, labels_mirrored=False)
    assert of_layout.board_layout("mine").name == "square"
    assert of_layout.axes(DESIGN).labels_middle_mm == (10.0, 12.0)


def test_scene_lab_has_the_layout_of_the_paper_with_its_own_gap_and_name():
    lab = section(**read_yaml(LAB)["compare"])
    assert lab.board_layout("lab") == paper_layout().model_copy(update={"name": "lab", "gap_mm": 1.1})
    np.testing.assert_allclose(lab.board_layout("lab").turns_deg, lab.axes(DESIGN).turns_deg)


def test_layout_cannot_have_chips_that_are_turned_by_45_degrees():
    content = read_yaml(LAB)["compare"]
    turned = section(**content | {"design": content["design"] | {"chips_turn_deg": [45.0, 0.0, 0.0, 0.0, 0.0]}})
    with pytest.raises(ParamsError, match=r"scene mine: compare: chips\.0\.turn_deg"):
        turned.board_layout("mine")
