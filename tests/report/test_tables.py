import json

import pyarrow as pa
import pytest

from pipeline.report.formatting import OF_PAPER, rounded, show, show_digits, to_markdown
from pipeline.report.numbers import add_up, compose, foretold, lost_by_protocol
from pipeline.report.paper import TABLE_2
from pipeline.report.readme import fill
from pipeline.report.table1 import NOT_GIVEN, OURS
from pipeline.report.tables import make_tables
from pipeline.statistics import tidy
from reskin.errors import SchemaError
from tests.report import cards


def card(experiment: str, fold: str, accuracy_pct: float, recipe: str = "paper") -> dict:
    one = {"accuracy_pct": accuracy_pct, "mse_xy_mm2": 1.0, "mse_f_N2": 0.5}
    skins = {"s0": one, "s1": {**one, "accuracy_pct": accuracy_pct + 10}}
    board = fold if experiment == "lobo" else "b0"
    scores = {"all": one, "registered": one, "by_skin": skins, "board_of": dict.fromkeys(skins, board)}
    return cards.card(experiment, fold, scores | {"rows_n": 20}, recipe)


CARDS = [
    card("lobo", "b0", 80.0), card("lobo", "b1", 90.0), card("lobo", "b0", 1.0, "released"),
    card("transfer", "s0", 20.0),
]  # fmt: skip
ACCOUNTS = [
    {
        "bytes_n": 85,
        "frames_n": 1,
        "skipped_resync_bytes_n": 1,
        "skipped_truncated_bytes_n": 2,
        "clock_explained_pct": 9,
    },
    {"bytes_n": 164, "frames_n": 2, "skipped_resync_bytes_n": 0},
]


def numbers(made: list[dict] = CARDS, source: str = "recorded") -> dict:
    provenance = {"source": source, "scene": "x", "git": "y", "seed": 1, "device": "z", "seconds": 1.0}
    return {"provenance": provenance, **compose(tidy(made), ACCOUNTS, {"low_force_rows_n": 3}, headline="paper")}


def test_pooled_numbers_are_over_boards_and_single_ones_over_pairs_of_skins():
    table2 = numbers()["table2"]
    spread = pytest.approx(50**0.5)
    assert table2["multi"]["accuracy_pct"] == {"mean": 85.0, "n": 2, "sd": spread, "values": [80.0, 90.0]}
    pairs = {"mean": 25.0, "n": 2, "sd": spread, "training_n": 1, "boards_n": 1}
    assert table2["single"]["accuracy_pct"] == pairs


def test_what_tells_a_place_before_its_touch_stands_below_the_split_that_it_was_scored_on():
    columns = {"question": ["single_temporal"] * 4, "fold": ["s0", "s0", "s1", "s1"], "told_by": ["noload", "scan"] * 2}
    told = pa.table(columns | {"accuracy_pct": [10.0, 99.0, 20.0, 97.0], "mse_xy_mm2": [9.0, 0.1, 8.0, 0.3]})
    shown = numbers([card("single_temporal", "s0", 95.0)])
    table = make_tables(shown | foretold([told]))["single_sensor"]
    assert table["accuracy, % (ours)"].str.partition(" ")[0].tolist() == ["95", "15", "98"]
    assert ["no-load" in row or "number" in row for row in table["model"]] == [False, True, True]
    assert set(table["MSE_F, N² (ours)"][1:]) == {"–"}
    assert "before the touch" in table.attrs["meaning"]
    assert len(make_tables(shown)["single_sensor"]) == 1


def test_an_experiment_that_was_not_asked_is_absent_and_not_null():
    only_single = numbers([card("single_temporal", "s0", 99.0)])
    assert "table2" not in only_single
    assert "lobo" not in only_single
    assert only_single["single_sensor"]["split"] == "single_temporal"
    assert "null" not in json.dumps(only_single)


def test_three_ways_to_split_one_skin_stand_side_by_side_and_the_papers_first():
    ways = {"single_pass": 70.0, "single_indentation": 80.0, "single_random": 90.0}
    shown = numbers([card(experiment, "repeat0", accuracy_pct) for experiment, accuracy_pct in ways.items()])
    single = shown["single_sensor"]
    assert single["split"] == "single_random"
    means = [one["accuracy_pct"]["mean"] for one in (single, single["by_indentation"], single["by_pass"])]
    assert means == [90.0, 80.0, 70.0]
    table = make_tables(shown)["single_sensor"]
    assert table["accuracy, % (ours)"].tolist() == ["90", "80", "70"]
    assert all(table["accuracy, % (paper)"] == "99.58 ± 0.34")
    assert "the paper's way" in table["model"][0]


def test_variants_stand_apart_from_the_headline():
    assert numbers()["variants"]["lobo"]["released"]["accuracy_pct"]["mean"] == 1.0


def test_accounts_add_up():
    assert add_up(ACCOUNTS) == {
        "captures_n": 2, "bytes_n": 249, "frames_n": 3, "skipped_resync_bytes_n": 1, "skipped_truncated_bytes_n": 2,
        "lost_bytes_n": 3,
    }  # fmt: skip


