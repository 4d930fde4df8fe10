"""Tests of experiments flexible, manual and shear: scores, and differences between variants."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import mean_squared_error, r2_score

from pipeline.experiments import shear
from pipeline.experiments.flexible import sizes_by_depth, strength_ratio
from pipeline.experiments.manual import GRID, add_hand_pokes
from pipeline.scores import by_skin, make_table, rows_of_cards
from pipeline.statistics import Stat, paired
from pipeline.training.variants import (
    AFTER,
    BEFORE,
    CONTROL,
    VariantPrediction,
    compare_variants,
    score_variants,
    summarise_variants,
)
from reskin.data.rows import Selection, gather
from reskin.errors import ParamsError
from reskin.metrics import METRICS, score, score_groups, score_shear
from reskin.seeds import rng_for
from tests.data.tables import readings
from tests.report.synthetic import card

SINGLE = 1e-4  # This is an upper limit for the rounding error of sums of forces of a few N in single precision.


BOARD = {"s0": "b0", "s1": "b0", "s2": "b1"}


def truth(skin: str, n: int = 30) -> np.ndarray:
    return rng_for(0, "truth", skin).uniform([0, 0, 0.2], [16, 16, 3], (n, 3)).astype(np.float32)


def prediction(variant: str, skin: str, seed_i: int, spread: float = 1.0) -> VariantPrediction:
    true = truth(skin)
    noise = rng_for(0, variant, skin, seed_i).normal(0, spread, true.shape)
    return VariantPrediction(variant, BOARD[skin], skin, seed_i, true, (true + noise).astype(np.float32))


PREDICTIONS = [
    prediction(variant, skin, seed_i, spread)
    for variant, spread in ((BEFORE, 1.0), (AFTER, 0.5), (CONTROL, 1.0), (GRID, 0.3))
    for skin in ("s0", "s1", "s2") for seed_i in (0, 1)
]  # fmt: skip


TABLE = score_variants("manual", PREDICTIONS)


@given(st.floats(-2, 2))
def test_bias_of_predicted_forces_equals_the_added_force(over_N):
    true = truth("s0")
    predicted = true + np.array([5, -5, over_N], np.float32)
    (row,) = score_variants("flexible", [VariantPrediction(BEFORE, "b0", "s0", 0, true, predicted)]).to_dict("records")
    assert row["bias_f_N"] == pytest.approx(over_N, abs=SINGLE)
    assert row["bias_f_pct"] == pytest.approx(100 * over_N / true[:, 2].mean(), abs=100 * SINGLE)


def test_score_of_a_board_is_the_mean_over_its_skins_and_seeds():
    adapted = [one for one in PREDICTIONS if one.variant == AFTER]
    skins = {
        skin: np.mean([score(one.true, one.predicted)["mse_xy_mm2"] for one in adapted if one.skin == skin])
        for skin in BOARD
    }
    boards = [(skins["s0"] + skins["s1"]) / 2, skins["s2"]]
    ours = summarise_variants(TABLE)[AFTER]["mse_xy_mm2"]
    assert ours.mean == pytest.approx(np.mean(boards))
    assert ours.values == pytest.approx(boards)
    assert ours.n == 2


def test_differences_equal_those_computed_from_model_cards():
    cards = {
        variant: [
            card("adapt", a.board, score_groups(a.true, a.predicted, np.full(30, a.board), np.full(30, a.skin)))
            for a in PREDICTIONS if a.variant == variant
        ]
        for variant in (BEFORE, AFTER)
    }  # fmt: skip
    after, before = (by_skin(rows_of_cards(cards[variant])) for variant in (AFTER, BEFORE))
    result = compare_variants(TABLE, AFTER, BEFORE)
    assert result | {name: replace(result[name], sd_seeds=None) for name in METRICS} == paired(after, before)


def hand_readings(skin: str):
    press, unknown = np.repeat(np.arange(3, dtype=np.int32), 2), np.full(6, np.nan, np.float32)
    return readings(
        f"{skin}-hand", "b0", skin, indentation=press, pass_i=np.zeros(6, np.int32), x_mm=unknown, y_mm=unknown,
        Fz_N=unknown,
    )  # fmt: skip


def test_hand_pokes_are_appended_with_fields_and_lines_but_without_labels():
    grid = gather([readings()], Selection(force_min_N=0.0))
    rows, lines = add_hand_pokes(grid, [hand_readings("s1"), hand_readings("s2")])
    assert len(rows) == 6 + 12
    assert np.isnan(rows.target[6:]).all()
    assert rows.db_uT[6:, 0].tolist() == [0, 1, 2, 3, 4, 5] * 2
    assert len({*rows.indentation}) == 6 + 6
    for skin, first in (("s1", 6), ("s2", 12)):
        assert lines[skin].row.tolist() == list(range(first, first + 6))
        assert lines[skin].order_i.tolist() == [0, 0, 1, 1, 2, 2]
    with pytest.raises(ParamsError, match="skin s1 also has manual pokes in another capture"):
        add_hand_pokes(grid, [hand_readings("s1"), hand_readings("s1")])


@given(st.floats(0.5, 3))
def test_strength_ratio_equals_the_factor_between_two_sets_of_field_changes(ratio):
    rng = rng_for(1, "fields")
    depth_mm = np.tile(np.array([0.2, 0.8, 1.2], np.float32), 20)
    db_uT = rng.normal(0, 50, (60, 15)).astype(np.float32)
    none_uT = np.zeros_like(db_uT)
    rigid = sizes_by_depth(readings(f=60, depth_mm=depth_mm, b_uT=db_uT, noload_uT=none_uT))
    flexible = sizes_by_depth(
        readings(f=60, depth_mm=depth_mm + np.float32(1e-4), b_uT=db_uT * np.float32(ratio), noload_uT=none_uT)
    )
    result = strength_ratio([flexible], [rigid])
    assert result.mean == pytest.approx(ratio, rel=SINGLE)
    assert result.sd == pytest.approx(0, abs=SINGLE)
    assert result.n == 3


def make_drag(seed: int, n: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = rng_for(seed, "shear")
    true = rng.normal(0, [5, 5, 0.3, 0.3, 1], (n, 5)).astype(np.float32)
    return true, (true + rng.normal(0, [1, 1, 0.1, 0.2, 0.3], (n, 5))).astype(np.float32)


@given(st.integers(0, 1000))
def test_errors_of_five_targets_equal_those_of_scikit_learn(seed):
    true, predicted = make_drag(seed)
    ours, rel = score_shear(true, predicted), 1e-5  # Inputs are in single precision, so the relative tolerance is 1e-5.
    assert ours["mse_xy_mm2"] == pytest.approx(mean_squared_error(true[:, :2], predicted[:, :2]), rel=rel)
    assert ours["mse_fxy_N2"] == pytest.approx(mean_squared_error(true[:, 2:4], predicted[:, 2:4]), rel=rel)
    assert ours["mse_fz_N2"] == pytest.approx(mean_squared_error(true[:, 4], predicted[:, 4]), rel=rel)
    assert ours["explained_fz"] == pytest.approx(r2_score(true[:, 4], predicted[:, 4]), rel=rel, abs=1e-6)
    near = [abs(p[0] - t[0]) <= 1 and abs(p[1] - t[1]) <= 1 for t, p in zip(true, predicted, strict=True)]
    assert ours["accuracy_pct"] == pytest.approx(100 * sum(near) / len(near))


def test_scores_of_shear_are_averaged_over_seeds_before_folds():
    rows = [("line", "a", 0, 1.0), ("line", "a", 1, 3.0), ("line", "b", 0, 6.0), ("line", "b", 1, 6.0)]
    rows += [("reading", *others) for _, *others in rows[:2]]
    names = ("split", "fold", "seed", "mse_fz_N2")
    summary = shear.summarise(make_table(dict(zip(names, row, strict=True)) for row in rows), {"lines_n": 3})
    by_line = {"mean": 4.0, "n": 2, "sd": pytest.approx(8**0.5), "sd_seeds": pytest.approx(2**-0.5)}
    assert summary["by_line"]["mse_fz_N2"].to_json() == by_line
    assert summary["mse_fz_N2"] == Stat(2.0, 1, sd_seeds=pytest.approx(2**0.5))
    assert (summary["seeds_n"], summary["lines_n"]) == (2, 3)
