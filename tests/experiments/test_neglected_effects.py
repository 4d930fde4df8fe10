"""Tests of the errors caused by physical effects that a simulation neglects, against closed forms and scaling laws."""

import numpy as np
import pytest

from pipeline.experiments import neglected_effects
from pipeline.experiments.neglected_effects import AGEING, RELAXATION, measure, neglected_effects_table
from reskin.physics.aging import relaxed_share, softening
from reskin.physics.board import draw_board
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import changes_of_field, draw_skin
from tests.simulation.scene import AGEING as SIZES
from tests.simulation.scene import GRID, synthesis, with_protocol

FEW = GRID | {"passes_n": 1}
INDENTATIONS_N = 130


@pytest.fixture(autouse=True, scope="module")
def few_nodes():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neglected_effects, "COARSE", Quadrature(2e-3, 3))
        yield


def rows_of(scene):
    return {row.term: row for row in measure(scene, seed=1)}


@pytest.fixture(scope="module")
def rows(few_nodes):
    """Return the table row of each effect, by its name."""
    return rows_of(with_protocol("grid", FEW))


@pytest.fixture
def not_inside(monkeypatch):
    """Replace the computation of the effects inside the skin, which takes most of the time, by an empty result."""
    monkeypatch.setattr(neglected_effects, "_inside", lambda on: [])


def test_effects_that_the_main_protocol_neglects_are_marked(rows, not_inside):
    assert {term for term, row in rows.items() if row.done == "left out"} == {
        "ageing", "relaxation", "memory", "temperature", "friction", "the earth's field", "the skin's free edge",
        "the powder's own field",
    }  # fmt: skip
    assert rows["friction"].field_pct == rows["friction"].force_pct == 0  # Friction acts only if the tip is dragged.
    aged = rows_of(with_protocol("grid", FEW | {"terms": ["ageing"]}, terms={"ageing": SIZES}))
    assert aged["ageing"].done == "kept"


def test_row_of_an_effect_names_the_protocols_that_neglect_and_compute_it(rows, not_inside):
    wear = FEW | {"skins_n": 1, "terms": ["ageing"]}
    found = rows_of(with_protocol("wear", wear, protocols={"grid": FEW, "wear": wear}, terms={"ageing": SIZES}))
    assert (found["ageing"].left_out_by, found["ageing"].computed_by) == (("grid",), ("wear",))
    assert found["ageing"].done == "left out"  # The main protocol neglects ageing.
    assert found["ageing"].force_pct == rows["ageing"].force_pct
    assert (found["friction"].left_out_by, found["friction"].computed_by) == (("grid", "wear"), ())
    assert found["the powder's own field"].left_out_by == found["the chips' steps"].computed_by == ()


def test_force_errors_of_neglected_ageing_and_relaxation_equal_closed_forms(rows):
    left = softening(np.array([INDENTATIONS_N - 1]), settling=AGEING.settling, ageing=AGEING.ageing)[0]
    assert rows["ageing"].force_pct == pytest.approx(100 * (1 / left - 1), rel=1e-9)
    assert rows["relaxation"].force_pct == pytest.approx(100 * (1 / relaxed_share(RELAXATION) - 1), rel=1e-9)
    # The depth of a press is given, so these effects change only the force, and not the field.
    assert rows["ageing"].field_pct == rows["relaxation"].field_pct == 0


def test_neglecting_one_kelvin_changes_the_field_by_0_12_percent(rows):
    scene = synthesis()
    board = draw_board(scene.main_boards.design, scene.spreads, seed=1, name="b0")
    skin = draw_skin(scene.skin, scene.spreads, seed=1, name="b0_s0", rule=scene.main_boards.quadrature.in_si())
    rest_T, _ = changes_of_field(board, skin, np.zeros((0, 3)))
    assert rows["temperature"].field_pct == pytest.approx(100 * (1 / 0.9988 - 1), rel=1e-6)
    assert rows["temperature"].rest_uT == pytest.approx(0.0012e6 * np.abs(rest_T).max(), rel=1e-6)


def test_constant_external_field_is_removed_by_the_no_load_reading(rows):
    assert 0 < rows["the earth's field"].field_pct < 1e-6  # Only rounding errors remain.
    assert rows["the earth's field"].rest_uT == pytest.approx(45)


def test_table_states_how_much_neglecting_an_included_effect_would_change_the_field(rows):
    # Computing the deformation in increments changes the field of a bonded skin at 1.2 mm by 16-23 %. On a sliding
    # skin, the change is smaller, because most of the field change is due to the distant motion, which is linear in the
    # depth.
    assert rows["increments"].field_pct > 2
    assert rows["rotation of the magnetisation"].field_pct > 5
    assert rows["slipping base"].field_pct > 50
    assert rows["the chips' steps"].field_pct < 0.5


def test_springs_that_hold_the_skin_on_its_base_are_listed_as_an_included_effect(rows, not_inside):
    hold = {
        "give_um": (48.0, 7.0),
        "away_um_mm": 6.0,
        "lets_go_mm2": 40.0,
        "springs_N_mm": 7.0,
        "friction": 0.8,
    }
    found = rows_of(with_protocol("grid", FEW, skin=synthesis("skin", hold=hold).skin.model_dump()))
    assert "the base's hold" not in rows
    assert found["the base's hold"].done == "kept"
    assert found["the base's hold"].field_pct > 10


def test_error_of_the_neglected_field_of_the_powder_is_proportional_to_its_amount(rows, not_inside):
    half = rows_of(with_protocol("grid", FEW, skin=synthesis("skin", saturation_T=0.055).skin.model_dump()))
    # The tolerance is 10 %, because the magnetisation is not quite linear in the magnetising field, which is half as
    # strong.
    assert half["the powder's own field"].field_pct == pytest.approx(
        rows["the powder's own field"].field_pct / 2, rel=0.1
    )


def test_each_row_describes_how_its_error_is_computed(rows):
    assert all(row.how for row in rows.values())


def table_row(term: str, done: str, left_out_by: list[str], computed_by: list[str]) -> dict:
    sizes = {"field_pct": 12.3, "rest_uT": None, "force_pct": 0.5}
    return {"term": term, "done": done, "how": "so"} | sizes | {"left_out_by": left_out_by, "computed_by": computed_by}


TABLE_ROWS = [
    table_row("temperature", "kept", [], ["grid", "wear"]),
    table_row("ageing", "left out", ["grid", "flexible"], ["wear"]),
    table_row("the earth's field", "left out", [], []),
]


def test_table_lists_the_protocols_of_each_effect():
    table = neglected_effects_table(TABLE_ROWS, "simulated").set_index("effect")
    assert table["in this scene"].to_dict() == {
        "ageing": "neglected: grid, flexible; computed: wear",
        "the earth's field": "neglected",
        "temperature": "computed: grid, wear",
    }
    # The effects that the main protocol neglects come first. The main protocol includes temperature, so temperature is
    # last.
    assert table.index[-1] == "temperature"
    assert table.loc["ageing"].tolist()[1:] == ["12", "–", "0.5", "so", "simulated"]


def test_caption_names_the_main_protocol():
    assert "the main protocol of this scene" in neglected_effects_table(TABLE_ROWS, "simulated").attrs["meaning"]
