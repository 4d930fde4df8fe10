"""Tests of the statistics over boards. They are compared with SciPy and with loops, and must have their symmetries."""

import io

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t, ttest_rel

from pipeline.scores import (
    AS_LABELLED,
    KEYS,
    REGISTERED,
    by_skin,
    make_table,
    read_scores,
    rows_of_cards,
    to_csv,
    whole,
    write_scores,
)  # fmt: skip
from pipeline.statistics import (
    holm,
    over_boards,
    over_folds,
    p_value_of,
    paired,
    paired_with_single,
    statistic,
    two_way_error,
)
from reskin.data.splits import Split, draw_folds
from reskin.errors import SchemaError
from reskin.metrics import METRICS, TRUTH, score_groups
from reskin.seeds import rng_for
from tests.data.test_splits import six_by_three_in_passes
from tests.report.synthetic import SKINS, adapted_cards, card

# Hypothesis tries fewer examples than usual, because building each table takes milliseconds.
FEW = settings(max_examples=25, deadline=None)
DOUBLE = 1e-9  # The relative rounding error of sums of numbers of about 10.
VALUES = st.lists(st.floats(-50, 50), min_size=4, max_size=9).filter(lambda values: np.std(values) > 1e-3)
PAIRS = st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=4, max_size=9).filter(
    lambda pairs: np.std([a - b for a, b in pairs]) > 1e-3
)
RNG = rng_for(0, "summary")
TRUE = RNG.uniform(0, 16, (30, 3))
SKIN = np.repeat(["s0", "s1", "s2"], 10)


def card_with_offset(fold: str, off_mm: float) -> dict:
    return card("lobo", fold, score_groups(TRUE, TRUE + off_mm, np.repeat(fold, 30), SKIN))


def skin_scores(**changes: object) -> pd.DataFrame:
    return by_skin(rows_of_cards(adapted_cards(**changes)))


def score_table(values: dict[str, list[list[float]]]) -> pd.DataFrame:
    """Return a score table with one row per network.

    For each board, `values` has one list per skin, with the scores of the networks.
    """
    rows = [
        {"board": board, "skin": f"{board}_s{i}", "accuracy_pct": value}
        for board, skins in values.items() for i, networks in enumerate(skins) for value in networks
    ]  # fmt: skip
    return pd.DataFrame(rows)


def board_scores(values: list[float]) -> pd.DataFrame:
    return score_table({f"b{i}": [[value]] for i, value in enumerate(values)})


def test_scores_are_averaged_over_the_seeds_of_a_fold_before_folds():
    # The squared errors of fold b0 are 0 and 4 for its two seeds. The squared error of fold b1 is 16.
    cards = [card_with_offset("b0", 0), card_with_offset("b0", 2) | {"seed_i": 1}, card_with_offset("b1", 4)]
    summary = over_folds(rows_of_cards(cards))["mse_xy_mm2"]
    assert summary.n == 2
    assert summary.mean == pytest.approx((2 + 16) / 2)
    assert summary.sd == pytest.approx(14 / 2**0.5)
    assert summary.sd_seeds == pytest.approx(8**0.5)
    assert over_folds(rows_of_cards(cards[:2]))["mse_xy_mm2"].sd is None


def test_scores_of_adapted_networks_are_averaged_over_skins_by_fold_and_seed():
    rows = whole(rows_of_cards(adapted_cards()))
    assert list(zip(rows.fold, rows.seed, strict=True)) == [(fold, i) for i in range(3) for fold in ("b0", "b1")]
    assert set(rows.rows_n) == {20}
    for places, part in ((AS_LABELLED, "all"), (REGISTERED, "registered")):
        for _, row in whole(rows_of_cards(adapted_cards()), places).iterrows():
            cards = [one for one in adapted_cards() if (one["fold"], one["seed_i"]) == (row.fold, row.seed)]
            for name in METRICS[
                :3
            ]:  # R^2 has a test of its own, test_score_of_a_board_is_computed_from_the_rows_of_all_its_skins.
                total = 0.0
                for one in cards:
                    total += one["scores"][part][name]
                # The tolerance is rounding in double precision.
                assert row[name] == pytest.approx(total / 2, rel=1e-12)


def test_score_of_a_board_is_computed_from_the_rows_of_all_its_skins():
    predicted = TRUE + RNG.normal(0, 1, TRUE.shape)
    board = np.repeat("b0", 30)
    parts = [slice(0, 10), slice(10, 30)]
    skins = [score_groups(TRUE[part], predicted[part], board[part], np.repeat(str(part), 30)[part]) for part in parts]
    (row,) = whole(rows_of_cards([card("adapt", "b0", scores) for scores in skins])).to_dict("records")
    whole_board = score_groups(TRUE, predicted, board, SKIN)["all"]
    assert [row[name] for name in METRICS] == pytest.approx([whole_board[name] for name in METRICS], rel=1e-12)


