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
    "boosting": {"method": "boosting", "rounds_n": 10, "rate": 0.2, "leaves_n": 7},
}
every_method = pytest.mark.parametrize("method", SETTINGS)

# Inputs, targets and answers are float32: 6e-8 of some 30 uT, 16 mm, a few times over.
ANSWER_ATOL_MM = 1e-4


def asked(method: str, **changes: object) -> Classical:
    return TypeAdapter(Classical).validate_python(SETTINGS[method] | {"inputs": "raw"} | changes)


def rows(seed: int = 0, n: int = 200, ch: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Places and forces, and what one skin's field, smooth, changes by then, with 1 uT of noise."""
    rng, skin = rng_for(seed, "rows"), rng_for(0, "skin")
    target = rng.uniform(0, 16, (n, 3))
    db_uT = 30 * np.tanh(target @ skin.normal(0, 0.1, (3, ch)) + skin.normal(0, 1, ch)) + rng.normal(0, 1, (n, ch))
    return db_uT.astype(np.float32), target.astype(np.float32)


def fit_to(
    method: str, db_uT: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None, **changes
) -> FittedRegressor:
    return fit(asked(method, **changes), db_uT, target, rng_for(0, "fit"), weight=weight)


def scaled(db_uT: np.ndarray, target: np.ndarray, asked_uT: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, targets and experiments as a method sees them, by the mean and deviation of the rows alone."""
    mean, sd = db_uT.mean(axis=0, dtype=float), db_uT.std(axis=0, dtype=float)
    wanted = (target - target.mean(axis=0, dtype=float)) / target.std(axis=0, dtype=float)
    return (db_uT - mean) / sd, wanted, (asked_uT - mean) / sd


def unscaled(answer: np.ndarray, target: np.ndarray) -> np.ndarray:
    return answer * target.std(axis=0, dtype=float) + target.mean(axis=0, dtype=float)


@pytest.mark.parametrize("weighted", [False, True])
def test_ridge_is_the_closed_form(weighted):
    db_uT, target = rows()
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    asked_uT, _ = rows(1)
    a, t, q = scaled(db_uT, target, asked_uT)
    w = np.ones(len(a)) if weight is None else weight.astype(float)
    a1, q1 = np.c_[a, np.ones(len(a))], np.c_[q, np.ones(len(q))]
    penalty = np.diag([3.0] * 5 + [0.0])  # a plane's height is free
    wanted = q1 @ np.linalg.solve(a1.T @ (w[:, None] * a1) + penalty, a1.T @ (w[:, None] * t))
    got = fit_to("ridge", db_uT, target, weight, alpha=3.0).predict(asked_uT)
    np.testing.assert_allclose(got, unscaled(wanted, target), atol=ANSWER_ATOL_MM)


@pytest.mark.parametrize("weighted", [False, True])
def test_neighbours_vote_by_weight_over_distance(weighted):
    db_uT, target = rows()
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    asked_uT, _ = rows(1, n=20)
    a, _, q = scaled(db_uT, target, asked_uT)
    got = fit_to("knn", db_uT, target, weight).predict(asked_uT)
    for i in range(len(q)):
        distances = [math.sqrt(sum((q[i, c] - a[j, c]) ** 2 for c in range(5))) for j in range(len(a))]
        nearest = sorted(range(len(a)), key=lambda j, distances=distances: distances[j])[:4]
        votes = [(1.0 if weight is None else float(weight[j])) / distances[j] for j in nearest]
        for column in range(3):
            wanted = sum(v * float(target[j, column]) for v, j in zip(votes, nearest, strict=True)) / sum(votes)
            assert got[i, column] == pytest.approx(wanted, abs=ANSWER_ATOL_MM)


@every_method
def test_many_rows_are_answered_as_each_alone(method):
    db_uT, target = rows()
    fitted = fit_to(method, db_uT, target)
    asked_uT, _ = rows(1, n=BLOCK_ROWS_N + 2)
    got = fitted.predict(asked_uT)
    for i in (0, BLOCK_ROWS_N - 1, BLOCK_ROWS_N, BLOCK_ROWS_N + 1):
        np.testing.assert_allclose(got[i : i + 1], fitted.predict(asked_uT[i : i + 1]), atol=ANSWER_ATOL_MM)


def test_a_neighbour_at_no_distance_answers_alone():
    db_uT, target = rows()
    weight = np.where(np.arange(len(db_uT)) < 5, 50, 1).astype(np.float32)
    np.testing.assert_allclose(fit_to("knn", db_uT, target, weight).predict(db_uT), target, atol=ANSWER_ATOL_MM)


@pytest.mark.parametrize("weighted", [False, True])
def test_rbf_is_the_kernel_solve(weighted):
    db_uT, target = rows(n=60)
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    asked_uT, _ = rows(1, n=20)
    a, t, q = scaled(db_uT, target, asked_uT)
    w = np.ones(len(a)) if weight is None else weight.astype(float)

    def kernel(u, v):
        return np.array([[math.exp(-0.1 * sum((x - y) ** 2)) for y in v] for x in u])

    wanted = kernel(q, a) @ np.linalg.solve(kernel(a, a) + np.diag(0.1 / w), t)
    got = fit_to("rbf_ridge", db_uT, target, weight).predict(asked_uT)
    np.testing.assert_allclose(got, unscaled(wanted, target), atol=ANSWER_ATOL_MM)


@pytest.mark.parametrize("weighted", [False, True])
def test_cubic_ridge_is_scikit_learns_on_all_products_at_once(weighted):
    db_uT, target = rows(n=BLOCK_ROWS_N + 100)
    weight = rng_for(0, "weight").uniform(1, 20, len(db_uT)).astype(np.float32) if weighted else None
    asked_uT, _ = rows(1)
    a, t, q = scaled(db_uT, target, asked_uT)
    lift = PolynomialFeatures(3, include_bias=False)
    wanted = Ridge(3.0).fit(lift.fit_transform(a), t, weight).predict(lift.transform(q))
    got = fit_to("cubic_ridge", db_uT, target, weight, alpha=3.0).predict(asked_uT)
    np.testing.assert_allclose(got, unscaled(wanted, target), atol=ANSWER_ATOL_MM)


def test_a_cubic_is_recovered_and_a_plane_is_not_enough():
    rng = rng_for(0, "cubic")
    db_uT = rng.uniform(-30, 30, (400, 4)).astype(np.float32)

    def cubic(u):
        a, b, c, d = (u / 10.0).T
        return np.c_[a * b * c - d**3, 1 + a - b**2 * d, c * d + a**3].astype(np.float32)

    asked_uT = rng.uniform(-30, 30, (50, 4)).astype(np.float32)
    got = fit_to("cubic_ridge", db_uT, cubic(db_uT), alpha=1e-9).predict(asked_uT)
    np.testing.assert_allclose(got, cubic(asked_uT), atol=1e-4)  # of up to 54, in float32 (6e-8 of it)
    plane = fit_to("ridge", db_uT, cubic(db_uT), alpha=1e-9).predict(asked_uT)
    assert np.abs(plane - cubic(asked_uT)).max() > 1


def test_boosting_with_one_seed_is_one_model():
    db_uT, target = rows()
    asked_uT, _ = rows(1)
    assert (
        fit_to("boosting", db_uT, target).predict(asked_uT) == fit_to("boosting", db_uT, target).predict(asked_uT)
    ).all()


@every_method
def test_held_out_rows_are_told_better_than_by_the_mean(method):
    db_uT, target = rows(n=600)
    got = fit_to(method, db_uT[:400], target[:400]).predict(db_uT[400:])
    error, spread = ((got - target[400:]) ** 2).mean(axis=0), target[400:].var(axis=0)
    assert (error < 0.7 * spread).all()


@every_method
@settings(max_examples=10, deadline=None)  # each fits twice
@given(st.integers(0, 10_000), st.integers(-20, 20))
def test_targets_in_other_units_give_answers_in_those_units(method, seed, power):
    """A factor of 1e-6 to 1e6, as a power of 2: rounds nothing, so that no tree splits elsewhere."""
    db_uT, target = rows(seed, n=60)
    asked_uT, _ = rows(seed + 1, n=20)
    factor = np.float32(2.0**power)
    got = fit_to(method, db_uT, target).predict(asked_uT)
    other = fit_to(method, db_uT, target * factor).predict(asked_uT)
    np.testing.assert_allclose(other / factor, got, atol=ANSWER_ATOL_MM)


@every_method
@pytest.mark.parametrize("shift_mm", [-500.0, 3.0, 40.0])
def test_places_from_another_origin_give_answers_from_that_origin(method, shift_mm):
    db_uT, target = rows()
    asked_uT, _ = rows(1)
    target = np.round(target * 64) / 64  # exact after the shift
    got = fit_to(method, db_uT, target).predict(asked_uT)
    other = fit_to(method, db_uT, target + np.float32(shift_mm)).predict(asked_uT)
    # the shifted answers are float32: 6e-8 of 500 mm, on top of the rest
    np.testing.assert_allclose(other - shift_mm, got, atol=ANSWER_ATOL_MM + 6e-8 * abs(shift_mm))


@every_method
def test_a_channel_that_never_moved_in_training_changes_no_answer_even_if_it_moves_later(method):
    db_uT, target = rows()
    asked_uT, _ = rows(1)
    still = np.full((len(db_uT), 1), 0.1, np.float32)
    got = fit_to(method, np.hstack([db_uT, still]), target).predict(np.hstack([asked_uT, still + 5]))
    np.testing.assert_allclose(got, fit_to(method, db_uT, target).predict(asked_uT), atol=ANSWER_ATOL_MM)


@every_method
def test_an_unknown_force_is_answered_as_unknown_and_leaves_places_alone(method):
    db_uT, target = rows()
    asked_uT, _ = rows(1)
    placed = target.copy()
    placed[:, 2] = np.nan
    got = fit_to(method, db_uT, placed).predict(asked_uT)
    assert np.isnan(got[:, 2]).all()
    np.testing.assert_allclose(got[:, :2], fit_to(method, db_uT, target).predict(asked_uT)[:, :2], atol=ANSWER_ATOL_MM)


@every_method
def test_a_force_known_in_some_rows_is_learned_from_those_and_places_from_all(method):
    """Inputs of the known rows are those of the others again, so that both standardise alike."""
    db_uT, target = rows(n=80)
    asked_uT, _ = rows(1)
    both = np.vstack([target, target])
    both[80:, 2] = np.nan
    got = fit_to(method, np.vstack([db_uT, db_uT]), both).predict(asked_uT)
    np.testing.assert_allclose(got[:, 2], fit_to(method, db_uT, target).predict(asked_uT)[:, 2], atol=ANSWER_ATOL_MM)
    whole = fit_to(method, np.vstack([db_uT, db_uT]), np.vstack([target, target])).predict(asked_uT)
    if method != "rbf_ridge":  # draws 100 of the 160 rows, each time others
        np.testing.assert_allclose(got[:, :2], whole[:, :2], atol=ANSWER_ATOL_MM)


@every_method
def test_rows_of_great_weight_are_heeded(method):
    """A tenth of the rows answers 8 mm further along x; it weighs twice what all others do, or hardly anything."""
    db_uT, target = rows(n=400)
    further = np.arange(400) < 40
    target[further, 0] += 8
    asked_uT, wanted = rows(1)
    most = {"rows_max_n": 400} if method == "rbf_ridge" else {}
    errors_mm = []
    for weight_of_one in (1e-3, 20.0):
        weight = np.where(further, weight_of_one, 1).astype(np.float32)
        answer = fit_to(method, db_uT, target, weight, **most).predict(asked_uT)
        errors_mm.append((answer[:, 0] - wanted[:, 0] - 8).mean())
    assert errors_mm[0] == pytest.approx(-8, abs=1)  # a third of the weight at most pulls elsewhere
    assert errors_mm[1] > -6


def test_rbf_draws_rows_at_random_and_says_how_many():
    db_uT, target = rows(n=300)
    fitted = fit_to("rbf_ridge", db_uT, target, rows_max_n=50)
    assert fitted.rows_n == 50
    assert fit_to("rbf_ridge", db_uT[:40], target[:40], rows_max_n=50).rows_n == 40
    assert fit_to("ridge", db_uT, target).rows_n == 300
    again = fit(asked("rbf_ridge", rows_max_n=50), db_uT, target, rng_for(1, "fit"), weight=None)
    assert (again.predict(db_uT) != fitted.predict(db_uT)).any()


def test_rbf_keeps_every_row_of_greater_weight_and_its_share():
    """Only the kept rows press elsewhere: an answer there is theirs alone, pulled to the mean by alpha over weight."""
    db_uT, target = rows(n=300)
    db_uT[:5] += 1e5 * np.arange(1, 6)[:, None]
    weight = np.where(np.arange(300) < 5, 59, 1).astype(np.float32)  # half of all that the others weigh
    got = fit_to("rbf_ridge", db_uT, target, weight, gamma=300.0, rows_max_n=64).predict(db_uT[:5])
    lowered = 59 * 59 / 295  # of 295 others 59 stay
    mean = target.mean(axis=0, dtype=float)
    wanted = mean + (target[:5] - mean) / (1 + 0.1 / lowered)
    np.testing.assert_allclose(got, wanted, atol=ANSWER_ATOL_MM)


def test_rbf_refuses_to_lose_rows_of_greater_weight():
    db_uT, target = rows(n=300)
    weight = np.where(np.arange(300) < 50, 20, 1).astype(np.float32)
    with pytest.raises(TrainingError, match="rows_max_n must be more than the 50 rows of greater weight; got 50"):
        fit_to("rbf_ridge", db_uT, target, weight, rows_max_n=50)


@pytest.mark.parametrize(("method", "n"), [("ridge", 0), ("knn", 3)])
def test_too_few_rows_are_refused(method, n):
    db_uT, target = rows()
    target[n:] = np.nan
    with pytest.raises(TrainingError, match=f"training rows must be .* or more for each target; got {n}"):
        fit_to(method, db_uT, target)


def test_readings_that_are_no_numbers_are_refused_by_trees_too():
    db_uT, target = rows()
    db_uT[3, 1] = np.nan
    with pytest.raises(TrainingError, match="inputs must be finite; got 1 rows that are not"):
        fit_to("boosting", db_uT, target)


def test_a_setting_has_no_default_and_a_method_a_name_for_tables():
    with pytest.raises(ValidationError, match="alpha"):
        TypeAdapter(Classical).validate_python({"method": "ridge", "inputs": "raw"})
    with pytest.raises(ValidationError, match="extra"):
        asked("ridge", gamma=1.0)
    titles = [asked(method).title for method in SETTINGS]
    assert titles == ["ridge", "cubic ridge", "k nearest neighbours", "RBF kernel ridge", "gradient boosting"]
