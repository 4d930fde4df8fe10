"""Tests of the map, the model of a skin that gives the likelihood of each place and force for a reading.

The map is conditioned on presses like a Gaussian process, and reproduces labelled places.
"""

from dataclasses import replace

import numpy as np
import pytest

from reskin.errors import SchemaError
from reskin.seeds import rng_for
from reskin.universal import map
from reskin.universal.map import (
    LAW_ERROR,
    NOISE_uT,
    OFFSET_uT,
    condition_on_even_presses,
    condition_on_labels,
    condition_on_presses,
    new_map,
)
from reskin.universal.population import grid
from tests.universal.skins import REST_SLOPE_uT, make_tables, poked_uT

NUMBER = np.array([0.0, 0.0, 1.5])


@pytest.fixture(scope="module")
def skin() -> map.SkinMap:
    return new_map(make_tables())


def presses(number=NUMBER, seed=0):
    force_N = np.exp(rng_for(seed, "pokes").uniform(np.log(0.7), np.log(8), 65))
    return grid(), force_N, poked_uT(grid(), force_N, number)


def test_conditioning_on_the_no_load_field_equals_conditioning_of_a_gaussian(skin):
    noload_uT = rng_for(1, "rest").normal(0, 300, 15)
    found = map.condition_on_noload(skin, noload_uT)
    # The reference computes with covariances. The map computes with their inverses.
    gain = REST_SLOPE_uT.T @ np.linalg.inv(REST_SLOPE_uT @ REST_SLOPE_uT.T + OFFSET_uT**2 * np.eye(15))
    np.testing.assert_allclose(found.mean, gain @ noload_uT, rtol=1e-9)
    np.testing.assert_allclose(found.cov, np.eye(3) - gain @ REST_SLOPE_uT, rtol=1e-9, atol=1e-12)


def test_deviance_equals_that_of_a_multivariate_normal_distribution(skin):
    skin = replace(skin, mean=np.array([0.3, -0.2, 0.5]))
    hypothesis = [300, 1100, 2000]
    mean_uT, slope_uT = skin.hypotheses.mean_uT[hypothesis], skin.hypotheses.slope_uT[hypothesis]
    expected_uT = mean_uT + slope_uT @ skin.mean
    db_uT = expected_uT * 1.2 + 10.0
    for row, i in enumerate(hypothesis):
        length_uT = np.linalg.norm(expected_uT[row])
        cov = slope_uT[row] @ skin.cov @ slope_uT[row].T + ((LAW_ERROR * length_uT) ** 2 / 15 + NOISE_uT**2) * np.eye(
            15
        )
        off_uT = db_uT[row] - expected_uT[row]
        chi2 = off_uT @ np.linalg.solve(cov, off_uT)
        deviance = chi2 + np.linalg.slogdet(cov)[1]
        found = skin.evaluator.evaluate(db_uT[row : row + 1])
        # The tolerance is the rounding of chi^2, which is in single precision.
        assert found.chi2[0, i] == pytest.approx(chi2, abs=0.01)
        assert found.deviance[0, i] == pytest.approx(deviance, abs=0.02)


def test_presses_on_the_tabulated_skin_are_located_within_1_mm(skin):
    place_mm, force_N, db_uT = presses(np.zeros(3))
    found = skin.evaluator.estimate(db_uT)
    assert np.abs(found.place_mm - place_mm).max() < 1.0
    assert np.abs(np.log(found.force_N / force_N)).mean() < 0.3


def test_labelled_places_are_estimated_even_if_they_contradict_the_law(skin):
    place_mm, force_N, db_uT = presses()
    # The labels contradict the law (the simulated field changes), because each place is labelled with the field of the
    # opposite place.
    wrong_uT = db_uT[::-1] * 0.9
    labelled = [12, 32, 50]
    found = condition_on_labels(skin, place_mm[labelled], force_N[labelled], wrong_uT[labelled]).evaluator.estimate(
        wrong_uT[labelled]
    )
    assert np.abs(found.place_mm - place_mm[labelled]).max() < 0.5
    before = skin.evaluator.estimate(wrong_uT[[12, 50]])
    assert np.abs(before.place_mm - place_mm[[12, 50]]).max() > 3


def test_order_of_labels_does_not_matter(skin):
    place_mm, force_N, db_uT = (part[:10] for part in presses())
    order = rng_for(2, "order").permutation(10)
    maps = [condition_on_labels(skin, place_mm[i], force_N[i], db_uT[i]) for i in (np.arange(10), order)]
    one, other = (each.evaluator.estimate(db_uT) for each in maps)
    # The tolerance in mm is the effect of rounding, because deviances are in single precision.
    np.testing.assert_allclose(one.place_mm, other.place_mm, atol=1e-3)
    np.testing.assert_allclose(one.sd_mm, other.sd_mm, atol=1e-3)


@pytest.mark.parametrize("gap", [-1.5, 1.5])
def test_unlabelled_presses_move_a_parameter_towards_its_true_value(skin, gap):
    _, _, db_uT = presses(np.array([0.0, 0.0, gap]))
    found = condition_on_presses(skin, db_uT + rng_for(3, "noise").normal(0, 3, db_uT.shape))
    # The tolerance is wide: places and forces of the presses are unknown, and their estimates absorb a part of the
    # effect of the parameter.
    assert abs(found.mean[2] - gap) < 0.8 * abs(gap)
    assert found.cov[2, 2] < skin.cov[2, 2]


def test_mean_of_evenly_spread_presses_determines_the_origin_of_the_places(skin):
    shifted = np.array([2.0, -1.0, 0.0])  # The shift of the origin, in standard deviations of 0.25 mm each.
    _, _, db_uT = presses(shifted)
    found = condition_on_even_presses(skin, db_uT)
    assert np.linalg.norm((found.mean - shifted)[:2]) < 0.5 * np.linalg.norm(shifted)


def test_evaluator_raises_if_a_covariance_is_not_positive_definite(skin):
    broken = replace(skin, hypotheses=replace(skin.hypotheses, error_cov=-1e6 * skin.hypotheses.error_cov))
    with pytest.raises(SchemaError, match="covariances of .* hypotheses .places and forces. are not positive definite"):
        _ = broken.evaluator
