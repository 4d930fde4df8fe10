"""Tests of the classical regression methods, with which the networks are compared."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from sklearn.linear_model import Ridge
from sklearn.preprocessing import PolynomialFeatures

from reskin.errors import TrainingError
from reskin.models.classical import BLOCK_ROWS_N, Classical, FittedRegressor, fit
from reskin.seeds import rng_for

SETTINGS = {
    "ridge": {"method": "ridge", "alpha": 1.0},
    "cubic_ridge": {"method": "cubic_ridge", "alpha": 1.0},
    "knn": {"method": "knn", "neighbours_n": 4},
    "rbf_ridge": {"method": "rbf_ridge", "alpha": 0.1, "gamma": 0.1, "rows_max_n": 100},
}
every_method = pytest.mark.parametrize("method", SETTINGS)

# Tolerance: inputs (about 30 uT), targets (up to 16 mm) and predictions are in single precision, with a relative
# rounding error of 6e-8.
PREDICTION_ATOL_MM = 1e-4


def settings_of(method: str, **changes: object) -> Classical:
    return TypeAdapter(Classical).validate_python(SETTINGS[method] | {"inputs": "raw"} | changes)


def rows(seed: int = 0, n: int = 200, ch: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Return field changes and targets of a skin.

    The field changes are smooth functions of place and force, plus noise of 1 uT.
    """
    rng, skin = rng_for(seed, "rows"), rng_for(0, "skin")
    target = rng.uniform(0, 16, (n, 3))
    db_uT = 30 * np.tanh(target @ skin.normal(0, 0.1, (3, ch)) + skin.normal(0, 1, ch)) + rng.normal(0, 1, (n, ch))
    return db_uT.astype(np.float32), target.astype(np.float32)


def fit_to(
    method: str, db_uT: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None, **changes
) -> FittedRegressor:
    return fit(settings_of(method, **changes), db_uT, target, rng_for(0, "fit"), weight=weight)