def test_table_is_equal_after_it_was_written_and_read(tmp_path):
    cards = rows_of_cards([card_with_offset("b0", 1), *adapted_cards()])
    # The parts are joint rows as labelled and registered, and one row per skin.
    assert len(cards) == (2 + 3) + (2 * 6 + 12)
    assert list(cards.columns) == [*KEYS, *METRICS, *TRUTH]
    swept = make_table([{"experiment": "pokes", "board": "b0", "pokes_n": 65, "accuracy_pct": 80.0, "bias_f_N": 0.5}])
    for name, part in (("a", cards), ("b", swept)):
        write_scores(tmp_path / name, part)
    table = read_scores([tmp_path / "a", tmp_path / "b"])
    pd.testing.assert_frame_equal(table[: len(cards)][list(cards)], cards)
    row = table.iloc[-1]
    assert (row["experiment"], row["method"], row["pokes_n"], row["bias_f_N"]) == ("pokes", "", 65, 0.5)
    again = pd.read_csv(io.StringIO(to_csv(table)))
    assert "draw" not in again  # columns without any value are left out
    np.testing.assert_allclose(again[list(METRICS)], table[list(METRICS)], rtol=1e-5)  # the CSV text has six digits


@given(VALUES)
def test_interval_equals_students_interval_of_scipy(values):
    low, high = t.interval(0.95, len(values) - 1, np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values)))
    assert statistic(values, boards=True).ci95 == pytest.approx([low, high], abs=DOUBLE)


@FEW
@given(PAIRS)
def test_paired_difference_equals_scipys_paired_t_test(pairs):
    stat = paired(*(board_scores([pair[side] for pair in pairs]) for side in (0, 1)))["accuracy_pct"]
    test = ttest_rel(*np.array(pairs).T)
    low, high = test.confidence_interval(0.95)
    assert stat.ci95 == pytest.approx([low, high], abs=DOUBLE)
    assert p_value_of(stat, 0) == pytest.approx(test.pvalue)


def test_differences_are_averaged_over_networks_then_skins_then_boards():
    # The means on the skins of b0 are 2 and 10. The skins have different numbers of networks.
    first = score_table({"b0": [[1.0, 3.0], [10.0]], "b1": [[5.0]]})
    second = score_table({"b0": [[1.0], [1.0, 3.0]], "b1": [[9.0]]})  # The means on the skins of b0 are 1 and 2.
    found = paired(first, second)
    assert found["by_board"] == {"b0": {"accuracy_pct": (1 + 8) / 2}, "b1": {"accuracy_pct": -4.0}}
    assert (found["accuracy_pct"].mean, found["accuracy_pct"].n) == (0.25, 2)


def looped_boards(cards: list[dict], others: list[dict], name: str) -> dict[str, float]:
    """Return the reference: the mean difference of each board, by loops over skins and seeds."""
    found: dict[str, list[float]] = {}
    for board, skin in SKINS:
        sides = [
            [one["scores"]["by_skin"][skin][name] for one in side if skin in one["scores"]["by_skin"]]
            for side in (cards, others)
        ]
        found.setdefault(board, []).append(sum(sides[0]) / len(sides[0]) - sum(sides[1]) / len(sides[1]))
    return {board: sum(differences) / len(differences) for board, differences in found.items()}


def test_paired_difference_equals_loops_over_skins_and_seeds():
    found = paired(skin_scores(), skin_scores(off_mm=2.0))
    for name in METRICS:
        looped = looped_boards(adapted_cards(), adapted_cards(off_mm=2.0), name)
        assert {board: one[name] for board, one in found["by_board"].items()} == pytest.approx(looped)
        mean = sum(looped.values()) / 2
        sd = sum((one - mean) ** 2 for one in looped.values()) ** 0.5
        assert found[name].to_json() == {
            "mean": pytest.approx(mean), "sd": pytest.approx(sd), "n": 2,
            "values": pytest.approx([looped[board] for board in sorted(looped)]),
        }  # fmt: skip
    assert found["mse_xy_mm2"].mean < 0  # The first method has the smaller error.


def test_methods_tested_on_different_skins_cannot_be_compared():
    few, many = score_table({"b0": [[1.0]]}), score_table({"b0": [[2.0], [3.0]], "b1": [[4.0]]})
    with pytest.raises(SchemaError, match="the same held-out skins, but only one method has scores on .*'b1_s0'"):
        paired(few, many)


