"""Simulate the response of a skin to a tip: the fields at the chips and the forces at every stop of a protocol.

A stop is a place and depth at which the tip rests while readings are taken. Friction, ageing and some other effects are
optional: they are simulated only if the protocol's settings list them under `terms`. The experiment `accuracy_and_cost`
reports the error that results if such an effect is not simulated.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.constants import micro
from scipy.spatial.transform import Rotation

from reskin.config import Strict
from reskin.physics import shear, slide
from reskin.physics.aging import (
    Ageing,
    Memory,
    Relaxation,
    Temperature,
    baseline_walk,
    fading,
    field_memory,
    relaxed_share,
    softening,
)
from reskin.physics.board import Board
from reskin.physics.magnet import Dipoles, change_of_field
from reskin.physics.shear import Friction, drag_force
from reskin.physics.skin import (
    Skin,
    changes_of_field,
    count_beyond_verified,
    forces,
    moved_dipoles,
    press_motion,
    shear_moduli_Pa,
)


class Terms(Strict):
    """Section `terms` of the settings: the parameters of the optional physical effects.

    An effect that is None is not simulated.
    """

    ageing: Ageing | None = None
    friction: Friction | None = None
    memory: Memory | None = None
    relaxation: Relaxation | None = None
    temperature: Temperature | None = None

    def named(self) -> set[str]:
        """Return the names of the effects that are not None."""
        return {name for name in type(self).model_fields if getattr(self, name) is not None}

    def only(self, names: Collection[str]) -> "Terms":
        """Return a copy in which all effects except the named ones are None."""
        return Terms(**{name: getattr(self, name) for name in names})


class TangentialResponse(NamedTuple):
    """The response of a skin to a dragged or tilted tip, for n indentations with p stops each, and k chips."""

    force_N: Float[np.ndarray, "n p 2"]  # tangential force on the skin
    change_T: Float[np.ndarray, "n p k 3"]  # field change due to both pressing and dragging
    slide_m: Float[np.ndarray, "n p 2"]  # translation of the skin on its base


@dataclass(frozen=True)
class Response:
    """The response of a skin to a tip, for n indentations with p stops each, and k chips."""

    rest_T: Float[np.ndarray, "n k 3"]  # no-load field before each indentation
    change_T: Float[np.ndarray, "n p k 3"]  # field at each stop, minus the no-load field
    force_N: Float[np.ndarray, "n p 3"]  # force on the skin; the last component is the normal force
    # number of stops whose depth is beyond the range in which the published solution for the layer was verified
    beyond_verified_n: int


def simulate_response(
    board: Board,
    skin: Skin,
    tip_m: Float[np.ndarray, "n p 3"],
    *,
    tilt: Float[np.ndarray, "n 2"],
    terms: Terms,
    rng: np.random.Generator,
) -> Response:
    """Simulate the response of a new skin at each stop of the tip.

    Parameters
    ----------
    board, skin : the board and the skin on it
    tip_m : x, y and depth of the tip at each stop, in the coordinate system of the board
    tilt : slope of the stylus, dx/dz and dy/dz, in each indentation
    terms : the optional effects. If `terms.friction` is None, there is no tangential force, and a dragged or tilted tip
        has the same effect as an upright tip that presses at the same place.
    rng : random generator for the drift of the no-load field
    """
    n, stops_n, _ = tip_m.shape
    flat_m = tip_m.reshape(-1, 3)
    force_N = np.zeros((n, stops_n, 3))
    if terms.friction is None:
        rest_T, change_T = changes_of_field(board, skin, flat_m)
    else:
        rest_T, _ = changes_of_field(board, skin, flat_m[:0])
        dragged = drag_tip(board, skin, tip_m, tilt=tilt, friction=terms.friction)
        force_N[:, :, :2], change_T = dragged.force_N, dragged.change_T
    force_N[:, :, 2] = forces(skin, flat_m[:, 2]).reshape(n, stops_n)
    change_T = change_T.reshape(n, stops_n, *rest_T.shape)
    every_rest_T = np.broadcast_to(rest_T, (n, *rest_T.shape))
    if terms.ageing is not None:
        contacts_n, ageing = np.arange(n), terms.ageing
        force_N *= softening(contacts_n, settling=ageing.settling, ageing=ageing.ageing)[:, None, None]
        relative_rest = 1 - fading(contacts_n, per_decade=ageing.fading_per_decade)
        walk_T = baseline_walk(contacts_n, rest_T.size, step_T=ageing.wandering_uT * micro, rng=rng)
        every_rest_T = relative_rest[:, None, None] * rest_T + walk_T.reshape(-1, *rest_T.shape)
    if terms.relaxation is not None:
        force_N *= relaxed_share(terms.relaxation)
    if terms.memory is not None:
        before_T, added_T = field_memory(change_T, terms.memory)
        every_rest_T = every_rest_T + before_T
        change_T = change_T + added_T
    deep_n = count_beyond_verified(skin, flat_m[:, 2])
    return Response(every_rest_T, change_T, force_N, deep_n)


def drag_tip(
    board: Board, skin: Skin, tip_m: Float[np.ndarray, "n p 3"], *, tilt: Float[np.ndarray, "n 2"], friction: Friction
) -> TangentialResponse:
    """Simulate a dragged or tilted tip at the stops of each indentation, with Coulomb friction.

    The tangential force of the tip shears the layer under the tip. If springs hold the skin on its base (`Skin.hold`),
    the force also moves the whole skin. Otherwise, the lower side of the skin is assumed to be fixed sideways.

    Both pressing and dragging exert a lateral force, and friction limits the sum of the two forces. The drag is assumed
    to exert its full force. The remaining fraction of the friction limit is available for the press. The displacement
    due to the press is therefore multiplied by this fraction. If the tip slips, the drag uses the whole limit, so that
    the fraction is zero.
    """
    if skin.hold is not None:
        skin = replace(skin, hold=replace(skin.hold, friction=friction.coefficient))
    responses = [_drag_once(board, skin, *each, friction.coefficient) for each in zip(tip_m, tilt, strict=True)]
    return TangentialResponse(*map(np.stack, zip(*responses, strict=True)))


def _drag_once(
    board: Board, skin: Skin, tip_m: Float[np.ndarray, "p 3"], tilt: Float[np.ndarray, "2"], coefficient: float
) -> TangentialResponse:
    normal_N = forces(skin, tip_m[:, 2])
    shear_Pa = shear_moduli_Pa(skin, tip_m[:, 2])
    layer_N_per_m = np.zeros(len(tip_m))
    for stop_i in np.flatnonzero(normal_N > 0).tolist():
        layer_N_per_m[stop_i] = shear_Pa[stop_i] * _shear_map(skin, tip_m[stop_i, 2]).stiffness_m
    slides_m_per_N = _base_compliance(skin, tip_m[:, :2])
    dragged = drag_force(
        tip_m[:, :2], normal_N, stiffness_N_per_m=_in_series(layer_N_per_m, slides_m_per_N), friction=coefficient
    )
    force_N = _clip(dragged.force_N + normal_N[:, None] * tilt, coefficient * normal_N)
    # The deformations due to pressing and dragging are centred at the place at which the material under the tip was
    # before it was touched.
    drag_slide_m = (slides_m_per_N @ force_N[:, :, None])[:, :, 0]
    elastic_m = force_N / np.where(layer_N_per_m > 0, layer_N_per_m, 1.0)[:, None] + drag_slide_m
    centre_m = np.column_stack([tip_m[:, :2] - elastic_m, tip_m[:, 2]])
    dragged_slide = slide.rigid_motion(tip_m[:, :2] - skin.seat_m, drag_slide_m, skin.sides_m)
    limit_N = coefficient * normal_N
    press_share = 1 - np.minimum(np.hypot(*force_N.T) / np.where(limit_N > 0, limit_N, 1.0), 1.0)
    change_T = np.zeros((len(tip_m), *board.chips_m.shape))
    for stop_i, before, after in moved_dipoles(skin, centre_m, press_share):
        if force_N[stop_i].any():
            shear_map = _shear_map(skin, centre_m[stop_i, 2])
            after = _apply_shear(shear_map, after, centre_m[stop_i, :2], force_N[stop_i], 3 * shear_Pa[stop_i])
            after = slide.apply(dragged_slide, stop_i, after, skin.seat_m)
        change_T[stop_i] = change_of_field(before, after, board.chips_m)
    slide_m = np.zeros((len(tip_m), 2))
    if skin.hold is not None:
        true_m = centre_m + np.array([0.0, 0.0, skin.depth_zero_m])
        slide_m = dragged_slide.move_m + press_motion(skin, skin.hold, true_m).scaled(press_share).move_m
    return TangentialResponse(force_N, change_T, slide_m)


def _base_compliance(skin: Skin, places_m: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, "p 2 2"]:
    if skin.hold is None:
        return np.zeros((len(places_m), 2, 2))
    return slide.compliance_m_per_N(places_m - skin.seat_m, skin.sides_m, skin.hold.springs_N_per_m)


def _in_series(
    layer_N_per_m: Float[np.ndarray, " p"], slides_m_per_N: Float[np.ndarray, "p 2 2"]
) -> Float[np.ndarray, "p 2 2"]:
    # Return the tangential stiffness of the layer in series with the springs of the base. It is 0 at stops without
    # contact, where the stiffness of the layer is given as 0.
    stiff = layer_N_per_m > 0
    layers_m_per_N = np.eye(2) / np.where(stiff, layer_N_per_m, 1.0)[:, None, None]
    return np.where(stiff[:, None, None], np.linalg.inv(layers_m_per_N + slides_m_per_N), 0.0)


def _shear_map(skin: Skin, depth_m: float) -> shear.ShearMap:
    true_m = depth_m + skin.depth_zero_m
    return shear.at_depth(true_m, thickness_m=skin.thickness_m, tip_radius_m=skin.tip_radius_m, base=skin.base)


def _clip(force_N: Float[np.ndarray, "p 2"], limit_N: Float[np.ndarray, " p"]) -> Float[np.ndarray, "p 2"]:
    size_N = np.hypot(*force_N.T)
    with np.errstate(over="ignore"):  # the quotient overflows to infinity if the force is far below the limit
        return force_N * np.minimum(1.0, limit_N / np.where(size_N > 0, size_N, 1.0))[:, None]


def _apply_shear(
    shear_map: shear.ShearMap,
    dipoles: Dipoles,
    centre_m: Float[np.ndarray, "2"],
    force_N: Float[np.ndarray, "2"],
    modulus_Pa: float,
) -> Dipoles:
    nodes_m, moments_A_m2 = dipoles
    carried = shear.shear_in_steps(shear_map, nodes_m, centre_m, force_N=force_N, modulus_Pa=modulus_Pa)
    angle_rad, axis = shear.rotation_from_curl(carried.half_curl)
    return nodes_m + carried.displacement_m, Rotation.from_rotvec(angle_rad[:, None] * axis).apply(moments_A_m2)
