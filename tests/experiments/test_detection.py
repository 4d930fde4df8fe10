"""Tests of contact detectors against naive loops and scikit-learn's ROC area."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score

from pipeline.experiments.contacts import disagreement, residual
from pipeline.experiments.detection import (
    NEIGHBOURS_N,
    NOISE_uT,
    direction_distance,
    neighbour_distance,
    roc_area,
)
from reskin.seeds import rng_for

SCORES = st.lists(st.integers(0, 9), min_size=1, max_size=30).map(lambda values: np.array(values, float))


def random_fields(name, *shape):
    return rng_for(0, "oddness", name).normal(0, 40, shape)


def nearest_by_loops(known, tested):
    found = []
    for one in tested:
        distances = sorted(np.sqrt(((one - other) ** 2).sum()) for other in known)
        found.append(np.mean(distances[:NEIGHBOURS_N]))
    return np.array(found)


def test_distance_to_neighbours_equals_a_loop():
    known, tested = random_fields("known", 40, 4) * [1, 10, 100, 1000], random_fields("tested", 7, 4)
    scaled = nearest_by_loops(known / known.std(axis=0), tested / known.std(axis=0))
    np.testing.assert_allclose(neighbour_distance(known, tested), scaled, rtol=1e-9)


def test_distance_of_directions_equals_a_loop():
    known, tested = random_fields("known", 40, 4), random_fields("tested", 7, 4)
    soft = [np.array([row / (np.sqrt((row**2).sum()) + NOISE_uT) for row in rows]) for rows in (known, tested)]
    np.testing.assert_allclose(direction_distance(known, tested), nearest_by_loops(*soft), rtol=1e-9)


def test_distance_of_directions_does_not_depend_on_the_strength_of_fields():
    known, tested = 1e7 * random_fields("known", 40, 4), 1e7 * random_fields("tested", 7, 4)
    np.testing.assert_allclose(direction_distance(known, 2 * tested), direction_distance(known, tested), rtol=1e-5)


def linear_skin(n):
    rng = rng_for(0, "oddness", "skin")
    target = rng.uniform(0, 16, (n, 3))
    return target, target @ rng.normal(0, 30, (3, 15))


def test_residual_is_zero_for_known_fields_and_large_for_fields_of_opposite_sign():
    target, db_uT = linear_skin(200)
    # The residual is zero, except for rounding.
    np.testing.assert_allclose(residual((target, db_uT), target[:9], db_uT[:9]), 0, atol=1e-9)
    # Without noise, the residual of negated field changes would be 2.
    assert residual((target, db_uT), target[:9], -db_uT[:9]).min() > 1.5


def test_residual_of_known_contacts_is_zero_although_forces_are_unknown():
    target, db_uT = linear_skin(200)
    unknown = np.column_stack([target[:, :2], np.full(200, np.nan)])
    ours = residual((unknown, db_uT), target[:9], db_uT[:9])
    np.testing.assert_allclose(ours, 0, atol=1e-9)  # The residual is zero, except for rounding.


def test_disagreement_is_the_rms_distance_of_estimates_from_their_mean():
    predicted = random_fields("predicted", 3, 5, 3)
    naive = []
    for i in range(5):
        mean = predicted[:, i, :2].mean(axis=0)
        naive.append(np.sqrt(np.mean([((one[i, :2] - mean) ** 2).sum() for one in predicted])))
    np.testing.assert_allclose(disagreement(predicted), naive, rtol=1e-12)
    assert not disagreement(np.repeat(predicted[:1], 4, axis=0)).any()


@given(SCORES, SCORES)
def test_roc_area_equals_scikit_learn(single, double):
    truth = np.repeat([0, 1], [len(single), len(double)])
    theirs = roc_auc_score(truth, np.concatenate([single, double]))
    assert roc_area(single, double) == pytest.approx(theirs, abs=1e-12)


@given(SCORES, SCORES)
def test_swapping_both_classes_changes_the_roc_area_to_one_minus_its_value(single, double):
    assert roc_area(single, double) + roc_area(double, single) == pytest.approx(1, abs=1e-12)
