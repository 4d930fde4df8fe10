"""Tests of combining the estimates of the map and of the networks as normal distributions, and of correcting places."""

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal.force import prior_line
from reskin.universal.law import inside
from reskin.universal.map import Estimate, SkinMap, move_places, new_map, shift_onto_area
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


def test_shift_to_the_middle_of_evenly_spread_presses_is_reduced_by_labels():
    """The first result is the shift that moves the mean place to the middle of the skin.

    Labels make this shift smaller.
    """
    even_mm, place_mm = RNG.normal(0.7, 3, (65, 2)), np.zeros((10, 2))
    centre_mm, _ = network_offsets_mm(-even_mm.mean(axis=0), place_mm[:0], place_mm[:0])
    np.testing.assert_allclose((even_mm + centre_mm).mean(axis=0), 0, atol=1e-12)
    faded_mm, _ = network_offsets_mm(-even_mm.mean(axis=0), place_mm, place_mm)
    assert (0 < np.abs(faded_mm)).all()
    assert (np.abs(faded_mm) < np.abs(centre_mm)).all()


@pytest.mark.parametrize("labels_n", [1, 7])
def test_labels_shift_places_as_with_a_gaussian_prior(labels_n):
    """The shift equals the conditional mean of a normal variable, given true minus estimated places."""
    estimated_mm, true_mm = RNG.normal(0, 3, (labels_n, 2)), RNG.normal(0, 3, (labels_n, 2))
    cov = OFFSET_SD_MM**2 * np.ones((labels_n, labels_n)) + LABEL_SD_MM**2 * np.eye(labels_n)
    expected_mm = OFFSET_SD_MM**2 * np.ones(labels_n) @ np.linalg.solve(cov, true_mm - estimated_mm)
    centre_mm, shift_mm = network_offsets_mm(np.zeros(2), estimated_mm, true_mm)
    np.testing.assert_allclose(shift_mm, expected_mm)
    assert (centre_mm == 0).all()


def test_network_determines_the_place_where_the_map_is_ambiguous(skin):
    """If there is no field change, all places are equally likely according to the map, so the network determines the
    place.
    """
    place_mm = np.array([[3.0, 2.0], [-4.0, 1.0]])
    db_uT = fields_uT(place_mm, np.array([2.0, 3.0]))
    right = evaluation(skin, db_uT, place_mm).combined(1.0)
    unsure = evaluation(skin, db_uT, place_mm + 5, sd_mm=50.0).combined(1.0)
    blind = evaluation(skin, np.zeros((2, 15)), place_mm, sd_mm=0.1).combined(1.0)
    assert np.abs(right.place_mm - place_mm).max() < 0.5
    assert np.abs(unsure.place_mm - place_mm).max() < 0.8
    assert (right.sd_mm <= unsure.sd_mm + 1e-6).all()
    assert np.isfinite(blind.place_mm).all()


def test_lower_likelihood_power_widens_intervals_without_changing_estimates(skin):
    place_mm = np.array([[3.0, 2.0]])
    evaluated = evaluation(skin, fields_uT(place_mm, np.array([2.0])), place_mm)
    full, lower = evaluated.combined(1.0), evaluated.combined(0.25)
    np.testing.assert_array_equal(full.place_mm, lower.place_mm)
    assert (lower.sd_mm > full.sd_mm).all()


def test_shift_that_moves_places_back_onto_the_grid_area_is_found():
    octagon_mm = RNG.uniform(-8, 8, (2000, 2))
    octagon_mm = octagon_mm[inside(octagon_mm)]
    errors = []
    for shift_mm in ((0.0, 0.0), (0.9, -0.6), (-1.2, 0.4)):
        for _ in range(5):
            place_mm = RNG.permutation(octagon_mm)[:65] + shift_mm + 0.5 * RNG.standard_normal((65, 2))
            nan = np.full(65, np.nan)
            moved_mm = shift_onto_area(Estimate(place_mm, np.full((65, 2), 0.5), nan, nan, nan), sd_mm=1.0)
            errors.append(moved_mm + shift_mm)
    rms_mm = np.sqrt(np.mean(np.square(errors)))
    # For comparison, this is the standard error of the mean of 65 random places in the octagon. A shift that moves the
    # mean place to the middle would be wrong by this distance.
    mean_mm = 4.4 / np.sqrt(65)
    assert rms_mm < 0.8 * mean_mm


def test_shifting_the_map_shifts_all_estimated_places(skin):
    place_mm, by_mm = np.array([[3.0, 2.0], [-4.0, 1.0], [0.0, -3.0]]), np.array([0.3, -0.2])
    db_uT = fields_uT(place_mm, np.full(3, 2.0))
    before = skin.evaluator.estimate(db_uT)
    after = move_places(skin, by_mm).evaluator.estimate(db_uT)
    np.testing.assert_allclose(after.place_mm - before.place_mm, np.tile(by_mm, (3, 1)), atol=0.15)
