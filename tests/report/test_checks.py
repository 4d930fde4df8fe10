"""Tables of checks and cases show every row, its numbers with their unit, and whether it holds."""

import pytest

from pipeline.report.formatting import stability_table, verification_table

CHECK = {
    "subject": "chip", "law": "conversion", "against": "data sheet", "error": 3.33e-05, "unit": "uT",
    "tolerance": 5e-5, "reason": "four decimals", "holds": True,
}  # fmt: skip
CASE = {
    "area": "wire", "case": "truncated", "should": "counted", "happened": "59 of 60 frames back", "error": 1.0,
    "limit": 1.0, "holds": True,
}  # fmt: skip


def test_a_check_is_a_row_with_its_error_beside_what_is_allowed():
    table = verification_table([CHECK, CHECK | {"unit": "1", "error": 1.5e-15}], "simulated")
    assert table["error"].tolist() == ["3.3e-05 uT", "1.5e-15"]
    assert table["allowed"].tolist() == ["5e-05 uT", "5e-05"]
    assert table["why so much"].tolist() == ["four decimals"] * 2


def test_a_case_without_a_number_has_a_dash():
    table = stability_table([CASE, CASE | {"error": None, "limit": None}], "simulated")
    assert table["error"].tolist() == ["1", "–"]
    assert table["allowed"].tolist() == ["1", "–"]


@pytest.mark.parametrize(("layout", "row"), [(verification_table, CHECK), (stability_table, CASE)])
def test_a_row_that_does_not_hold_stands_out_and_each_names_its_source(layout, row):
    table = layout([row, row | {"holds": False}], "simulated")
    assert table["holds"].tolist() == ["yes", "NO"]
    assert table["source"].tolist() == ["simulated"] * 2


@pytest.mark.parametrize("layout", [verification_table, stability_table])
def test_no_rows_make_an_empty_table(layout):
    assert layout([], "simulated").empty
