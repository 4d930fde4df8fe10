"""Detectors against plain loops and scikit-learn's own area; what does not fit is odder than what does."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import roc_auc_score

from pipeline.experiments.contacts import (
    NEIGHBOURS_N,
    NOISE_uT,
    direction_distance,
    disagreement,
    neighbour_distance,
    residual,
    roc_area,
)
from reskin.seeds import rng_for

SCORES = st.lists(st.integers(0, 9), min_size=1, max_size=30).map(lambda values: np.array(values, float))


def drawn(name, *shape):
    return rng_for(0, "oddness", name).normal(0, 40, shape)


def nearest_by_loops(known, asked):
    found = []
    for one in asked:
        distances = sorted(np.sqrt(((one - other) ** 2).sum()) for other in known)
        found.append(np.mean(distances[:NEIGHBOURS_N]))
    return np.array(found)


def test_the_neighbours_are_those_that_loops_find():
    known, asked = drawn("known", 40, 4) * [1, 10, 100, 1000], drawn("asked", 7, 4)
    scaled = nearest_by_loops(known / known.std(axis=0), asked / known.std(axis=0))
    np.testing.assert_allclose(neighbour_distance(known, asked), scaled, rtol=1e-9)


def test_directions_are_compared_above_noise():
    known, asked = drawn("known", 40, 4), drawn("asked", 7, 4)
    soft = [np.array([row / (np.sqrt((row**2).sum()) + NOISE_uT) for row in rows]) for rows in (known, asked)]
    np.testing.assert_allclose(direction_distance(known, asked), nearest_by_loops(*soft), rtol=1e-9)


def test_a_strong_reading_is_as_odd_when_it_is_twice_as_strong():
    known, asked = 1e7 * drawn("known", 40, 4), 1e7 * drawn("asked", 7, 4)
    np.testing.assert_allclose(direction_distance(known, 2 * asked), direction_distance(known, asked), rtol=1e-5)


def a_linear_skin(n):
    rng = rng_for(0, "oddness", "skin")
    target = rng.uniform(0, 16, (n, 3))
    return target, target @ rng.normal(0, 30, (3, 15))


def test_a_known_contact_leaves_nothing_and_a_foreign_field_much():
    target, db_uT = a_linear_skin(200)
    np.testing.assert_allclose(residual((target, db_uT), target[:9], db_uT[:9]), 0, atol=1e-9)  # rounding
    assert residual((target, db_uT), target[:9], -db_uT[:9]).min() > 1.5  # 2, less the noise's part


def test_a_recording_without_forces_is_asked_for_places_alone():
    target, db_uT = a_linear_skin(200)
    unknown = np.column_stack([target[:, :2], np.full(200, np.nan)])
    ours = residual((unknown, db_uT), target[:9], db_uT[:9])
    np.testing.assert_allclose(ours, 0, atol=1e-9)  # rounding: their own places are known


def test_disagreement_is_the_rms_distance_from_the_mean_place():
    answers = drawn("answers", 3, 5, 3)
    naive = []
    for i in range(5):
        mean = answers[:, i, :2].mean(axis=0)
        naive.append(np.sqrt(np.mean([((one[i, :2] - mean) ** 2).sum() for one in answers])))
    np.testing.assert_allclose(disagreement(answers), naive, rtol=1e-12)
    assert not disagreement(np.repeat(answers[:1], 4, axis=0)).any()


@given(SCORES, SCORES)
def test_the_area_is_scikit_learns(single, double):
    truth = np.repeat([0, 1], [len(single), len(double)])
    theirs = roc_auc_score(truth, np.concatenate([single, double]))
    assert roc_area(single, double) == pytest.approx(theirs, abs=1e-12)


@given(SCORES, SCORES)
def test_the_areas_of_both_ways_round_make_one(single, double):
    assert roc_area(single, double) + roc_area(double, single) == pytest.approx(1, abs=1e-12)
