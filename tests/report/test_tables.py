"""Tests of the tables in the report, which contain our numbers, those of the paper, and the source of the data."""

import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.formatting import PAPER_METRICS, TITLES, rounded, show, show_digits, to_markdown
from pipeline.paper import TABLE_2
from pipeline.report.figures import IN_CONTEXT
from pipeline.report.numbers import add_up, before_touch_numbers, learning_numbers, lost_by_protocol
from pipeline.report.readme import fill
from pipeline.report.table_2 import CONTROL, models
from pipeline.report.tables import (
    HELD_OUT,
    LOCALISATION,
    NOT_GIVEN,
    OURS,
    accuracy_and_cost_table,
    extremes_table,
    make_tables,
    measured,
    read_table1,
    run_tables,
    skins_table,
    summary_table,
    table1,
)
from pipeline.scores import make_table, rows_of_cards
from pipeline.statistics import as_json
from reskin.errors import ParamsError, SchemaError
from tests.report import synthetic
from tests.report.synthetic import all_experiments, cost, new_board, stat


def card(experiment: str, fold: str, accuracy_pct: float, recipe: str = "paper") -> dict:
    one = {"accuracy_pct": accuracy_pct, "mse_xy_mm2": 1.0, "mse_f_N2": 0.5}
    skins = {"s0": one, "s1": {**one, "accuracy_pct": accuracy_pct + 10}}
    board = fold if experiment == "lobo" else "b0"
    scores = {"all": one, "registered": one, "by_skin": skins, "board_of": dict.fromkeys(skins, board)}
    return synthetic.card(experiment, fold, scores | {"rows_n": 20}, recipe)


CARDS = [
    card("lobo", "b0", 80.0), card("lobo", "b1", 90.0), card("lobo", "b0", 1.0, "released"),
    card("transfer", "s0", 20.0),
]  # fmt: skip
COUNTS = [
    {
        "bytes_n": 85,
        "frames_n": 1,
        "skipped_resync_bytes_n": 1,
        "skipped_truncated_bytes_n": 2,
        "clock_explained_pct": 9,
    },
    {"bytes_n": 164, "frames_n": 2, "skipped_resync_bytes_n": 0},
]


def numbers(cards: list[dict] = CARDS, source: str = "recorded") -> dict:
    provenance = {"source": source, "scene": "x", "git": "y", "seed": 1, "device": "z", "seconds": 1.0}
    capture = add_up(COUNTS) | {"left_out": {"low_force_rows_n": 3}}
    return {
        "provenance": provenance,
        "capture": capture,
        **as_json(learning_numbers(rows_of_cards(cards), headline="paper")),
    }


def test_scores_of_table_2_are_means_over_boards_or_pairs_of_skins():
    table2 = numbers()["table2"]
    spread = pytest.approx(50**0.5)
    assert table2["multi"]["accuracy_pct"] == {"mean": 85.0, "n": 2, "sd": spread, "values": [80.0, 90.0]}
    pairs = {"mean": 25.0, "n": 2, "sd": spread, "training_n": 1, "boards_n": 1}
    assert table2["single"]["accuracy_pct"] == pairs


def test_table_has_scores_of_predictions_from_readings_before_touch():
    predicted = make_table(
        {"experiment": "single_temporal", "fold": fold, "method": method, "accuracy_pct": accuracy, "mse_xy_mm2": mse}
        for fold, method, accuracy, mse in (
            ("s0", "noload", 10.0, 9.0), ("s0", "scan", 99.0, 0.1),
            ("s1", "noload", 20.0, 8.0), ("s1", "scan", 97.0, 0.3),
        )
    )  # fmt: skip
    shown = numbers([card("single_temporal", "s0", 95.0)])
    table = make_tables(shown | as_json(before_touch_numbers(predicted)))["single_sensor"]
    assert table["accuracy, % (ours)"].str.partition(" ")[0].tolist() == ["95", "15.0", "98.0"]
    assert ["no-load" in row or "number" in row for row in table["model"]] == [False, True, True]
    assert set(table["MSE_F, N² (ours)"][1:]) == {"–"}
    assert "do not use the field change" in table.attrs["meaning"]
    assert len(make_tables(shown)["single_sensor"]) == 1