def test_losses_of_further_protocols_stand_under_their_names_and_not_under_the_main_ones():
    wear = {"accounts": ACCOUNTS, "left_out": {}}
    losses = {
        "drift": wear | {"left_out": {"low_force_rows_n": 4}},
        "variation": wear,  # of the same captures: counted once
        "shear": {"accounts": ACCOUNTS[1:], "left_out": {"low_force_rows_n": 7}},
        "contacts": {"accounts": [], "left_out": {}},  # asks the main captures
    }
    found = lost_by_protocol(losses)
    assert set(found) == {"wear", "drag"}
    assert found["wear"] == add_up(ACCOUNTS) | {"left_out": {"low_force_rows_n": 4}}
    assert (found["drag"]["captures_n"], found["drag"]["bytes_n"]) == (1, 164)
    shown = make_tables(numbers() | {"capture_by_protocol": found})["captures"].set_index(["protocol", "what"])["count"]
    assert shown["main", "bytes_n"] == shown["wear", "bytes_n"] == "249"
    assert shown["drag", "left out of training: low_force_rows_n"] == "7"
    assert ("drag", "lost_bytes_n") not in shown  # nothing was lost
    assert shown["wear", "lost_bytes_n"] == "3"


def test_every_table_says_where_its_rows_come_from():
    for source in ("simulated", "recorded"):
        tables = make_tables(numbers(source=source))
        ours = tables.pop("table1")[OURS]  # the paper's own table, our column beside it
        assert all(cell == NOT_GIVEN or cell.endswith(f", {source}") for cell in ours)
        assert any(cell != NOT_GIVEN for cell in ours)
        for table in tables.values():
            assert set(table["source"]) == {source}


def test_the_papers_numbers_stand_beside_ours():
    text = to_markdown(make_tables(numbers())["table2"])
    for value in TABLE_2["multi"].values():
        assert f"{value[0]:g} ± {value[1]:g}" in text  # as published, no digit less
    assert "85 ± 7.1" in text


def test_one_training_skin_is_not_called_pooled():
    alone = numbers([{**one, "train_skins": ["s9"]} for one in CARDS])
    (row,) = [name for name in make_tables(alone)["table2"]["model"] if "board" in name]
    assert row == "Leave-one-board-out, one training skin (paper: single-sensor)"
    assert "84.43" not in to_markdown(make_tables(alone)["table2"])


def test_a_table_of_scores_says_what_they_mean():
    tables = make_tables(numbers())
    assert "within 1 mm" in to_markdown(tables["table2"])
    assert "within 1 mm" not in to_markdown(tables["captures"])


def test_a_number_that_is_not_known_is_a_dash():
    unknown = card("single_temporal", "s0", 99.0)
    del unknown["scores"]["all"]["mse_f_N2"]
    table = make_tables(numbers([unknown]))["single_sensor"]
    assert table["MSE_F, N² (ours)"].tolist() == ["–"]


def test_a_spread_over_seeds_is_shown_and_called_so():
    assert show({"mean": 99.7, "n": 1, "sd_seeds": 0.04}) == "99.7 ± 0.04 (seeds)"
    assert show({"mean": 99.7, "n": 2, "sd": 1.0, "sd_seeds": 0.04}) == "99.7 ± 1 ± 0.04 (seeds)"
    of_boards = {"mean": 99.7, "n": 2, "sd": 1.0, "ci95": [90.7, 108.7], "sd_seeds": 0.04}
    assert show(of_boards) == "99.7 [90.7, 108.7] ± 0.04 (seeds)"
    few = {"mean": 85.0, "n": 2, "sd": 7.0, "values": [80.0, 90.0]}
    assert (show(few), show_digits(few, 1)) == ("85 (80; 90)", "85.0 (80.0; 90.0)")
    assert show_digits(of_boards, 2) == "99.70 [90.70, 108.70] ± 0.04 (seeds)"


@pytest.mark.parametrize(("value", "kept"), [(1234567.8, 1234570.0), (0.000123456789, 0.000123457), (0.0, 0.0)])
def test_rounding_keeps_six_digits(value, kept):
    assert rounded({"a": [value, 3]}) == {"a": [kept, 3]}


def test_generated_blocks_replace_only_what_is_between_their_marks():
    pages = {"one.md": "before\n<!-- a -->\nold\n<!-- /a -->\nafter\n", "other.md": "a\n"}
    assert fill(pages, {"a": "new"}) == pages | {"one.md": "before\n<!-- a -->\nnew\n<!-- /a -->\nafter\n"}
    assert fill(fill(pages, {"a": r"\1 new"}), {"a": r"\1 new"}) == fill(pages, {"a": r"\1 new"})
    with pytest.raises(SchemaError, match="the block b must be in one page; got no page"):
        fill(pages, {"b": "new"})
    with pytest.raises(SchemaError, match="in one page; got one.md, other.md"):
        fill(pages | {"other.md": pages["one.md"]}, {"a": "new"})


def test_all_metrics_have_a_column():
    assert {metric for row in TABLE_2.values() for metric in row} == set(OF_PAPER)
