"""Tests of regression by nearest neighbours, compared with a plain loop."""

import numpy as np
import pytest

from pipeline.training.neighbours import predict_by_neighbours
from reskin.errors import TrainingError
from reskin.seeds import rng_for


def rows(seed: int = 0, n: int = 60, ch: int = 5) -> tuple[np.ndarray, np.ndarray]:
    rng = rng_for(seed, "rows")
    db_uT = rng.normal(0, 50, (n, ch)).astype(np.float32)
    return db_uT, (8 + np.tanh(db_uT[:, :3] / 50)).astype(np.float32)


def test_predictions_are_means_of_the_nearest_rows_weighted_by_one_over_distance():
    db_uT, target = rows()
    query_uT, _ = rows(1)
    scaled, scaled_query = (x.astype(float) / db_uT.std(axis=0) for x in (db_uT, query_uT))
    expected = []
    for one in scaled_query:
        distance = np.linalg.norm(scaled - one, axis=1)
        nearest = np.argsort(distance)[:4]
        expected.append(np.average(target[nearest], axis=0, weights=1 / distance[nearest]))
    # Tolerance: inputs and targets are in single precision.
    np.testing.assert_allclose(predict_by_neighbours(db_uT, target, query_uT, 4), expected, atol=1e-4)


def test_rows_with_unknown_force_are_used_for_places():
    db_uT, target = rows()
    partly = target.copy()
    partly[::2, 2] = np.nan
    found = predict_by_neighbours(db_uT, partly, db_uT, 1)
    np.testing.assert_allclose(found[:, :2], target[:, :2], atol=1e-5)
    np.testing.assert_allclose(found[1::2, 2], target[1::2, 2], atol=1e-5)
    assert np.isfinite(found).all()
    partly[:, 2] = np.nan
    assert np.isnan(predict_by_neighbours(db_uT, partly, db_uT, 1)[:, 2]).all()


def test_input_that_is_constant_in_training_is_ignored():
    db_uT, target = rows()
    db_uT[:, 3] = 7.0
    query_uT = db_uT.copy()
    query_uT[:, 3] += 1000.0
    query, itself = (predict_by_neighbours(db_uT, target, tested_uT, 2) for tested_uT in (query_uT, db_uT))
    np.testing.assert_array_equal(query, itself)


def test_too_few_rows_are_refused():
    db_uT, target = rows()
    target[3:, 0] = np.nan
    with pytest.raises(TrainingError, match="training rows must be 4 or more for each target; got 3"):
        predict_by_neighbours(db_uT, target, db_uT, 4)
