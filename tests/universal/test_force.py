"""Tests of the calibration of forces: the Bayesian regression line, its intervals, and the choice of the estimator."""

import numpy as np
import pytest
from scipy import stats

from pipeline.training.shipping import draw_prior_skins, law_error, read_inputs, split_presses
from reskin.data.grid import CENTRE_MM
from reskin.seeds import rng_for
from reskin.universal.force import (
    FEW_ESTIMATOR,
    LOG_CENTRE_N,
    NORMAL_90,
    PRIORS,
    SCATTER_LABELS_N,
    fit_line,
    prior_line,
)
from reskin.universal.law import to_chips
from reskin.universal.model import load_universal

SKINS_N, LABELS_N = 5, 20
(INTERCEPT_SD, SLOPE_SD), SCATTER_SD = PRIORS["combined"].sd, PRIORS["combined"].scatter_sd


def draw_log_forces(labels_n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return estimated and true log forces of presses on a skin whose calibration line is drawn from the prior."""
    rng = rng_for(seed, "force line")
    log_N = rng.uniform(np.log(0.5), np.log(9), labels_n)
    line = (
        LOG_CENTRE_N
        + INTERCEPT_SD * rng.standard_normal()
        + (1 + SLOPE_SD * rng.standard_normal()) * (log_N - LOG_CENTRE_N)
    )
    return log_N, line + SCATTER_SD * rng.standard_normal(labels_n)


def test_without_labels_forces_are_not_corrected():
    log_N = np.log([0.1, 2.0, 9.0])
    calibrated, sd_log_N = prior_line().apply(log_N)
    np.testing.assert_allclose(calibrated, log_N)
    assert (sd_log_N >= np.hypot(INTERCEPT_SD, SCATTER_SD) - 1e-12).all()


@pytest.mark.parametrize("labels_n", [1, 4])
def test_calibration_line_equals_gaussian_process_regression(labels_n):
    """A line with normal priors on intercept and slope is a Gaussian process with a linear kernel."""
    log_N, true_log_N = draw_log_forces(labels_n, 1)
    line = fit_line([log_N, log_N], true_log_N)
    query_log_N = np.log([0.3, 1.0, 5.0])
    off, query_off = log_N - LOG_CENTRE_N, query_log_N - LOG_CENTRE_N
    cov = INTERCEPT_SD**2 + SLOPE_SD**2 * np.outer(off, off) + line.scatter_var * np.eye(labels_n)
    shared = INTERCEPT_SD**2 + SLOPE_SD**2 * np.outer(query_off, off)
    expected = query_log_N + shared @ np.linalg.solve(cov, true_log_N - log_N)
    var = INTERCEPT_SD**2 + SLOPE_SD**2 * query_off**2 - ((shared @ np.linalg.inv(cov)) * shared).sum(axis=1)
    found, sd_log_N = line.apply(query_log_N)
    np.testing.assert_allclose(found, expected)
    np.testing.assert_allclose(sd_log_N, np.sqrt(var + line.scatter_var))


def test_90_percent_intervals_of_the_line_contain_90_percent_of_forces():
    inside = []
    for seed in range(200):
        log_N, true_log_N = draw_log_forces(12, seed)
        line = prior_line().condition(log_N[:6], true_log_N[:6])
        found, sd_log_N = line.apply(log_N[6:])
        inside.append(np.abs(found - true_log_N[6:]) < NORMAL_90 * sd_log_N)
    assert stats.binomtest(int(np.sum(inside)), np.size(inside), 0.9).pvalue > 1e-4


@pytest.mark.parametrize(("noise", "expected"), [((0.1, 1.0), "combined"), ((1.0, 0.1), "map"), ((0.1, 0.1), "map")])
def test_estimator_with_the_smaller_residuals_is_selected(noise, expected):
    log_N, true_log_N = draw_log_forces(40, 2)
    rng = rng_for(3, "force line")
    by_estimator = [log_N + sd * rng.standard_normal(40) for sd in noise]
    assert fit_line(by_estimator, true_log_N).estimator == expected
    few = [part[:3] for part in by_estimator]
    assert fit_line(few, true_log_N[:3]).estimator == FEW_ESTIMATOR


@pytest.fixture(scope="module")
def calibrated() -> list[tuple]:
    """Calibrate the shipped model to simulated skins with large errors of the law, which gives the field change of a
    press.

    Each skin is calibrated with 0, 1 and 20 labels. Returns, for each skin and number of labels: this number, the
    errors of the log forces, and their estimated standard deviations.
    """
    prior, model, found = read_inputs().prior, load_universal(), []
    skins = draw_prior_skins(prior, SKINS_N, 5, "force", law_error(1.5))
    for i in range(SKINS_N):
        pool, tested = split_presses(skins, i, 5)
        rest_uT, pool_uT, tested_uT = (to_chips(b) for b in (skins.rest_uT[i][None], pool.db_uT, tested.db_uT))
        model.zero(rest_uT).see(rest_uT + pool_uT)
        for n in (0, 1, LABELS_N):
            if n:
                labels = np.flatnonzero(pool.force_N > 0.3)[:n]
                model.label(pool.place_mm[labels] + CENTRE_MM, pool.force_N[labels], rest_uT + pool_uT[labels])
            estimate, pressed = model.estimate(rest_uT + tested_uT), tested.force_N > 0.3
            error = np.log(estimate.force_N / tested.force_N)[pressed]
            found.append((n, error, estimate.sd_log_N[pressed]))
    return found


@pytest.mark.parametrize("labels_n", [0, 1, LABELS_N])
def test_force_intervals_cover_simulated_skins(calibrated, labels_n):
    inside = [np.abs(error) < NORMAL_90 * sd for n, error, sd in calibrated if n == labels_n]
    # The expected coverage is 90 % if errors are as large as the model assumes, but here they are drawn larger.
    assert 0.8 < np.concatenate(inside).mean() <= 1


def test_labels_reduce_force_errors(calibrated):
    rms = {n: np.sqrt(np.mean([np.mean(error**2) for m, error, _ in calibrated if m == n])) for n in (0, LABELS_N)}
    assert rms[LABELS_N] < 0.9 * rms[0]


def test_scatter_of_forces_is_estimated_from_residuals():
    log_N = np.log(np.geomspace(0.5, 8, 200))
    for scatter_sd in (0.1, 1.0):
        residual = scatter_sd * rng_for(4, "force line").standard_normal(200)
        line = prior_line().condition(log_N, log_N + residual)
        expected = (SCATTER_LABELS_N * SCATTER_SD**2 + 200 * scatter_sd**2) / (SCATTER_LABELS_N + 200)
        # Tolerance: the variance of 200 residuals has a standard error of 10 %.
        assert line.scatter_var == pytest.approx(expected, rel=0.15)


def test_calibrated_force_is_constant_if_estimates_are_only_noise():
    rng = rng_for(5, "force line")
    true_log_N = np.log(rng.uniform(1.5, 2.5, 40))
    line = fit_line(list(3 * rng.standard_normal((2, 40))), true_log_N)
    assert abs(line.mean[1]) < 0.1


def test_labels_without_a_force_do_not_calibrate_forces():
    model = load_universal()
    rest_uT = to_chips(model.tables.rest_uT[None])
    presses_uT = to_chips(model.tables.mean_uT[11:13, 11, 4])
    model.zero(rest_uT).label([[8.4, 8.4], [9.2, 8.4]], None, rest_uT + presses_uT)
    np.testing.assert_array_equal(model.line.mean, prior_line().mean)
    model.label([[8.4, 8.4]], [4.0], rest_uT + presses_uT[:1], keep=True)
    assert model.line.mean[0] != 0
    # A label with this small force lowers all calibrated forces, far below the uncalibrated estimate.
    model.label([[8.4, 8.4]], [0.05], rest_uT + presses_uT[:1])
    # Even then, a light press is accepted as a label.
    model.label([[9.2, 8.4]], None, rest_uT + 1e-2 * presses_uT[1:] + 3.0, keep=True)


@pytest.mark.parametrize("labels_n", [1, 5, 12])
def test_held_out_labels_do_not_affect_the_model_that_predicts_them(labels_n):
    model = load_universal()
    rest_uT = to_chips(model.tables.rest_uT[None])
    place_i = rng_for(6, "force line").integers(4, 18, (labels_n, 2))
    presses_uT = rest_uT + to_chips(model.tables.mean_uT[place_i[:, 0], place_i[:, 1], 5])
    place_mm, force_N = model.tables.axis_mm[place_i] + CENTRE_MM, np.full(labels_n, 3.0)
    model.zero(rest_uT).label(place_mm, force_N, presses_uT)
    before = model.line
    wrong_N = np.where(np.arange(labels_n) == 0, 8.0, 3.0)  # The force of the first label is changed to 8 N.
    model.label(place_mm, wrong_N, presses_uT)
    (fold, *_) = model._held_out()
    same_as_without = load_universal().zero(rest_uT)
    others = np.arange(labels_n) % 5 != 0
    if others.any():
        same_as_without.label(place_mm[others], force_N[others], presses_uT[others])
        calibration = same_as_without._calibration.with_labels(same_as_without._data.labels, few=0 < labels_n < 5)
    else:
        calibration = same_as_without._calibration.with_labels(same_as_without._data.labels)
    expected = calibration.evaluate(fold.labels.db_uT).log_forces()
    np.testing.assert_allclose(fold.evaluation.log_forces(), expected, atol=1e-3)
    assert model.line.mean[0] != before.mean[0]


def test_known_weight_corrects_forces_near_its_place_and_far_from_it():
    """The map (the model of the fields of a skin) is corrected near the label only, the calibration line everywhere."""
    model, weight_N = load_universal(), 4.0
    rest_uT = to_chips(model.tables.rest_uT[None])
    weight_uT, far_uT = (rest_uT + to_chips(model.tables.mean_uT[i : i + 1, i, 5]) for i in (11, 2))
    before_N = model.zero(rest_uT).estimate(np.concatenate([weight_uT, far_uT])).force_N
    after_N = model.label([[8.4, 8.4]], [weight_N], weight_uT).estimate(np.concatenate([weight_uT, far_uT])).force_N
    assert abs(np.log(after_N[0] / weight_N)) < 0.6 * abs(np.log(before_N[0] / weight_N))
    off = np.log(before_N[0]) - LOG_CENTRE_N
    cov = INTERCEPT_SD**2 + SLOPE_SD**2 * np.array([off**2, off * (np.log(before_N[1]) - LOG_CENTRE_N)])
    gain = cov / (INTERCEPT_SD**2 + (SLOPE_SD * off) ** 2 + model.line.scatter_var)
    moved = np.log(after_N[1] / before_N[1]) / np.log(weight_N / before_N[0])
    # The second press is 12 mm away from the label, where the map is not corrected. Only the line changes its force.
    assert moved == pytest.approx(gain[1], rel=0.05)
