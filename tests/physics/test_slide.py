"""Tests of the rigid sliding of a finite skin on its base, which a press away from the middle causes.

References are the motion of least drag, found numerically, and closed forms for a square.
"""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from reskin.errors import ParamsError
from reskin.physics import deformation, layer, slide
from reskin.physics.magnet import change_of_field

SIDE_M, H_M = 20e-3, 2e-3
SQUARE = (SIDE_M, SIDE_M)
places_m = st.tuples(st.floats(-9e-3, 9e-3), st.floats(-9e-3, 9e-3))
displacements_m = st.tuples(st.floats(-1e-4, 1e-4), st.floats(-1e-4, 1e-4))
NO_SLIDE = {"give_m": (0.0, 0.0), "away": 0.0}
HELD = {"give_um": (48.0, 7.0), "away_um_mm": 6.0, "lets_go_N": 8.0, "springs_N_mm": 7.0, "friction": 0.8}


def motion_of(place_m, taken_m, sides_m=SQUARE) -> tuple[np.ndarray, float]:
    found = slide.rigid_motion(np.array([place_m]), np.array([taken_m]), sides_m)
    return found.move_m[0], float(found.spin_rad[0])


def drag_matrix(pieces_n, sides_m):
    """Return the matrix of the drag of a rigid motion (f_x, f_y, theta), which is quadratic in the motion.

    The drag is summed over small pieces of the skin.
    """
    drag = np.zeros((3, 3))
    for i in range(pieces_n):
        for j in range(pieces_n):
            x, y = ((k + 0.5) / pieces_n * side - side / 2 for k, side in zip((i, j), sides_m, strict=True))
            velocity = np.array([[1, 0, -y], [0, 1, x]])
            drag += velocity.T @ velocity / pieces_n**2
    return drag


@pytest.mark.parametrize("sides_m", [SQUARE, (20e-3, 50e-3)])
def test_rigid_motion_minimises_the_drag(sides_m):
    place_m, taken_m = np.array([6e-3, -3e-3]), np.array([4e-5, 7e-5])
    # Reference: the motion of least drag among those with the given displacement at the place, by Lagrange multipliers.
    # With 80 pieces per side, the squared radius of gyration rho^2 has a relative error of 1/80^2.
    held = np.array([[1, 0, -place_m[1]], [0, 1, place_m[0]]])
    equations = np.block([[drag_matrix(80, sides_m), held.T], [held, np.zeros((2, 2))]])
    *expected, spin_rad = np.linalg.solve(equations, np.append(np.zeros(3), taken_m))[:3]
    move_m, found_rad = motion_of(place_m, taken_m, sides_m)
    np.testing.assert_allclose(move_m, expected, rtol=1e-3)
    np.testing.assert_allclose(found_rad, spin_rad, rtol=1e-3)


def test_motion_of_a_square_pulled_at_its_edge_equals_the_closed_form():
    # A square of side L is displaced by D along y at the place (L/2, 0). Expected: displacement of its middle
    # f = D / (1 + (L/2)^2 / (L^2/6)) = D / 2.5, and rotation theta = 6 f (L/2) / L^2 = 3 f / L.
    move_m, spin_rad = motion_of((SIDE_M / 2, 0.0), (0.0, 1e-4))
    np.testing.assert_allclose(move_m, (0.0, 1e-4 / 2.5), rtol=1e-12)
    assert spin_rad == pytest.approx(3 * 1e-4 / 2.5 / SIDE_M, rel=1e-12)


def test_displacement_of_the_skin_follows_force_and_distance_from_the_middle():
    places_m = np.array([[4e-3, 0.0]] * 3)
    found_m = slide.press_displacement_m(places_m, np.array([0.0, 0.5, 1.0]), give_m=(5e-5, 1e-5), away=7e-3)
    # The slide per distance is 7 um/mm. At 4 mm from the middle, this is 28 um at zero force, and 14 um at half the
    # force at which the slide vanishes.
    np.testing.assert_allclose(found_m, [[2.2e-5, 1e-5], [3.6e-5, 1e-5], [5e-5, 1e-5]], atol=1e-18)


