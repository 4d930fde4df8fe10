"""Tests of the tables about training with many skins."""

from pipeline.formatting import to_markdown
from pipeline.paper import TABLE_2
from pipeline.report.table_2 import CONTROL
from pipeline.report.tables import (
    audit_table,
    chosen_table,
    make_tables,
    paired_table,
)
from tests.report.synthetic import new_board, over_boards


def stat(mean: float, sd: float | None = 1.0, n: int = 6) -> dict:
    return {"mean": float(mean), "n": n} | ({} if sd is None else {"sd": sd})


def row(accuracy_pct: float, mse_xy_mm2: float = 0.5, sd: float | None = 1.0, n: int = 6) -> dict:
    return {"accuracy_pct": stat(accuracy_pct, sd, n), "mse_xy_mm2": stat(mse_xy_mm2, sd, n)}


def paired(of: str, over: str, **scores) -> dict:
    return {"of": of, "over": over, **scores}


def between(accuracy_pct: tuple[float, float], error: tuple[float, float]) -> dict:
    """Return paired differences with the given 95 % intervals over boards."""
    differences = {"accuracy_pct": accuracy_pct, "mse_xy_mm2": error, "mse_f_N2": error}
    by_board = {board: {name: ends[i] for name, ends in differences.items()} for i, board in enumerate(("b0", "b1"))}
    return {name: over_boards(*ends) for name, ends in differences.items()} | {"by_board": by_board}


BOARDS = {f"b{i}": {"trained_on_skins_n": 15} for i in range(6)}
ALONE = {f"b{i}": {"trained_on_skins_n": 1} for i in range(2)}
PAPER_AS_OURS = {name: {metric: stat(*value) for metric, value in metrics.items()} for name, metrics in TABLE_2.items()}
PAIRED = [
    paired("multi", "single", **between((40.0, 70.0), (-6.0, -4.0))),
    paired("triplet", "multi", **between((-4.4, -2.4), (-0.1, 0.2))),
    paired("adapted", "triplet", **between((5.0, 7.0), (-0.3, 0.1))),
    paired("adapted", "control", **between((-2.9, 3.1), (0.05, 0.15))),
]
NUMBERS = {"table2": PAPER_AS_OURS, "lobo": {"by_board": BOARDS}, "paired": PAIRED}


def test_table_of_paired_differences_has_the_difference_of_the_papers_means():
    table = paired_table(NUMBERS, "simulated")
    assert table["difference"].tolist() == [
        "multi-sensor − single-sensor", "multi-sensor + triplet − multi-sensor", "adapted − multi-sensor + triplet",
        "adapted − control",
    ]  # fmt: skip
    assert table["accuracy, % (ours)"].tolist() == [
        "+55 [40, 70]",
        "-3.4 [-4.4, -2.4]",
        "+6.0 [5.0, 7.0]",
        "+0.1 [-2.9, 3.1]",
    ]
    # The expected differences of the paper are 81.03 - 84.43 and 87.00 - 81.03, from the means in its table 2. The
    # paper has no control.
    assert table["accuracy, % (paper: difference of means)"].tolist() == ["+59.19", "-3.4", "+5.97", "–"]
    assert table["MSE_xy, mm² (paper: difference of means)"].tolist() == ["-5.72", "+0.023", "-0.242", "–"]


def test_network_of_one_training_skin_is_not_called_multi_sensor():
    numbers = NUMBERS | {"lobo": {"by_board": ALONE}, "paired": PAIRED[1:]}
    text = to_markdown(paired_table(numbers, "recorded"))
    assert "multi-sensor" not in text
    assert "one training skin + triplet" in text
    assert set(paired_table(numbers, "recorded")["accuracy, % (paper: difference of means)"]) == {"–"}


def test_rows_of_table_2_are_in_the_order_of_the_paper():
    numbers = all_numbers() | {"adapt": {"pokes_n": 390, "control": row(82.0)}}
    table = make_tables(numbers)["table2"]
    assert table["model"].tolist() == [
        "Single-sensor", "Multi-sensor without triplet loss", "Multi-sensor with triplet loss",
        "Multi-sensor with triplet loss, adapted using 390 indentations", CONTROL,
    ]  # fmt: skip
    assert table["accuracy, % (paper)"].tolist() == [
        "25.24 ± 10.12",
        "84.43 ± 12.88",
        "81.03 ± 12.86",
        "87 ± 11.81",
        "–",
    ]
    assert table["accuracy, % (ours)"].tolist()[-1] == "82.0 ± 1.0"


def test_leak_that_is_not_known_is_highlighted_in_the_audit():
    check = {"what": "skins", "where": "lobo", "rule": "on one side", "found": 0, "holds": True, "known": False}
    rows = [check, check | {"holds": False, "known": True, "found": 6}, check | {"holds": False}]
    table = audit_table(rows, "simulated")
    assert table["holds"].tolist() == ["yes", "no, known", "NO"]
    assert table["found"].tolist() == ["0", "6", "0"]


def test_chosen_settings_are_marked_among_the_candidates():
    candidates = [
        {"recipe_name": name, "settings": "", **row(80.0, error)} for name, error in (("slow", 0.4), ("fast", 0.3))
    ]
    choices = {"triplet": {"recipe_name": "fast", "by": "MSE_xy", "candidates": candidates}}
    table = chosen_table(choices, "simulated")
    assert dict(zip(table["candidate"], table["chosen"], strict=True)) == {"slow": "", "fast": "yes, by MSE_xy"}


PARTS = {places: {"accuracy_pct": 80.0, "mse_xy_mm2": 0.5} for places in ("as_labelled", "registered")}


def all_numbers() -> dict:
    provenance = {
        "source": "simulated",
        "scene": "x",
        "git": "y",
        "trained": "y",
        "seed": 1,
        "device": "z",
        "seconds": 1.0,
    }
    check = {"what": "skins", "where": "lobo", "rule": "on one side", "found": 0, "holds": True, "known": False}
    return NUMBERS | {
        "provenance": provenance,
        "lobo": {"by_board": {board: one | PARTS for board, one in BOARDS.items()}},
        "variants": {"lobo": {"paper": row(84.0)}},
        "capture": {"captures_n": 18, "left_out": {}},
        "sweep_pokes": [{"pokes_n": 0, **row(81.0)}],
        "sweep_sensors": [{"method": "multi", "skins_n": 3, **row(60.0)}],
        "new_board": new_board(),
        "audit": [check],
        "chosen": {
            "multi": {
                "recipe_name": "a",
                "by": "MSE_xy",
                "candidates": [{"recipe_name": "a", "settings": "steps_n 9"} | row(80.0)],
            }
        },
    }


def test_table_of_each_experiment_names_its_source():
    expected = {
        "claims",
        "paired",
        "paired_boards",
        "sweep_pokes",
        "sweep_sensors",
        "new_board",
        "audit",
        "chosen",
    }
    tables = make_tables(all_numbers())
    assert expected < set(tables)
    for name in expected:
        assert set(tables[name].get("source", ["simulated"])) == {"simulated"}
    nothing = {name: all_numbers()[name] for name in ("provenance", "variants", "capture")}
    assert not expected & set(make_tables(nothing))
