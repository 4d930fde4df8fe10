"""Tests of the geometry that simulated boards take from the layouts."""

import shutil

import pytest

from reskin import layouts
from reskin.errors import ParamsError


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return a layout file of the user, in a copy of the folder of layouts."""
    shutil.copytree(layouts.FOLDER, tmp_path / "layouts")
    monkeypatch.setattr(layouts, "FOLDER", tmp_path / "layouts")
    return shutil.copy(tmp_path / "layouts/reskin.yaml", tmp_path / "layouts/mine.yaml")


def change(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_own_layout_has_its_own_gap_and_chips(mine):
    change(mine, "gap_mm: 1.6", "gap_mm: 2.0")
    change(mine, "{x_mm: -7.0,", "{x_mm: -6.0,")
    found, usual = layouts.geometry("mine"), layouts.geometry("reskin")
    assert (found["design"]["gap_mm"], usual["design"]["gap_mm"]) == (2.0, 1.6)
    assert found["design"]["chips_xy_mm"][1] == [-6.0, 0.0]
    kind = {"letter": "b", "layout": "mine"}
    assert layouts.with_geometry(kind) == {"letter": "b"} | found
    stated = {"letter": "b"} | usual  # without a layout, the geometry that is stated is kept
    assert layouts.with_geometry(stated) == stated


def test_eight_boards_lie_under_the_skin_of_the_sleeve():
    found = layouts.geometry("sleeve")
    assert found["design"]["tiles"] == {"columns_n": 2, "rows_n": 4, "pitch_mm": 25.4}
    assert found["skin_mm"] == [50.8, 101.6]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("gap_mm: 1.6", "gap_um: 1600", r"mine.yaml: gap_mm is missing"),
        ("gap_mm: 1.6", "gap_mm: -2", r"mine.yaml: gap_mm must be greater than 0"),
        ("chips:", "chip:", r"mine.yaml: chips is missing"),
        ("turn_deg: 180", "turn_deg: 45", r"mine.yaml: chips.1.turn_deg"),
        ("polarity: checkerboard", "polarity: same", r"mine.yaml: skin.polarity differs from reskin.yaml"),
    ],
)
def test_wrong_layouts_are_refused_by_file_and_key(mine, old, new, message):
    change(mine, old, new)
    with pytest.raises(ParamsError, match=message):
        layouts.geometry("mine")


def test_layout_and_design_exclude_each_other():
    with pytest.raises(ParamsError, match="design cannot be set together with layout"):
        layouts.with_geometry({"layout": "reskin", "design": {"gap_mm": 9.0}})


def test_skins_of_other_kinds_cannot_be_simulated():
    with pytest.raises(ParamsError, match="eflesh.yaml: .*skin.thickness_mm"):
        layouts.geometry("eflesh")
