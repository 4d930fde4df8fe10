"""Tests of the magnets that magnetise the skin, and of the resulting magnetisation.

References are magpylib's Cuboid and Maxwell's equations.
"""

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.constants import mu_0

from pipeline.experiments.extremes import physics as laws
from reskin.errors import ParamsError
from reskin.physics import magnet
from reskin.physics.magnet import MU0_4PI, Quadrature, field, place_nodes
from reskin.seeds import rng_for
from tests.laws import LIMITS

THICKNESS_M = 2e-3
NODES_M = place_nodes(THICKNESS_M, Quadrature(1.5e-3, 3)).nodes_m
places_m = st.tuples(st.floats(-9e-3, 9e-3), st.floats(-9e-3, 9e-3), st.floats(1e-4, 1.9e-3)).map(np.array)
seeds = st.integers(0, 10**6)
polarities = st.sampled_from(["checkerboard", "same"])


def test_field_of_a_cuboid_equals_magpylib():
    sides_m = (6e-3, 4e-3, 3e-3)
    places_m = rng_for(0, "cuboid").uniform(-20e-3, 20e-3, (2000, 3)) * rng_for(1, "cuboid").uniform(size=(2000, 1))
    theirs_T = magpylib.magnet.Cuboid(polarization=(0, 0, 1.3), dimension=sides_m).getB(places_m)
    assert (np.abs(places_m) < np.array(sides_m) / 2).all(axis=1).sum() > 50
    # The tolerance is the rounding of a sum of 24 logarithms, for fields of 1 T.
    np.testing.assert_allclose(magnet.cuboid_field(places_m, 1.3, sides_m=sides_m), theirs_T, atol=1e-12)


@settings(max_examples=10)
@given(polarities, seeds)
def test_field_of_the_array_equals_magpylib_and_satisfies_maxwells_equations(polarity, seed):
    assert laws.array(NODES_M, THICKNESS_M, polarity) <= LIMITS["array"]
    assert laws.maxwell(THICKNESS_M, polarity, seed) <= LIMITS["maxwell"]


def test_field_of_the_array_equals_the_specification():
    # The specified field in the slab is 0.38 to 0.65 T. The field is weaker at places where seams between magnets
    # cross, and stronger at the faces of the magnets.
    size_T = np.linalg.norm(magnet.array_field(NODES_M, THICKNESS_M, "checkerboard"), axis=1)
    assert 0.38 < np.median(size_T) < 0.65


def test_field_of_the_array_raises_for_a_place_outside_the_slab():
    with pytest.raises(ParamsError, match="height of the nodes must be from 0 to .*, inside the skin"):
        magnet.array_field(np.array([[0.0, 0.0, 2.1e-3]]), THICKNESS_M, "same")


def test_magnetisation_at_the_half_field_is_half_of_saturation():
    for b_T in rng_for(0, "magnet").normal(size=(50, 3)):
        strength_T = float(np.linalg.norm(b_T))
        j_T = magnet.magnetise(b_T[None], saturation_T=0.17, half_field_T=strength_T)[0]
        np.testing.assert_allclose(j_T, 0.17 / 2 * b_T / strength_T, rtol=1e-12)


def test_mean_magnetisation_equals_the_specification():
    # The specified mean is 22 to 28 mT for a saturation (phi Br) of 0.11 T and a half field (B_half) of 0.8 T.
    rest = place_nodes(THICKNESS_M)
    b_T = magnet.array_field(rest.nodes_m, THICKNESS_M, "checkerboard")
    j_T = np.linalg.norm(magnet.magnetise(b_T, saturation_T=0.11, half_field_T=0.8), axis=1)
    assert 22e-3 <= np.average(j_T, weights=rest.volumes_m3) <= 28e-3


def test_uniformly_magnetised_skin_has_the_far_field_of_a_dipole():
    rest = place_nodes(THICKNESS_M)
    j_T = np.tile([0.0, 0.0, 0.1], (len(rest.nodes_m), 1))
    above_m = np.array([[0.0, 0.0, 1.0]])
    b_T = field(rest.nodes_m, magnet.moments(j_T, rest.volumes_m3), above_m)
    moment = 0.1 * 20e-3**2 * THICKNESS_M / mu_0
    # The tolerance is 0.3 %, because the skin is 1 mm off centre at a distance of 1 m.
    np.testing.assert_allclose(b_T[0, 2], 2 * MU0_4PI * moment, rtol=5e-3)


@pytest.mark.parametrize("polarity", ["checkerboard", "same"])
def test_field_of_the_array_is_the_sum_of_the_fields_of_its_cubes(polarity):
    cubes_n, side_m = (3, 2), magnet.CUBE_SIDE_M
    truth_T = np.zeros_like(NODES_M)
    for i in range(cubes_n[0]):
        for j in range(cubes_n[1]):
            sign = -1 if polarity == "checkerboard" and (i + j) % 2 else 1
            for z_m in (-magnet.ARRAY_BELOW_M - side_m / 2, THICKNESS_M + magnet.ARRAY_ABOVE_M + side_m / 2):
                middle_m = ((i - (cubes_n[0] - 1) / 2) * side_m, (j - (cubes_n[1] - 1) / 2) * side_m, z_m)
                truth_T += magnet.cuboid_field(
                    NODES_M - middle_m, sign * magnet.ARRAY_REMANENCE_T, sides_m=(side_m,) * 3
                )
    found_T = magnet.array_field(NODES_M, THICKNESS_M, polarity, cubes_n=cubes_n)
    np.testing.assert_allclose(found_T, truth_T, atol=1e-12)
