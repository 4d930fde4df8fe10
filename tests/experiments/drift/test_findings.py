import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import ttest_rel

from pipeline.experiments.drift import EACH_IS_WORSE, HIGHER_AND_FASTER, OFFSET, OVERESTIMATES, findings, rates
from pipeline.statistics import FEW_BOARDS, INCONCLUSIVE, NO, YES

FIELD = {"contact_uT": 140.0, "noload_noise_uT": 1.25}
LATE = {
    "policy": "regular", "contacts_n": 45_000, "bias_N": 0.02, "bias_pct": 1.7, "bias_se_N": 7e-4, "slope": 1.01,
    "indentations_n": 1000, "force_left_pct": 98.1, "network_bias_N": [0.019, 0.0195, 0.0205, 0.021],
    "network_board": ["b0", "b1", "b2", "b3"],
}  # fmt: skip
OFF_uT = {"initial": 3.0, "regular": 2.0, "each": 0.0}
CONTACTS_N = [5000, 10_000, 15_000, 20_000]
BY_SEED = (-0.01, -0.003, 0.003, 0.01)  # one network against another


def errors(start: float, per_window: float, by_seed=BY_SEED, force: bool = True) -> dict[str, np.ndarray]:
    """Errors of a network a row, which grow by so much from one of four windows to the next."""
    places = np.array([[start * (1 + more) + i * per_window * (1 + more) for i in range(4)] for more in by_seed])
    return {"mse_xy_mm2": places} | ({"mse_f_N2": places / 100} if force else {})


PAPER = {"initial": errors(1.0, 0.5), "regular": errors(0.2, 0.01), "each": errors(0.3, 0.01)}


def found(
    networks: dict, late: dict | None = LATE, boards: tuple[str, ...] = ("b0", "b1", "b2", "b3")
) -> dict[str, dict]:
    rows = {
        policy: [
            {"contacts_n": n, "noload_off_uT": OFF_uT[policy]}
            for n, _ in zip(CONTACTS_N, of["mse_xy_mm2"].T, strict=False)
        ]
        for policy, of in networks.items()
    }
    return {one["finding"]: one for one in findings(rows, networks, boards=boards, field=FIELD, late=late)}


def verdicts(networks: dict, late: dict | None = LATE) -> dict[str, str]:
    return {name: one["verdict"] for name, one in found(networks, late).items()}


def test_errors_as_in_the_paper_show_all_its_findings_and_need_no_reason():
    assert verdicts(PAPER) == dict.fromkeys((HIGHER_AND_FASTER, OFFSET, EACH_IS_WORSE, OVERESTIMATES), YES)
    assert all(one["holds"] and "why" not in one for one in found(PAPER).values())


@pytest.mark.parametrize(
    ("finding", "changed", "late", "said"),
    [
        (HIGHER_AND_FASTER, {"initial": errors(1.0, -0.1)}, LATE, "is off by 3 µT"),  # higher, not faster
        (HIGHER_AND_FASTER, {"initial": errors(0.0, 0.05)}, LATE, "noise of 1.2 µT"),  # faster, not higher
        (OFFSET, {"initial": errors(0.1, 0.0)}, LATE, "changes the field by 140 µT"),
        (EACH_IS_WORSE, {"each": errors(0.1, 0.01)}, LATE, "off by 0.94 µT of drift"),  # 2^2 - 2 1.25^2 = 0.94^2
        (
            OVERESTIMATES, {},
            LATE | {"bias_N": -0.02, "bias_pct": -1.7, "network_bias_N": [-0.02, -0.021, -0.02, -0.019]},
            "explains a bias of +1.9 %",
        ),
    ],
)  # fmt: skip
def test_a_finding_that_is_the_other_way_round_says_no_and_why_with_numbers_of_the_run(finding, changed, late, said):
    one = found(PAPER | changed, late)[finding]
    assert (one["holds"], one["verdict"]) == (False, NO)
    assert said in one["why"]
    assert "Undecided" not in one["why"]


