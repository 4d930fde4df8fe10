"""Tests of the tabulated deformation against the motion of each node, computed in steps.

Further tests: pokes without contact, the base of the skin, places beyond the table, and thin skins.
"""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import ParamsError
from reskin.physics import deformation, layer

H_M, TIP_M = 2e-3, 3e-3
HEIGHTS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)
BASES = ("bonded", "slipping")
depths_m = st.floats(1e-5, 1.2e-3)
bases = st.sampled_from(BASES)


@cache  # The table is not computed at import, because every test worker imports this module.
def table(base="bonded"):
    return deformation.tabulate(H_M, TIP_M, 1.2e-3, heights=HEIGHTS, base=base)


def follow(r_m, z_m, to_m, base):
    press = layer.IndentedLayer(H_M, TIP_M, base)
    return deformation.follow(r_m, z_m, deformation.depth_steps((to_m,), press), press=press)[-1]


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


@given(st.floats(-8e-3, 8e-3), st.floats(-8e-3, 8e-3), depths_m, bases)
def test_nodes_move_in_planes_through_the_axis(x_m, y_m, depth_m, base):
    moved = move(places(np.random.default_rng(1), 60), (x_m, y_m, depth_m), base)
    away_m = moved.before[0][:, :2] - (x_m, y_m)
    for part in ((moved.after[0] - moved.before[0]), 1e-3 * moved.after[1]):
        np.testing.assert_allclose(away_m[:, 0] * part[:, 1] - away_m[:, 1] * part[:, 0], 0, atol=1e-17)
    np.testing.assert_allclose(np.linalg.norm(moved.after[1], axis=1), 1)


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("depth_m", [0.0, -0.3e-3])
def test_poke_without_contact_moves_no_node(depth_m, base):
    assert move(places(np.random.default_rng(2), 100), (1e-3, 1e-3, depth_m), base).i.size == 0


@given(depths_m)
def test_bonded_base_does_not_move(depth_m):
    base_m = np.column_stack([np.linspace(0, 10e-3, 200), np.zeros(200), np.zeros(200)])
    np.testing.assert_array_equal(move(base_m, (0, 0, depth_m)).after[0], base_m)


@settings(max_examples=25)
@given(depths_m, depths_m, bases)
def test_deeper_pokes_move_material_farther_down(first_m, second_m, base):
    shallow_m, deep_m = sorted((first_m, second_m))
    column_m = np.column_stack([np.zeros((7, 2)), H_M * np.array(HEIGHTS[1:])])
    shallow, deep = (move(column_m, (0, 0, depth), base).after[0][:, 2] for depth in (shallow_m, deep_m))
    assert (deep <= shallow + 1e-12).all()
    assert (np.diff(deep) > 0).all()  # Layers stay in order of their height.


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


def test_table_of_a_thin_skin_is_accurate_up_to_its_greatest_depth():
    thin = deformation.tabulate(0.2e-3, TIP_M, 0.058e-3, heights=(0.5, 1.0), base="bonded")
    assert deformation.at_depth(thin, 0.058e-3)[-1, 0, 1] * 0.2e-3 == pytest.approx(-0.058e-3, rel=0.02)
    with pytest.raises(ParamsError, match="depth must be so small that"):
        deformation.tabulate(0.2e-3, TIP_M, 0.12e-3, heights=(0.5, 1.0), base="bonded")


@pytest.mark.parametrize(
    ("thickness_m", "depth_m"), [(0.0, 1e-3), (np.nan, 1e-3), (H_M, H_M), (H_M, 1.95e-3), (H_M, np.nan), (H_M, -1e-3)]
)
def test_invalid_layers_and_pokes_are_refused(thickness_m, depth_m):
    with pytest.raises(ParamsError, match="must be"):
        deformation.tabulate(thickness_m, TIP_M, depth_m, heights=(0.5,), base="bonded")


@pytest.mark.parametrize("depth_m", [1.3e-3, np.nan, np.inf, -np.inf])
def test_moving_nodes_raises_if_the_depth_is_invalid(depth_m):
    with pytest.raises(ParamsError, match="depth must be"):
        move(np.zeros((1, 3)), (0, 0, depth_m))


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