@given(places_m, st.floats(1e3, 1e5))
def test_motion_on_uniform_springs_equals_force_over_stiffness(place_m, springs_N_per_m):
    # On uniform springs of stiffness k, a force f moves the skin by f / k and rotates the skin by moment / (k rho^2),
    # where rho is the radius of gyration.
    force_N, (x, y) = np.array([0.7, -0.4]), place_m
    taken_m = slide.compliance_m_per_N(np.array([place_m]), SQUARE, springs_N_per_m)[0] @ force_N
    move_m, spin_rad = motion_of(place_m, taken_m)
    np.testing.assert_allclose(move_m, force_N / springs_N_per_m, atol=1e-15)
    moment_m = (x * force_N[1] - y * force_N[0]) / springs_N_per_m
    np.testing.assert_allclose(spin_rad, moment_m / (2 * SIDE_M**2 / 12), rtol=1e-9, atol=1e-15)


@given(places_m, displacements_m, st.floats(1e-6, 20.0))
@example((0.0, 0.0), (0.0, 2.2e-313), 1.0)  # This displacement is so small that dividing a force by it overflows.
def test_friction_limits_the_slide(place_m, taken_m, force_N):
    hold = slide.HoldDesign(**HELD).in_si()
    whole = slide.rigid_motion(np.array([place_m]), np.array([taken_m]), SQUARE)
    found = slide.limit_by_friction(whole, np.array([force_N]), hold.grip_N_per_m)
    sideways_N = hold.springs_N_per_m * np.hypot(*found.move_m[0])
    assert sideways_N <= min(0.8 * force_N, hold.springs_N_per_m * np.hypot(*whole.move_m[0])) * (1 + 1e-12)
    moves, (x, y), (whole_x, whole_y) = whole.move_m.any(), found.move_m[0], whole.move_m[0]
    assert x * whole_y == pytest.approx(y * whole_x, rel=1e-12, abs=1e-24)
    if moves:  # Friction multiplies displacement and rotation by the same factor, 1 - exp(-mu F / k u).
        with np.errstate(over="ignore"):
            share = 1 - np.exp(-0.8 * force_N / (7e3 * np.hypot(whole_x, whole_y)))
        np.testing.assert_allclose(found.move_m, share * whole.move_m, rtol=1e-9, atol=1e-20)
        np.testing.assert_allclose(found.spin_rad, share * whole.spin_rad, rtol=1e-9, atol=1e-20)


def test_press_without_slide_leaves_the_deformation_on_a_slipping_base_unchanged():
    rng = np.random.default_rng(0)
    heights = (0.2, 0.8)
    nodes_m = np.column_stack([rng.uniform(-8e-3, 8e-3, (60, 2)), H_M * rng.choice(heights, 60)])
    rest = deformation.group_by_height(nodes_m, rng.normal(0, 1e-6, (60, 3)), H_M)
    table = deformation.tabulate(H_M, 2e-3, 0.8e-3, heights=rest.heights, base="slipping")
    moved = deformation.move_dipoles(table, rest, np.array([3e-3, -2e-3, 0.8e-3]))
    place_m = np.array([[3e-3, -2e-3]])
    without_slide = slide.rigid_motion(
        place_m, slide.press_displacement_m(place_m, np.array([0.2]), **NO_SLIDE), SQUARE
    )
    after = slide.apply(without_slide, 0, moved.after)
    for found, expected in zip(after, moved.after, strict=True):
        assert np.array_equal(found, expected)
    chips_m = np.array([[0.0, 0.0, -1e-3]])
    assert np.array_equal(
        change_of_field(moved.before, after, chips_m), change_of_field(moved.before, moved.after, chips_m)
    )