def test_missing_experiment_has_no_table():
    only_single = numbers([card("single_temporal", "s0", 99.0)])
    assert "table2" not in only_single
    assert "lobo" not in only_single
    assert only_single["single_sensor"]["split"] == "single_temporal"
    assert "null" not in json.dumps(only_single)


def test_split_of_the_paper_is_first_in_the_table():
    accuracy_by_split = {"single_pass": 70.0, "single_indentation": 80.0, "single_random": 90.0}
    shown = numbers(
        [card(experiment, "repeat0", accuracy_pct) for experiment, accuracy_pct in accuracy_by_split.items()]
    )
    single = shown["single_sensor"]
    assert single["split"] == "single_random"
    means = [one["accuracy_pct"]["mean"] for one in (single, single["by_indentation"], single["by_pass"])]
    assert means == [90.0, 80.0, 70.0]
    table = make_tables(shown)["single_sensor"]
    assert table["accuracy, % (ours)"].tolist() == ["90", "80", "70"]
    assert all(table["accuracy, % (paper)"] == "99.58 ± 0.34")
    assert "as in the paper" in table["model"][0]


def test_variants_are_in_a_separate_table():
    assert numbers()["variants"]["lobo"]["released"]["accuracy_pct"]["mean"] == 1.0


def test_bytes_and_frames_of_all_captures_are_summed():
    assert add_up(COUNTS) == {
        "captures_n": 2, "bytes_n": 249, "frames_n": 3, "skipped_resync_bytes_n": 1, "skipped_truncated_bytes_n": 2,
        "lost_bytes_n": 3,
    }  # fmt: skip


def test_lost_bytes_and_rows_are_counted_for_each_protocol():
    wear = {"accounts": COUNTS, "left_out": {}}
    losses = {
        "drift": wear | {"left_out": {"low_force_rows_n": 4}},
        "variation": wear,  # This experiment uses the captures of `drift`, which are counted once.
        "shear": {"accounts": COUNTS[1:], "left_out": {"low_force_rows_n": 7}},
        "compare": {"accounts": [], "left_out": {}},  # This experiment uses the main captures.
    }
    found = lost_by_protocol(losses)
    assert set(found) == {"wear", "drag"}
    assert found["wear"] == add_up(COUNTS) | {"left_out": {"low_force_rows_n": 4}}
    assert (found["drag"]["captures_n"], found["drag"]["bytes_n"]) == (1, 164)
    shown = make_tables(numbers() | {"capture_by_protocol": found})["captures"].set_index(["protocol", "what"])["count"]
    assert shown["main", "bytes_n"] == shown["wear", "bytes_n"] == "249"
    assert shown["drag", "left out of training: low_force_rows_n"] == "7"
    assert ("drag", "lost_bytes_n") not in shown  # Counts of zero are not shown.
    assert shown["wear", "lost_bytes_n"] == "3"


def test_every_row_names_its_source():
    for source in ("simulated", "recorded"):
        tables = make_tables(numbers(source=source))
        ours = tables.pop("table1")[OURS]  # This table is table 1 of the paper, with one more column for our skin.
        assert all(cell == NOT_GIVEN or cell.endswith(f", {source}") for cell in ours)
        assert any(cell != NOT_GIVEN for cell in ours)
        for name in tables.keys() - {"claims"}:
            assert set(tables[name]["source"]) == {source}


def test_table_2_contains_the_papers_numbers():
    text = to_markdown(make_tables(numbers())["table2"])
    for value in TABLE_2["multi"].values():
        assert f"{value[0]:g} ± {value[1]:g}" in text  # Numbers have as many digits as in the paper.
    assert "85.0 ± 7.1" in text


def test_network_of_one_training_skin_is_not_called_pooled():
    alone = numbers([{**one, "train_skins": ["s9"]} for one in CARDS])
    (row,) = [name for name in make_tables(alone)["table2"]["model"] if "board" in name]
    assert row == "Leave-one-board-out, one training skin (paper: single-sensor)"
    assert "84.43" not in to_markdown(make_tables(alone)["table2"])


