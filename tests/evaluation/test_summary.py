import numpy as np
import pytest

from pipeline.evaluation.metrics import score
from pipeline.evaluation.summary import over_folds, over_test_skins, score_groups
from pipeline.seeds import rng_for

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
