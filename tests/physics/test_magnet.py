"""The skin's lattice and magnetisation against the box it fills, Maxwell, and a real array of 4x4 cubes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.constants import mu_0

from pipeline.physics import magnet
from pipeline.physics.dipole import MU0_4PI, field
from pipeline.seeds import rng_for

THICKNESS_M = 2e-3
places_m = st.tuples(st.floats(-9e-3, 9e-3), st.floats(-9e-3, 9e-3), st.floats(1e-4, 1.9e-3)).map(np.array)


def jacobian(point_m):
    step_m = 1e-6
    steps = (np.eye(3)[:, None] * np.array([step_m, -step_m])[:, None]).reshape(6, 3)
    b_T = magnet.array_field(point_m + steps, THICKNESS_M).reshape(3, 2, 3)
    return (b_T[:, 0] - b_T[:, 1]) / (2 * step_m)


def magnetise(nodes_m, **changes):
    settings = {"polarity": "checkerboard", "saturation_T": 0.17, "half_field_T": 0.5, **changes}
    return magnet.magnetise(nodes_m, THICKNESS_M, **settings)


@given(st.floats(2e-4, 1e-2))
def test_the_cells_fill_the_skin_and_balance(thickness_m):
    rest = magnet.lattice(thickness_m)
    volume_m3 = magnet.SKIN_SIDE_M**2 * thickness_m
    np.testing.assert_allclose(rest.volumes_m3.sum(), volume_m3, rtol=1e-12)
    centre_m = rest.volumes_m3 @ rest.nodes_m / volume_m3
    np.testing.assert_allclose(centre_m, (0, 0, thickness_m / 2), atol=1e-15)


def test_no_cell_crosses_a_seam():
    # Seen from a seam, cells are as thick on one side as on the other, so its neighbours lie symmetrically.
    x_m = np.unique(magnet.lattice(THICKNESS_M).nodes_m[:, 0])
    for seam_m, half_m in ((0.0, magnet.CUBE_SIDE_M / 20), (magnet.CUBE_SIDE_M, magnet.CUBE_SIDE_M / 20)):
        below_m = x_m[x_m < seam_m].max()
        np.testing.assert_allclose(seam_m - below_m, half_m, rtol=1e-9)


@given(places_m)
def test_the_array_field_has_neither_divergence_nor_curl(point_m):
    grad = jacobian(point_m)
    size = np.abs(grad).max() + 1.0  # T/m; the field changes by about 300 T/m
    assert abs(np.trace(grad)) < 1e-5 * size  # central differences over 1 um
    assert np.abs(grad - grad.T).max() < 1e-5 * size


@given(places_m)
def test_the_next_magnet_has_the_opposite_field(point_m):
    there = magnet.array_field((point_m + np.array([magnet.CUBE_SIDE_M, 0, 0]))[None], THICKNESS_M)
    np.testing.assert_allclose(there, -magnet.array_field(point_m[None], THICKNESS_M), atol=1e-12)


def test_the_array_field_is_that_of_a_real_4x4_array_but_for_its_edge():
    magpylib = pytest.importorskip("magpylib", reason="needs magpylib, of the dev dependencies")
    side_m = magnet.CUBE_SIDE_M
    heights_m = (-magnet.ARRAY_BELOW_M - side_m / 2, THICKNESS_M + magnet.ARRAY_ABOVE_M + side_m / 2)
    cubes = [
        magpylib.magnet.Cuboid(
            polarization=(0, 0, magnet.ARRAY_REMANENCE_T * (-1) ** (i + j)),
            dimension=(side_m, side_m, side_m),
            position=((i - 1.5) * side_m, (j - 1.5) * side_m, z_m),
        )
        for i in range(4)
        for j in range(4)
        for z_m in heights_m
    ]
    nodes_m = magnet.lattice(THICKNESS_M).nodes_m
    inner_m = nodes_m[np.abs(nodes_m).max(axis=1) < side_m]
    truth_T = magpylib.getB(cubes, inner_m, sumup=True)
    wrong_T = magnet.array_field(inner_m, THICKNESS_M) - truth_T
    # 5 %: the endless array has no edge, and the series stops at the seventh harmonic.
    assert np.linalg.norm(wrong_T) < 0.05 * np.linalg.norm(truth_T)


def test_magnetisation_is_half_of_saturation_at_the_half_field_and_lies_along_the_field():
    rng = rng_for(0, "magnet")
    nodes_m = rng.uniform((-9e-3, -9e-3, 0), (9e-3, 9e-3, THICKNESS_M), size=(50, 3))
    b_T = magnet.array_field(nodes_m, THICKNESS_M)
    for node_m, b in zip(nodes_m, b_T, strict=True):
        strength_T = float(np.linalg.norm(b))
        j_T = magnetise(node_m[None], half_field_T=strength_T)[0]
        np.testing.assert_allclose(j_T, 0.17 / 2 * b / strength_T, rtol=1e-9, atol=1e-15)


def test_at_a_seam_crossing_in_the_middle_nothing_is_magnetised_and_nothing_is_nan():
    assert not magnetise(np.array([[0.0, 0.0, 1e-3]])).any()


def test_same_polarity_is_uniform_along_z():
    j_T = magnetise(magnet.lattice(THICKNESS_M).nodes_m, polarity="same")
    assert not j_T[:, :2].any()
    assert np.ptp(j_T[:, 2]) == 0
    assert j_T[0, 2] > 0


@given(st.floats(0, 10))
def test_magnetisation_is_proportional_to_saturation(factor):
    nodes_m = magnet.lattice(THICKNESS_M).nodes_m[::97]
    np.testing.assert_allclose(
        magnetise(nodes_m, saturation_T=0.1 * factor),
        factor * magnetise(nodes_m, saturation_T=0.1),
        rtol=1e-12,
        atol=1e-18,
    )


def test_far_away_the_uniform_skin_is_one_dipole_of_j_times_volume_over_mu0():
    rest = magnet.lattice(THICKNESS_M)
    j_T = np.tile([0.0, 0.0, 0.1], (len(rest.nodes_m), 1))
    above_m = np.array([[0.0, 0.0, 1.0]])
    b_T = field(rest.nodes_m, magnet.moments(j_T, rest.volumes_m3), above_m)
    moment = 0.1 * magnet.SKIN_SIDE_M**2 * THICKNESS_M / mu_0
    np.testing.assert_allclose(b_T[0, 2], 2 * MU0_4PI * moment, rtol=5e-3)  # 1 mm / 1 m off centre, three times
