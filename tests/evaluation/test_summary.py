import numpy as np
import pytest

from pipeline.core.seeds import rng_for
from pipeline.evaluation.metrics import METRICS, score
from pipeline.evaluation.summary import over_folds, over_test_skins, pool_skins, score_groups

RNG = rng_for(0, "summary")
TRUE = RNG.uniform(0, 16, (30, 3))
BOARD = np.repeat(["b0", "b1"], 15)
SKIN = np.repeat(["s0", "s1", "s2"], 10)
OFFSET = np.where(BOARD == "b0", 3.0, -2.0)[:, None] * [1.0, 1.0, 0.0]


def test_groups_are_scored_as_if_they_were_alone():
    predicted = TRUE + RNG.normal(0, 1, TRUE.shape)
    scores = score_groups(TRUE, predicted, BOARD, SKIN)
    assert scores["rows_n"] == 30
    assert scores["all"] == score(TRUE, predicted)
    assert scores["by_skin"]["s1"] == score(TRUE[10:20], predicted[10:20])


def test_one_offset_a_board_is_registration_and_the_true_places_do_not_change_the_result():
    scores = score_groups(TRUE, TRUE + OFFSET, BOARD, SKIN)
    assert scores["all"]["accuracy_pct"] == 0.0
    assert scores["registered"]["accuracy_pct"] == 100.0


def test_summaries_are_over_trainings_or_over_pairs_with_test_skins():
    cards = [
        {"fold": fold, "scores": score_groups(TRUE, TRUE + shift, BOARD, SKIN)}
        for fold, shift in (("b0", 0), ("b1", 2))
    ]
    assert over_folds(cards)["mse_xy_mm2"] == {"mean": pytest.approx(2.0), "n": 2, "sd": pytest.approx(8**0.5)}
    assert over_test_skins(cards)["mse_xy_mm2"]["n"] == 6


def test_seeds_of_one_fold_are_averaged_before_folds_are_counted():
    # squared errors: fold b0 has 0 and 4 (two seeds), fold b1 has 16
    cards = [
        {"fold": fold, "scores": score_groups(TRUE, TRUE + shift, BOARD, SKIN)}
        for fold, shift in (("b0", 0), ("b0", 2), ("b1", 4))
    ]
    summary = over_folds(cards)["mse_xy_mm2"]
    assert summary["n"] == 2
    assert summary["mean"] == pytest.approx((2 + 16) / 2)
    assert summary["sd"] == pytest.approx(14 / 2**0.5)
    assert summary["sd_seeds"] == pytest.approx(8**0.5)
    assert "sd" not in over_folds(cards[:2])["mse_xy_mm2"]


def adapted(fold: str, skin: str, seed_i: int, *, off_mm: float = 1.0, force: bool = True) -> dict:
    """The card of a network that was adapted to one skin, and misses by about so much on it."""
    rng = rng_for(seed_i, "adapted", fold, skin)
    true = rng.uniform(0, 16, (10, 3))
    predicted = true + rng.normal(0, off_mm, true.shape)
    if not force:
        true[:, 2] = np.nan
    scores = score_groups(true, predicted, np.repeat(fold, 10), np.repeat(skin, 10))
    return {"fold": fold, "seed_i": seed_i, "scores": scores}


def every(**changes: object) -> list[dict]:
    pairs = [("b0", "s0"), ("b0", "s1"), ("b1", "s2"), ("b1", "s3")]
    return [adapted(fold, skin, seed_i, **changes) for seed_i in range(3) for fold, skin in pairs]


def test_networks_adapted_to_one_skin_each_are_pooled_to_one_a_fold_and_seed():
    pooled = pool_skins(every())
    assert [(card["fold"], card["seed_i"]) for card in pooled] == [(f, i) for i in range(3) for f in ("b0", "b1")]
    for card in pooled:
        own = [one for one in every() if (one["fold"], one["seed_i"]) == (card["fold"], card["seed_i"])]
        for part in ("all", "registered"):
            for name in METRICS:
                total = 0.0
                for one in own:
                    total += one["scores"][part][name]
                assert card["scores"][part][name] == pytest.approx(total / 2, rel=1e-12)  # float64
        assert card["scores"]["by_skin"] == {**own[0]["scores"]["by_skin"], **own[1]["scores"]["by_skin"]}
        assert card["scores"]["board_of"] == {skin: card["fold"] for skin in card["scores"]["by_skin"]}
        assert card["scores"]["rows_n"] == 20


def test_skins_of_equally_many_rows_pool_to_the_score_of_all_their_rows():
    true = RNG.uniform(0, 16, (20, 3))
    predicted = true + RNG.normal(0, 1, true.shape)
    board, skin = np.repeat("b0", 20), np.repeat(["s0", "s1"], 10)
    parts = [slice(0, 10), slice(10, 20)]
    cards = [
        {"fold": "b0", "seed_i": 0, "scores": score_groups(true[one], predicted[one], board[one], skin[one])}
        for one in parts
    ]
    (pooled,) = pool_skins(cards)
    whole = score_groups(true, predicted, board, skin)
    assert pooled["scores"]["all"] == pytest.approx(whole["all"], rel=1e-12)  # float64
    assert pooled["scores"]["by_skin"] == whole["by_skin"]


def test_pooling_what_is_of_all_skins_already_changes_nothing():
    once = pool_skins(every())
    assert pool_skins(once) == once
