"""Tests of the tables of experiments, which contain our numbers, those of the paper, and the source of the data."""

import json

import pytest

from pipeline import paper
from pipeline.report.experiment_tables import TABLES, logs, manual, sensitivity, shear, sleeve, variation
from tests.stages.checkout import ROOT

NUMBERS = json.loads((ROOT / "reports/paper/numbers.json").read_text())


@pytest.mark.parametrize("name", sorted(TABLES))
def test_each_row_names_its_source(name):
    if name not in NUMBERS:
        pytest.skip(f"the committed report has no results of experiment {name}")
    for table in TABLES[name](NUMBERS[name], "recorded").values():
        assert len(table)
        assert set(table["source"]) == {"recorded"}


def test_scores_of_the_paper_are_shown_beside_ours():
    split = shear(NUMBERS["shear"], "simulated")["shear"].iloc[0]
    assert split["MSE_xy, mm² (paper)"] == "{:g} ± {:g}".format(*paper.SHEAR["mse_xy_mm2"])
    assert float(split["MSE_xy, mm² (ours)"].split()[0]) == pytest.approx(
        NUMBERS["shear"]["mse_xy_mm2"]["mean"], rel=5e-3
    )
    rows = manual(NUMBERS["manual"], "simulated")["manual"].set_index("networks")["accuracy, % (paper)"]
    assert rows["before adaptation"] == f"{paper.MANUAL['before']['accuracy_pct']:g}"
    assert rows["after adaptation minus before adaptation"] == f"{paper.GAINS['by_hand']['accuracy_pct']:g}"
    assert rows["control"] == "–"


def test_scores_that_are_unknown_are_left_out():
    without = {name: value for name, value in NUMBERS["sleeve"].items() if name != "near_seam"}
    assert sleeve(without, "simulated")["sleeve"]["median error < 4 mm from a border, mm"][0] == "–"
    known = ("rate_hz", "duration_s", "readings_n", "account", "contacts_n", "contact_readings_n", "force_max_N")
    tables = logs({name: NUMBERS["logs"][name] for name in known}, "recorded")
    assert tables["logs"].set_index("what")["ours"]["accuracy, %"] == "unknown"
    assert "logs_turning" not in tables
    place = NUMBERS["variation"]["places"][0]
    alone = NUMBERS["variation"] | {"places": [place | {"skins": {"skins": ["s0"]}}]}
    assert len(variation(alone, "simulated")["variation"]) == 2


@pytest.mark.parametrize(("step_N", "shown"), [(0.01, "≤ 0.01"), (0.03, "0.03"), (None, "none up to 1")])
def test_finest_step_of_weight_is_an_upper_bound(step_N, shown):
    found = {"one_reading": step_N} if step_N else {}
    table = sensitivity(NUMBERS["sensitivity"] | {"step_N": 0.01, "smallest_step_N": found}, "simulated")["sensitivity"]
    assert table["ours"][0] == shown
