"""The bonded layer against its boundary, incompressibility, Hertz, and the numbers of PHYSICS section 4."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ParamsError
from pipeline.physics import layer

THICKNESS_M, RADIUS_M = 2e-3, 3e-3
depths_m = st.floats(1e-5, 1.45e-3)
heights_m = st.floats(0, THICKNESS_M)
radii_m = st.floats(1e-5, 1e-2)


def dent(depth_m):
    return layer.dent_under_sphere(depth_m, RADIUS_M, THICKNESS_M)


def displacement(r_m, z_m, depth_m):
    return np.array(layer.displacement(np.atleast_1d(r_m), np.atleast_1d(z_m), dent(depth_m)))


def slopes(r_m, z_m, depth_m):
    """Derivatives of (u, w) along r and z by central differences."""
    step_m = 1e-8
    along_r = displacement(r_m + step_m, z_m, depth_m) - displacement(r_m - step_m, z_m, depth_m)
    along_z = displacement(r_m, z_m + step_m, depth_m) - displacement(r_m, z_m - step_m, depth_m)
    return along_r[:, 0] / (2 * step_m), along_z[:, 0] / (2 * step_m)


@given(depths_m, radii_m)
def test_the_base_is_bonded_and_stays_exactly(depth_m, r_m):
    assert not displacement(r_m, 0.0, depth_m).any()


@given(depths_m)
def test_under_the_tip_the_top_sinks_by_the_depth_and_nothing_moves_sideways(depth_m):
    outward_m, up_m = displacement(0.0, THICKNESS_M, depth_m)
    assert outward_m == 0
    np.testing.assert_allclose(up_m, -depth_m, rtol=1e-12)


@given(depths_m)
def test_the_dent_has_the_curvature_of_the_tip(depth_m):
    r_m = 1e-3 * np.sqrt(2 * RADIUS_M * depth_m)
    rise_m = displacement(r_m, THICKNESS_M, depth_m)[1] + depth_m
    np.testing.assert_allclose(rise_m, r_m**2 / (2 * RADIUS_M), rtol=1e-4)  # next term: (r/a)^2, and cancelling digits


@given(depths_m, radii_m, st.floats(1e-5, 1.99e-3))
def test_the_volume_of_no_piece_changes_to_first_order(depth_m, r_m, z_m):
    along_r, along_z = slopes(r_m, z_m, depth_m)
    outward_m = displacement(r_m, z_m, depth_m)[0, 0]
    assert abs(along_r[0] + outward_m / r_m + along_z[1]) < 1e-6  # central differences: rounding over 1e-8 m
    f = layer.gradient(np.array([r_m]), np.array([z_m]), dent(depth_m))
    np.testing.assert_allclose(f.rr + f.hoop + f.zz, 3, atol=1e-12)


@given(depths_m, radii_m, st.floats(1e-5, 1.99e-3))
def test_the_gradient_is_that_of_the_displacement(depth_m, r_m, z_m):
    along_r, along_z = slopes(r_m, z_m, depth_m)
    f = layer.gradient(np.array([r_m]), np.array([z_m]), dent(depth_m))
    found = [f.rr[0] - 1, f.zr[0], f.rz[0], f.zz[0] - 1]
    np.testing.assert_allclose(found, [*along_r, *along_z], atol=1e-6)


def test_what_the_tip_pushes_down_rises_as_a_rim():
    r_m = np.linspace(0, 30e-3, 200_001)
    up_m = displacement(r_m, np.full_like(r_m, THICKNESS_M), 1e-3)[1]
    ring = up_m * r_m
    assert abs(np.trapezoid(ring, r_m)) < 1e-6 * np.trapezoid(np.abs(ring), r_m)


@given(depths_m, radii_m, heights_m)
def test_the_rotation_leaves_a_symmetric_stretch(depth_m, r_m, z_m):
    f = layer.gradient(np.array([r_m]), np.array([z_m]), dent(depth_m))
    cos, sin = (part[0] for part in layer.rotation(f))
    turn = np.array([[cos, sin], [-sin, cos]])
    stretch = turn.T @ np.array([[f.rr[0], f.rz[0]], [f.zr[0], f.zz[0]]])
    np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(stretch, stretch.T, atol=1e-12)
    assert np.trace(stretch) > 0


def test_the_map_does_not_fold_within_the_depth_that_is_allowed():
    r_m, z_m = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 8e-3, 81), np.linspace(0, THICKNESS_M, 61)))
    for depth_m in (0.2e-3, 1.2e-3, 1.49e-3):
        f = layer.gradient(r_m, z_m, dent(depth_m))
        assert (f.hoop * (f.rr * f.zz - f.rz * f.zr)).min() > 0


def test_past_the_reach_almost_nothing_moves():
    r_m = np.linspace(layer.REACH, 3 * layer.REACH, 100) * dent(1e-3).width_m
    moved_m = np.abs(displacement(r_m, np.full_like(r_m, THICKNESS_M), 1e-3))
    assert moved_m.max() < 0.003 * 1e-3


@pytest.mark.parametrize("depth_m", [-1e-4, 0.0, 1.5e-3, np.nan])
def test_a_depth_at_which_the_map_would_fold_or_vanish_is_refused(depth_m):
    with pytest.raises(ParamsError, match=r"depth must be above 0 and below 0\.75 of the 2 mm thickness"):
        dent(depth_m)


def force(depth_m, **changes):
    settings = {"radius_m": RADIUS_M, "thickness_m": THICKNESS_M, "modulus_Pa": 190e3, **changes}
    return layer.force(np.atleast_1d(depth_m).astype(float), **settings)


@given(depths_m)
def test_on_a_very_thick_layer_the_force_is_that_of_hertz(depth_m):
    hertz_N = 16 / 9 * 190e3 * np.sqrt(RADIUS_M) * depth_m**1.5
    np.testing.assert_allclose(force(depth_m, thickness_m=1e6), hertz_N, rtol=1e-8)


def test_the_force_is_within_ten_percent_of_the_exact_layer():
    # PHYSICS 4: the Hankel-space solution at 0.2 ... 1.2 mm; Dimitriadis 2002 is stated to lie within 10 % of it.
    exact_N = [0.09, 0.33, 0.74, 1.33, 2.08, 3.00]
    np.testing.assert_allclose(force(np.arange(1, 7) * 0.2e-3), exact_N, rtol=0.10)


def test_without_contact_and_without_stiffness_there_is_no_force():
    assert not force([-1e-3, 0.0]).any()
    assert not force([1e-3], modulus_Pa=0.0).any()


@given(depths_m, st.floats(1.01, 2))
def test_force_grows_with_depth_and_stiffness_and_on_a_thinner_layer(depth_m, factor):
    assert force(depth_m * factor) > force(depth_m)
    assert force(depth_m, thickness_m=THICKNESS_M / factor) > force(depth_m)
    np.testing.assert_allclose(force(depth_m, modulus_Pa=190e3 * factor), factor * force(depth_m), rtol=1e-12)
