"""The flow of material under a poke: sphere, volume, gradient, small depth as truth; no poke, base, reach as laws."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline.errors import ParamsError
from pipeline.physics import flow, layer

H_M, TIP_M = 2e-3, 3e-3
LAYER = {"thickness_m": H_M, "tip_radius_m": TIP_M}
DEPTHS_M = (0.2e-3, 0.4e-3, 0.6e-3, 0.8e-3, 1.0e-3, 1.2e-3)
MAP = flow.tabulate(H_M, TIP_M, DEPTHS_M)
depths_m = st.floats(1e-5, 1.2e-3)


def nodes(r_n=25, z_n=11, r_max_m=5e-3):
    r_m, z_m = np.meshgrid(np.linspace(0.07e-3, r_max_m, r_n), np.linspace(0.03, 0.97, z_n) * H_M, indexing="ij")
    return r_m.ravel(), z_m.ravel()


def follow(r_m, z_m, to_m=1.2e-3):
    return flow.follow(r_m, z_m, flow.steps((to_m,), H_M), **LAYER)[-1]


def det_f(at):
    return np.linalg.det(at.f) * at.hoop


def move(places_m, poke_m, of=MAP):
    return flow.move(of, np.asarray(places_m, dtype=float), np.asarray(poke_m, dtype=float))


@pytest.mark.parametrize("depth_m", [0.2e-3, 0.6e-3, 1.2e-3])
def test_the_sunken_surface_lies_on_the_sphere(depth_m):
    radius_m = layer.contact_of_depth(depth_m, **LAYER).radius_m
    surface_m = np.linspace(0, 1.4 * radius_m, 40)
    at = follow(surface_m, np.full(40, H_M), depth_m)
    above_m = at.z_m - (H_M - depth_m + TIP_M - np.sqrt(TIP_M**2 - np.minimum(at.r_m, TIP_M) ** 2))
    # 2 % of the depth: six pressures and twelve steps. Without following the surface it is 27 % at 1.2 mm.
    np.testing.assert_allclose(above_m[at.r_m < 0.95 * radius_m], 0, atol=0.02 * depth_m)
    assert above_m.max() < 0.02 * depth_m  # nor does anything outside the contact pierce the tip


def test_volume_is_kept_where_one_linear_step_loses_most_of_it():
    r_m, z_m = nodes()
    linear = layer.displacement(r_m, z_m, layer.waves(layer.contact_of_depth(1.2e-3, **LAYER), H_M))
    one_shot = ((1 + linear.r_r) * (1 + linear.z_z) - linear.r_z * linear.z_r) * (1 + linear.hoop)
    followed = det_f(follow(r_m, z_m))
    assert one_shot.min() < 0.5  # PHYSICS 0: 0.42 on the axis
    np.testing.assert_allclose(followed, 1, atol=0.02)  # second order in steps of 0.1 mm, worst at the contact's edge
    assert np.mean(np.abs(followed - 1) < 0.01) > 0.97
    np.testing.assert_allclose(MAP.det_f, 1, atol=0.02)


def test_halving_the_steps_quarters_the_loss_of_volume_and_converges(monkeypatch):
    r_m, z_m = nodes(12, 6)
    found = []
    for step in (0.1, 0.05, 0.025):
        monkeypatch.setattr(flow, "STEP", step)
        found.append(follow(r_m, z_m))
    loss = [np.abs(det_f(at) - 1).max() for at in found]
    assert loss[1] < loss[0] / 2.5
    assert loss[2] < loss[1] / 2.5
    apart_m = [np.hypot(b.r_m - a.r_m, b.z_m - a.z_m).max() for a, b in pairwise(found)]
    assert apart_m[1] < apart_m[0] / 2
    assert apart_m[1] < 0.03 * 1.2e-3  # the default step is this far from half of it


def test_a_shallow_poke_is_the_linear_one():
    r_m, z_m = nodes(r_max_m=1e-3)
    at, depth_m = follow(r_m, z_m, 30e-6), 30e-6
    linear = layer.displacement(r_m, z_m, layer.waves(layer.contact_of_depth(depth_m, **LAYER), H_M))
    # 5 % of the depth: the material's own displacement, and a contact (0.3 mm) not wider than the shortest wave
    np.testing.assert_allclose(at.r_m - r_m, linear.r_m, atol=0.05 * depth_m)
    np.testing.assert_allclose(at.z_m - z_m, linear.z_m, atol=0.05 * depth_m)


def test_the_rotation_is_that_of_the_gradient_of_the_map():
    r_m, z_m = nodes(14, 7)
    step_m = 1e-7
    moved = [follow(r_m + dr, z_m + dz) for dr, dz in ((step_m, 0), (-step_m, 0), (0, step_m), (0, -step_m))]
    columns = [
        np.stack([plus.r_m - minus.r_m, plus.z_m - minus.z_m], axis=-1) / (2 * step_m)
        for plus, minus in (moved[:2], moved[2:])
    ]
    at = follow(r_m, z_m)
    np.testing.assert_allclose(at.f, np.stack(columns, axis=-1), atol=1e-5)  # step squared over length squared
    u, _, vt = np.linalg.svd(at.f)  # polar decomposition F = R U, R = u vt
    turn = u @ vt
    np.testing.assert_allclose(np.linalg.det(turn), 1)
    np.testing.assert_allclose(turn[:, 0, 1], np.sin(flow.angle(at.f)), atol=1e-12)


def test_the_table_gives_what_following_each_node_gives():
    rng = np.random.default_rng(0)
    r_m, z_m = rng.uniform(0, 6e-3, 200), rng.uniform(0, 0.97 * H_M, 200)
    path = flow.follow(r_m, z_m, MAP.depth_m, **LAYER)
    for depth_m in (0.2e-3, 1.2e-3):
        at = path[int(np.argmin(np.abs(MAP.depth_m - depth_m)))]
        moved = move(np.column_stack([r_m, np.zeros(200), z_m]), (0, 0, depth_m))
        # 1e-3 of the depth, 3 mrad: spline over 56 x 16 places, then linear over 512 x 80
        np.testing.assert_allclose(moved.nodes_m[:, 0], at.r_m, atol=1e-3 * depth_m)
        np.testing.assert_allclose(moved.nodes_m[:, 2], at.z_m, atol=1e-3 * depth_m)
        np.testing.assert_allclose(moved.angle_rad, flow.angle(at.f), atol=3e-3)


@pytest.mark.parametrize("depth_m", [0.06e-3, 0.14e-3, 0.25e-3, 0.55e-3, 1.15e-3])
def test_between_its_depths_the_table_is_near_the_flow(depth_m):
    r_m, z_m = nodes()
    at = follow(r_m, z_m, depth_m)
    moved = move(np.column_stack([r_m, np.zeros_like(r_m), z_m]), (0, 0, depth_m))
    # 5 % of the depth, worst near the surface at the contact's edge, which jumps outwards between two depths
    np.testing.assert_allclose(moved.nodes_m[:, 2], at.z_m, atol=0.05 * depth_m)


def test_a_thousand_depths_share_the_steps_of_one_map():
    asked_m = np.random.default_rng(5).uniform(0, 1.2e-3, 1000)
    steps_m = flow.steps(tuple(asked_m.tolist()), H_M)
    assert len(steps_m) < 30
    assert steps_m[0] == 0
    assert steps_m[-1] == asked_m.max()
    assert 0 < np.diff(steps_m).min()
    assert np.diff(steps_m).max() < 0.051e-3


@given(st.floats(-8e-3, 8e-3), st.floats(-8e-3, 8e-3), depths_m)
def test_each_node_moves_in_its_plane_through_the_axis_and_turns_about_the_normal_of_it(x_m, y_m, depth_m):
    rng = np.random.default_rng(1)
    places_m = np.column_stack([rng.uniform(-10e-3, 10e-3, (60, 2)), rng.uniform(0, H_M, 60)])
    moved = move(places_m, (x_m, y_m, depth_m))
    away_m = places_m[moved.i, :2] - (x_m, y_m)
    shift_m = (moved.nodes_m - places_m[moved.i])[:, :2]
    np.testing.assert_allclose(away_m[:, 0] * shift_m[:, 1] - away_m[:, 1] * shift_m[:, 0], 0, atol=1e-18)
    np.testing.assert_allclose(np.linalg.norm(moved.axis, axis=1), 1)
    np.testing.assert_array_equal(moved.axis[:, 2], 0)
    up = Rotation.from_rotvec(moved.axis * moved.angle_rad[:, None]).apply(np.tile([0.0, 0.0, 1.0], (len(moved.i), 1)))
    outward = (up[:, :2] * away_m).sum(axis=1) / np.linalg.norm(away_m, axis=1)
    np.testing.assert_allclose(outward, np.sin(moved.angle_rad), atol=1e-12)  # from z towards r


@pytest.mark.parametrize("depth_m", [0.0, -0.3e-3])
def test_without_contact_no_node_moves(depth_m):
    moved = move(np.random.default_rng(2).uniform(0, H_M, (100, 3)), (1e-3, 1e-3, depth_m))
    assert len(moved.i) == len(moved.nodes_m) == len(moved.angle_rad) == len(moved.axis) == 0


@given(depths_m)
def test_the_base_stays_where_it_is_to_the_last_bit(depth_m):
    r_m = np.linspace(0, 10e-3, 200)
    base_m = np.column_stack([r_m, np.zeros(200), np.zeros(200)])
    np.testing.assert_array_equal(move(base_m, (0, 0, depth_m)).nodes_m, base_m)


@settings(max_examples=25)
@given(depths_m, depths_m)
def test_deeper_pokes_press_the_material_under_the_tip_deeper(first_m, second_m):
    shallow_m, deep_m = sorted((first_m, second_m))
    column_m = np.column_stack([np.zeros((20, 2)), np.linspace(0.1, 1, 20) * H_M])
    shallow, deep = (move(column_m, (0, 0, depth)).nodes_m[:, 2] for depth in (shallow_m, deep_m))
    assert (deep <= shallow + 1e-12).all()
    assert (np.diff(deep) > 0).all()  # what lay above stays above


def test_under_the_very_tip_nothing_turns_or_moves_sideways():
    moved = move([[1e-3, 2e-3, 1.5e-3]], (1e-3, 2e-3, 1e-3))
    assert np.isfinite(moved.axis).all()
    np.testing.assert_allclose(moved.nodes_m[0, :2], (1e-3, 2e-3), atol=1e-15)
    assert moved.angle_rad[0] == pytest.approx(0, abs=1e-12)


def test_what_lies_past_the_reach_does_not_move_and_would_hardly():
    reach_m = MAP.r0_m[-1]
    assert reach_m == pytest.approx(layer.contact_of_depth(1.2e-3, **LAYER).radius_m + 5 * H_M)
    assert move([[1.001 * reach_m, 0, 1e-3]], (0, 0, 1.2e-3)).i.size == 0
    assert np.abs(MAP.moved[-1, :2, -1]).max() < 0.015 * 1.2e-3


def test_nodes_may_come_in_any_order():
    places_m = np.random.default_rng(3).uniform(0, H_M, (50, 3)) * (8, 8, 1)
    order = np.random.default_rng(4).permutation(50)
    one, other = move(places_m, (0, 0, 1e-3)), move(places_m[order], (0, 0, 1e-3))
    there = np.full((2, 50, 3), np.nan)
    there[0, one.i], there[1, order[other.i]] = one.nodes_m, other.nodes_m
    np.testing.assert_array_equal(there[0], there[1])


def test_a_map_is_made_once_for_each_skin_and_tip():
    assert flow.tabulate(H_M, TIP_M, DEPTHS_M) is MAP


def test_a_thin_skin_flows_too():
    thin = flow.tabulate(0.2e-3, TIP_M, (0.06e-3,))
    assert thin.moved[-1, 1, 0, -1] == pytest.approx(-0.06e-3, rel=0.02)
    assert np.isfinite(thin.moved).all()
    with pytest.raises(ParamsError, match="rim"):
        flow.tabulate(0.2e-3, TIP_M, (0.1e-3,))


@pytest.mark.parametrize(
    ("thickness_m", "depth_m"), [(0.0, 1e-3), (np.nan, 1e-3), (H_M, H_M), (H_M, 1.95e-3), (H_M, np.nan), (H_M, -1e-3)]
)
def test_impossible_layers_and_pokes_are_refused(thickness_m, depth_m):
    with pytest.raises(ParamsError, match="must be"):
        flow.tabulate(thickness_m, TIP_M, (depth_m,))


@pytest.mark.parametrize("depth_m", [1.21e-3, np.nan, np.inf, -np.inf])
def test_pokes_deeper_than_the_table_or_of_no_depth_at_all_are_refused(depth_m):
    with pytest.raises(ParamsError, match="depth must be"):
        move(np.zeros((1, 3)), (0, 0, depth_m))
