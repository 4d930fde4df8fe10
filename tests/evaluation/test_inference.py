"""Inference over boards: scipy's t tests and plain loops as truth; order, sign and shift as laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t, ttest_rel

from pipeline.core.errors import SchemaError
from pipeline.evaluation.inference import (
    INCONCLUSIVE,
    NO,
    ONE_BOARD,
    YES,
    all_of,
    board_means,
    interval,
    negated,
    on_skins_of,
    over_boards,
    paired,
    verdict,
    verdict_within,
)

DOUBLE = 1e-9  # sums of doubles of tens
VALUES = st.lists(st.floats(-50, 50), min_size=2, max_size=9).filter(lambda values: np.std(values) > 1e-3)
PAIRS = st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=2, max_size=9).filter(
    lambda pairs: np.std([a - b for a, b in pairs]) > 1e-3
)


def scored(values: dict[str, list[list[float]]]) -> list[tuple[str, str, dict[str, float]]]:
    """Scores by board, skin and network."""
    return [
        (board, f"{board}_s{i}", {"accuracy_pct": value})
        for board, skins in values.items() for i, networks in enumerate(skins) for value in networks
    ]  # fmt: skip


@given(VALUES)
def test_the_interval_is_that_of_scipy(values):
    low, high = t.interval(0.95, len(values) - 1, np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values)))
    assert interval(values) == pytest.approx([low, high], abs=DOUBLE)


@given(PAIRS)
def test_paired_boards_are_judged_as_by_the_paired_t_test(pairs):
    of, over = (
        [(f"b{i}", f"b{i}_s0", {"accuracy_pct": pair[side]}) for i, pair in enumerate(pairs)] for side in (0, 1)
    )
    stat = paired(of, over)["accuracy_pct"]
    test = ttest_rel(*np.array(pairs).T)
    low, high = test.confidence_interval(0.95)
    assert stat["ci95"] == pytest.approx([low, high], abs=DOUBLE)
    if abs(test.pvalue - 0.05) > 1e-6:
        assert (verdict(stat) == INCONCLUSIVE) == (test.pvalue > 0.05)


def test_differences_are_of_skins_then_boards_each_the_mean_of_its_networks():
    of = scored({"b0": [[1.0, 3.0], [10.0]], "b1": [[5.0]]})  # of b0: 2 and 10; unequal numbers of networks
    over = scored({"b0": [[1.0], [1.0, 3.0]], "b1": [[9.0]]})  # of b0: 1 and 2
    found = paired(of, over)
    assert found["by_board"] == {"b0": {"accuracy_pct": (1 + 8) / 2}, "b1": {"accuracy_pct": -4.0}}
    assert (found["accuracy_pct"]["mean"], found["accuracy_pct"]["n"]) == (0.25, 2)


def test_more_skins_or_networks_of_equal_scores_make_no_board_surer():
    once, thrice = ({f"b{i}": [[float(i)]] * n for i in range(3)} for n in (1, 3))
    nothing = {board: [[0.0]] * 3 for board in thrice}
    assert paired(scored(thrice), scored(nothing)) == paired(scored(once), scored({board: [[0.0]] for board in once}))


@given(VALUES, st.randoms())
def test_the_order_of_boards_and_scores_is_no_matter(values, random):
    of = scored({f"b{i}": [[value], [2 * value]] for i, value in enumerate(values)})
    over = scored({f"b{i}": [[1.0], [0.0]] for i in range(len(values))})
    shuffled = list(of)
    random.shuffle(shuffled)
    assert paired(shuffled, over[::-1]) == paired(of, over)


@given(VALUES)
def test_swapped_sides_turn_the_difference_and_the_verdict_round(values):
    of = scored({f"b{i}": [[value]] for i, value in enumerate(values)})
    over = scored({f"b{i}": [[1.0]] for i in range(len(values))})
    ahead, back = paired(of, over)["accuracy_pct"], paired(over, of)["accuracy_pct"]
    turned = negated(ahead)
    assert back["ci95"] == pytest.approx(turned["ci95"], abs=DOUBLE)
    assert back["mean"] == pytest.approx(turned["mean"], abs=DOUBLE)
    opposite = {YES: NO, NO: YES, INCONCLUSIVE: INCONCLUSIVE}
    assert verdict(turned) == opposite[verdict(ahead)]


@given(VALUES, st.floats(-50, 50))
def test_a_threshold_is_a_shift_of_all_boards(values, above):
    stat, shifted = over_boards(values), over_boards([value - above for value in values])
    if min(abs(end) for end in shifted["ci95"]) > DOUBLE:
        assert verdict(stat, above=above) == verdict(shifted)


@pytest.mark.parametrize(
    ("ends", "word"), [([0.1, 4.0], YES), ([-4.0, -0.1], NO), ([-0.1, 4.0], INCONCLUSIVE), ([0.0, 1.0], INCONCLUSIVE)]
)
def test_an_interval_that_includes_0_concludes_nothing(ends, word):
    assert verdict({"mean": 1.0, "n": 6, "ci95": ends}) == word


@pytest.mark.parametrize(
    ("ends", "word"),
    [([-4.9, 4.9], YES), ([5.1, 9.0], NO), ([-9.0, -5.1], NO), ([4.0, 6.0], INCONCLUSIVE), ([-9.0, 9.0], INCONCLUSIVE)],
)
def test_small_is_what_lies_wholly_between_both_limits(ends, word):
    assert verdict_within({"mean": 1.0, "n": 6, "ci95": ends}, 5.0) == word


def test_one_board_has_no_interval_and_concludes_nothing():
    stat = paired(scored({"b0": [[3.0], [4.0]]}), scored({"b0": [[1.0], [1.0]]}))["accuracy_pct"]
    assert stat == {"mean": 2.5, "n": 1}
    assert verdict(stat) == verdict_within(stat, 5.0) == verdict(negated(stat)) == ONE_BOARD


def test_repeats_on_one_skin_are_no_boards():
    assert verdict({"mean": 96.0, "sd": 0.1, "n": 5}, above=90.0) == ONE_BOARD  # n with no interval over boards


def test_a_claim_of_several_parts_holds_where_all_do_and_fails_where_one_does():
    assert all_of([YES, YES]) == YES
    assert all_of([YES, INCONCLUSIVE, NO]) == NO
    assert all_of([YES, INCONCLUSIVE]) == INCONCLUSIVE
    assert all_of([YES, ONE_BOARD]) == ONE_BOARD


def test_sides_with_other_skins_make_no_pair_unless_they_are_left_out_first():
    few, many = scored({"b0": [[1.0]]}), scored({"b0": [[2.0], [3.0]], "b1": [[4.0]]})
    with pytest.raises(SchemaError, match="held-out skins must be the same on both sides; got .*'b1_s0'"):
        paired(few, many)
    assert paired(on_skins_of(many, few), few)["by_board"] == {"b0": {"accuracy_pct": 1.0}}


def test_a_score_that_some_skins_lack_is_the_mean_of_those_that_have_it():
    known = [("b0", "s0", {"mse_f_N2": 1.0, "mse_xy_mm2": 2.0}), ("b0", "s1", {"mse_xy_mm2": 4.0})]
    assert board_means(known) == {"b0": {"mse_f_N2": 1.0, "mse_xy_mm2": 3.0}}
