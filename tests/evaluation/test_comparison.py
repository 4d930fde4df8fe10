"""Cards over boards: naive loops as truth; equal test rows, the order of cards and swapped sides as laws."""

import numpy as np
import pytest

from pipeline.core.errors import SchemaError
from pipeline.core.seeds import rng_for
from pipeline.dataset.splits import Split, draw_folds
from pipeline.evaluation.comparison import over_boards, over_pairs, paired, paired_where_tested
from pipeline.evaluation.inference import interval
from pipeline.evaluation.metrics import METRICS
from pipeline.evaluation.summary import over_folds, pool_skins, score_groups
from tests.dataset.test_splits import six_by_three_in_passes
from tests.evaluation.test_summary import every

SKINS = [("b0", "s0"), ("b0", "s1"), ("b1", "s2"), ("b1", "s3")]


def looped_boards(cards: list[dict], others: list[dict], name: str) -> dict[str, float]:
    """Per held-out skin, the mean over seeds of one side less that of the other; then the mean of a board; plainly."""
    differences: dict[str, list[float]] = {}
    for fold, skin in SKINS:
        means = []
        for side in (cards, others):
            found = [
                one["scores"]["by_skin"][skin][name]
                for one in side
                if one["fold"] == fold and skin in one["scores"]["by_skin"]
            ]
            means.append(sum(found) / len(found))
        differences.setdefault(fold, []).append(means[0] - means[1])
    return {board: sum(own) / len(own) for board, own in differences.items()}


def test_paired_differences_are_those_of_naive_loops():
    cards, others = every(), every(off_mm=2.0)
    found = paired(cards, others)
    for name in METRICS:
        looped = looped_boards(cards, others, name)
        assert {board: one[name] for board, one in found["by_board"].items()} == pytest.approx(looped)
        mean = sum(looped.values()) / 2
        sd = sum((one - mean) ** 2 for one in looped.values()) ** 0.5
        ends = interval(list(looped.values()))
        assert found[name] == {
            "mean": pytest.approx(mean), "sd": pytest.approx(sd), "n": 2, "ci95": pytest.approx(ends)
        }  # fmt: skip
    assert found["mse_xy_mm2"]["mean"] < 0  # the first side is the better one


def test_swapping_the_sides_of_a_pair_negates_its_mean_and_keeps_its_spread():
    one, other = paired(every(), every(off_mm=2.0)), paired(every(off_mm=2.0), every())
    for name in METRICS:
        assert one[name]["mean"] == pytest.approx(-other[name]["mean"], rel=1e-12)  # float64
        assert one[name]["sd"] == pytest.approx(other[name]["sd"], rel=1e-12)


def test_nothing_differs_from_itself_and_pooling_changes_no_pair():
    assert paired(every(), every())["accuracy_pct"] == {"mean": 0.0, "sd": 0.0, "n": 2, "ci95": [0.0, 0.0]}
    assert paired(pool_skins(every()), every(off_mm=2.0)) == paired(every(), every(off_mm=2.0))


def test_the_order_of_cards_and_another_number_of_seeds_are_no_matter_for_pairs():
    cards, others = every(), every(off_mm=2.0)
    turned = paired(cards[::-1], others[::-1])
    for name in METRICS:
        assert turned[name]["ci95"] == pytest.approx(paired(cards, others)[name]["ci95"], rel=1e-9)  # float64
    assert paired(cards, others[:4])["accuracy_pct"]["n"] == 2


def test_a_force_that_no_recording_has_is_absent_from_pairs():
    assert set(paired(every(force=False), every(force=False))) == {"accuracy_pct", "mse_xy_mm2", "by_board"}


def test_sides_that_do_not_hold_the_same_skins_out_make_no_pair():
    with pytest.raises(SchemaError, match=r"held-out skins must be the same on both sides; got .*'b1', 's3'"):
        paired(every(), [card for card in every() if "s3" not in card["scores"]["by_skin"]])


def test_boards_are_summarised_as_folds_are_and_have_an_interval():
    cards = pool_skins(every())
    for name, stat in over_boards(cards).items():
        plain = over_folds(cards)[name]
        assert {key: stat[key] for key in ("mean", "sd", "n")} == pytest.approx(
            {key: plain[key] for key in ("mean", "sd", "n")}
        )
        values = [
            np.mean([card["scores"]["all"][name] for card in cards if card["fold"] == board]) for board in ("b0", "b1")
        ]
        assert stat["ci95"] == pytest.approx(interval(values))


def test_draws_of_one_board_are_no_boards():
    cards = [card | {"fold": f"{card['fold']}-draw{card['seed_i']}"} for card in pool_skins(every())]
    assert over_boards(cards) == over_boards(pool_skins(every()))
    alone = over_boards([card for card in cards if card["fold"].startswith("b0")])["accuracy_pct"]
    assert alone["n"] == 1
    assert "ci95" not in alone
    assert alone["sd_seeds"] > 0


def test_one_skin_on_others_counts_pairs_as_the_paper_does_and_its_interval_is_over_test_boards():
    rng = rng_for(0, "transfer")
    boards, skins = np.repeat(["b1", "b2"], 20), np.repeat(["b1_s0", "b1_s1", "b2_s0", "b2_s1"], 10)
    cards = []
    for fold in ("b0_s0", "b3_s0", "b4_s0"):
        true = rng.uniform(0, 16, (40, 3))
        cards.append({"fold": fold, "scores": score_groups(true, true + rng.normal(0, 2, true.shape), boards, skins)})
    stat = over_pairs(cards)["mse_xy_mm2"]
    assert stat["n"] == 3 * 4
    by_board = [
        np.mean([card["scores"]["by_skin"][f"{board}_s{i}"]["mse_xy_mm2"] for card in cards for i in range(2)])
        for board in ("b1", "b2")
    ]
    assert stat["ci95"] == pytest.approx(interval(by_board))


def test_one_skin_on_others_and_many_skins_are_tested_on_the_same_rows():
    split = Split(transfer_skins_n=3, pool_passes_n=2)
    table = six_by_three_in_passes(5)
    many = {skin: fold for fold in draw_folds(table, ["lobo"], split, 0) for skin in np.unique(table.skin[fold.test])}
    for fold in draw_folds(table, ["transfer"], split, 0):
        skins = np.unique(table.skin[fold.test])
        assert len(skins) == 9
        for skin in skins:
            pooled = many[skin].test
            assert fold.test[table.skin[fold.test] == skin].tolist() == pooled[table.skin[pooled] == skin].tolist()


def test_many_skins_are_compared_where_one_skin_was_tested():
    single = [card for card in every(off_mm=2.0) if "s2" in card["scores"]["by_skin"]]
    found = paired_where_tested(every(), single)
    assert list(found["by_board"]) == ["b1"]
    assert found["accuracy_pct"] == {
        "mean": pytest.approx(
            np.mean([card["scores"]["by_skin"]["s2"]["accuracy_pct"] for card in every() if card["fold"] == "b1"
                     and "s2" in card["scores"]["by_skin"]])
            - np.mean([card["scores"]["by_skin"]["s2"]["accuracy_pct"] for card in single])
        ),
        "n": 1,
    }  # fmt: skip
