"""Tests of jobs that fit classical regression methods, with which the networks are compared."""

import pickle
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from sklearn.linear_model import Ridge

from reskin.models import classical
from reskin.models.classical import Classical, ClassicalJob, ClassicalResult, fit, run_classical_jobs
from reskin.models.job import TrainingData
from reskin.seeds import rng_for

SETTINGS = {
    "ridge": {"method": "ridge", "alpha": 1.0},
    "cubic_ridge": {"method": "cubic_ridge", "alpha": 1.0},
    "knn": {"method": "knn", "neighbours_n": 4},
    "rbf_ridge": {"method": "rbf_ridge", "alpha": 0.1, "gamma": 0.1, "rows_max_n": 30},
}
ROWS_N, CH_N = 90, 5
TRAIN, NEW_SKIN_ROWS, TEST = np.arange(0, 60, 2), np.arange(60, 66), np.arange(70, 90)
NO_ROWS = np.zeros(0, np.int64)


class PicklingExecutor(Executor):
    """An executor that pickles and unpickles each call, and runs it in this process.

    A worker process would get the same copy of the call.
    """

    def submit(self, call: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        call, args = pickle.loads(pickle.dumps((call, args)))
        done.set_result(call(*args))
        return done


def make_rows() -> TrainingData:
    rng = rng_for(0, "baselines")
    db_uT = rng.normal(0, 50, (ROWS_N, CH_N)).astype(np.float32)
    target = (np.tanh(db_uT[:, :3] / 50) + rng.normal(0, 0.1, (ROWS_N, 3))).astype(np.float32)
    return TrainingData(db_uT, target, np.array(["s0"] * ROWS_N))


ROWS = make_rows()


def method(name: str = "ridge", inputs: str = "raw") -> Classical:
    return TypeAdapter(Classical).validate_python(SETTINGS[name] | {"inputs": inputs})


def task(one: Classical | None = None, **changes: Any) -> ClassicalJob:
    values = {"name": "one", "method": one or method(), "train": TRAIN, "test": TEST, "few_labels": NO_ROWS}
    return ClassicalJob(**values | {"rows_max_n": 1000, "seed": 3} | changes)


def results_of(*tasks: ClassicalJob, rows: TrainingData = ROWS) -> list[ClassicalResult]:
    return run_classical_jobs(tasks, rows, PicklingExecutor(), lambda line: None)


@pytest.fixture
def fits(monkeypatch) -> list[dict[str, Any]]:
    """Return a list to which every call of `fit` appends its arguments."""
    seen: list[dict[str, Any]] = []

    def recording_fit(one, inputs, target, rng, *, weight):
        seen.append({"inputs": inputs, "target": target, "weight": weight})
        return fit(one, inputs, target, rng, weight=weight)

    monkeypatch.setattr(classical, "fit", recording_fit)
    return seen


def expected_inputs(inputs: str, db_uT: np.ndarray) -> np.ndarray:
    if inputs == "raw":
        return db_uT
    length_uT = np.sqrt((db_uT.astype(float) ** 2).sum(axis=1))[:, None]
    return np.hstack([db_uT / length_uT, np.log(length_uT)]).astype(np.float32)


@pytest.mark.parametrize("inputs", ["raw", "shape"])
@pytest.mark.parametrize("name", SETTINGS)
def test_result_of_a_job_equals_a_direct_call_of_fit_and_predict(name, inputs):
    one = method(name, inputs)
    (found,) = results_of(task(one))
    train, test = (expected_inputs(inputs, ROWS.db_uT[rows]) for rows in (TRAIN, TEST))
    by_hand = fit(one, train, ROWS.target[TRAIN], rng_for(3, "baseline", "one"), weight=None)
    # Tolerance: the inputs of 1 to 200 uT may differ in the last bit of single precision, which changes predictions by
    # at most 1e-5.
    np.testing.assert_allclose(found.predicted, by_hand.predict(test), atol=1e-5)
    assert found.rows_n == 30
    assert found.seconds > 0
    assert found.one_reading_s > 0


def test_labels_of_a_new_skin_weigh_as_much_as_all_other_rows():
    (found,) = results_of(task(few_labels=NEW_SKIN_ROWS))
    train = np.concatenate([TRAIN, NEW_SKIN_ROWS])
    mean, sd = ROWS.db_uT[train].mean(axis=0, dtype=float), ROWS.db_uT[train].std(axis=0, dtype=float)
    middle, spread = ROWS.target[train].mean(axis=0, dtype=float), ROWS.target[train].std(axis=0, dtype=float)
    # The 6 labelled rows have the weight 5 each, so together they weigh as much as the 30 other rows.
    weight = [1.0] * 30 + [5.0] * 6
    plane = Ridge(1.0).fit((ROWS.db_uT[train] - mean) / sd, (ROWS.target[train] - middle) / spread, weight)
    expected = plane.predict((ROWS.db_uT[TEST] - mean) / sd) * spread + middle
    np.testing.assert_allclose(found.predicted, expected, atol=1e-5)  # The tolerance is rounding to single precision.
    assert found.rows_n == 36
    assert np.abs(found.predicted - results_of(task())[0].predicted).max() > 1e-3


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 30), st.integers(1, 40))
def test_labelled_and_other_rows_have_equal_sums_of_weights(own_n, rows_max_n):
    with pytest.MonkeyPatch.context() as patch:
        weights = []

        def recording_fit(one, inputs, target, rng, *, weight):
            weights.append(weight)
            return fit(one, inputs, target, rng, weight=weight)

        patch.setattr(classical, "fit", recording_fit)
        results_of(task(few_labels=np.arange(60, 60 + own_n), rows_max_n=rows_max_n))
    (weight,) = weights
    others, labelled = weight[:-own_n], weight[-own_n:]
    assert len(others) == min(30, rows_max_n)
    assert (others == 1).all()
    # The tolerance is the rounding of sums in single precision.
    assert labelled.sum() == pytest.approx(len(others), rel=1e-6)


