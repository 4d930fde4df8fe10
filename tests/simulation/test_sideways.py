"""Tests of dragged tips.

Tangential forces are compared with Coulomb's law and a spring. Other tests drag without friction, or along mirrored
lines.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reskin.physics import shear
from reskin.physics.board import draw_board
from reskin.physics.magnet import change_of_field
from reskin.physics.shear import Friction
from reskin.physics.skin import changes_of_field, draw_skin, forces, moved_dipoles
from reskin.physics.slide import HoldDesign
from reskin.simulation.contact import drag_tip
from tests.simulation.scene import SECTIONS, synthesis

LENGTH = "skin_filler_length_mm"
EVEN = synthesis("spreads", **{name: 0.0 for name in SECTIONS["spreads"] if name != LENGTH})
BOARD = draw_board(EVEN.boards["rigid"].design, EVEN.spreads, seed=0, name="b0")
SKIN = draw_skin(EVEN.skin, EVEN.spreads, seed=0, name="b0_s0")
DEPTH_M = 0.6e-3
STRAIGHT = np.zeros((1, 2))


def line(*x_mm, y_mm=1.0):
    """Return the positions of the tip (x, y, depth) along one dragged line."""
    return np.array([[[1e-3 * x, 1e-3 * y_mm, DEPTH_M] for x in x_mm]])


def drag(tip_m, coefficient=0.8, tilt=STRAIGHT):
    return drag_tip(BOARD, SKIN, tip_m, tilt=tilt, friction=Friction(coefficient=coefficient))


def press_T(tip_m):
    return changes_of_field(BOARD, SKIN, tip_m.reshape(-1, 3))[1].reshape(*tip_m.shape[:2], 5, 3)


def test_tip_sticks_in_a_short_drag_and_slides_in_a_long_one():
    found = drag(line(0.0, 0.1, 4.0)).force_N[0]
    sizes = {"thickness_m": SKIN.thickness_m, "tip_radius_m": SKIN.tip_radius_m, "base": SKIN.base}
    stiffness = SKIN.modulus_Pa / 3 * shear.tabulate_depth(DEPTH_M, **sizes).stiffness_m
    limit_N = 0.8 * forces(SKIN, np.array([DEPTH_M]))[0]
    np.testing.assert_allclose(found, [[0, 0], [stiffness * 0.1e-3, 0], [limit_N, 0]], rtol=1e-6)
    assert found[1, 0] < limit_N  # At the first stop, the tip does not slide yet.


def test_drag_without_friction_equals_a_press():
    tip_m = line(-2.0, 0.0, 3.0)
    found = drag(tip_m, coefficient=0.0)
    assert not found.force_N.any()
    np.testing.assert_array_equal(found.change_T, press_T(tip_m))


def test_mirrored_drag_has_the_mirrored_field():
    # The reflection x -> -x swaps chips 1 and 3, and leaves the checkerboard unchanged as a field of axial vectors. By
    # and Bz therefore change sign.
    one = drag(line(-1.0, 2.0))
    mirrored = drag(line(1.0, -2.0)).change_T[0][:, [0, 3, 2, 1, 4]]
    np.testing.assert_allclose(mirrored, one.change_T[0] * (1, -1, -1), atol=1e-9 * np.abs(one.change_T).max())


def test_force_of_a_leaning_tip_is_limited_by_friction():
    normal_N = forces(SKIN, np.array([DEPTH_M]))[0]
    for lean, share in ((0.1, 0.1), (2.0, 0.8)):
        found = drag(line(1.0), tilt=np.array([[0.0, lean]])).force_N[0, 0]
        np.testing.assert_allclose(found, [0.0, share * normal_N], rtol=1e-12)


@pytest.mark.parametrize("coefficient", [0.3, 0.8])
def test_tangential_force_is_limited_by_friction(coefficient):
    tip_m = line(-5.0, -4.9, -4.5, 0.0, 0.05, -3.0)
    found = np.hypot(*drag(tip_m, coefficient).force_N[0].T)
    assert (found <= coefficient * forces(SKIN, tip_m[0, :, 2]) * (1 + 1e-12)).all()


def test_drag_equals_a_press_followed_by_many_small_shears():
    # Reference: press the material at its rest position behind the tip, then shear it in 50 steps of the force.
    tip_m, modulus_Pa = line(-2.0, 1.0), SKIN.modulus_Pa
    found = drag(tip_m, coefficient=0.4)
    sizes = {"thickness_m": SKIN.thickness_m, "tip_radius_m": SKIN.tip_radius_m, "base": SKIN.base}
    table = shear.tabulate_depth(DEPTH_M, **sizes)
    force_N = found.force_N[0, 1]
    behind_m = tip_m[0, 1, :2] - force_N / (modulus_Pa / 3 * table.stiffness_m)
    [(_, before, (nodes_m, moments))] = moved_dipoles(SKIN, np.array([[*behind_m, DEPTH_M]]))
    for _ in range(50):
        step = shear.shear_displacement(
            table, nodes_m.clip(min=0.0), behind_m, force_N=force_N / 50, modulus_Pa=modulus_Pa
        )
        nodes_m, moments = nodes_m + step.displacement_m, Rotation.from_rotvec(step.half_curl).apply(moments)
    truth_T = change_of_field(before, (nodes_m, moments), BOARD.chips_m)
    # The tolerance is 20 %, because the code takes one or two midpoint steps and moves the traction. A wrong sign would
    # give 50 % or more.
    assert np.linalg.norm(found.change_T[0, 1] - truth_T) < 0.2 * np.linalg.norm(truth_T)


HOLD = HoldDesign(give_um=(0.0, 0.0), away_um_mm=0.0, lets_go_N=8.0, springs_N_mm=7.0, friction=0.8)
HELD = EVEN.skin.model_copy(update={"hold": HOLD, "stiffening": 1.5})


def test_springs_that_hold_the_skin_act_in_series_with_its_shear_stiffness():
    one = draw_skin(HELD, EVEN.spreads, seed=0, name="b0_s0")
    # The line passes through the middle, so the skin does not rotate.
    tip_m, so_far_m = line(0.0, 0.1, y_mm=0.0), 0.1e-3
    force_N = drag_tip(BOARD, one, tip_m, tilt=STRAIGHT, friction=Friction(coefficient=0.8)).force_N[0, 1]
    sizes = {"thickness_m": one.thickness_m, "tip_radius_m": one.tip_radius_m, "base": one.base}
    thinned = (1 - DEPTH_M / one.thickness_m) ** -1.5
    layer_N_per_m = thinned * one.modulus_Pa / 3 * shear.tabulate_depth(DEPTH_M, **sizes).stiffness_m
    np.testing.assert_allclose(force_N, [so_far_m / (1 / layer_N_per_m + 1 / 7e3), 0.0], rtol=1e-9, atol=1e-12)
    # Far from the tip, where the layer is not sheared, nodes move by force / stiffness of the springs.
    slid = one.nodes_m + (force_N[0] / 7e3, 0.0, 0.0)
    as_one_T = change_of_field((one.nodes_m, one.moments_A_m2), (slid, one.moments_A_m2), BOARD.chips_m)
    pressed_T = changes_of_field(BOARD, one, tip_m[0, 1:])[1][0]
    dragged_T = drag_tip(BOARD, one, tip_m, tilt=STRAIGHT, friction=Friction(coefficient=0.8)).change_T[0, 1]
    far = [2, 4]  # These chips are beside the line.
    np.testing.assert_allclose((dragged_T - pressed_T)[far], as_one_T[far], atol=0.5 * np.abs(as_one_T[far]).max())


def test_skin_held_by_stiff_springs_equals_a_skin_on_a_fixed_base():
    tip_m, hold = line(0.0, 0.02), HELD.hold.model_copy(update={"springs_N_mm": 1e6})
    stiff = draw_skin(HELD.model_copy(update={"hold": hold}), EVEN.spreads, seed=0, name="b0_s0")
    free = replace(stiff, hold=None)
    ours, theirs = (
        drag_tip(BOARD, one, tip_m, tilt=STRAIGHT, friction=Friction(coefficient=10.0)) for one in (stiff, free)
    )
    np.testing.assert_allclose(ours.force_N, theirs.force_N, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(ours.change_T, theirs.change_T, atol=1e-3 * np.abs(theirs.change_T).max())
