"""The table of neglected effects: protocols that neglect and compute each, and the order of rows."""

from pipeline.experiments.neglected_effects import neglected_effects_table


def effect(term: str, done: str, left_out_by: list[str], computed_by: list[str]) -> dict:
    sizes = {"field_pct": 12.3, "rest_uT": None, "force_pct": 0.5}
    return {"term": term, "done": done, "how": "so"} | sizes | {"left_out_by": left_out_by, "computed_by": computed_by}


ROWS = [
    effect("temperature", "kept", [], ["grid", "wear"]),
    effect("ageing", "left out", ["grid", "flexible"], ["wear"]),
    effect("the earth's field", "left out", [], []),
]


def test_each_effect_lists_its_protocols():
    table = neglected_effects_table(ROWS, "simulated").set_index("effect")
    assert table["in this scene"].to_dict() == {
        "ageing": "neglected: grid, flexible; computed: wear",
        "the earth's field": "neglected",
        "temperature": "computed: grid, wear",
    }
    assert table.index[-1] == "temperature"  # what the main protocol neglects stands first
    assert table.loc["ageing"].tolist()[1:] == ["12", "–", "0.5", "so", "simulated"]


def test_the_caption_names_the_main_protocol():
    assert "under the main protocol" in neglected_effects_table(ROWS, "simulated").attrs["meaning"]