def test_dipoles_rotate_about_the_middle_of_the_skin():
    rng = np.random.default_rng(1)
    nodes_m, moments = rng.normal(0, 5e-3, (7, 3)), rng.normal(0, 1e-6, (7, 3))
    motion = slide.RigidMotion(np.array([[0.0, 0.0], [3e-5, -2e-5]]), np.array([0.0, 0.2]))
    moved_m, rotated = slide.apply(motion, 1, (nodes_m, moments))
    turn = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    for i in range(7):
        np.testing.assert_allclose(moved_m[i], turn @ nodes_m[i] + (3e-5, -2e-5, 0), rtol=1e-13, atol=1e-18)
        np.testing.assert_allclose(rotated[i], turn @ moments[i], rtol=1e-13, atol=1e-20)
    middle_m = np.array([2e-3, -1e-3])
    about_m, _ = slide.apply(motion, 1, (nodes_m, moments), middle_m)
    shift_m = np.append(middle_m, 0.0)
    np.testing.assert_allclose(about_m, slide.apply(motion, 1, (nodes_m - shift_m, moments))[0] + shift_m, atol=1e-17)


TIP = {"thickness_m": H_M, "tip_radius_m": 2e-3, "stiffening": 1.5}


@given(st.floats(0, 0.71 * H_M), st.floats(1e5, 1e7))
def test_depth_at_a_force_inverts_the_force_at_a_depth(depth_m, modulus_Pa):
    layer_settings = TIP | {"modulus_Pa": modulus_Pa}
    found_m = slide.depth_at(slide.force_at(np.array([depth_m]), **layer_settings), **layer_settings)
    assert abs(found_m[0] - depth_m) < 1e-6 * H_M


def test_force_has_the_limits_of_small_and_great_depth():
    layer_settings = TIP | {"modulus_Pa": 2e5}
    # For small depths, the force is that of Hertz for an incompressible material: 4/3 E / (1 - 1/4) sqrt(R) d^(3/2).
    np.testing.assert_allclose(
        slide.force_at(np.array([0.0, 1e-9]), **layer_settings),
        [0, 16 / 9 * 2e5 * np.sqrt(2e-3) * 1e-9**1.5],
        rtol=2e-3,
    )
    at_m = np.array([0.75 * H_M])
    assert slide.force_at(at_m, **layer_settings)[0] == pytest.approx(
        8 * slide.force_at(at_m, **(layer_settings | {"stiffening": 0.0}))[0]
    )
    assert slide.depth_at(np.array([1e6]), **layer_settings)[0] == pytest.approx(slide.DEEPEST * H_M)
    assert slide.count_clipped(np.array([1.0, 1e6]), **layer_settings) == 1
    # At a negative depth, the tip is above the skin.
    assert slide.force_at(np.array([-1e-6]), **layer_settings)[0] == 0
    for wrong_m in (H_M, np.nan):
        with pytest.raises(ParamsError, match="poke: depth must be finite and below"):
            slide.force_at(np.array([wrong_m]), **layer_settings)
    with pytest.raises(ParamsError, match="modulus must be above"):
        slide.depth_at(np.array([1.0]), **(layer_settings | {"modulus_Pa": 0.0}))


def test_force_without_stiffening_is_that_of_the_bonded_layer():
    at_m, of_layer = np.linspace(0.0, 1.2e-3, 7), {"thickness_m": H_M, "tip_radius_m": 3e-3, "modulus_Pa": 1.9e5}
    bonded_N = layer.force(at_m, **of_layer, base="bonded")
    np.testing.assert_array_equal(slide.force_at(at_m, **of_layer, stiffening=0.0), bonded_N)
    # Dimitriadis et al. (2002), bonded layer, which is within 10 % of the exact sphere at these depths.
    chi = np.sqrt(3e-3 * at_m) / H_M
    series = 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    np.testing.assert_allclose(bonded_N, 16 / 9 * 1.9e5 * np.sqrt(3e-3) * at_m**1.5 * series, rtol=0.1)
