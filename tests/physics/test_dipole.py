"""Tests of the dipole field against closed forms, a naive sum, magpylib and laws of magnetostatics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.extremes.physics import dipoles
from reskin.errors import ParamsError
from reskin.physics.magnet import MU0_4PI, field, field_of_each
from reskin.seeds import rng_for
from tests.laws import LIMITS

ROUNDING = 1e-12  # This is the relative rounding error of a few hundred double-precision operations.

coordinates = st.floats(-1, 1, allow_subnormal=False)
triples = st.tuples(coordinates, coordinates, coordinates).map(np.array)
# Sources are away from the origin, and observers are far from the sources. Otherwise a separation vector with the wrong
# sign could go unnoticed.
sources_m = triples.map(lambda v: v + np.array([3.0, -2.0, 1.0]))
observers_m = triples.map(lambda v: v + np.array([-3.0, 4.0, 5.0]))


def field_at(source_m, moment, observer_m):
    return field(np.atleast_2d(source_m), np.atleast_2d(moment).astype(float), np.atleast_2d(observer_m))[0]


@given(sources_m, st.floats(0.1, 5))
def test_field_on_the_axis_and_beside_the_dipole_equals_the_closed_form(source_m, r_m):
    # The relative tolerance allows for the difference (source + r) - source, which loses digits.
    for direction, times in (((0, 0, r_m), 2), ((r_m, 0, 0), -1)):
        truth_T = (0, 0, times * 2.0 * MU0_4PI / r_m**3)
        np.testing.assert_allclose(
            field_at(source_m, (0, 0, 2.0), source_m + direction), truth_T, rtol=1e-9, atol=1e-25
        )


def test_sum_of_fields_equals_a_loop_over_the_textbook_formula():
    rng = rng_for(0, "dipole")
    positions, moments, observers = rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), rng.normal(size=(4, 3)) + 5
    naive = np.zeros((4, 3))
    for o, observer in enumerate(observers):
        for position, moment in zip(positions, moments, strict=True):
            d = observer - position
            r = np.linalg.norm(d)
            naive[o] += MU0_4PI * (3 * d * (moment @ d) / r**5 - moment / r**3)
    np.testing.assert_allclose(field(positions, moments, observers), naive, rtol=ROUNDING)
    np.testing.assert_allclose(field_of_each(positions, moments, observers).sum(axis=1), naive, rtol=ROUNDING)


@given(st.integers(0, 10**6))
def test_field_equals_magpylib(seed):
    assert dipoles(seed)[0] <= LIMITS["dipoles"]


@given(sources_m, triples, observers_m)
def test_rotating_sources_and_observers_by_90_degrees_rotates_the_field(source_m, moment, observer_m):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        field_at(turn @ source_m, turn @ moment, turn @ observer_m),
        turn @ field_at(source_m, moment, observer_m),
        rtol=1e-9,
        atol=1e-22,
    )


@pytest.mark.parametrize("place", [0.0, np.nan])
def test_observer_at_the_place_of_a_dipole_is_refused(place):
    with pytest.raises(ParamsError, match="distance to a chip must be above 0 m"):
        field(np.full((1, 3), place), np.ones((1, 3)), np.zeros((1, 3)))


def test_field_of_an_empty_set_of_dipoles_is_zero():
    assert not field(np.zeros((0, 3)), np.zeros((0, 3)), np.ones((2, 3))).any()
