"""Two experts multiplied are what two Gaussians multiplied are."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.combine import LABEL_SD_MM, OFFSET_SD_MM, Labels, centre, multiply, shift
from reskin.universal.map import Reader, new_map
from reskin.universal.network import Opinion
from tests.universal.skins import fields_uT, made_tables

RNG = rng_for(0, "experts")


def opinion(place_mm: np.ndarray, sd_mm: float = 1.0) -> Opinion:
    n = len(place_mm)
    return Opinion(place_mm, np.full((n, 2), sd_mm), np.full(n, 1.0), np.full(n, 1.0))


def test_a_centred_opinion_has_no_mean_over_the_pool():
    pool_mm = RNG.normal(0.7, 3, (65, 2))
    np.testing.assert_allclose(centre(opinion(pool_mm), pool_mm, 0).place_mm.mean(axis=0), 0, atol=1e-12)
    some = centre(opinion(pool_mm), pool_mm, 10).place_mm.mean(axis=0)
    assert (0 < np.abs(some)).all()
    assert (np.abs(some) < np.abs(pool_mm.mean(axis=0))).all()


@pytest.mark.parametrize("labels_n", [1, 7])
def test_labels_shift_an_opinion_as_a_constant_with_a_gaussian_prior(labels_n):
    said_mm, true_mm = RNG.normal(0, 3, (labels_n, 2)), RNG.normal(0, 3, (labels_n, 2))
    cov = OFFSET_SD_MM**2 * np.ones((labels_n, labels_n)) + LABEL_SD_MM**2 * np.eye(labels_n)
    expected_mm = OFFSET_SD_MM**2 * np.ones(labels_n) @ np.linalg.solve(cov, true_mm - said_mm)
    found = shift(opinion(np.zeros((1, 2))), Labels(said_mm, true_mm))
    np.testing.assert_allclose(found.place_mm, expected_mm[None])


def test_an_opinion_decides_where_the_map_cannot_and_little_where_it_can():
    reader = Reader(new_map(made_tables()))
    place_mm = np.array([[3.0, 2.0], [-4.0, 1.0]])
    db_uT = fields_uT(place_mm, np.array([2.0, 3.0]))
    right = multiply(reader, reader.weigh(db_uT), opinion(place_mm), 1.0)
    unsure = multiply(reader, reader.weigh(db_uT), opinion(place_mm + 5, sd_mm=50.0), 1.0)
    blind = multiply(reader, reader.weigh(np.zeros((2, 15))), opinion(place_mm, sd_mm=0.1), 1.0)
    assert np.abs(right.place_mm - place_mm).max() < 0.5
    assert np.abs(unsure.place_mm - place_mm).max() < 0.8
    assert (right.sd_mm <= unsure.sd_mm + 1e-6).all()
    assert np.isfinite(blind.place_mm).all()


def test_a_lower_power_widens_intervals_and_leaves_the_answer():
    reader = Reader(new_map(made_tables()))
    place_mm = np.array([[3.0, 2.0]])
    db_uT = fields_uT(place_mm, np.array([2.0]))
    sure, less = (multiply(reader, reader.weigh(db_uT), opinion(place_mm), temper) for temper in (1.0, 0.25))
    np.testing.assert_array_equal(sure.place_mm, less.place_mm)
    assert (less.sd_mm > sure.sd_mm).all()
