"""The table of omissions: who does without a term, who computes it, and what stands first."""

from pipeline.experiments.left_out import left_out_table


def omission(term: str, done: str, left_out_by: list[str], computed_by: list[str]) -> dict:
    sizes = {"field_pct": 12.3, "rest_uT": None, "force_pct": 0.5}
    return {"term": term, "done": done, "how": "so"} | sizes | {"left_out_by": left_out_by, "computed_by": computed_by}


ROWS = [
    omission("temperature", "kept", [], ["grid", "wear"]),
    omission("ageing", "left out", ["grid", "flexible"], ["wear"]),
    omission("the earth's field", "left out", [], []),
]


def test_each_term_names_its_protocols_and_the_rest_say_what_is_done():
    table = left_out_table(ROWS, "simulated").set_index("term")
    assert table["in this scene"].to_dict() == {
        "ageing": "left out: grid, flexible; computed: wear",
        "the earth's field": "left out",
        "temperature": "computed: grid, wear",
    }
    assert table.index[-1] == "temperature"  # what the main protocol leaves out stands first
    assert table.loc["ageing"].tolist()[1:] == ["12", "–", "0.5", "so", "simulated"]


def test_the_table_says_that_costs_are_those_of_the_main_protocol():
    assert "under the main protocol" in left_out_table(ROWS, "simulated").attrs["meaning"]
