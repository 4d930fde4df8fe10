"""Tests of `reskin model make`: a layout is compared by what it states, not only by its name."""

import pytest

from pipeline.training.board_model import make
from reskin.errors import ParamsError
from reskin.layouts import FOLDER


def test_name_of_the_papers_board_is_refused_for_another_geometry(tmp_path):
    layout = tmp_path / "other.yaml"
    layout.write_text((FOLDER / "reskin.yaml").read_text().replace("gap_mm: 1.6", "gap_mm: 2"))
    with pytest.raises(ParamsError, match=r"other\.yaml: name reskin"):
        make(layout, tmp_path / "model.safetensors")
    assert list(tmp_path.iterdir()) == [layout]