def standardise(
    db_uT: np.ndarray, target: np.ndarray, query_uT: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inputs, targets and queries, standardised by the means and standard deviations of the training rows."""
    mean, sd = db_uT.mean(axis=0, dtype=float), db_uT.std(axis=0, dtype=float)
    expected = (target - target.mean(axis=0, dtype=float)) / target.std(axis=0, dtype=float)
    return (db_uT - mean) / sd, expected, (query_uT - mean) / sd


def unstandardise(predicted: np.ndarray, target: np.ndarray) -> np.ndarray:
    return predicted * target.std(axis=0, dtype=float) + target.mean(axis=0, dtype=float)


@pytest.mark.parametrize("weighted", [False, True])
def test_ridge_regression_equals_the_closed_form(weighted):
    db_uT, target = rows()
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    query_uT, _ = rows(1)
    a, t, q = standardise(db_uT, target, query_uT)
    w = np.ones(len(a)) if weight is None else weight.astype(float)
    a1, q1 = np.c_[a, np.ones(len(a))], np.c_[q, np.ones(len(q))]
    penalty = np.diag([3.0] * 5 + [0.0])  # The intercept is not penalised.
    expected = q1 @ np.linalg.solve(a1.T @ (w[:, None] * a1) + penalty, a1.T @ (w[:, None] * t))
    found = fit_to("ridge", db_uT, target, weight, alpha=3.0).predict(query_uT)
    np.testing.assert_allclose(found, unstandardise(expected, target), atol=PREDICTION_ATOL_MM)


@pytest.mark.parametrize("weighted", [False, True])
def test_nearest_neighbours_are_weighted_by_inverse_distance(weighted):
    db_uT, target = rows()
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    query_uT, _ = rows(1, n=20)
    a, _, q = standardise(db_uT, target, query_uT)
    found = fit_to("knn", db_uT, target, weight).predict(query_uT)
    for i in range(len(q)):
        distances = [math.sqrt(sum((q[i, c] - a[j, c]) ** 2 for c in range(5))) for j in range(len(a))]
        nearest = sorted(range(len(a)), key=lambda j, distances=distances: distances[j])[:4]
        votes = [(1.0 if weight is None else float(weight[j])) / distances[j] for j in nearest]
        for column in range(3):
            expected = sum(v * float(target[j, column]) for v, j in zip(votes, nearest, strict=True)) / sum(votes)
            assert found[i, column] == pytest.approx(expected, abs=PREDICTION_ATOL_MM)


@every_method
def test_predictions_do_not_depend_on_the_size_of_blocks(method):
    db_uT, target = rows()
    fitted = fit_to(method, db_uT, target)
    query_uT, _ = rows(1, n=BLOCK_ROWS_N + 2)
    found = fitted.predict(query_uT)
    for i in (0, BLOCK_ROWS_N - 1, BLOCK_ROWS_N, BLOCK_ROWS_N + 1):
        np.testing.assert_allclose(found[i : i + 1], fitted.predict(query_uT[i : i + 1]), atol=PREDICTION_ATOL_MM)


def test_prediction_at_a_training_row_is_the_target_of_this_row():
    db_uT, target = rows()
    weight = np.where(np.arange(len(db_uT)) < 5, 50, 1).astype(np.float32)
    np.testing.assert_allclose(fit_to("knn", db_uT, target, weight).predict(db_uT), target, atol=PREDICTION_ATOL_MM)


@pytest.mark.parametrize("weighted", [False, True])
def test_rbf_ridge_equals_a_solution_with_the_kernel_matrix(weighted):
    db_uT, target = rows(n=60)
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    query_uT, _ = rows(1, n=20)
    a, t, q = standardise(db_uT, target, query_uT)
    w = np.ones(len(a)) if weight is None else weight.astype(float)

    def kernel(u, v):
        return np.array([[math.exp(-0.1 * sum((x - y) ** 2)) for y in v] for x in u])

    expected = kernel(q, a) @ np.linalg.solve(kernel(a, a) + np.diag(0.1 / w), t)
    found = fit_to("rbf_ridge", db_uT, target, weight).predict(query_uT)
    np.testing.assert_allclose(found, unstandardise(expected, target), atol=PREDICTION_ATOL_MM)


@pytest.mark.parametrize("weighted", [False, True])
def test_cubic_ridge_equals_scikit_learn(weighted):
    db_uT, target = rows(n=BLOCK_ROWS_N + 100)
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    query_uT, _ = rows(1)
    a, t, q = standardise(db_uT, target, query_uT)
    lift = PolynomialFeatures(3, include_bias=False)
    expected = Ridge(3.0).fit(lift.fit_transform(a), t, weight).predict(lift.transform(q))
    found = fit_to("cubic_ridge", db_uT, target, weight, alpha=3.0).predict(query_uT)
    np.testing.assert_allclose(found, unstandardise(expected, target), atol=PREDICTION_ATOL_MM)


def test_cubic_ridge_recovers_a_cubic_function():
    rng = rng_for(0, "cubic")
    db_uT = rng.uniform(-30, 30, (400, 4)).astype(np.float32)

    def cubic(u):
        a, b, c, d = (u / 10.0).T
        return np.c_[a * b * c - d**3, 1 + a - b**2 * d, c * d + a**3].astype(np.float32)

    query_uT = rng.uniform(-30, 30, (50, 4)).astype(np.float32)
    found = fit_to("cubic_ridge", db_uT, cubic(db_uT), alpha=1e-9).predict(query_uT)
    # Tolerance: predictions of up to 54 are in single precision, with a relative rounding error of 6e-8.
    np.testing.assert_allclose(found, cubic(query_uT), atol=1e-4)
    plane = fit_to("ridge", db_uT, cubic(db_uT), alpha=1e-9).predict(query_uT)
    assert np.abs(plane - cubic(query_uT)).max() > 1


@every_method
def test_predictions_are_better_than_the_mean_of_the_targets(method):
    db_uT, target = rows(n=600)
    found = fit_to(method, db_uT[:400], target[:400]).predict(db_uT[400:])
    error, spread = ((found - target[400:]) ** 2).mean(axis=0), target[400:].var(axis=0)
    assert (error < 0.7 * spread).all()


@every_method
# Hypothesis tries fewer examples than usual, because each example fits two models.
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), st.integers(-20, 20))
def test_predictions_scale_with_the_unit_of_the_targets(method, seed, power):
    """The factor (1e-6 to 1e6) is a power of 2, so no value is rounded, and decision trees split at the same values."""
    db_uT, target = rows(seed, n=60)
    query_uT, _ = rows(seed + 1, n=20)
    factor = np.float32(2.0**power)
    found = fit_to(method, db_uT, target).predict(query_uT)
    other = fit_to(method, db_uT, target * factor).predict(query_uT)
    np.testing.assert_allclose(other / factor, found, atol=PREDICTION_ATOL_MM)


@every_method
@pytest.mark.parametrize("shift_mm", [-500.0, 3.0, 40.0])
def test_shifting_the_training_places_shifts_the_predictions(method, shift_mm):
    db_uT, target = rows()
    query_uT, _ = rows(1)
    # Places are rounded to multiples of 1/64 mm, so that they are exact after the shift.
    target = np.round(target * 64) / 64
    found = fit_to(method, db_uT, target).predict(query_uT)
    other = fit_to(method, db_uT, target + np.float32(shift_mm)).predict(query_uT)
    # The additional tolerance is for shifted predictions of up to 500 mm, which are rounded to single precision (6e-8).
    np.testing.assert_allclose(other - shift_mm, found, atol=PREDICTION_ATOL_MM + 6e-8 * abs(shift_mm))


@every_method
def test_channel_without_variation_is_ignored(method):
    db_uT, target = rows()
    query_uT, _ = rows(1)
    constant = np.full((len(db_uT), 1), 0.1, np.float32)
    found = fit_to(method, np.hstack([db_uT, constant]), target).predict(np.hstack([query_uT, constant + 5]))
    np.testing.assert_allclose(found, fit_to(method, db_uT, target).predict(query_uT), atol=PREDICTION_ATOL_MM)


@every_method
def test_rows_without_a_force_are_still_used_for_places(method):
    db_uT, target = rows()
    query_uT, _ = rows(1)
    placed = target.copy()
    placed[:, 2] = np.nan
    found = fit_to(method, db_uT, placed).predict(query_uT)
    assert np.isnan(found[:, 2]).all()
    np.testing.assert_allclose(
        found[:, :2], fit_to(method, db_uT, target).predict(query_uT)[:, :2], atol=PREDICTION_ATOL_MM
    )


@every_method
def test_force_is_learnt_from_the_rows_where_it_is_known(method):
    """Rows without a force have the same inputs as rows with a force, so both sets are scaled in the same way."""
    db_uT, target = rows(n=80)
    query_uT, _ = rows(1)
    both = np.vstack([target, target])
    both[80:, 2] = np.nan
    found = fit_to(method, np.vstack([db_uT, db_uT]), both).predict(query_uT)
    np.testing.assert_allclose(
        found[:, 2], fit_to(method, db_uT, target).predict(query_uT)[:, 2], atol=PREDICTION_ATOL_MM
    )
    whole = fit_to(method, np.vstack([db_uT, db_uT]), np.vstack([target, target])).predict(query_uT)
    # The method rbf_ridge is excluded, because it uses a random selection of 100 of the 160 rows.
    if method != "rbf_ridge":
        np.testing.assert_allclose(found[:, :2], whole[:, :2], atol=PREDICTION_ATOL_MM)


@every_method
def test_rows_with_a_large_total_weight_determine_the_prediction(method):
    """A tenth of the rows are shifted by 8 mm along x.

    Their total weight is twice that of all other rows, or nearly 0.
    """
    db_uT, target = rows(n=400)
    further = np.arange(400) < 40
    target[further, 0] += 8
    query_uT, expected = rows(1)
    most = {"rows_max_n": 400} if method == "rbf_ridge" else {}
    errors_mm = []
    for weight_of_one in (1e-3, 20.0):
        weight = np.where(further, weight_of_one, 1).astype(np.float32)
        predicted = fit_to(method, db_uT, target, weight, **most).predict(query_uT)
        errors_mm.append((predicted[:, 0] - expected[:, 0] - 8).mean())
    # With nearly no weight, the shifted rows do not influence the prediction, which is therefore 8 mm off.
    assert errors_mm[0] == pytest.approx(-8, abs=1)
    # With two thirds of the total weight, the shifted rows move the prediction by more than 2 mm.
    assert errors_mm[1] > -6


def test_rbf_ridge_selects_random_rows():
    db_uT, target = rows(n=300)
    fitted = fit_to("rbf_ridge", db_uT, target, rows_max_n=50)
    assert fitted.rows_n == 50
    assert fit_to("rbf_ridge", db_uT[:40], target[:40], rows_max_n=50).rows_n == 40
    assert fit_to("ridge", db_uT, target).rows_n == 300
    again = fit(settings_of("rbf_ridge", rows_max_n=50), db_uT, target, rng_for(1, "fit"), weight=None)
    assert (again.predict(db_uT) != fitted.predict(db_uT)).any()


def test_rbf_ridge_always_selects_rows_with_a_weight_above_1():
    """Only a selection of the training rows is used, but it must contain every row whose weight is greater than 1.

    Five of the 300 rows have a greater weight. Their inputs are far from the inputs of all other rows, so a prediction
    at one of these inputs depends on this row alone.
    """
    db_uT, target = rows(n=300)
    db_uT[:5] += 1e5 * np.arange(1, 6)[:, None]
    # Each of the five rows has the weight 59, so together they weigh 5 * 59 = 295, as much as the 295 other rows.
    weight = np.where(np.arange(300) < 5, 59, 1).astype(np.float32)
    found = fit_to("rbf_ridge", db_uT, target, weight, gamma=300.0, rows_max_n=64).predict(db_uT[:5])
    # Of the 295 other rows, 59 are selected. Each stands for five rows, so the weight of the five special rows is
    # divided by five.
    lowered = 59 * 59 / 295
    mean = target.mean(axis=0, dtype=float)
    expected = mean + (target[:5] - mean) / (1 + 0.1 / lowered)
    np.testing.assert_allclose(found, expected, atol=PREDICTION_ATOL_MM)


def test_more_weighted_rows_than_rbf_ridge_can_select_are_refused():
    db_uT, target = rows(n=300)
    weight = np.where(np.arange(300) < 50, 20, 1).astype(np.float32)
    with pytest.raises(TrainingError, match="rows_max_n must be more than the 50 labelled rows of the skin; got 50"):
        fit_to("rbf_ridge", db_uT, target, weight, rows_max_n=50)


@pytest.mark.parametrize(("method", "n"), [("ridge", 0), ("knn", 3)])
def test_fewer_rows_than_a_method_needs_are_refused(method, n):
    db_uT, target = rows()
    target[n:] = np.nan
    with pytest.raises(TrainingError, match=f"training rows must be .* or more for each target; got {n}"):
        fit_to(method, db_uT, target)


def test_nan_readings_are_refused():
    db_uT, target = rows()
    db_uT[3, 1] = np.nan
    with pytest.raises(TrainingError, match="inputs of 1 rows are not finite"):
        fit_to("ridge", db_uT, target)


def test_each_method_has_a_title_and_requires_its_settings():
    with pytest.raises(ValidationError, match="alpha"):
        TypeAdapter(Classical).validate_python({"method": "ridge", "inputs": "raw"})
    with pytest.raises(ValidationError, match="extra"):
        settings_of("ridge", gamma=1.0)
    titles = [settings_of(method).title for method in SETTINGS]
    assert titles == ["ridge", "cubic ridge", "k nearest neighbours", "RBF kernel ridge"]
