"""Tests of experiments flexible, manual and shear: scores, differences between variants, tables and figures."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import mean_squared_error, r2_score

from pipeline.experiments import flexible, manual, shear
from pipeline.experiments.flexible import (  # fmt: skip
    DRAWN_N,
    draw_forces,
    sizes_by_depth,
    strength_ratio,
    summarise_flexible,
)
from pipeline.experiments.manual import GRID, summarise_manual
from pipeline.experiments.shear import score5, summarise_shear
from pipeline.formatting import to_markdown
from pipeline.paper import FLEXIBLE, MANUAL, SHEAR
from pipeline.scores import by_skin, rows_of_cards
from pipeline.statistics import paired
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
from tests.report.synthetic import card, texts_of

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


@given(st.floats(-2, 2))
def test_bias_of_predicted_forces_equals_the_added_force(over_N):
    true = truth("s0")
    result = bias(true, true + np.array([5, -5, over_N], np.float32))
    assert result["bias_f_N"] == pytest.approx(over_N, abs=SINGLE)
    assert result["bias_f_pct"] == pytest.approx(100 * over_N / true[:, 2].mean(), abs=100 * SINGLE)


def test_bias_is_also_given_in_percent_of_the_true_force():
    true = truth("s0")
    predictions = [
        VariantPrediction(BEFORE, "b0", "s0", 0, true, true * np.float32(1.5)),
        VariantPrediction(AFTER, "b0", "s0", 0, true, true),
    ]
    assert force_biases(predictions)["bias_f_pct"][BEFORE]["mean"] == pytest.approx(50, abs=100 * SINGLE)
    assert force_biases(predictions)["bias_f_N"][AFTER]["mean"] == 0


def test_score_of_a_board_is_the_mean_over_its_skins_and_seeds():
    adapted = [one for one in PREDICTIONS if one.variant == AFTER]
    skins = {
        skin: np.mean([score(one.true, one.predicted)["mse_xy_mm2"] for one in adapted if one.skin == skin])
        for skin in BOARD
    }
    boards = [(skins["s0"] + skins["s1"]) / 2, skins["s2"]]
    ours = summarise_variants(PREDICTIONS)[AFTER]["mse_xy_mm2"]
    assert ours["mean"] == pytest.approx(np.mean(boards))
    assert ours["values"] == pytest.approx(boards)
    assert ours["n"] == 2


def test_differences_equal_those_computed_from_model_cards():
    cards = {
        variant: [
            card("adapt", a.board, score_groups(a.true, a.predicted, np.full(30, a.board), np.full(30, a.skin)))
            for a in PREDICTIONS if a.variant == variant
        ]
        for variant in (BEFORE, AFTER)
    }  # fmt: skip
    after, before = (by_skin(rows_of_cards(cards[variant])) for variant in (AFTER, BEFORE))
    result = compare_variants(PREDICTIONS, AFTER, BEFORE)
    for name in METRICS:
        del result[name]["sd_seeds"]
    assert result == paired(after, before)


def scores_by_seed(variant: str, skin: str) -> np.ndarray:
    by_seed = sorted(
        (one for one in PREDICTIONS if (one.variant, one.skin) == (variant, skin)), key=lambda one: one.seed_i
    )
    return np.array([score(one.true, one.predicted)["mse_xy_mm2"] for one in by_seed])


def test_differences_between_variants_are_paired_by_seed():
    result = summarise_variants(PREDICTIONS)[AFTER]["mse_xy_mm2"]
    assert result["sd_seeds"] == pytest.approx(np.mean([scores_by_seed(AFTER, skin).std(ddof=1) for skin in BOARD]))
    result = compare_variants(PREDICTIONS, AFTER, BEFORE)["mse_xy_mm2"]
    differences = [scores_by_seed(AFTER, skin) - scores_by_seed(BEFORE, skin) for skin in BOARD]
    assert result["sd_seeds"] == pytest.approx(np.mean([one.std(ddof=1) for one in differences]))


def test_scores_of_one_network_have_no_standard_deviation_over_seeds():
    first = [one for one in PREDICTIONS if one.seed_i == 0]
    assert "sd_seeds" not in summarise_variants(first)[AFTER]["accuracy_pct"]
    assert "sd_seeds" not in compare_variants(first, AFTER, BEFORE)["accuracy_pct"]
    assert "sd_seeds" in summarise_manual(PREDICTIONS, pokes_n=[3], lines_n=[1])["after"]["accuracy_pct"]
    assert "sd_seeds" in summarise_flexible(PREDICTIONS)["bias_f_N"][AFTER]


def test_summary_of_hand_pokes_has_counts_and_differences():
    summary = summarise_manual(PREDICTIONS, pokes_n=[325, 324, 325], lines_n=[13, 13, 13])
    counts = ("pokes_n", "lines_n", "skins_n", "boards_n", "seeds_n")
    assert {name: summary[name] for name in counts} == dict(zip(counts, (325, 13, 3, 2, 2), strict=True))
    for other in (BEFORE, CONTROL, GRID):
        difference = summary["paired"][f"after_minus_{other}"]["accuracy_pct"]["mean"]
        after, before = (summary[variant]["accuracy_pct"]["mean"] for variant in (AFTER, other))
        assert difference == pytest.approx(after - before)


def test_summary_has_no_difference_from_the_control_if_there_is_no_control():
    summary = summarise_manual([one for one in PREDICTIONS if one.variant != CONTROL], pokes_n=[3], lines_n=[1])
    assert CONTROL not in summary
    assert "after_minus_control" not in summary["paired"]


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
    assert result["mean"] == pytest.approx(ratio, rel=SINGLE)
    assert result["sd"] == pytest.approx(0, abs=SINGLE)
    assert result["n"] == 3


def test_strength_ratio_ignores_depths_that_only_one_variant_has():
    one, other = ({d: np.array([float(i + d)]) for d in depths} for i, depths in ((1, (0.2, 0.4)), (3, (0.4, 0.6))))
    assert strength_ratio([one], [other]) == {"mean": pytest.approx(1.4 / 3.4), "n": 1}


def test_figure_shows_the_same_random_readings_of_both_variants():
    many = [
        VariantPrediction(variant, "b0", "s0", 0, truth("s0", 900), truth("s0", 900)) for variant in (BEFORE, AFTER)
    ]
    plotted = draw_forces(many, rng_for(0, "drawn"))
    assert plotted[BEFORE]["true_N"] == plotted[AFTER]["true_N"] == plotted[AFTER]["predicted_N"]
    assert len(plotted[BEFORE]["true_N"]) == DRAWN_N
    assert set(np.round(truth("s0", 900)[:, 2].astype(float), 3)) >= set(plotted[BEFORE]["true_N"])


def test_numbers_of_experiment_flexible_list_all_variants_and_their_bias():
    summary = summarise_flexible(PREDICTIONS)
    assert set(summary["bias_f_N"]) == {BEFORE, AFTER, CONTROL, GRID} < set(summary)


def make_drag(seed: int, n: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = rng_for(seed, "shear")
    true = rng.normal(0, [5, 5, 0.3, 0.3, 1], (n, 5)).astype(np.float32)
    return true, (true + rng.normal(0, [1, 1, 0.1, 0.2, 0.3], (n, 5))).astype(np.float32)


@given(st.integers(0, 1000))
def test_errors_of_five_targets_equal_those_of_scikit_learn(seed):
    true, predicted = make_drag(seed)
    ours, rel = score5(true, predicted), 1e-5  # Inputs are in single precision, so the relative tolerance is 1e-5.
    assert ours["mse_xy_mm2"] == pytest.approx(mean_squared_error(true[:, :2], predicted[:, :2]), rel=rel)
    assert ours["mse_fxy_N2"] == pytest.approx(mean_squared_error(true[:, 2:4], predicted[:, 2:4]), rel=rel)
    assert ours["mse_fz_N2"] == pytest.approx(mean_squared_error(true[:, 4], predicted[:, 4]), rel=rel)
    assert ours["explained_fz"] == pytest.approx(r2_score(true[:, 4], predicted[:, 4]), rel=rel, abs=1e-6)
    near = [abs(p[0] - t[0]) <= 1 and abs(p[1] - t[1]) <= 1 for t, p in zip(true, predicted, strict=True)]
    assert ours["accuracy_pct"] == pytest.approx(100 * sum(near) / len(near))


@given(st.integers(0, 1000), st.floats(0.1, 10))
def test_explained_variance_does_not_depend_on_the_unit(seed, size):
    true, predicted = make_drag(seed)
    scale = np.array([1, 1, size, size, size])
    one, other = score5(true, predicted), score5(true * scale, predicted * scale)
    assert other["mse_fxy_N2"] == pytest.approx(size**2 * one["mse_fxy_N2"], rel=1e-4)
    assert other["explained_fxy"] == pytest.approx(one["explained_fxy"], rel=1e-4, abs=1e-5)
    assert other["mse_xy_mm2"] == pytest.approx(one["mse_xy_mm2"])


def test_explained_variance_is_1_for_exact_predictions_and_0_for_the_mean():
    true, _ = make_drag(0)
    assert score5(true, true)["explained_fxy"] == 1
    mean = np.broadcast_to(true.mean(axis=0, dtype=np.float64), true.shape)
    assert score5(true, mean)["explained_xy"] == pytest.approx(0, abs=1e-6)


def test_scores_are_averaged_over_seeds_before_folds():
    scores = [("a", {"mse": 1.0}), ("a", {"mse": 3.0}), ("b", {"mse": 6.0})]
    summary = summarise_shear(scores, scores[:1], target=make_drag(0)[0], lines_n=3, passes_n=1, seeds_n=2)
    assert summary["mse"] == {"mean": 4.0, "n": 2, "sd": pytest.approx(8**0.5), "sd_seeds": pytest.approx(2**0.5)}
    assert "sd_seeds" not in summary["by_line"]["mse"]
    assert summary["seeds_n"] == 2


def test_summary_of_shear_has_both_splits_and_the_size_of_forces():
    true, predicted = make_drag(1)
    score = score5(true, predicted)
    summary = summarise_shear(
        [("a", score)], [("b", {**score, "accuracy_pct": 7.0})], target=true, lines_n=3, passes_n=1, seeds_n=1
    )
    assert summary["accuracy_pct"]["mean"] == score["accuracy_pct"]
    assert summary["by_line"]["accuracy_pct"]["mean"] == 7.0
    assert (summary["readings_n"], summary["lines_n"]) == (40, 3)
    assert summary["fx_rms_N"] == pytest.approx(np.sqrt(np.mean(true[:, 2].astype(float) ** 2)))


def stat(mean: float, n: int = 3) -> dict[str, float]:
    return {"mean": float(mean), "sd": 0.1, "n": float(n), "sd_seeds": 0.02}


def metrics(accuracy_pct: float) -> dict:
    return {"accuracy_pct": stat(accuracy_pct), "mse_xy_mm2": stat(0.4), "mse_f_N2": stat(0.2)}


SHEAR_SCORES = {
    "accuracy_pct": stat(96), "mse_xy_mm2": stat(0.12), "mse_fxy_N2": stat(0.02), "mse_fz_N2": stat(0.002),
    "explained_xy": stat(0.99), "explained_fxy": stat(0.98), "explained_fz": stat(0.999),
}  # fmt: skip
SHEAR_NUMBERS = SHEAR_SCORES | {
    "by_line": SHEAR_SCORES | {"accuracy_pct": stat(58)}, "readings_n": 4590, "lines_n": 54, "passes_n": 1,
    "seeds_n": 3, "fx_rms_N": 1.06, "fy_rms_N": 1.07, "fz_rms_N": 1.97,
}  # fmt: skip
MANUAL_NUMBERS = {
    "pokes_n": 321, "lines_n": 13, "skins_n": 6, "seeds_n": 3,
    "before": metrics(80), "after": metrics(83), "control": metrics(81), "grid": metrics(84),
    "paired": {f"after_minus_{other}": metrics(2) for other in ("before", "control", "grid")},
}  # fmt: skip
FLEXIBLE_NUMBERS = {
    "skins_n": 3, "boards_n": 3, "seeds_n": 3, "pokes_n": 390, "fold": "b0", "trained_on_skins_n": 15,
    "gap_mm": {"rigid": 1.0, "flexible": 0.7}, "gap_less_pct": 30.0, "strength_ratio": {"mean": 1.44, "n": 1.0},
    **{variant: metrics(70 + i) for i, variant in enumerate(("before", "after", "control"))},
    "bias_f_N": {"before": stat(0.96), "after": stat(-0.83), "control": stat(0.97)},
    "bias_f_pct": {"before": stat(91), "after": stat(-79), "control": stat(92)},
}  # fmt: skip
CURVES = {"true": [[-1.0, 0, 1]] * 3, "predicted": [[-0.9, 0, 1.2]] * 3}
FORCES = {variant: {"true_N": [0.1, 3.0], "predicted_N": [0.3, 4.5]} for variant in ("before", "after")}
CASES = {
    "shear": (shear, SHEAR_NUMBERS, CURVES),
    "manual": (manual, MANUAL_NUMBERS, {}),
    "flexible": (flexible, FLEXIBLE_NUMBERS, FORCES),
}


@pytest.mark.parametrize("experiment", CASES)
@pytest.mark.parametrize("source", ["simulated", "recorded"])
def test_tables_and_figures_name_their_source(experiment, source):
    module, numbers, figure_data = CASES[experiment]
    (table,) = module.tables(numbers, source).values()
    assert set(table["source"]) == {source}
    if figure_data:
        (text,) = module.figures(numbers, figure_data, source).values()
        assert f"({source})" in texts_of(text)
        ET.fromstring(text)
        assert [text] == list(module.figures(numbers, figure_data, source).values())


def test_shear_table_has_both_splits_of_the_data():
    text = to_markdown(shear.tables(SHEAR_NUMBERS, "simulated")["shear"])
    for mean, sd in SHEAR.values():
        assert f"{mean:g} ± {sd:g}" in text
    table = shear.tables(SHEAR_NUMBERS, "simulated")["shear"]
    assert table["accuracy, % (ours)"].tolist() == ["96.00 ± 0.10 ± 0.02 (seeds)", "58.00 ± 0.10 ± 0.02 (seeds)"]
    assert "± (seeds) is the standard deviation over 3 network seeds" in text
    assert table["split"].tolist()[0] == "random readings held out (ours; the paper does not state its split)"
    assert "4590 readings of 54 dragged lines in 1 passes" in text
    text = texts_of(shear.figures(SHEAR_NUMBERS, CURVES, "simulated")["shear.svg"])
    assert "0.980 ± 0.020 (seeds) sideways, 0.999 ± 0.020 (seeds) normal" in text
    assert text.count("/ N") == 6


def test_manual_table_has_all_variants_and_their_differences():
    table = manual.tables(MANUAL_NUMBERS, "simulated")["manual"].set_index("networks")
    for variant, name in (("before", "before adaptation"), ("after", "adapted with hand pokes")):
        assert table.loc[name, "accuracy, % (paper)"] == f"{MANUAL[variant]['accuracy_pct']:g}"
    difference = table.loc["with hand pokes minus before, on the same skin", "accuracy, % (ours)"]
    assert difference == "not judged (fewer than 4 boards): +2.00 ± 0.10 ± 0.02 (seeds)"
    assert table.loc["adapted with hand pokes", "accuracy, % (ours)"] == "83.00 ± 0.10 ± 0.02 (seeds)"
    assert "over 3 network seeds" in to_markdown(manual.tables(MANUAL_NUMBERS, "simulated")["manual"])
    assert len(table) == 7
    without = {name: value for name, value in MANUAL_NUMBERS.items() if name != "control"}
    without["paired"] = {"after_minus_before": metrics(2)}
    assert len(manual.tables(without, "simulated")["manual"]) == 4


def test_flexible_table_has_biases_and_differences():
    text = to_markdown(flexible.tables(FLEXIBLE_NUMBERS, "simulated")["flexible"])
    assert f"{FLEXIBLE['mse_xy_mm2']:g}" in text
    assert "30 % smaller on flexible boards" in text
    assert "In the paper, it is 80 % smaller" in text
    table = flexible.tables(FLEXIBLE_NUMBERS, "simulated")["flexible"]
    assert table["bias of F, N"].tolist() == [f"{mean} ± 0.10 ± 0.02 (seeds)" for mean in ("+0.96", "-0.83", "+0.97")]
    assert "over 3 network seeds" in text
    text = texts_of(flexible.figures(FLEXIBLE_NUMBERS, FORCES, "simulated")["flexible.svg"])
    assert "bias +0.96 ± 0.10 ± 0.02 (seeds) N" in text
    assert "bias -0.83 ± 0.10 ± 0.02 (seeds) N" in text


def test_table_has_additional_rows_for_networks_with_input_shape():
    shape = {name: FLEXIBLE_NUMBERS[name] for name in ("before", "after", "bias_f_N", "bias_f_pct")}
    table = flexible.tables(FLEXIBLE_NUMBERS | {"shape": shape}, "simulated")["flexible"]
    assert table["networks"].str.startswith("direction and length").tolist() == [False] * 3 + [True] * 2
