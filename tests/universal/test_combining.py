"""Tests of combining map and networks as normal distributions, and of correcting the networks' places."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.force import prior_line
from reskin.universal.map import SkinMap, new_map
from reskin.universal.model import LABEL_SD_MM, OFFSET_SD_MM, Evaluation, network_offsets_mm
from reskin.universal.network import NetworkEstimate
from tests.universal.skins import fields_uT, make_tables

RNG = rng_for(0, "experts")


@pytest.fixture(scope="module")
def skin() -> SkinMap:
    return new_map(make_tables())


def evaluation(skin: SkinMap, db_uT: np.ndarray, place_mm: np.ndarray, sd_mm: float = 1.0) -> Evaluation:
    n = len(place_mm)
    network = NetworkEstimate(place_mm, np.full((n, 2), sd_mm), np.full(n, 1.0), np.full(n, 1.0))
    return Evaluation(skin.evaluator, skin.evaluator.evaluate(db_uT), network, prior_line())


def test_places_of_evenly_spread_presses_are_centred():
    even_mm, place_mm = RNG.normal(0.7, 3, (65, 2)), np.zeros((10, 2))
    centre_mm, _ = network_offsets_mm(even_mm, place_mm[:0], place_mm[:0])
    np.testing.assert_allclose((even_mm + centre_mm).mean(axis=0), 0, atol=1e-12)
    faded_mm, _ = network_offsets_mm(even_mm, place_mm, place_mm)
    assert (0 < np.abs(faded_mm)).all()
    assert (np.abs(faded_mm) < np.abs(centre_mm)).all()


@pytest.mark.parametrize("labels_n", [1, 7])
def test_labels_shift_places_as_with_a_gaussian_prior(labels_n):
    estimated_mm, true_mm = RNG.normal(0, 3, (labels_n, 2)), RNG.normal(0, 3, (labels_n, 2))
    cov = OFFSET_SD_MM**2 * np.ones((labels_n, labels_n)) + LABEL_SD_MM**2 * np.eye(labels_n)
    expected_mm = OFFSET_SD_MM**2 * np.ones(labels_n) @ np.linalg.solve(cov, true_mm - estimated_mm)
    centre_mm, shift_mm = network_offsets_mm(np.zeros((0, 2)), estimated_mm, true_mm)
    np.testing.assert_allclose(shift_mm, expected_mm)
    assert (centre_mm == 0).all()


def test_network_determines_the_place_where_the_map_is_ambiguous(skin):
    place_mm = np.array([[3.0, 2.0], [-4.0, 1.0]])
    db_uT = fields_uT(place_mm, np.array([2.0, 3.0]))
    right = evaluation(skin, db_uT, place_mm).combined(1.0)
    unsure = evaluation(skin, db_uT, place_mm + 5, sd_mm=50.0).combined(1.0)
    blind = evaluation(skin, np.zeros((2, 15)), place_mm, sd_mm=0.1).combined(1.0)
    assert np.abs(right.place_mm - place_mm).max() < 0.5
    assert np.abs(unsure.place_mm - place_mm).max() < 0.8
    assert (right.sd_mm <= unsure.sd_mm + 1e-6).all()
    assert np.isfinite(blind.place_mm).all()


def test_lower_power_widens_intervals_without_changing_estimates(skin):
    place_mm = np.array([[3.0, 2.0]])
    evaluated = evaluation(skin, fields_uT(place_mm, np.array([2.0])), place_mm)
    full, lower = evaluated.combined(1.0), evaluated.combined(0.25)
    np.testing.assert_array_equal(full.place_mm, lower.place_mm)
    assert (lower.sd_mm > full.sd_mm).all()
