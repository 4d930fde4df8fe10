"""Numbers of dragged lines against scikit-learn, and what they are when nothing is wrong or nothing is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import mean_squared_error, r2_score

from pipeline.experiments.shear import score5, summarise_shear
from reskin.seeds import rng_for


def drawn(seed: int, f: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = rng_for(seed, "shear")
    true = rng.normal(0, [5, 5, 0.3, 0.3, 1], (f, 5)).astype(np.float32)
    return true, (true + rng.normal(0, [1, 1, 0.1, 0.2, 0.3], (f, 5))).astype(np.float32)


@given(st.integers(0, 1000))
def test_errors_are_scikit_learns_mean_over_axes(seed):
    true, predicted = drawn(seed)
    ours, rel = score5(true, predicted), 1e-5  # single precision in, double here
    assert ours["mse_xy_mm2"] == pytest.approx(mean_squared_error(true[:, :2], predicted[:, :2]), rel=rel)
    assert ours["mse_fxy_N2"] == pytest.approx(mean_squared_error(true[:, 2:4], predicted[:, 2:4]), rel=rel)
    assert ours["mse_fz_N2"] == pytest.approx(mean_squared_error(true[:, 4], predicted[:, 4]), rel=rel)
    assert ours["explained_fz"] == pytest.approx(r2_score(true[:, 4], predicted[:, 4]), rel=rel, abs=1e-6)
    near = [abs(p[0] - t[0]) <= 1 and abs(p[1] - t[1]) <= 1 for t, p in zip(true, predicted, strict=True)]
    assert ours["accuracy_pct"] == pytest.approx(100 * sum(near) / len(near))


@given(st.integers(0, 1000), st.floats(0.1, 10))
def test_forces_of_another_size_change_their_errors_but_not_what_is_explained(seed, size):
    true, predicted = drawn(seed)
    scale = np.array([1, 1, size, size, size])
    one, other = score5(true, predicted), score5(true * scale, predicted * scale)
    assert other["mse_fxy_N2"] == pytest.approx(size**2 * one["mse_fxy_N2"], rel=1e-4)
    assert other["explained_fxy"] == pytest.approx(one["explained_fxy"], rel=1e-4, abs=1e-5)
    assert other["mse_xy_mm2"] == pytest.approx(one["mse_xy_mm2"])


def test_the_truth_explains_all_and_its_mean_nothing():
    true, _ = drawn(0)
    assert score5(true, true)["explained_fxy"] == 1
    mean = np.broadcast_to(true.mean(axis=0, dtype=np.float64), true.shape)
    assert score5(true, mean)["explained_xy"] == pytest.approx(0, abs=1e-6)


def test_seeds_are_averaged_within_a_fold_before_folds_are():
    scores = [("a", {"mse": 1.0}), ("a", {"mse": 3.0}), ("b", {"mse": 6.0})]
    answer = summarise_shear(scores, scores[:1], target=drawn(0)[0], lines_n=3, passes_n=1, seeds_n=2)
    assert answer["mse"] == {"mean": 4.0, "n": 2, "sd": pytest.approx(8**0.5), "sd_seeds": pytest.approx(2**0.5)}
    assert "sd_seeds" not in answer["by_line"]["mse"]
    assert answer["seeds_n"] == 2


def test_both_ways_stand_beside_each_other_with_the_size_of_the_forces():
    true, predicted = drawn(1)
    score = score5(true, predicted)
    answer = summarise_shear(
        [("a", score)], [("b", {**score, "accuracy_pct": 7.0})], target=true, lines_n=3, passes_n=1, seeds_n=1
    )
    assert answer["accuracy_pct"]["mean"] == score["accuracy_pct"]
    assert answer["by_line"]["accuracy_pct"]["mean"] == 7.0
    assert (answer["readings_n"], answer["lines_n"]) == (40, 3)
    assert answer["fx_rms_N"] == pytest.approx(np.sqrt(np.mean(true[:, 2].astype(float) ** 2)))
