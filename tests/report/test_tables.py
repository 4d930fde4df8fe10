"""Tests of tables: their cells are the numbers of numbers.json, beside those of the paper."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import paper
from pipeline.formatting import NONE, rounded, show, show_with_sd
from pipeline.report import tables
from pipeline.report.numbers import add_up, before_touch_numbers, join, learning_numbers, lost_by_protocol
from pipeline.report.tables import LOCALISATION, TABLES, make_tables, run_tables, table_texts
from pipeline.scores import make_table, rows_of_cards
from pipeline.statistics import as_json
from reskin import io
from reskin.code import ROOT
from tests.report import synthetic
from tests.report.synthetic import cost, over_boards

SCENES = sorted(file.parent.name for file in (ROOT / "reports").glob("*/numbers.json"))
PROVENANCE = {"source": "simulated", "scene": "x"}


def committed(scene: str) -> dict:
    return io.read_json(ROOT / "reports" / scene / "numbers.json")


def first_number(cell: str) -> float:
    return float(cell.partition(" ")[0])


@pytest.fixture(scope="module", params=SCENES)
def scene(request) -> tuple[dict, dict[str, pd.DataFrame]]:
    numbers = committed(request.param)
    return numbers, make_tables(numbers)


def test_tables_of_committed_scenes_are_whole(scene):
    numbers, made = scene
    needed = {key for key, _ in TABLES.values()} & numbers.keys() - {"provenance", "variants"}
    for key in needed:
        assert made.keys() & {name for name, (of, _) in TABLES.items() if of == key}
    for name, table in made.items():
        assert len(table), name
        assert table.columns.is_unique
        assert table.notna().all(axis=None)
        assert not (table == NONE).all().any()  # no column without a value
    assert all(text.count("\n") > 1 for text in table_texts(made).values())


def test_cells_are_the_numbers_of_the_scene(scene):
    numbers, made = scene
    shown = {
        "table2": [row["accuracy_pct"] for row in numbers.get("table2", {}).values()],
        "sweep_pokes": [row["accuracy_pct"] for row in numbers.get("sweep_pokes", ())],
        "new_board": [row["accuracy_pct"] for row in numbers.get("new_board", ()) if "accuracy_pct" in row],
        "interference_places": [row["accuracy_pct"] for row in numbers.get("interference", {}).get("places", ())],
        "manual": [
            numbers[name][part]["accuracy_pct"]
            for name, part in (("manual", "before"), ("manual", "after"))
            if name in numbers
        ],
        "lobo_boards": [
            {"mean": row["as_labelled"]["accuracy_pct"]}
            for row in numbers.get("lobo", {"by_board": {}})["by_board"].values()
        ],
    }
    for name in shown.keys() & made.keys():
        cells = [cell for cell in made[name]["within 1 mm, %"] if cell != NONE]
        means = [stat["mean"] for stat in shown[name]]
        np.testing.assert_allclose([first_number(cell) for cell in cells[: len(means)]], means, atol=0.5)


def test_run_has_a_table_of_the_cost_of_each_stage():
    made = run_tables({"runtime": {"stages": {"train_multi": cost(seconds=0.25)}}})
    assert list(made) == ["stages"]
    (line,) = made["stages"].to_dict("records")
    assert (line["computed, s"], line["last run, s"]) == ("3.0", "0.2")
    assert "last run, CPU s" not in line
    quick = join(committed("quick"), io.read_json(ROOT / "reports/quick/provenance.json"))
    assert "run time, s" in run_tables(quick)["accuracy_and_cost"]
    assert "run time, s" not in make_tables(quick)["accuracy_and_cost"]


def test_parts_that_a_scene_lacks_have_no_table():
    capture = {"captures_n": 2, "left_out": {}}
    assert list(make_tables({"provenance": PROVENANCE, "capture": capture})) == ["captures"]
    alone = committed("quick")
    del alone["logs"]["turning"], alone["variation"]["places"][0]["skins"]["spread_uT"]
    del alone["sleeve"]["near_seam"]
    for row in alone["sleeve"]["variants"].values():
        row.pop("near_seam", None)
    made = make_tables(alone)
    assert "logs_turning" not in made
    assert not any("border" in column for column in made["sleeve"])
    assert made["variation"].iloc[2]["between"] != "skins"


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


def numbers(cards: list[dict] = CARDS, source: str = "simulated") -> dict:
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
    shown = make_tables(numbers() | {"capture_by_protocol": found})["captures"].set_index("what")
    assert (shown.loc["bytes", "main"], shown.loc["bytes", "drag"], shown.loc["lost bytes", "wear"]) == (249, 164, 3)
    assert shown.loc["left out of training: low force rows", "drag"] == 7


def test_controls_of_one_skin_do_not_use_the_touch():
    predicted = make_table(
        {"experiment": "single_temporal", "fold": fold, "method": method, "accuracy_pct": accuracy, "mse_xy_mm2": mse}
        for fold, method, accuracy, mse in (
            ("s0", "noload", 10.0, 9.0), ("s0", "scan", 99.0, 0.1),
            ("s1", "noload", 20.0, 8.0), ("s1", "scan", 97.0, 0.3),
        )
    )  # fmt: skip
    shown = numbers([card("single_temporal", "s0", 95.0)]) | as_json(before_touch_numbers(predicted))
    table = tables.single_sensor(shown)
    assert [first_number(cell) for cell in table["within 1 mm, %"]] == [95, 15, 98]
    assert table["within 1 mm, % (paper)"].dropna().tolist() == ["99.58 ± 0.34"]


def test_skin_whose_tip_is_sensed_without_contact_is_not_beside_the_paper():
    table = make_tables(committed("ini"))["single_sensor"].query("`predicted from` == 'field change'").set_index("skin")
    assert table.loc["plain", "within 1 mm, % (paper)"] == "99.58 ± 0.34"
    assert table.loc["screw", "within 1 mm, % (paper)"] == NONE


def test_only_experiments_with_several_recipes_are_among_the_variants():
    table = tables.variants(numbers())
    assert dict(zip(table["recipe"], table["within 1 mm, %"], strict=True)).keys() == {"paper", "released"}
    assert set(table["experiment"]) == {"lobo"}


def test_table_2_has_the_papers_numbers_and_a_control():
    table = make_tables(committed("paper"))["table2"]
    for column, metric in (("within 1 mm, %", "accuracy_pct"), ("MSE_F, N²", "mse_f_N2")):
        printed = ["{:g} ± {:g}".format(*row[metric]) for row in paper.TABLE_2.values()]
        assert table[f"{column} (paper)"].tolist() == [*printed, NONE, NONE]
    assert table["model"].tolist()[:4] == list(paper.TABLE_2_ROWS.values())


def test_network_of_one_training_skin_is_beside_the_papers_single_sensor():
    alone = numbers([{**one, "train_skins": ["s9"]} for one in CARDS])
    table = tables.table2(alone).set_index("model")
    printed = table.loc["Leave-one-board-out, one training skin", "within 1 mm, % (paper)"]
    assert printed == "{:g} ± {:g}".format(*paper.TABLE_2["single"]["accuracy_pct"])
    pairs = {"paired": [{"of": "triplet", "over": "multi", "accuracy_pct": over_boards()}]}
    assert "multi" not in tables.paired(alone | pairs)["difference"][0]


def test_paired_differences_are_beside_those_of_the_papers_means():
    pairs = [("multi", "single"), ("triplet", "multi"), ("adapted", "triplet"), ("adapted", "control")]
    rows = [{"of": of, "over": over, "accuracy_pct": over_boards(-4.4, -2.4)} for of, over in pairs]
    table = tables.paired({"paired": rows})
    assert table["within 1 mm, %"].tolist() == ["-3.4 [-4.4, -2.4]"] * 4
    # The expected differences are those of the paper's means in its table 2, which has no control.
    assert table["within 1 mm, % (paper)"].fillna("").tolist() == ["+59.19", "-3.4", "+5.97", ""]


def test_gains_by_hand_are_beside_the_papers():
    table = make_tables(committed("paper"))["manual"].set_index("networks")["within 1 mm, % (paper)"]
    assert table["before adaptation"] == paper.MANUAL["before"]["accuracy_pct"]
    assert float(table["after adaptation − before adaptation"]) == paper.GAINS["by_hand"]["accuracy_pct"]


@pytest.mark.parametrize(("step_N", "shown"), [(0.01, "≤ 0.01"), (0.03, "0.03"), (None, "none up to 1")])
def test_finest_step_of_weight_is_an_upper_bound(step_N, shown):
    found = committed("paper")["sensitivity"] | {"step_N": 0.01}
    found["smallest_step_N"] = {"one_reading": step_N} if step_N else {}
    assert tables.sensitivity({"sensitivity": found})["ours"][0] == shown


def test_leak_that_is_not_known_is_highlighted_in_the_audit():
    check = {"what": "skins", "where": "lobo/b0", "rule": "on one side", "found": 0, "holds": True, "known": False}
    rows = [check, check | {"where": "lobo/b1"}, check | {"holds": False, "known": True}, check | {"holds": False}]
    table = tables.audit({"audit": rows})
    assert dict(zip(table["holds"], table["checks"], strict=True)) == {"yes": 2, "no, known": 1, "NO": 1}


def test_chosen_settings_are_marked_among_the_candidates():
    candidates = [{"recipe_name": name, "settings": "", "mse_f_N2": over_boards()} for name in ("slow", "fast")]
    choice = {"recipe_name": "fast", "by": "MSE_xy", "candidates": candidates}
    table = tables.chosen({"chosen": {"triplet": choice}})
    assert dict(zip(table["candidate"], table["chosen"], strict=True)) == {"slow": "", "fast": "yes, by MSE_xy"}


def test_failed_cases_are_in_the_table_of_extremes():
    case = {
        "area": "chip", "what": "field per count", "reference": "data sheet", "error": 3.33e-05, "message": "",
        "unit": "uT", "limit": 5e-5, "reason": "four decimals", "holds": True,
    }  # fmt: skip
    failed = case | {"error": None, "message": "ValueError: no chip", "holds": False}
    table = tables.extremes({"extremes": {"cases": [case, case | {"unit": "1", "error": 1.5e-3}, failed]}})
    assert table["error"].tolist() == ["3.3e-05 uT", "0.0015", "ValueError: no chip"]
    assert table["holds"].tolist() == ["yes", "yes", "NO"]


def test_only_reskin_meets_every_requirement_in_table_1():
    printed = make_tables(committed("paper"))["table1"].set_index("property")
    requirements = printed.drop(["Type", "Frequency", LOCALISATION]).drop(columns="ours")
    assert requirements.columns[(requirements == "yes").all()].tolist() == ["ReSkin"]
    assert printed.loc["Frequency", "ours"] == "400 Hz"
    assert first_number(printed.loc[LOCALISATION, "ours"]) == pytest.approx(
        committed("paper")["table2"]["adapted"]["accuracy_pct"]["mean"], abs=0.1
    )


def test_standard_deviation_over_seeds_is_marked():
    assert show({"mean": 99.7, "n": 1, "sd_seeds": 0.04}) == "99.70 ± 0.04 (seeds)"
    assert show({"mean": 99.7, "n": 2, "sd": 1.0, "sd_seeds": 0.04}) == "99.7 ± 1.0 ± 0.04 (seeds)"
    boards = {"mean": 99.7, "n": 2, "sd": 1.0, "ci95": [90.7, 108.7], "sd_seeds": 0.04}
    assert show(boards) == "99.7 [90.7, 108.7] ± 0.04 (seeds)"
    assert show_with_sd(boards) == "99.7 ± 1.0 ± 0.04 (seeds) [90.7, 108.7]"
    assert show({"mean": 85.0, "n": 2, "sd": 7.0, "values": [80.0, 90.0]}) == "85.0 (80.0; 90.0)"


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
