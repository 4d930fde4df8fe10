"""Tests of the verdicts on the paper's findings about drift.

A policy says when no-load readings are taken: once at the start (initial), regularly, or before each contact.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ttest_rel

from pipeline.experiments.drift import EACH_IS_WORSE, HIGHER_AND_FASTER, OFFSET, OVERESTIMATES, growth, judge_findings
from pipeline.statistics import CONTRADICTED, FEW_BOARDS, SUPPORTED, UNDECIDED

LATE = {
    "policy": "regular", "contacts_n": 45_000, "bias_N": 0.02, "bias_pct": 1.7, "bias_se_N": 7e-4, "slope": 1.01,
    "indentations_n": 1000, "force_left_pct": 98.1, "network_bias_N": [0.019, 0.0195, 0.0205, 0.021],
    "network_board": ["b0", "b1", "b2", "b3"],
}  # fmt: skip
CONTACTS_N = [5000, 10_000, 15_000, 20_000]
BY_SEED = (-0.01, -0.003, 0.003, 0.01)  # The errors of four networks, one per board, differ by these fractions.


def errors(start: float, per_window: float, by_seed=BY_SEED, force: bool = True) -> dict[str, np.ndarray]:
    """Return errors in four windows of contacts, as arrays [network, window].

    From one window to the next, the errors grow by `per_window`.
    """
    places = np.array([[start * (1 + more) + i * per_window * (1 + more) for i in range(4)] for more in by_seed])
    return {"mse_xy_mm2": places} | ({"mse_f_N2": places / 100} if force else {})


PAPER = {"initial": errors(1.0, 0.5), "regular": errors(0.2, 0.01), "each": errors(0.3, 0.01)}


def findings_by_name(
    networks: dict, late: dict | None = LATE, boards: tuple[str, ...] = ("b0", "b1", "b2", "b3")
) -> dict[str, dict]:
    windows_n = next(iter(networks.values()))["mse_xy_mm2"].shape[1]
    results = judge_findings(networks, boards=boards, contacts_n=CONTACTS_N[:windows_n], late=late)
    return {one["finding"]: one for one in results}


def verdicts(networks: dict, late: dict | None = LATE) -> dict[str, str]:
    return {name: one["verdict"] for name, one in findings_by_name(networks, late).items()}


def test_all_findings_are_supported_if_errors_are_like_those_of_the_paper():
    assert verdicts(PAPER) == dict.fromkeys((HIGHER_AND_FASTER, OFFSET, EACH_IS_WORSE, OVERESTIMATES), SUPPORTED)
    assert all(one["holds"] for one in findings_by_name(PAPER).values())


@pytest.mark.parametrize(
    ("finding", "changed", "late"),
    [
        (HIGHER_AND_FASTER, {"initial": errors(1.0, -0.1)}, LATE),  # The errors are higher, but do not grow faster.
        (HIGHER_AND_FASTER, {"initial": errors(0.0, 0.05)}, LATE),  # The errors grow faster, but are not higher.
        (OFFSET, {"initial": errors(0.1, 0.0)}, LATE),
        (EACH_IS_WORSE, {"each": errors(0.1, 0.01)}, LATE),
        (OVERESTIMATES, {}, LATE | {"bias_N": -0.02, "network_bias_N": [-0.02, -0.021, -0.02, -0.019]}),
    ],
)
def test_finding_is_contradicted_by_significant_opposite_errors(finding, changed, late):
    one = findings_by_name(PAPER | changed, late)[finding]
    assert (one["holds"], one["verdict"]) == (False, CONTRADICTED)


@pytest.mark.parametrize("finding", [HIGHER_AND_FASTER, OFFSET, EACH_IS_WORSE])
def test_finding_is_undecided_if_one_board_contradicts_the_others(finding):
    # On each board, the difference between two policies is multiplied by one of these factors. The mean of the factors
    # agrees with the finding of the paper, but one factor has the opposite sign.
    signs = (-1.0, 1.2, 0.3, 0.1)
    near = errors(0.2, 0.01)
    disagreeing = {
        name: values + np.array(signs)[:, None] * 0.1 * np.arange(1, 5) * values for name, values in near.items()
    }
    changed = {"each": disagreeing} if finding == EACH_IS_WORSE else {"initial": disagreeing}
    one = findings_by_name(PAPER | {"regular": near} | changed)[finding]
    assert (one["holds"], one["verdict"]) == (False, UNDECIDED)


def test_findings_from_a_single_network_have_no_verdict():
    alone = {policy: {name: values[:1] for name, values in metrics.items()} for policy, metrics in PAPER.items()}
    findings = findings_by_name(alone, LATE | {"network_bias_N": [0.02], "network_board": ["b0"]}, ("b0",))
    assert {one["verdict"] for one in findings.values()} == {FEW_BOARDS}
    assert {one["of_trainings"] for one in findings.values()} == {UNDECIDED}


def test_findings_have_a_verdict_over_networks_only_if_all_networks_are_of_one_board():
    one_board = findings_by_name(PAPER, LATE | {"network_board": ["b0"] * 4}, ("b0",) * 4)
    assert {one["verdict"] for one in one_board.values()} == {FEW_BOARDS}
    assert {one["of_trainings"] for one in one_board.values()} == {SUPPORTED}


def test_more_networks_per_board_do_not_narrow_the_interval_over_boards():
    twice = {
        policy: {name: np.repeat(values, 2, axis=0) for name, values in metrics.items()}
        for policy, metrics in PAPER.items()
    }
    late = LATE | {"network_bias_N": list(np.repeat(LATE["network_bias_N"], 2))}
    boards = ("b0", "b0", "b1", "b1", "b2", "b2", "b3", "b3")
    again, once = findings_by_name(twice, late | {"network_board": list(boards)}, boards), findings_by_name(PAPER)
    assert [one["verdict"] for one in again.values()] == [one["verdict"] for one in once.values()]
    assert again[OFFSET]["measured"] == once[OFFSET]["measured"]


def test_finding_is_contradicted_if_one_of_its_metrics_contradicts_it():
    falls = PAPER["initial"] | {"mse_f_N2": 0.02 - 0.004 * np.arange(4) + np.array([[0.0], [1e-5], [2e-5], [3e-5]])}
    assert verdicts(PAPER | {"initial": falls})[HIGHER_AND_FASTER] == CONTRADICTED
    unclear = PAPER["initial"] | {"mse_f_N2": PAPER["regular"]["mse_f_N2"] + np.array([[-1.0], [1.0], [0.3], [0.1]])}
    assert verdicts(PAPER | {"initial": unclear})[OFFSET] == UNDECIDED


def test_no_load_policies_are_compared_by_the_mean_over_all_windows():
    last_good = {name: values.copy() for name, values in errors(1.0, 0.5).items()}
    for values in last_good.values():
        values[:, -1] = 0
    assert verdicts(PAPER | {"initial": last_good})[OFFSET] == SUPPORTED


def test_errors_that_two_policies_share_do_not_affect_their_paired_difference():
    # These errors are added to those of each network under both policies.
    shared = np.array([0.0, 5.0, 9.0, 4.0])[:, None]
    regular = {name: values + shared for name, values in PAPER["regular"].items()}
    each_contact = {name: values + shared for name, values in PAPER["each"].items()}
    assert verdicts(PAPER | {"regular": regular, "each": each_contact})[EACH_IS_WORSE] == SUPPORTED
    before_each, other = (values["mse_xy_mm2"].mean(axis=1) for values in (each_contact, regular))
    low, high = ttest_rel(before_each, other).confidence_interval(0.95)
    difference = f"difference {(before_each - other).mean():+.2g} [{low:+.2g}, {high:+.2g}] mm²"
    assert difference in findings_by_name(PAPER | {"regular": regular, "each": each_contact})[EACH_IS_WORSE]["measured"]


@pytest.mark.parametrize(
    ("bias_N", "se_N", "networks_N", "verdict"),
    [
        (0.02, 0.0099, [0.02, 0.02, 0.02, 0.02], SUPPORTED),
        # The bias is less than two standard errors over indentations.
        (0.02, 0.0101, [0.02, 0.02, 0.02, 0.02], UNDECIDED),
        (-0.02, 0.0101, [-0.02, -0.02, -0.02, -0.02], UNDECIDED),
        (-0.02, 0.0099, [-0.02, -0.02, -0.02, -0.02], CONTRADICTED),
        # The biases of the four networks differ by more than their mean.
        (0.02, 0.0001, [-0.02, 0.06, 0.02, 0.02], UNDECIDED),
    ],
)
def test_bias_must_exceed_the_variation_over_indentations_and_networks(bias_N, se_N, networks_N, verdict):
    late = LATE | {"bias_N": bias_N, "bias_se_N": se_N, "network_bias_N": networks_N}
    assert findings_by_name(PAPER, late)[OVERESTIMATES]["of_trainings"] == verdict


def test_without_forces_only_place_errors_are_judged():
    two = {"initial": errors(1.0, 0.5, force=False), "each": errors(0.3, 0.01, force=False)}
    assert verdicts(two, None) == {HIGHER_AND_FASTER: SUPPORTED, OFFSET: SUPPORTED}
    assert not any("MSE_F" in one["measured"] for one in findings_by_name(two, None).values())


def test_findings_that_cannot_be_tested_are_omitted():
    assert findings_by_name({"initial": errors(1, 1)}, None) == {}
    one_window = {
        policy: {name: values[:, :1] for name, values in metrics.items()} for policy, metrics in PAPER.items()
    }
    assert set(findings_by_name(one_window, None)) == {OFFSET, EACH_IS_WORSE}


@given(st.lists(st.floats(0, 10), min_size=2, max_size=9))
def test_growth_of_errors_equals_the_slope_of_numpys_linear_fit(values):
    contacts_n = [5000 * i for i in range(len(values))]
    slope = np.polyfit(np.array(contacts_n) / 10_000, values, 1)[0]
    # The tolerance is rounding in double precision.
    assert growth(contacts_n, np.array([values, values])) == pytest.approx(slope, abs=1e-9)


def test_text_of_a_finding_states_both_errors_and_the_interval_of_their_difference():
    first, offset, third, late = (one["measured"] for one in findings_by_name(PAPER).values())
    assert first.startswith("MSE_xy, mean over windows: initial 1.75, regular 0.215, difference +1.5 [")
    assert "MSE_xy, growth in 10,000 contacts: initial 1, regular 0.02, difference +0.98 [" in first
    assert offset == "; ".join(first.split("; ")[:2])
    assert "MSE_F, mean over windows: each 0.00315, regular 0.00215" in third
    assert late == "bias of force: +0.02 [+0.019, +0.021] N (+1.7 %), slope 1.01"
