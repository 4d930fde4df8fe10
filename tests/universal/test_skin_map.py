"""A map learns as Gaussian conditioning does, and reads what it was told."""

from dataclasses import replace

import numpy as np
import pytest

from reskin.errors import SchemaError
from reskin.seeds import rng_for
from reskin.universal import map
from reskin.universal.map import LAW_ERROR, NOISE_uT, OFFSET_uT, Reader, new_map, see_even, see_labelled, see_pokes
from reskin.universal.population import grid
from tests.universal.skins import REST_SLOPE_uT, made_tables, poked_uT

NUMBER = np.array([0.0, 0.0, 1.5])


@pytest.fixture(scope="module")
def skin() -> map.SkinMap:
    return new_map(made_tables())


def pokes(number=NUMBER, seed=0):
    force_N = np.exp(rng_for(seed, "pokes").uniform(np.log(0.7), np.log(8), 65))
    return grid(), force_N, poked_uT(grid(), force_N, number)


def test_a_field_at_rest_is_learnt_as_by_conditioning_a_gaussian(skin):
    noload_uT = rng_for(1, "rest").normal(0, 300, 15)
    found = map.see_rest(skin, noload_uT)
    # The covariance form of what the map writes in the information form.
    gain = REST_SLOPE_uT.T @ np.linalg.inv(REST_SLOPE_uT @ REST_SLOPE_uT.T + OFFSET_uT**2 * np.eye(15))
    np.testing.assert_allclose(found.number, gain @ noload_uT, rtol=1e-9)
    np.testing.assert_allclose(found.cov, np.eye(3) - gain @ REST_SLOPE_uT, rtol=1e-9, atol=1e-12)


def test_a_reading_is_weighed_by_its_gaussian_distance(skin):
    skin = replace(skin, number=np.array([0.3, -0.2, 0.5]))
    reader = Reader(skin)
    hypothesis = [300, 1100, 2000]
    mean_uT, slope_uT = skin.hypotheses.mean_uT[hypothesis], skin.hypotheses.slope_uT[hypothesis]
    expected_uT = mean_uT + slope_uT @ skin.number
    db_uT = expected_uT * 1.2 + 10.0
    for row, i in enumerate(hypothesis):
        length_uT = np.linalg.norm(expected_uT[row])
        cov = slope_uT[row] @ skin.cov @ slope_uT[row].T + ((LAW_ERROR * length_uT) ** 2 / 15 + NOISE_uT**2) * np.eye(
            15
        )
        off_uT = db_uT[row] - expected_uT[row]
        chi2 = off_uT @ np.linalg.solve(cov, off_uT)
        weighed = chi2 + np.linalg.slogdet(cov)[1]
        found = reader.weigh(db_uT[row : row + 1])
        assert found.chi2[0, i] == pytest.approx(chi2, abs=0.01)  # single precision
        assert found.likelihoods.total[0, i] == pytest.approx(weighed, abs=0.02)


def test_readings_of_the_tables_own_skin_are_read_where_they_were(skin):
    place_mm, force_N, db_uT = pokes(np.zeros(3))
    found = Reader(skin).estimate(db_uT)
    assert np.abs(found.place_mm - place_mm).max() < 1.0
    assert np.abs(np.log(found.force_N / force_N)).mean() < 0.3


def test_a_labelled_place_is_read_as_labelled_whatever_the_law_says(skin):
    place_mm, force_N, db_uT = pokes()
    wrong_uT = db_uT[::-1] * 0.9  # each place reads as the one opposite
    some = [12, 32, 50]
    found = Reader(see_labelled(skin, place_mm[some], force_N[some], wrong_uT[some])).estimate(wrong_uT[some])
    assert np.abs(found.place_mm - place_mm[some]).max() < 0.5
    before = Reader(skin).estimate(wrong_uT[[12, 50]])
    assert np.abs(before.place_mm - place_mm[[12, 50]]).max() > 3


def test_the_order_of_labels_changes_nothing(skin):
    place_mm, force_N, db_uT = (part[:10] for part in pokes())
    order = rng_for(2, "order").permutation(10)
    one, other = (
        Reader(see_labelled(skin, place_mm[i], force_N[i], db_uT[i])).estimate(db_uT) for i in (np.arange(10), order)
    )
    np.testing.assert_allclose(one.place_mm, other.place_mm, atol=1e-3)  # mm; weighed in single precision
    np.testing.assert_allclose(one.sd_mm, other.sd_mm, atol=1e-3)


@pytest.mark.parametrize("gap", [-1.5, 1.5])
def test_unlabelled_pokes_move_the_numbers_towards_the_truth(skin, gap):
    _, _, db_uT = pokes(np.array([0.0, 0.0, gap]))
    found = see_pokes(skin, db_uT + rng_for(3, "noise").normal(0, 3, db_uT.shape))
    # Not nearer: each poke's likeliest places and forces take up part of what the number does.
    assert abs(found.number[2] - gap) < 0.8 * abs(gap)
    assert found.cov[2, 2] < skin.cov[2, 2]


def test_pokes_that_lie_evenly_tell_where_the_labels_middle_is(skin):
    shifted = np.array([2.0, -1.0, 0.0])  # spreads of 0.25 mm
    _, _, db_uT = pokes(shifted)
    found = see_even(skin, db_uT)
    assert np.linalg.norm((found.number - shifted)[:2]) < 0.5 * np.linalg.norm(shifted)


def test_a_spread_that_is_no_covariance_is_an_error_and_no_answer_of_nan(skin):
    broken = replace(skin, hypotheses=replace(skin.hypotheses, error_cov=-1e6 * skin.hypotheses.error_cov))
    with pytest.raises(SchemaError, match="covariances of its hypotheses must be positive definite"):
        Reader(broken)
