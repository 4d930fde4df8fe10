"""A tip that also pushes sideways: dragged by a robot, or leaning in a hand. In: board, skin, tips. Out: force, field.

Sideways the skin's base is taken as held, whatever it does for the pressing: an assumption, without which a skin that
slides would come along with the tip. Refuses to know protocols and what else acts on the force.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from pipeline.physics import friction, shear
from pipeline.physics.board import Board
from pipeline.physics.change import change_of_field
from pipeline.physics.friction import Friction
from pipeline.physics.skin import Dipoles, Skin, forces, moved_dipoles

DEPTH_STEP_M = 10e-6  # depths whose shear is taken as one: stiffness differs by 1 %


@dataclass(frozen=True)
class Sideways:
    """At every stop: the force on the skin in its plane, and the change of field that press and push make together."""

    force_N: Float[np.ndarray, "n p 2"]
    change_T: Float[np.ndarray, "n p k 3"]


def push(
    board: Board, skin: Skin, tip_m: Float[np.ndarray, "n p 3"], *, tilt: Float[np.ndarray, "n 2"], how: Friction
) -> Sideways:
    """Take the tip through the stops of every indentation, from its first on in contact; Coulomb limits the force."""
    n, stops_n, _ = tip_m.shape
    force_N = np.zeros((n, stops_n, 2))
    change_T = np.zeros((n, stops_n, *board.chips_m.shape))
    for i in range(n):
        force_N[i], change_T[i] = _push_once(board, skin, tip_m[i], tilt[i], how)
    return Sideways(force_N, change_T)


def _push_once(
    board: Board, skin: Skin, tip_m: Float[np.ndarray, "p 3"], tilt: Float[np.ndarray, "2"], how: Friction
) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, "p k 3"]]:
    normal_N = forces(skin, tip_m[:, 2])
    maps = [_map(skin, depth_m) if force > 0 else None for depth_m, force in zip(tip_m[:, 2], normal_N, strict=True)]
    shear_Pa = skin.modulus_Pa / 3  # incompressible
    stiffness = np.array([0.0 if one is None else shear_Pa * one.stiffness_m for one in maps])
    dragged = friction.drag(tip_m[:, :2], normal_N, stiffness_N_per_m=stiffness, friction=how.coefficient)
    force_N = _within(dragged.force_N + normal_N[:, None] * tilt, how.coefficient * normal_N)
    # The material under the tip rested behind it: there both press and push are centred.
    elastic_m = force_N / np.where(stiffness > 0, stiffness, 1.0)[:, None]
    centre_m = np.column_stack([tip_m[:, :2] - elastic_m, tip_m[:, 2]])
    change_T = np.zeros((len(tip_m), *board.chips_m.shape))
    for stop_i, before, after in moved_dipoles(skin, centre_m):
        of = maps[stop_i]
        if of is not None and force_N[stop_i].any():
            after = _carry(of, after, centre_m[stop_i, :2], force_N[stop_i], skin.modulus_Pa)
        change_T[stop_i] = change_of_field(before, after, board.chips_m)
    return force_N, change_T


def _map(skin: Skin, depth_m: float) -> shear.ShearMap:
    true_m = DEPTH_STEP_M * max(round((depth_m + skin.depth_zero_m) / DEPTH_STEP_M), 1)
    return shear.tabulate_depth(true_m, thickness_m=skin.thickness_m, tip_radius_m=skin.tip_radius_m, base=skin.base)


def _within(force_N: Float[np.ndarray, "p 2"], limit_N: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p 2"]:
    size_N = np.hypot(*force_N.T)
    return force_N * np.minimum(1.0, limit_N / np.where(size_N > 0, size_N, 1.0))[:, None]


def _carry(
    of: shear.ShearMap,
    dipoles: Dipoles,
    centre_m: Float[np.ndarray, "2"],
    force_N: Float[np.ndarray, "2"],
    modulus_Pa: float,
) -> Dipoles:
    nodes_m, moments_A_m2 = dipoles
    carried = shear.carry(of, nodes_m, centre_m, force_N=force_N, modulus_Pa=modulus_Pa)
    angle_rad, axis = shear.angle_and_axis(carried.half_curl)
    return nodes_m + carried.displacement_m, Rotation.from_rotvec(angle_rad[:, None] * axis).apply(moments_A_m2)
