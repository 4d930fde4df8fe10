"""Tests of tables: their cells are the numbers of numbers.json, beside those of the paper."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import paper
from pipeline.formatting import NONE, show
from pipeline.report import tables
from pipeline.report.numbers import add_up, before_touch_numbers, learning_numbers, lost_by_protocol
from pipeline.report.tables import TABLES, make_tables, table_texts
from pipeline.scores import make_table, rows_of_cards
from pipeline.statistics import as_json
from reskin import io
from reskin.code import ROOT
from tests.report import synthetic

SCENES = sorted(file.parent.name for file in (ROOT / "reports").glob("*/numbers.json"))


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
    provenance = {"source": source, "scene": "x", "git": "y", "seed": 1, "device": "z"}
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


def test_table_2_has_the_papers_numbers_and_a_control():
    table = make_tables(committed("paper"))["table2"]
    for column, metric in (("within 1 mm, %", "accuracy_pct"), ("MSE_F, N²", "mse_f_N2")):
        printed = ["{:g} ± {:g}".format(*row[metric]) for row in paper.TABLE_2.values()]
        assert table[f"{column} (paper)"].tolist() == [*printed, NONE, NONE]
    assert table["model"].tolist()[:4] == list(paper.TABLE_2_ROWS.values())


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
