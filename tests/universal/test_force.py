"""Tests of the correction of forces: its Gaussian process, its leave-one-out errors, and its limits."""

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct

from reskin.seeds import rng_for
from reskin.universal import force
from reskin.universal.force import ForceHead, conformal, features_of

RNG = rng_for(0, "force")
DB_uT = RNG.normal(0, 300, (30, 15))
TRUE_N = np.exp(RNG.uniform(np.log(0.5), np.log(8), 30))
LOG_N = np.log(TRUE_N) + 0.3 + 0.2 * RNG.standard_normal(30)


def test_head_is_a_gaussian_process_on_the_errors_of_the_network():
    """The reference is scikit-learn's regression of the same errors, with a kernel of two parts and noise."""
    known, tested = np.arange(20), np.arange(20, 30)
    head = ForceHead.fit(LOG_N[known], DB_uT[known], TRUE_N[known])
    estimated_N = np.exp(np.minimum(LOG_N, force.LOG_MAX_N))
    # The kernel `DotProduct` acts on the first input only, because the features are far apart in the other inputs.
    scaled = force.SCALE_SD * estimated_N / head.spread_N
    of_scale = DotProduct(0.0, "fixed")(scaled[:, None])
    of_field = force.OF_FIELD_SD**2 * RBF(force.FIELD_LENGTH, "fixed")(features_of(DB_uT))
    covariance = of_scale + of_field
    noisy = covariance[np.ix_(known, known)] + force.NOISE_SD**2 * np.eye(20)
    errors_N = TRUE_N[known] - estimated_N[known]
    expected_N = estimated_N[tested] + covariance[np.ix_(tested, known)] @ np.linalg.solve(noisy, errors_N)
    found_N = head.force_N(LOG_N[tested], DB_uT[tested])
    np.testing.assert_allclose(found_N, np.clip(expected_N, *head.limits_N), rtol=1e-6)


def test_without_a_scale_the_head_is_scikit_learns_regression(monkeypatch):
    monkeypatch.setattr(force, "SCALE_SD", 0.0)
    head = ForceHead.fit(LOG_N[:20], DB_uT[:20], TRUE_N[:20])
    estimated_N = np.exp(np.minimum(LOG_N, force.LOG_MAX_N))
    scale = ConstantKernel(force.OF_FIELD_SD**2, "fixed") * RBF(force.FIELD_LENGTH, "fixed")
    process = GaussianProcessRegressor(scale, alpha=force.NOISE_SD**2, optimizer=None)
    process.fit(features_of(DB_uT[:20]), TRUE_N[:20] - estimated_N[:20])
    expected_N = estimated_N[20:] + process.predict(features_of(DB_uT[20:]))
    np.testing.assert_allclose(head.force_N(LOG_N[20:], DB_uT[20:]), np.clip(expected_N, *head.limits_N), rtol=1e-6)


def test_held_out_errors_are_those_of_heads_that_were_fitted_without_the_press(monkeypatch):
    monkeypatch.setattr(force, "LIMIT_N", 99)
    scores = []
    monkeypatch.setattr(force, "conformal", lambda each: scores.extend(each) or 1.0)
    monkeypatch.setattr(force, "PRIOR_N", 1e9)  # then the spread does not depend on which of the equal forces are known
    known_N = np.full(6, 2.0)
    ForceHead.fit(LOG_N[:6], DB_uT[:6], known_N)
    for i, score in enumerate(scores[:6]):
        others = np.arange(6) != i
        head = ForceHead.fit(LOG_N[:6][others], DB_uT[:6][others], known_N[others])
        found_N = head.force_N(LOG_N[i : i + 1], DB_uT[i : i + 1])[0]
        assert abs(found_N - 2.0) / max(found_N, 2 * force.FLOOR) == pytest.approx(score, rel=1e-4)


def test_head_corrects_a_skin_that_is_softer_than_usual_and_covers_the_truth():
    head = ForceHead.fit(LOG_N[:20], DB_uT[:20], TRUE_N[:20])
    found_N = head.force_N(LOG_N[20:], DB_uT[20:])
    assert np.abs(found_N - TRUE_N[20:]).mean() < 0.7 * np.abs(np.exp(LOG_N[20:]) - TRUE_N[20:]).mean()
    assert (np.abs(found_N - TRUE_N[20:]) <= force.NORMAL_90 * head.sd_N(found_N)).mean() >= 0.7


def test_forces_stay_near_the_range_of_the_known_ones_if_it_is_wide():
    head = ForceHead.fit(LOG_N, DB_uT, TRUE_N)
    far_N = head.force_N(np.array([-5.0, 5.0]), 10 * DB_uT[:2])
    assert far_N.min() >= 0.9 * TRUE_N.min()
    assert far_N.max() <= 1.1 * TRUE_N.max()
    for known_N in (np.linspace(2.0, 2.5, 10), np.array([1.0, 5.0])):  # a narrow range, and too few forces
        n = len(known_N)
        assert ForceHead.fit(LOG_N[:n], DB_uT[:n], known_N).limits_N == (force.LEAST_N, np.inf)


def test_one_known_weight_moves_all_forces_towards_its_scale():
    head = ForceHead.fit(np.log([1.0]), DB_uT[:1], np.array([2.0]))
    moved = head.force_N(np.log([1.0, 5.0]), DB_uT[1:3])
    assert 1.1 < moved[0] < 2.0
    assert 5.5 < moved[1] < 10.0


def test_conformal_factor_covers_new_scores():
    rng = rng_for(1, "conformal")
    covered = [(rng.exponential(size=50) <= conformal(rng.exponential(size=20))).mean() for _ in range(400)]
    assert 0.89 < np.mean(covered) < 0.93  # 19 of 21 exchangeable scores
