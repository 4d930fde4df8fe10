"""Tests of the tabulated deformation against the motion of each node, computed in steps.

Further tests: pokes without contact, the base of the skin, places beyond the table, and thin skins.
"""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import ParamsError
from reskin.physics import deformation, layer
from tests.physics.test_deformation import follow

H_M, TIP_M = 2e-3, 3e-3
HEIGHTS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)
BASES = ("bonded", "slipping")
depths_m = st.floats(1e-5, 1.2e-3)


@cache  # The table is not computed at import, because every test worker imports this module.
def table(base="bonded"):
    return deformation.tabulate(H_M, TIP_M, 1.2e-3, heights=HEIGHTS, base=base)


def move(places_m, poke_m, base="bonded"):
    places_m = np.asarray(places_m, dtype=float)
    up = np.tile([0.0, 0.0, 1.0], (len(places_m), 1))
    height_i = np.argmin(np.abs(places_m[:, 2:] / H_M - HEIGHTS), axis=1)
    return deformation.move_dipoles(
        table(base), deformation.RestingDipoles(places_m, up, height_i, HEIGHTS), np.asarray(poke_m, dtype=float)
    )


def places(rng, places_n, half_m=10e-3):
    return np.column_stack([rng.uniform(-half_m, half_m, (places_n, 2)), H_M * rng.choice(HEIGHTS, places_n)])


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize(("rung_i", "share"), [(4, 2e-3), (-1, 2e-3), (None, 0.05)])
def test_tabulated_motion_equals_the_computed_motion_of_nodes(rung_i, share, base):
    # The table is interpolated in R/h (radius of the tip divided by the thickness) and in r, with an error of 0.2 % of
    # the depth. Between the depths of the table, the error is 5 %, because the edge of the contact is at another radius
    # there.
    depth_m = 0.55e-3 if rung_i is None else table(base).depth_m[rung_i]
    start_m = places(np.random.default_rng(0), 150) * (1, 0, 1)
    # Only nodes below the surface are compared, because the angle of the surface jumps at the edge of the contact.
    start_m = start_m[start_m[:, 2] < H_M]
    moved = move(start_m, (0, 0, depth_m), base)
    followed = follow(np.abs(start_m[:, 0]), start_m[:, 2], depth_m, base)
    sign = np.sign(start_m[:, 0])
    np.testing.assert_allclose(moved.after[0][:, 0], sign * followed.r_m, atol=share * depth_m)
    np.testing.assert_allclose(moved.after[0][:, 2], followed.z_m, atol=share * depth_m)
    if share < 0.01:
        np.testing.assert_allclose(
            moved.after[1][:, 0], sign * np.sin(deformation.rotation_angle(followed.f)), atol=3e-3
        )


def test_displacement_beyond_the_range_of_the_table_is_negligible():
    radius_m = layer.contact_of_depth(1.2e-3, thickness_m=H_M, tip_radius_m=TIP_M, base="bonded").radius_m
    assert table().reach_m == pytest.approx(radius_m + 5 * H_M, rel=0.01)
    assert move([[1.001 * table().reach_m, 0, 1e-3]], (0, 0, 1.2e-3)).i.size == 0
    assert np.abs(table().moved[-1, :, -1, :2]).max() * H_M < 0.015 * 1.2e-3


@given(depths_m)
def test_slipping_skin_moves_outward_beyond_the_range_of_the_table(depth_m):
    r_m = np.repeat(table("slipping").reach_m * np.array([0.999, 1.001, 1.5, 2.2]), len(HEIGHTS))
    rest_m = np.column_stack([r_m, np.zeros_like(r_m), H_M * np.tile(HEIGHTS, 4)])
    moved = move(rest_m, (0, 0, depth_m), "slipping")
    assert moved.i.size == r_m.size
    grown_m2 = moved.after[0][:, 0] ** 2 - r_m**2
    # Tolerance: at the edge of the table, the two solutions differ by exp(-5 pi), and by the rounding of sums.
    np.testing.assert_allclose(grown_m2, grown_m2[-1], rtol=0.01)
    past = slice(len(HEIGHTS), None)
    np.testing.assert_array_equal(moved.after[0][past, 1:], rest_m[past, 1:])
    np.testing.assert_array_equal(moved.after[1][past], moved.before[1][past])


@given(depths_m)
def test_lower_surface_of_a_slipping_skin_stays_on_its_base(depth_m):
    base_m = np.column_stack([np.linspace(0.1e-3, 15e-3, 100), np.zeros(100), np.zeros(100)])
    after_m = move(base_m, (0, 0, depth_m), "slipping").after[0]
    assert not after_m[:, 2].any()
    assert (after_m[:, 0] > base_m[:, 0]).all()


@pytest.mark.parametrize(
    ("thickness_m", "depth_m"), [(0.0, 1e-3), (np.nan, 1e-3), (H_M, H_M), (H_M, 1.95e-3), (H_M, np.nan), (H_M, -1e-3)]
)
def test_invalid_layers_and_pokes_are_refused(thickness_m, depth_m):
    with pytest.raises(ParamsError, match="must be"):
        deformation.tabulate(thickness_m, TIP_M, depth_m, heights=(0.5,), base="bonded")


def test_cached_table_equals_computed_table(tmp_path, monkeypatch):
    def of_depth(depth_m):
        for cached in (deformation._tabulate, deformation._displaced):
            cached.cache_clear()
        return deformation.tabulate(H_M, TIP_M, depth_m, heights=(0.5,), base="bonded").moved

    monkeypatch.setattr(deformation, "PACKAGE", tmp_path)
    shallow = of_depth(0.2e-3)
    kept_n = len(list(tmp_path.rglob("*.npy")))
    deep = of_depth(0.5e-3)
    np.testing.assert_array_equal(deep[: len(shallow)], shallow)
    np.testing.assert_array_equal(of_depth(0.2e-3), shallow)
    np.testing.assert_array_equal(of_depth(0.5e-3), deep)
    assert len(list(tmp_path.rglob("*.npy"))) == kept_n == deformation.STENCIL_N