def test_tables_of_scores_explain_their_metric():
    tables = make_tables(numbers())
    assert "within 1 mm" in to_markdown(tables["table2"])
    assert "within 1 mm" not in to_markdown(tables["captures"])


def test_table_shows_a_dash_for_an_unknown_number():
    unknown = card("single_temporal", "s0", 99.0)
    del unknown["scores"]["all"]["mse_f_N2"]
    table = make_tables(numbers([unknown]))["single_sensor"]
    assert table["MSE_F, N² (ours)"].tolist() == ["–"]


def test_standard_deviation_over_seeds_is_shown_with_its_meaning():
    assert show({"mean": 99.7, "n": 1, "sd_seeds": 0.04}) == "99.70 ± 0.04 (seeds)"
    assert show({"mean": 99.7, "n": 2, "sd": 1.0, "sd_seeds": 0.04}) == "99.7 ± 1.0 ± 0.04 (seeds)"
    boards = {"mean": 99.7, "n": 2, "sd": 1.0, "ci95": [90.7, 108.7], "sd_seeds": 0.04}
    assert show(boards) == "99.7 [90.7, 108.7] ± 0.04 (seeds)"
    few = {"mean": 85.0, "n": 2, "sd": 7.0, "values": [80.0, 90.0]}
    assert (show(few), show_digits(few, 1)) == ("85.0 (80.0; 90.0)", "85.0 (80.0; 90.0)")
    assert show_digits(boards, 2) == "99.70 [90.70, 108.70] ± 0.04 (seeds)"


@given(
    mean=st.floats(-200, 200),
    half=st.floats(1e-4, 100),
    asymmetry=st.floats(0.3, 0.7),
)
def test_number_of_digits_of_a_score_follows_from_its_uncertainty(mean, half, asymmetry):
    value = {"mean": mean, "n": 6, "ci95": [mean - 2 * half * asymmetry, mean + 2 * half * (1 - asymmetry)]}
    shown, low, high = (float(text) for text in re.sub(r"[\[\],]", "", show(value)).split())
    unit = 10.0 ** -len(show(value).partition(" ")[0].partition(".")[2])
    ends = zip((shown, low, high), (mean, *value["ci95"]), strict=True)
    # All numbers have the same number of decimals.
    assert all(abs(one - exact) <= 0.5001 * unit for one, exact in ends)
    digits = np.floor(np.log10(half / unit)) + 1  # This is the number of digits with which half the interval is shown.
    assert digits <= 3  # There are two digits, or three if an end of the interval would otherwise be rounded to 0.
    # There are fewer digits only if the mean already has four digits.
    assert digits >= 2 or unit == 1 or abs(mean) > 999 * half / 10


def test_end_of_an_interval_is_not_rounded_to_zero():
    assert show({"mean": 2.09, "n": 6, "ci95": [0.0134, 4.17]}) == "2.09 [0.01, 4.17]"
    # In this case, no number of digits would help.
    assert show({"mean": 0.0335, "n": 6, "ci95": [-2e-5, 0.067]}) == "0.034 [0.000, 0.067]"


@pytest.mark.parametrize(("value", "kept"), [(1234567.8, 1234570.0), (0.000123456789, 0.000123457), (0.0, 0.0)])
def test_stored_numbers_are_rounded_to_six_digits(value, kept):
    assert rounded({"a": [value, 3]}) == {"a": [kept, 3]}


def test_only_marked_blocks_of_a_page_are_replaced():
    pages = {"one.md": "before\n<!-- a -->\nold\n<!-- /a -->\nafter\n", "other.md": "a\n"}
    assert fill(pages, {"a": "new"}) == pages | {"one.md": "before\n<!-- a -->\nnew\n<!-- /a -->\nafter\n"}
    assert fill(fill(pages, {"a": r"\1 new"}), {"a": r"\1 new"}) == fill(pages, {"a": r"\1 new"})
    with pytest.raises(SchemaError, match="block b must be in exactly one page; it is in no page"):
        fill(pages, {"b": "new"})
    with pytest.raises(SchemaError, match="in exactly one page; it is in one.md, other.md"):
        fill(pages | {"other.md": pages["one.md"]}, {"a": "new"})