def transfer_scores(values: dict[str, dict[str, float]]) -> pd.DataFrame:
    """Return a score table of networks that were trained on a single skin (a fold).

    `values` has the accuracy for each fold and test board.
    """
    rows = [
        {"fold": fold, "board": board, "skin": f"{board}_s0", "accuracy_pct": value}
        for fold, boards in values.items() for board, value in boards.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


def test_interval_of_a_difference_is_wider_if_the_gain_depends_on_the_training_skin():
    boards = [f"b{i}" for i in range(4)]
    equal_gains = transfer_scores(
        {fold: {board: 20.0 + i for i, board in enumerate(boards)} for fold in ("t0", "t1", "t2")}
    )
    different_gains = transfer_scores(
        {f"t{j}": {board: 20.0 + i + 10 * j for i, board in enumerate(boards)} for j in range(3)}
    )
    many = board_scores([80.0, 81.0, 82.0, 83.0])
    certain, uncertain = (paired_with_single(many, one)["accuracy_pct"] for one in (equal_gains, different_gains))
    assert certain.mean == pytest.approx(60.0)
    assert certain.ci95 == pytest.approx([60.0, 60.0])  # All gains are equal, so the interval has no width.
    # The mean gain is 50 on every board. For the three training skins it is 60, 50 and 40, so the variance of the mean
    # is 100 / 3 with two degrees of freedom.
    low, high = t.interval(0.95, 2, 50, np.sqrt(100 / 3))
    assert uncertain.ci95 == pytest.approx([low, high])
    assert p_value_of(uncertain, 0) == pytest.approx(2 * t.sf(50 / np.sqrt(100 / 3), 2))
    assert paired_with_single(board_scores([80.0] * 4), transfer_scores({"t0": {"b1": 79.0}}))["by_board"] == {
        "b1": {"accuracy_pct": 1.0}
    }
    with pytest.raises(SchemaError, match="the same held-out skins"):
        paired_with_single(board_scores([80.0]), equal_gains)


@FEW
@given(VALUES, VALUES)
def test_variance_over_training_skins_and_boards_is_the_sum_of_both_variances(rows, columns):
    table = pd.DataFrame(np.add.outer(rows, columns))
    se, freedom = two_way_error(table)
    row_variance, column_variance = (np.var(part, ddof=1) / len(part) for part in (rows, columns))
    assert se**2 == pytest.approx(row_variance + column_variance)
    assert min(len(rows), len(columns)) - 1 <= freedom * (1 + 1e-9)
    assert freedom <= (len(rows) + len(columns) - 2) * (1 + 1e-9)
    assert two_way_error(table[[0, 1]]) is None  # The variance is undefined for two boards.


@FEW
@given(st.lists(st.floats(1, 99), min_size=4, max_size=9))
def test_intervals_stay_in_the_range_of_the_metric(values):
    mean = float(np.mean(values))
    for metric, low, high in (("accuracy_pct", 0, 100), ("mse_xy_mm2", 0, np.inf)):
        ends = statistic(values, boards=True, metric=metric).ci95
        assert low <= ends[0] <= mean * (1 + 1e-12)
        assert mean * (1 - 1e-12) <= ends[1] <= high
    # These values are far below the upper limit of 1.
    ends = statistic([1 - value for value in values], boards=True, metric="r2_f").ci95
    assert ends[0] <= 1 - mean + 1e-9
    assert 1 - mean - 1e-9 <= ends[1] <= 1


@FEW
@given(st.dictionaries(st.text(min_size=1, max_size=3), st.floats(0, 1), min_size=1, max_size=8))
def test_corrected_p_values_equal_the_definition_of_holm(p_values):
    adjusted, names = holm(p_values), sorted(p_values, key=lambda name: p_values[name])
    for rank, name in enumerate(names):
        worst = max((len(names) - i) * p_values[names[i]] for i in range(rank + 1))
        assert adjusted[name] == min(1.0, worst)


def test_means_over_boards_equal_means_over_folds_if_each_fold_is_a_board():
    rows = rows_of_cards(adapted_cards())
    for name, stat in over_boards(rows).items():
        plain = over_folds(rows)[name]
        assert stat.to_json().keys() == {"mean", "n", "sd", "values"}
        assert (stat.mean, stat.sd, stat.n) == (plain.mean, plain.sd, plain.n)
        means = [
            np.mean([one["scores"]["all"][name] for one in adapted_cards() if one["fold"] == board])
            for board in ("b0", "b1")
        ]
        if (
            name != "r2_f"
        ):  # R^2 has a test of its own, test_score_of_a_board_is_computed_from_the_rows_of_all_its_skins.
            assert stat.values == pytest.approx(means)


def test_experiment_transfer_tests_each_skin_on_the_same_rows_as_experiment_lobo():
    split = Split(transfer_skins_n=3, pool_passes_n=2)
    table = six_by_three_in_passes(5)
    many = {skin: fold for fold in draw_folds(table, ["lobo"], split, 0) for skin in np.unique(table.skin[fold.test])}
    for fold in draw_folds(table, ["transfer"], split, 0):
        skins = np.unique(table.skin[fold.test])
        assert len(skins) == 9
        for skin in skins:
            pooled = many[skin].test
            assert fold.test[table.skin[fold.test] == skin].tolist() == pooled[table.skin[pooled] == skin].tolist()