@pytest.mark.parametrize("finding", [HIGHER_AND_FASTER, OFFSET, EACH_IS_WORSE])
def test_what_another_board_turns_round_is_inconclusive_and_its_interval_includes_0(finding):
    signs = (-1.0, 1.2, 0.3, 0.1)  # of the difference, on each board: the mean is on the paper's side
    near = errors(0.2, 0.01)
    apart = {name: of + np.array(signs)[:, None] * 0.1 * np.arange(1, 5) * of for name, of in near.items()}
    changed = {"each": apart} if finding == EACH_IS_WORSE else {"initial": apart}
    one = found(PAPER | {"regular": near} | changed)[finding]
    assert (one["holds"], one["verdict"]) == (False, INCONCLUSIVE)
    assert one["why"].startswith("Undecided: the 95 % interval over boards includes 0 (MSE_xy, +")


def test_one_network_concludes_nothing_of_boards_nor_of_trainings():
    alone = {policy: {name: of[:1] for name, of in own.items()} for policy, own in PAPER.items()}
    told = found(alone, LATE | {"network_bias_N": [0.02], "network_board": ["b0"]}, ("b0",))
    assert {one["verdict"] for one in told.values()} == {FEW_BOARDS}
    assert {one["of_trainings"] for one in told.values()} == {INCONCLUSIVE}


def test_many_trainings_on_one_board_conclude_nothing_of_others_but_are_judged_as_trainings():
    one_board = found(PAPER, LATE | {"network_board": ["b0"] * 4}, ("b0",) * 4)
    assert {one["verdict"] for one in one_board.values()} == {FEW_BOARDS}
    assert {one["of_trainings"] for one in one_board.values()} == {YES}
    assert all(
        one["why"].startswith("Not judged: fewer than 4 boards say little of others. ") for one in one_board.values()
    )


def test_more_trainings_of_the_same_errors_make_no_board_surer():
    twice = {policy: {name: np.repeat(of, 2, axis=0) for name, of in own.items()} for policy, own in PAPER.items()}
    late = LATE | {"network_bias_N": list(np.repeat(LATE["network_bias_N"], 2))}
    boards = ("b0", "b0", "b1", "b1", "b2", "b2", "b3", "b3")
    again, once = found(twice, late | {"network_board": list(boards)}, boards), found(PAPER)
    assert [one["verdict"] for one in again.values()] == [one["verdict"] for one in once.values()]
    assert again[OFFSET]["measured"] == once[OFFSET]["measured"]


def test_one_metric_that_disagrees_is_enough_to_say_no_and_one_that_is_unclear_not_to_say_yes():
    falls = PAPER["initial"] | {"mse_f_N2": 0.02 - 0.004 * np.arange(4) + np.array([[0.0], [1e-5], [2e-5], [3e-5]])}
    assert verdicts(PAPER | {"initial": falls})[HIGHER_AND_FASTER] == NO
    unclear = PAPER["initial"] | {"mse_f_N2": PAPER["regular"]["mse_f_N2"] + np.array([[-1.0], [1.0], [0.3], [0.1]])}
    assert verdicts(PAPER | {"initial": unclear})[OFFSET] == INCONCLUSIVE


def test_more_frequent_readings_are_judged_over_all_windows_and_not_by_the_last():
    last_good = {name: of.copy() for name, of in errors(1.0, 0.5).items()}
    for of in last_good.values():
        of[:, -1] = 0
    assert verdicts(PAPER | {"initial": last_good})[OFFSET] == YES