def test_each_metric_has_a_column():
    assert {metric for row in TABLE_2.values() for metric in row} == set(PAPER_METRICS)


def test_summary_has_our_scores_beside_the_papers_and_a_row_for_the_control():
    numbers = all_experiments()
    table = summary_table(numbers).set_index(HELD_OUT)
    assert len(table) == len(numbers["table2"]) + 1
    for name, model in models(numbers).items():
        if name in numbers["table2"]:
            title = model.title.replace("Multi-sensor with triplet loss, adapted", "The same, adapted")
            for metric, column in (("accuracy_pct", "accuracy, %"), ("mse_f_N2", "MSE_F, N²")):
                assert table.loc[title, f"{column} (paper)"].endswith(f"({TABLE_2[name][metric][0]:.3g})")
    assert "(" not in table.loc[CONTROL, "accuracy, % (paper)"]
    assert "R² of F" in table


def test_summary_of_unseen_boards_has_the_fewest_and_the_most_labels():
    rows = new_board()
    table = summary_table(all_experiments("recorded") | {"new_board": rows}).set_index(HELD_OUT)
    assert table.index.tolist() == [TITLES["shipped"], TITLES["rig"]]
    for row in rows:
        if row["method"] in IN_CONTEXT and row["labels_n"] in (0, 40):
            shown = table.loc[TITLES[row["method"]], f"within 1 mm, %, {row['labels_n']} labels"]
            assert shown == show(row["accuracy_pct"])
    assert not any("10 labels" in column for column in table)


def test_scene_without_held_out_boards_has_no_summary():
    assert (
        summary_table(
            {name: experiment_numbers for name, experiment_numbers in all_experiments().items() if name != "table2"}
        )
        is None
    )


TABLE_1 = read_table1()
PROPERTIES = (*TABLE_1.rows, LOCALISATION)


def test_table_1_columns_have_sources_with_years():
    assert list(TABLE_1.columns) == ["ReSkin", "DIGIT", "GelSlim", "BioTac", "RSkin"]
    for name, year in zip(TABLE_1.columns, (2021, 2020, 2018, 2019, 2013), strict=True):
        assert f"{year}" in TABLE_1.columns[name]


def test_only_reskin_meets_every_requirement_in_table_1():
    requirements = [name for name in TABLE_1.rows if name not in ("Type", "Frequency")]
    met = {
        column: all(TABLE_1.rows[name][i] == "yes" for name in requirements) for i, column in enumerate(TABLE_1.columns)
    }
    assert [column for column, all_met in met.items() if all_met] == ["ReSkin"]
    assert {cell for name in requirements for cell in TABLE_1.rows[name]} == {"yes", "no", "?"}


@given(st.dictionaries(st.sampled_from(PROPERTIES), st.text(max_size=9)))
def test_table_1_contains_the_cells_of_the_paper(measured):
    table = table1(TABLE_1, measured)
    for (name, cells), (_, row) in zip(TABLE_1.rows.items(), table.iterrows(), strict=False):
        assert [row["property"], *(row[column] for column in TABLE_1.columns)] == [name, *cells]
        assert row[OURS] == measured.get(name, NOT_GIVEN)
    if LOCALISATION in measured:
        assert set(table.iloc[-1][list(TABLE_1.columns)]) == {NOT_GIVEN}
        assert table.iloc[-1]["property"] == LOCALISATION
    assert len(table) == len(TABLE_1.rows) + (LOCALISATION in measured)


def test_table_1_calls_numbers_of_a_simulation_settings():
    for source, rate, area in (
        (
            "simulated",
            "400 Hz, a setting, computed from the times in the captures, simulated",
            "mm, a setting, simulated",
        ),
        ("recorded", "400 Hz, recorded", "mm, recorded"),
    ):
        numbers = all_experiments(source)
        numbers["described"]["grid"]["over_skins"]["rate_hz"] = stat(400.0)
        numbers["sleeve"]["area_mm"] = [50.8, 101.6]
        cells = measured(numbers)
        assert cells["Frequency"] == rate
        numbers["described"]["grid"]["over_skins"]["rate_hz"] = stat(9.2143)
        assert measured(numbers)["Frequency"].startswith("9.21 Hz")
        assert cells["Area coverage"] == f"40 chips under 50.8 x 101.6 {area}"


