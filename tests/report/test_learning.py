"""Tests of the tables about training with many skins, and of the blocks in README and docs that contain them."""

from pipeline.formatting import CONTROL, to_markdown
from pipeline.paper import TABLE_2
from pipeline.report.readme import blocks_of
from pipeline.report.tables import (
    audit_table,
    chosen_table,
    labels_table,
    make_tables,
    paired_boards_table,
    paired_table,
    sweep_pokes_table,
    sweep_sensors_table,
)
from tests.report.synthetic import over_boards


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


def test_table_of_paired_differences_lists_each_board():
    table = paired_boards_table(NUMBERS, "simulated")
    rows = table[table["difference"] == "adapted − multi-sensor + triplet"]
    assert rows["held-out board"].tolist() == ["b0", "b1"]
    assert rows["accuracy, %"].tolist() == ["+5", "+7"]


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
    assert "95 % interval over n boards" in to_markdown(table)


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


def test_table_states_a_number_of_pokes_other_than_the_papers():
    numbers = all_numbers() | {"adapt": {"pokes_n": 65, "control": row(82.0)}}
    (name,) = [name for name in make_tables(numbers)["table2"]["model"] if "adapted" in name]
    assert name.endswith("adapted using 65 indentations (paper: 390)")


def test_rows_of_sweeps_are_sorted_by_count():
    table = sweep_pokes_table([{"pokes_n": n, **row(80.0 + n / 100)} for n in (390, 0, 65)], "simulated")
    assert table["pokes"].tolist() == ["0", "65", "390"]
    assert table["accuracy, % (ours)"].tolist() == ["80.0 ± 1.0", "80.7 ± 1.0", "83.9 ± 1.0"]
    assert table["accuracy, % (paper, table 2)"].tolist() == ["81.03 ± 12.86", "–", "87 ± 11.81"]
    rows = [{"method": m, "skins_n": n, **row(n)} for m in ("adapted", "multi") for n in (15, 3)]
    table = sweep_sensors_table(rows, "simulated")
    assert table["training skins"].tolist() == ["3", "3", "15", "15"]
    assert table["method"].tolist() == ["multi-sensor", "adapted"] * 2


def test_table_of_labels_has_scores_as_labelled_and_registered():
    one = {"method": "ridge", "inputs": "shape", "labels_n": 20, "as_labelled": row(30.0), "registered": row(42.0, 0.2)}
    (line,) = labels_table([one], "recorded").to_dict("records")
    assert line == {
        "method": "ridge", "inputs": "shape", "labels": "20", "source": "recorded", "accuracy, %": "30.0 ± 1.0",
        "MSE_xy, mm²": "0.5 ± 1.0", "MSE_F, N²": "–", "R² of F": "–", "accuracy, % (registered)": "42.0 ± 1.0",
        "MSE_xy, mm² (registered)": "0.2 ± 1.0", "n": "6",
    }  # fmt: skip
    uncertain = one | {"as_labelled": row(30.0) | {"coverage_pct": {"mean": 91.0, "n": 2}}}
    (_, line) = labels_table([one, uncertain], "recorded").to_dict("records")
    assert (line["coverage of 90 % intervals, %"], line["half-width of 90 % intervals, mm (median)"]) == ("91", "–")


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
    one = {"method": "ridge", "inputs": "raw"}
    check = {"what": "skins", "where": "lobo", "rule": "on one side", "found": 0, "holds": True, "known": False}
    return NUMBERS | {
        "provenance": provenance,
        "lobo": {"by_board": {board: one | part() for board, one in BOARDS.items()}},
        "variants": {"lobo": {"paper": row(84.0)}},
        "capture": {"captures_n": 18, "left_out": {}},
        "sweep_pokes": [{"pokes_n": 0, **row(81.0)}],
        "sweep_sensors": [{"method": "multi", "skins_n": 3, **row(60.0)}],
        "labels": [one | {"labels_n": 0, "as_labelled": row(30.0), "registered": row(42.0)}],
        "audit": [check],
        "chosen": {
            "multi": {
                "recipe_name": "a",
                "by": "MSE_xy",
                "candidates": [{"recipe_name": "a", "settings": "steps_n 9"} | row(80.0)],
            }
        },
    }


def part() -> dict:
    scores = {"accuracy_pct": 80.0, "mse_xy_mm2": 0.5}
    return {"as_labelled": scores, "registered": scores}


def test_table_of_each_experiment_names_its_source():
    expected = {
        "claims",
        "paired",
        "paired_boards",
        "sweep_pokes",
        "sweep_sensors",
        "labels",
        "audit",
        "chosen",
    }
    tables = make_tables(all_numbers())
    assert expected < set(tables)
    for name in expected:
        assert set(tables[name]["source"]) == {"simulated"}
    nothing = {name: all_numbers()[name] for name in ("provenance", "variants", "capture")}
    assert not expected & set(make_tables(nothing))


def test_readme_has_the_claims_of_the_paper_below_table_2():
    described = {
        "grid": {"source": "simulated", "over_skins": {"step_z_uT": {"mean": 1.0, "least": 1.0, "most": 1.0, "n": 1}}}
    }
    tables = make_tables(all_numbers())
    results = blocks_of([all_numbers() | {"described": described, "trainings": {}}], [], {}, None)["results"]
    table2, claims = to_markdown(tables["table2"]), to_markdown(tables["claims"])
    assert f"{table2}\n\n{claims}" in results


def test_costs_in_the_readme_are_those_of_the_recorded_run():
    described = {"grid": {"source": "simulated", "over_skins": {}}}
    numbers = all_numbers() | {"described": described, "trainings": {}}
    numbers["provenance"] |= {"seconds": 5400.0, "scene": "paper"}
    row = next(line for line in blocks_of([numbers], [], {}, None)["costs"].splitlines() if "`paper`" in line)
    assert [cell.strip() for cell in row.split("|")[1:5]] == ["`paper`", "90", "0", "0"]