def test_a_difference_is_of_pairs_so_that_what_both_share_is_no_error():
    shared = np.array([0.0, 5.0, 9.0, 4.0])[:, None]  # one seed is far worse under both policies
    regular = {name: of + shared for name, of in PAPER["regular"].items()}
    each = {name: of + shared for name, of in PAPER["each"].items()}
    assert verdicts(PAPER | {"regular": regular, "each": each})[EACH_IS_WORSE] == YES
    own, other = (of["mse_xy_mm2"].mean(axis=1) for of in (each, regular))
    low, high = ttest_rel(own, other).confidence_interval(0.95)
    said = f"(difference {(own - other).mean():+.2g} [{low:+.2g}, {high:+.2g}] mm²)"
    assert said in found(PAPER | {"regular": regular, "each": each})[EACH_IS_WORSE]["measured"]


@pytest.mark.parametrize(
    ("bias_N", "se_N", "networks_N", "verdict"),
    [
        (0.02, 0.0099, [0.02, 0.02, 0.02, 0.02], YES),
        (0.02, 0.0101, [0.02, 0.02, 0.02, 0.02], INCONCLUSIVE),  # two standard errors over indentations
        (-0.02, 0.0101, [-0.02, -0.02, -0.02, -0.02], INCONCLUSIVE),
        (-0.02, 0.0099, [-0.02, -0.02, -0.02, -0.02], NO),
        (0.02, 0.0001, [-0.02, 0.06, 0.02, 0.02], INCONCLUSIVE),  # trainings differ more
    ],
)
def test_a_bias_of_trainings_is_one_beyond_what_indentations_and_trainings_vary_by(bias_N, se_N, networks_N, verdict):
    late = LATE | {"bias_N": bias_N, "bias_se_N": se_N, "network_bias_N": networks_N}
    assert found(PAPER, late)[OVERESTIMATES]["of_trainings"] == verdict


def test_without_forces_only_places_are_judged_and_nothing_is_said_of_force():
    two = {"initial": errors(1.0, 0.5, force=False), "each": errors(0.3, 0.01, force=False)}
    assert verdicts(two, None) == {HIGHER_AND_FASTER: YES, OFFSET: YES}
    assert not any("MSE_F" in one["measured"] for one in found(two, None).values())


def test_a_policy_alone_or_a_single_window_leaves_out_what_it_cannot_tell():
    assert found({"initial": errors(1, 1)}, None) == {}
    one_window = {policy: {name: of[:, :1] for name, of in own.items()} for policy, own in PAPER.items()}
    assert set(found(one_window, None)) == {OFFSET, EACH_IS_WORSE}


@given(st.lists(st.floats(0, 10), min_size=2, max_size=9))
def test_the_rate_is_the_slope_that_numpy_fits(values):
    contacts_n = [5000 * i for i in range(len(values))]
    slope = np.polyfit(np.array(contacts_n) / 10_000, values, 1)[0]
    assert rates(contacts_n, np.array([values, values])) == pytest.approx(slope, abs=1e-9)  # both in double precision


def test_measured_sentences_hold_the_numbers_of_the_run():
    first, offset, third, late = (one["measured"] for one in found(PAPER).values())
    assert "MSE_xy is 1.75 against 0.215 mm² with regular ones" in first
    assert "changes by 1 against 0.02 mm² in 10,000 contacts" in first
    assert first.endswith("([low, high]: 95 %, Student's t over 4 boards).")
    assert offset.startswith("Mean over windows: MSE_xy is 0.215 mm² with regular ones, 1.75 with a single no-load")
    assert "MSE_F is 0.00315 against 0.00215 N²" in third
    assert "bias +0.02 ± 0.0007 N (+1.7 %)" in late
    assert "1000 indentations, mean over 4 network(s); +0.02 [+0.019, +0.021] N ([low, high]" in late
    assert "98.1 % of its early force" in late


def test_what_shows_in_one_error_alone_is_said_to():
    lower = PAPER["each"] | {"mse_xy_mm2": np.full((4, 4), 0.1)}
    third = found(PAPER | {"each": lower})[EACH_IS_WORSE]
    assert third["verdict"] == NO
    assert third["why"].startswith("It shows in MSE_F alone. ")
