import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import sem

from pipeline.evaluation.drift_findings import EACH_IS_WORSE, HIGHER_AND_FASTER, OFFSET, OVERESTIMATES, findings, rate

FIELD = {"contact_uT": 140.0, "noload_noise_uT": 1.25}
LATE = {
    "policy": "regular", "contacts_n": 45_000, "bias_N": 0.02, "bias_pct": 1.7, "bias_se_N": 7e-4, "slope": 1.01,
    "indentations_n": 1000, "force_left_pct": 98.1,
}  # fmt: skip


def rows(start: float, per_window: float, off_uT: float = 0.0, force: bool = True) -> list[dict]:
    """Four windows whose errors grow by so much from one to the next."""
    errors = [start + i * per_window for i in range(4)]
    own = [
        {"contacts_n": 5000 * (i + 1), "mse_xy_mm2": error, "noload_off_uT": off_uT} for i, error in enumerate(errors)
    ]
    return [row | ({"mse_f_N2": row["mse_xy_mm2"] / 100} if force else {}) for row in own]


PAPER = {"initial": rows(1.0, 0.5), "regular": rows(0.2, 0.01, 2.0), "each": rows(0.3, 0.01)}


def holds(policies: dict, late: dict | None = LATE) -> dict[str, bool]:
    return {one["finding"]: one["holds"] for one in findings(policies, FIELD, late)}


def test_errors_as_in_the_paper_show_all_its_findings_and_need_no_reason():
    assert holds(PAPER) == {HIGHER_AND_FASTER: True, OFFSET: True, EACH_IS_WORSE: True, OVERESTIMATES: True}
    assert not any("why" in one for one in findings(PAPER, FIELD, LATE))


@pytest.mark.parametrize(
    ("finding", "changed", "late", "said"),
    [
        (HIGHER_AND_FASTER, {"initial": rows(1.0, 0.0, 3.0)}, LATE, "is off by 3 µT"),  # higher, not faster
        (HIGHER_AND_FASTER, {"initial": rows(0.0, 0.05, 3.0)}, LATE, "noise of 1.2 µT"),  # faster, not higher
        (OFFSET, {"initial": rows(0.1, 0.0, 3.0)}, LATE, "changes the field by 140 µT"),
        (EACH_IS_WORSE, {"each": rows(0.1, 0.01)}, LATE, "off by 0.94 µT of drift"),  # 2^2 - 2 1.25^2 = 0.94^2
        (OVERESTIMATES, {}, LATE | {"bias_N": -0.02, "bias_pct": -1.7}, "explains a bias of +1.9 %"),
    ],
)
def test_a_finding_that_does_not_show_says_no_and_why_with_numbers_of_the_run(finding, changed, late, said):
    [one] = [one for one in findings(PAPER | changed, FIELD, late) if one["finding"] == finding]
    assert not one["holds"]
    assert said in one["why"]


def test_one_metric_that_disagrees_is_enough_to_say_no():
    force_falls = [row | {"mse_f_N2": 0.02 - 0.004 * i} for i, row in enumerate(PAPER["initial"])]
    assert not holds(PAPER | {"initial": force_falls})[HIGHER_AND_FASTER]


def test_without_forces_only_places_are_judged_and_nothing_is_said_of_force():
    two = {"initial": rows(1.0, 0.5, force=False), "each": rows(0.3, 0.01, force=False)}
    assert holds(two, None) == {HIGHER_AND_FASTER: True, OFFSET: True}
    assert not any("MSE_F" in one["measured"] for one in findings(two, FIELD, None))


def test_a_policy_alone_or_a_single_window_leaves_out_what_it_cannot_tell():
    assert holds({"initial": rows(1, 1)}, None) == {}
    one_window = {policy: own[:1] for policy, own in PAPER.items()}
    assert set(holds(one_window, None)) == {OFFSET, EACH_IS_WORSE}


@given(st.lists(st.floats(0, 10), min_size=2, max_size=9))
def test_the_rate_is_the_slope_that_numpy_fits(errors):
    own = [{"contacts_n": 5000 * i, "mse_xy_mm2": error} for i, error in enumerate(errors)]
    slope = np.polyfit([row["contacts_n"] / 10_000 for row in own], errors, 1)[0]
    assert rate(own, "mse_xy_mm2") == pytest.approx(slope, abs=1e-9)  # both in double precision


def test_measured_sentences_hold_the_numbers_of_the_run():
    first, offset, third, late = (one["measured"] for one in findings(PAPER, FIELD, LATE))
    assert "MSE_xy is 1.75 against 0.215 mm² with regular ones" in first
    assert "changes by 1 against 0.02 mm² in 10,000 contacts" in first
    assert offset.startswith(
        "After 20,000 contacts MSE_xy is 0.23 mm² with regular ones, 2.5 with a single no-load reading"
    )
    assert "MSE_F is 0.00315 against 0.00215 N²" in third
    assert "MSE_xy is 0.315 against 0.215 mm² with regular ones, mean over windows (difference +0.1" in third
    assert "bias +0.02 ± 0.0007 N (+1.7 %)" in late
    assert "98.1 % of its early force" in late


def test_a_difference_comes_with_its_standard_error_over_windows():
    changed = [row | {"mse_xy_mm2": value} for row, value in zip(PAPER["each"], (0.1, 0.2, 0.4, 0.9), strict=True)]
    [third] = [one for one in findings(PAPER | {"each": changed}, FIELD, LATE) if one["finding"] == EACH_IS_WORSE]
    differences = [
        own["mse_xy_mm2"] - other["mse_xy_mm2"] for own, other in zip(changed, PAPER["regular"], strict=True)
    ]
    assert f"{np.mean(differences):+.2g}, standard error over windows {sem(differences):.1g}" in third["measured"]


def test_what_shows_in_one_error_alone_is_said_to():
    lower = [row | {"mse_xy_mm2": 0.1} for row in PAPER["each"]]
    [third] = [one for one in findings(PAPER | {"each": lower}, FIELD, LATE) if one["finding"] == EACH_IS_WORSE]
    assert not third["holds"]
    assert third["why"].startswith("It shows in MSE_F alone. ")