def test_list_below_table_1_contains_every_source():
    meaning = table1(TABLE_1, {}).attrs["meaning"]
    assert all(source in meaning for source in TABLE_1.columns.values())


def test_unknown_property_in_table_1_is_refused():
    with pytest.raises(ParamsError, match="Weight"):
        table1(TABLE_1, {"Weight": "5 g"})


@pytest.mark.parametrize(("rows", "fault"), [("{Type: [Magnetic]}", "2 cells, not 1"), ("{Type: [1, 2]}", "string")])
def test_invalid_rows_of_table_1_are_refused(tmp_path, rows, fault):
    file = tmp_path / "tables.yaml"
    file.write_text(f"columns: {{a: x, b: y}}\nrows: {rows}\n")
    with pytest.raises(ParamsError, match=fault):
        read_table1(file)


def described(source, **means):
    return {
        "source": source,
        "over_skins": {name: {"mean": m, "least": m / 2, "most": 2 * m, "n": 3} for name, m in means.items()},
    }


SIMULATED = described("simulated", noise_xy_uT=3.3, force_max_N=40.0, step_z_uT=0.3227)
RECORDED = described("recorded", noise_xy_uT=3.1, force_max_N=4.0)


def test_table_of_skins_gives_mean_range_and_number_of_skins():
    table = skins_table({"quick (simulated)": SIMULATED})
    assert table["quick (simulated)"].tolist() == [
        "3.3 [1.65 … 6.6] (3)",
        "0.323 [0.161 … 0.645] (3)",
        "40 [20 … 80] (3)",
    ]
    assert "simulated / nearest recorded" not in table


def test_table_compares_simulated_skins_with_recorded_ones():
    table = skins_table({"quick (simulated)": SIMULATED, "lab (recorded)": RECORDED})
    ratios = dict(zip(table["quantity"], table["simulated / nearest recorded"], strict=True))
    assert ratios["noise of one reading, x and y, µT"] == "1.1"
    assert ratios["force, largest, N"] == "10"
    assert ratios["resolution of a chip (one digital step), z, µT"] == "–"


CASE = {
    "area": "chip", "case": "steps", "what": "field per count", "reference": "data sheet", "error": 3.33e-05,
    "message": "", "unit": "uT", "limit": 5e-5, "reason": "four decimals", "holds": True,
}  # fmt: skip


def test_table_of_extremes_has_errors_limits_and_failed_cases():
    cases = [CASE, CASE | {"unit": "1", "error": 1.5e-3, "holds": False}]
    cases.append(CASE | {"error": None, "message": "ValueError: no chip", "holds": False})
    table = extremes_table({"cases": cases}, "simulated")
    assert table["error"].tolist() == ["3.3e-05 uT", "0.0015", "ValueError: no chip"]
    assert table["allowed"].tolist() == ["5e-05 uT", "5e-05", "5e-05 uT"]
    assert table["holds"].tolist() == ["yes", "NO", "NO"]
    assert table["source"].tolist() == ["simulated"] * 3


def test_table_of_accuracy_has_run_times_only_if_they_were_measured():
    row = {"study": "field", "method": "midpoint", "setting": "1 mm x 2", "error": 0.012, "unit": "1"}
    failed = row | {"error": None}
    assert accuracy_and_cost_table({"rows": [row, failed]}, "simulated")["error"].tolist() == ["0.012", "failed"]
    timed = accuracy_and_cost_table({"rows": [row | {"seconds": 0.25}, failed]}, "simulated")
    assert timed["run time, s"].tolist() == ["0.25", "–"]


def test_table_of_a_run_lists_the_cost_of_each_stage():
    tables = run_tables({"runtime": {"stages": {"train_multi": cost(seconds=0.25)}}}, "simulated")
    assert list(tables) == ["stages"]
    (line,) = tables["stages"].to_dict("records")
    assert line["computed, s"] == "3.0"
    assert line["last run, CPU s"] == "–"