def test_rows_are_unweighted_without_labels_of_a_new_skin(fits):
    results_of(task())
    assert fits[0]["weight"] is None


def rows_of(fits: list[dict[str, Any]]) -> list[list[int]]:
    """Return, for each call of `fit`, the numbers of the rows that it received.

    Rows are identified by their field changes, which are all different.
    """
    return [[int(np.flatnonzero((ROWS.db_uT == row).all(axis=1))[0]) for row in one["inputs"]] for one in fits]


def test_thinning_keeps_the_given_number_of_rows(fits):
    done = results_of(task(rows_max_n=12), task(rows_max_n=12, few_labels=NEW_SKIN_ROWS), task(rows_max_n=30))
    thinned, with_own, whole = rows_of(fits)
    assert len(set(thinned)) == len(thinned) == 12
    assert set(thinned) < set(TRAIN)
    assert with_own == [*thinned, *NEW_SKIN_ROWS]  # The labelled rows of a new skin are never dropped.
    assert whole == TRAIN.tolist()
    assert [one.rows_n for one in done] == [12, 18, 30]
    for one, numbers in zip(fits, (thinned, with_own, whole), strict=True):
        assert (one["target"] == ROWS.target[numbers]).all()


def test_thinning_draws_equal_rows_only_if_seed_and_name_are_equal(fits):
    others = {"seed": 4}, {"name": "other"}
    results_of(task(rows_max_n=12), task(rows_max_n=12, method=method("knn")))
    results_of(*(task(rows_max_n=12, **other) for other in others))
    first, same, *different = rows_of(fits)
    assert same == first
    assert all(numbers != first for numbers in different)


def test_results_and_log_lines_are_in_the_order_of_jobs():
    lines: list[str] = []
    names = {"first": TEST, "second": TEST[:5], "third": TEST[5:]}
    tasks = [task(name=name, test=test) for name, test in names.items()]
    done = run_classical_jobs(tasks, ROWS, PicklingExecutor(), lines.append)
    assert lines == ["1/3 first", "2/3 second", "3/3 third"]
    np.testing.assert_array_equal(np.concatenate([one.predicted for one in done[1:]]), done[0].predicted)


@pytest.mark.parametrize("name", SETTINGS)
def test_targets_of_test_rows_do_not_change_the_result(name):
    used = np.concatenate([TRAIN, NEW_SKIN_ROWS])
    others = ROWS.target.copy()
    others[np.setdiff1d(np.arange(ROWS_N), used)] = 1e6
    (found,), (other,) = (
        results_of(task(method(name), few_labels=NEW_SKIN_ROWS), rows=rows)
        for rows in (ROWS, TrainingData(ROWS.db_uT, others, ROWS.skin))
    )
    assert (found.predicted == other.predicted).all()
