"""Experiments flexible and manual: force bias, differences of variants on equal skins, strength of fields."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.flexible import (  # fmt: skip
    DRAWN_N,
    draw_forces,
    sizes_by_depth,
    strength_ratio,
    summarise_flexible,
)
from pipeline.experiments.manual import GRID, summarise_manual
from pipeline.statistics import by_skin, paired, tidy
from pipeline.training.variants import (
    AFTER,
    BEFORE,
    CONTROL,
    VariantPrediction,
    bias,
    compare_variants,
    force_biases,
    summarise_variants,
)
from reskin.metrics import METRICS, score, score_groups
from reskin.seeds import rng_for
from tests.data.tables import readings
from tests.report.cards import card

SINGLE = 1e-4  # sums of single-precision forces of some newtons


BOARD = {"s0": "b0", "s1": "b0", "s2": "b1"}


def truth(skin: str, f: int = 30) -> np.ndarray:
    return rng_for(0, "truth", skin).uniform([0, 0, 0.2], [16, 16, 3], (f, 3)).astype(np.float32)


def prediction(arm: str, skin: str, seed_i: int, spread: float = 1.0) -> VariantPrediction:
    true = truth(skin)
    noise = rng_for(0, arm, skin, seed_i).normal(0, spread, true.shape)
    return VariantPrediction(arm, BOARD[skin], skin, seed_i, true, (true + noise).astype(np.float32))


PREDICTIONS = [
    prediction(arm, skin, seed_i, spread)
    for arm, spread in ((BEFORE, 1.0), (AFTER, 0.5), (CONTROL, 1.0), (GRID, 0.3))
    for skin in ("s0", "s1", "s2") for seed_i in (0, 1)
]  # fmt: skip


@given(st.floats(-2, 2))
def test_the_bias_is_what_was_added_to_every_force(over_N):
    true = truth("s0")
    found = bias(true, true + np.array([5, -5, over_N], np.float32))
    assert found["bias_f_N"] == pytest.approx(over_N, abs=SINGLE)
    assert found["bias_f_pct"] == pytest.approx(100 * over_N / true[:, 2].mean(), abs=100 * SINGLE)


def test_forces_half_as_large_again_are_a_bias_of_fifty_percent():
    true = truth("s0")
    answers = [
        VariantPrediction(BEFORE, "b0", "s0", 0, true, true * np.float32(1.5)),
        VariantPrediction(AFTER, "b0", "s0", 0, true, true),
    ]
    assert force_biases(answers)["bias_f_pct"][BEFORE]["mean"] == pytest.approx(50, abs=100 * SINGLE)
    assert force_biases(answers)["bias_f_N"][AFTER]["mean"] == 0


def test_a_board_is_the_mean_of_its_skins_and_a_skin_of_its_seeds():
    own = [one for one in PREDICTIONS if one.variant == AFTER]
    skins = {
        skin: np.mean([score(one.true, one.predicted)["mse_xy_mm2"] for one in own if one.skin == skin])
        for skin in BOARD
    }
    boards = [(skins["s0"] + skins["s1"]) / 2, skins["s2"]]
    ours = summarise_variants(PREDICTIONS)[AFTER]["mse_xy_mm2"]
    assert ours["mean"] == pytest.approx(np.mean(boards))
    assert ours["values"] == pytest.approx(boards)
    assert ours["n"] == 2


def test_differences_are_those_of_the_summary_of_cards():
    cards = {
        arm: [
            card("adapt", a.board, score_groups(a.true, a.predicted, np.full(30, a.board), np.full(30, a.skin)))
            for a in PREDICTIONS if a.variant == arm
        ]
        for arm in (BEFORE, AFTER)
    }  # fmt: skip
    of, over = (by_skin(tidy(cards[arm])) for arm in (AFTER, BEFORE))
    found = compare_variants(PREDICTIONS, AFTER, BEFORE)
    for name in METRICS:
        del found[name]["sd_seeds"]
    assert found == paired(of, over)


def by_seed(arm: str, skin: str) -> np.ndarray:
    own = sorted((one for one in PREDICTIONS if (one.variant, one.skin) == (arm, skin)), key=lambda one: one.seed_i)
    return np.array([score(one.true, one.predicted)["mse_xy_mm2"] for one in own])


def test_the_spread_over_seeds_is_that_of_one_skins_networks_and_differences_pair_equal_seeds():
    found = summarise_variants(PREDICTIONS)[AFTER]["mse_xy_mm2"]
    assert found["sd_seeds"] == pytest.approx(np.mean([by_seed(AFTER, skin).std(ddof=1) for skin in BOARD]))
    found = compare_variants(PREDICTIONS, AFTER, BEFORE)["mse_xy_mm2"]
    differences = [by_seed(AFTER, skin) - by_seed(BEFORE, skin) for skin in BOARD]
    assert found["sd_seeds"] == pytest.approx(np.mean([one.std(ddof=1) for one in differences]))


def test_one_network_has_no_spread_over_seeds():
    first = [one for one in PREDICTIONS if one.seed_i == 0]
    assert "sd_seeds" not in summarise_variants(first)[AFTER]["accuracy_pct"]
    assert "sd_seeds" not in compare_variants(first, AFTER, BEFORE)["accuracy_pct"]
    assert "sd_seeds" in summarise_manual(PREDICTIONS, pokes_n=[3], lines_n=[1])["after"]["accuracy_pct"]
    assert "sd_seeds" in summarise_flexible(PREDICTIONS)["bias_f_N"][AFTER]


def test_the_summary_of_hand_pokes_has_counts_and_differences():
    answer = summarise_manual(PREDICTIONS, pokes_n=[325, 324, 325], lines_n=[13, 13, 13])
    counts = ("pokes_n", "lines_n", "skins_n", "boards_n", "seeds_n")
    assert {name: answer[name] for name in counts} == dict(zip(counts, (325, 13, 3, 2, 2), strict=True))
    for other in (BEFORE, CONTROL, GRID):
        difference = answer["paired"][f"after_minus_{other}"]["accuracy_pct"]["mean"]
        after, before = (answer[arm]["accuracy_pct"]["mean"] for arm in (AFTER, other))
        assert difference == pytest.approx(after - before)


def test_without_a_control_there_is_no_difference_to_it():
    answer = summarise_manual([one for one in PREDICTIONS if one.variant != CONTROL], pokes_n=[3], lines_n=[1])
    assert CONTROL not in answer
    assert "after_minus_control" not in answer["paired"]


@given(st.floats(0.5, 3))
def test_the_strength_ratio_is_that_of_scaled_fields_at_every_depth(ratio):
    rng = rng_for(1, "fields")
    depth_mm = np.tile(np.array([0.2, 0.8, 1.2], np.float32), 20)
    db_uT = rng.normal(0, 50, (60, 15)).astype(np.float32)
    none_uT = np.zeros_like(db_uT)
    rigid = sizes_by_depth(readings(f=60, depth_mm=depth_mm, b_uT=db_uT, noload_uT=none_uT))
    flexible = sizes_by_depth(
        readings(f=60, depth_mm=depth_mm + np.float32(1e-4), b_uT=db_uT * np.float32(ratio), noload_uT=none_uT)
    )
    found = strength_ratio([flexible], [rigid])
    assert found["mean"] == pytest.approx(ratio, rel=SINGLE)
    assert found["sd"] == pytest.approx(0, abs=SINGLE)
    assert found["n"] == 3


def test_depths_that_only_one_kind_of_board_has_are_not_compared():
    one, other = ({d: np.array([float(i + d)]) for d in depths} for i, depths in ((1, (0.2, 0.4)), (3, (0.4, 0.6))))
    assert strength_ratio([one], [other]) == {"mean": pytest.approx(1.4 / 3.4), "n": 1}


def test_the_figure_shows_equal_readings_of_both_variants():
    many = [VariantPrediction(arm, "b0", "s0", 0, truth("s0", 900), truth("s0", 900)) for arm in (BEFORE, AFTER)]
    drawn = draw_forces(many, rng_for(0, "drawn"))
    assert drawn[BEFORE]["true_N"] == drawn[AFTER]["true_N"] == drawn[AFTER]["predicted_N"]
    assert len(drawn[BEFORE]["true_N"]) == DRAWN_N
    assert set(np.round(truth("s0", 900)[:, 2].astype(float), 3)) >= set(drawn[BEFORE]["true_N"])


def test_flexible_numbers_hold_every_variant_and_its_bias():
    answer = summarise_flexible(PREDICTIONS)
    assert set(answer["bias_f_N"]) == {BEFORE, AFTER, CONTROL, GRID} < set(answer)
