"""What the report says of fields from outside: every arm where it was tried, units, and the earth's field."""

from pipeline.experiments.ambient import figures, tables
from tests.report.synthetic import texts_of


def scores(accuracy, boards_n):
    return {name: {"mean": accuracy, "n": boards_n} for name in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2")}


def rows(boards_n):
    arms = {"a": scores(80.0, boards_n), "b": scores(70.0, boards_n), "c": scores(60.0, 1)}
    iron = {"distance_mm": 2.0, "field_uT": 44.0, "aside_field_uT": 2.0}
    return {"uniform": [{"field_uT": 0.0} | arms, {"field_uT": 50.0} | arms], "iron": [iron | arms]}


NUMBERS = {
    "arms": {"a": "as it is", "b": "a chip more", "c": "trained anew"}, "boards_n": 3, "seeds_n": 2,
    "directions": "random", "earth_uT": 50.0, "earth_dip_deg": 66.0, "iron_radius_mm": 10.0, **rows(3),
    "last_board": {"board": "b2"} | rows(1),
}  # fmt: skip


def test_an_arm_of_one_board_stands_beside_others_on_that_board_alone():
    table = tables(NUMBERS, "simulated")["ambient"]
    assert set(table[table["boards"] == "all held out"]["method"]) == {"a", "b"}
    assert table[table["boards"] == "b2"]["method"].tolist() == ["a", "b", "c"] * 3
    assert set(table["source"]) == {"simulated"}
    assert "iron at 2 mm (44 µT at the chips)" in set(table["field"])
    assert "20 mm across" in table.attrs["meaning"]


def test_the_figure_names_arms_units_the_earth_the_board_and_the_source():
    drawn = figures(NUMBERS, {}, "simulated")
    words = texts_of(drawn["ambient.svg"])
    for word in ("a", "b", "c", "uniform field / µT", "iron ball above the skin / mm", "earth", "b2", "(simulated)"):
        assert word in words.split() or word in words
    assert figures(NUMBERS, {}, "simulated") == drawn
