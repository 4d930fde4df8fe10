"""Tests of board layouts: the layouts in the project are valid, and wrong files are refused with a message."""

import numpy as np
import pytest

from reskin.errors import ParamsError
from reskin.layouts import FOLDER
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import SkinDesign
from reskin.simulation.defaults import nominal
from reskin.universal import law
from reskin.universal.layout import paper_layout, read_layout
from reskin.universal.population import NOMINAL, NOMINAL_SPREADS, Forces, draw_places, grid

TEXT = (FOLDER / "reskin.yaml").read_text()


def test_layout_of_the_papers_board_equals_the_constants_of_the_shipped_model():
    layout = paper_layout()
    setup = layout.setup()
    filler_T, skin = setup.design.saturation_T, SkinDesign.model_validate(nominal("skin") | {"hold": setup.design.hold})
    assert skin == setup.design.model_copy(update={"saturation_T": filler_T * layout.skin.magnetisation})
    paper_area = law.Area(half_x_mm=law.HALF_MM, half_y_mm=law.HALF_MM, octagon=True)
    assert (setup.rule, setup.coarse_rule, setup.area) == (law.RULE, law.COARSE, paper_area)
    assert (layout.law, layout.all_spreads, layout.forces) == (NOMINAL, NOMINAL_SPREADS, Forces(light_share=0.2))
    np.testing.assert_array_equal(layout.reach_mm, [[-10, -10], [10, 10]])


@pytest.mark.parametrize("name", ["reskin", "anyskin", "eflesh"])
def test_layouts_of_the_project_can_be_simulated(name):
    layout = read_layout(name)
    places_mm = np.zeros((2, 2))
    places_mm[1] = 0.9 * np.array(layout.half_mm) / 1.5
    db_uT = law.simulate_uT(layout.law, layout.setup(), places_mm, np.array(layout.force_N))
    assert db_uT.shape == (2, len(layout.chips), 3)
    # A press with the largest force must change the field by more than the noise, and by less than a chip's range.
    assert 10 < np.abs(db_uT[1]).max() < 50_000


def test_grid_is_scaled_to_the_area_and_octagons_exclude_its_corners():
    wide = law.Area(half_x_mm=12.0, half_y_mm=6.0, octagon=True)
    np.testing.assert_array_equal(grid(wide), grid(paper_layout().area) * [1.5, 0.75])
    inner_mm = np.random.default_rng(0).uniform(-1, 1, (500, 2)) * [12.0, 6.0]
    octagon = (np.abs(inner_mm) / [12.0, 6.0]).sum(axis=1) <= 1.5
    found = law.inside(inner_mm, wide)
    assert found[octagon].all()
    assert not found.all()
    assert law.inside(inner_mm, law.Area(half_x_mm=12.0, half_y_mm=6.0, octagon=False)).all()
    assert law.inside(draw_places(np.random.default_rng(1), wide), wide).all()


def test_larger_skin_has_larger_cells_of_the_quadrature():
    large = TEXT.replace("size_mm: [20.0, 20.0]", "size_mm: [20.0, 40.0]")
    assert large != TEXT
    assert read_text(large).setup().rule == Quadrature(1.6e-3, 5)


def read_text(text):
    from reskin.config import YAML
    from reskin.universal.layout import as_layout

    return as_layout(YAML(typ="safe").load(text), "mine.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("turn_deg: 180", "turn_deg: 45", "chips.1.turn_deg must be 0, 90, 180 or 270; got 45"),
        ("x_mm: 7.0", "x_mm: 0.0", r"chips 0 and 3 are at the same place \(0.0, 0.0\) mm. Correct these settings"),
        ("x_mm: 7.0", "x_mm: 0.007", "two chips are 0.007 mm apart, but the smallest distance is 0.5 mm"),
        ("centre_mm: [8.0, 8.0]", "centre_mm: [8.0]", "centre_mm.1 is missing. Add this key"),
        (
            "half_x_mm: 8.0",
            "half_x_mm: 9.8",
            "half the skin's size is 10; the area must end 0.5 mm or more before the edge",
        ),
        ("gap_mm: 1.6", "gap_mm: 0.1", "gap_mm must be greater than or equal to 0.8; got 0.1"),
        ("gap_mm: 1.6", "gap: 1.6", "gap is not a known parameter"),
        ("tip_radius_mm: 2.0", "", "tip_radius_mm is missing"),
        (
            "tip_radius_mm: 2.0",
            "tip_radius_mm: 1.0",
            "tip_radius_mm is 1, but must be above 1.81 for a skin with a thickness of 2 mm",
        ),
        ("polarity: checkerboard", "polarity: chequer", "skin.polarity must be 'checkerboard' or 'same'; got"),
        ("half_x_mm: 8.0", "half_x_mm: 11.0", "area.half_x_mm is 11, but half the skin's size is 10"),
        ("force_N: [0.05, 9.5]", "force_N: [5.0, 9.5]", "the second value .the largest force. must be at least twice"),
        ("spreads: {}", "spreads: {gap: 1.0}", "gap is not a parameter of the law .* Did you mean gap_mm"),
        ("name: reskin", "name: my board", "name must be"),
        ("chips:", "chips: []\nchips_of_mine:", "chips_of_mine is not a known parameter"),
    ],
)
def test_wrong_layouts_are_refused(old, new, message, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(TEXT.replace(old, new))
    assert file.read_text() != TEXT
    with pytest.raises(ParamsError, match=f"mine.yaml: .*{message}"):
        read_layout(file)


def test_missing_layout_files_are_reported(tmp_path):
    with pytest.raises(ParamsError, match="none.yaml: file not found"):
        read_layout(tmp_path / "none.yaml")
    with pytest.raises(
        ParamsError, match="reskim: this is neither a YAML file nor .*anyskin, eflesh, .*reskin.*Did you mean reskin"
    ):
        read_layout("reskim")
