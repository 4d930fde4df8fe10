"""Extreme cases of a skin that slides on its base.

The cases are drags with almost no friction and with very high friction, a tip that is lifted after a drag, indentations
at the free edge of the skin, and force control.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.constants import milli

from pipeline.experiments.stability.cases import Case, condition_case, error_case
from pipeline.experiments.stability.physics import COARSE
from pipeline.experiments.verification.checks import no_spread
from reskin.physics import shear, slide
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.shear import Friction
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, forces, press_motion, shear_moduli_Pa
from reskin.simulation.contact import TangentialResponse, drag_tip

AREA = "physics"
DEPTH = 0.35  # depth / thickness; no drag of any scene is deeper, and shear increases with the depth
PLACE_M = np.array([5.0, -3.0]) * milli  # relative to the skin's centre; a drag at this place also rotates the skin
WAY_M = np.array([0.0, 0.05, 0.2, 0.5]) * milli  # displacements along x at the stops of a drag
HELD_M = 0.1 * milli  # displacement of the tip before it is lifted
LIFTS_N = (3, 30)  # numbers of stops while the tip is lifted
EDGE_M = 0.1 * milli  # distance of the indentations near the edge from the skin's edge
STICKY, SMOOTH = 10.0, 1e-9  # friction coefficients
ROUNDING = 1e-12
PRESSES = np.concatenate([[0.0], np.geomspace(1e-6, slide.DEEPEST, 400)])  # depth / thickness


def sliding_cases(board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, seed: int) -> list[Case]:
    """Run all cases of sliding, on a skin and a board without manufacturing spreads.

    Returns an empty list if no springs hold the skin on its base (`skin.hold` is None).
    """
    if skin.hold is None:
        return []
    spread_free = no_spread(spreads)
    drawn_board = draw_board(board, spread_free, seed=seed, name="b0")
    drawn_skin = draw_skin(skin, spread_free, seed=seed, name="b0_s0", rule=COARSE)
    return [
        *stick_slip(drawn_board, drawn_skin),
        lift(drawn_board, drawn_skin),
        *edge(drawn_board, drawn_skin),
        *force_control(drawn_skin),
    ]


def stick_slip(board: Board, skin: Skin) -> list[Case]:
    """Run cases of drags with almost no friction, in which the tip slips at once, and with very high friction."""
    path_m = _path(skin, skin.seat_m + PLACE_M, WAY_M, np.full(len(WAY_M), DEPTH))
    normal_N = forces(skin, path_m[:, 2])
    smooth, sticky = (_drag(board, skin, path_m, mu) for mu in (SMOOTH, STICKY))
    assert skin.hold is not None
    # With this low friction, neither a press nor a drag moves the skin on its base noticeably.
    slippery = replace(skin, hold=replace(skin.hold, friction=SMOOTH))
    _, pressed_T = changes_of_field(board, slippery, path_m)
    drawn_N = np.linalg.norm(smooth.force_N[0], axis=1)
    off_N = float(np.abs(drawn_N[1:] / (SMOOTH * normal_N[1:]) - 1).max())
    off_T = float(np.abs(smooth.change_T[0] - pressed_T).max() / np.abs(pressed_T).max())
    # The layer and the springs that hold the skin are in series. If the tip does not slip, their displacements add up
    # to the displacement of the tip.
    pulled_N = sticky.force_N[0]
    slides_m_per_N = slide.compliance_m_per_N(path_m[:, :2] - skin.seat_m, skin.sides_m, _springs(skin))
    taken_m = pulled_N / _layer_N_per_m(skin, DEPTH) + (slides_m_per_N @ pulled_N[:, :, None])[:, :, 0]
    left_m = np.abs(taken_m[:, 0] - WAY_M).max() + np.abs(taken_m[:, 1]).max()
    return [
        error_case(AREA, f"a drag with a coefficient of friction of {SMOOTH:g} on a sliding skin",
                   should="the tip slips at once: force is coefficient times normal force; dB as without a drag",
                   happened=f"{drawn_N.max():.2g} N, relative error {off_N:.1e}; relative error of dB {off_T:.1e}",
                   error=max(off_N, off_T), limit=1e-6),
        error_case(AREA, f"a drag with a coefficient of friction of {STICKY:g} on a sliding skin",
                   should="the tip sticks: displacements of layer and skin add up to the displacement of the tip",
                   happened=f"{np.abs(pulled_N).max():.3g} N over {WAY_M[-1] / milli:g} mm; relative error of the sum "
                            f"{left_m / WAY_M[-1]:.1e}",
                   error=float(left_m / WAY_M[-1]), limit=1e-9),
    ]  # fmt: skip


def lift(board: Board, skin: Skin) -> Case:
    """Run a case of a drag at the skin's centre, after which the tip is lifted.

    While the tip is lifted, the normal force decreases, and with it the friction limit, so the tangential force must
    decrease too.
    """
    mu, errors, last_N = 1.0, [], []
    for stops_n in LIFTS_N:
        share = np.append(DEPTH, np.linspace(DEPTH, 0, stops_n + 1))
        way_m = np.append(0.0, np.full(stops_n + 1, HELD_M))
        path_m = _path(skin, skin.seat_m, way_m, share)
        pulled_N = _drag(board, skin, path_m, mu).force_N[0]
        limit_N = mu * forces(skin, path_m[:, 2])
        layers_N_per_m = np.array([_layer_N_per_m(skin, depth_share) for depth_share in share[1:-1]])
        give_m_per_N = 1 / layers_N_per_m + 1 / _springs(skin)  # a drag at the centre does not rotate the skin
        reach_m = np.minimum.accumulate(np.minimum(HELD_M, limit_N[1:-1] * give_m_per_N))
        errors.append(np.abs(pulled_N[1:-1, 0] - reach_m / give_m_per_N).max() / limit_N[0])
        last_N.append(np.abs(pulled_N[-1]).max())
    observed = (
        f"in {LIFTS_N[0]} and {LIFTS_N[1]} stops: error {max(errors):.1e} of the first friction limit; "
        f"{max(last_N):g} N left at the end"
    )
    return error_case(AREA, "a tip that drags the skin and is then lifted",
                      should="the tangential force is limited by the springs and by the smallest friction limit so "
                             "far, for any number of stops; it is 0 at the end",
                      happened=observed, error=float(max(*errors, *last_N)), limit=1e-9)  # fmt: skip


def edge(board: Board, skin: Skin) -> list[Case]:
    """Run cases of two indentations just inside the skin's free edge: at the middle of a side, and at a corner."""
    half_m = np.array(skin.sides_m) / 2 - EDGE_M
    places_m = np.array([[half_m[0], 0.0], half_m])
    pokes_m = np.column_stack([skin.seat_m + places_m, np.full(2, 0.3 * skin.thickness_m)])
    _, change_T = changes_of_field(board, skin, pokes_m)
    assert skin.hold is not None
    slides = press_motion(skin, skin.hold, pokes_m)
    force_N = skin.modulus_Pa * slide.force_at(
        pokes_m[:, 2], modulus_Pa=1.0, thickness_m=skin.thickness_m, tip_radius_m=skin.tip_radius_m
    )
    load = np.minimum(force_N / (skin.modulus_Pa * skin.hold.lets_go_m2), 1.0)
    wanted_m = slide.press_displacement_m(places_m, load, give_m=skin.hold.give_m, away=skin.hold.away)
    moved_m = slides.move_m + slides.spin_rad[:, None] * np.stack([-places_m[:, 1], places_m[:, 0]], axis=1)
    share = (moved_m * wanted_m).sum(axis=1) / (wanted_m**2).sum(axis=1)
    error = float(np.abs(moved_m - share[:, None] * wanted_m).max() / np.abs(wanted_m).max())
    friction_used = skin.hold.grip_N_per_m * np.hypot(*slides.move_m.T) / force_N
    sizes_uT = ", ".join(f"{1e6 * size:.3g}" for size in np.abs(change_T).max(axis=(1, 2)))
    return [
        condition_case(AREA, f"pokes {EDGE_M / milli:g} mm from the skin's free edge, at a side and at a corner",
                       should="dB is finite and not 0, although a part of the tip is beside the skin",
                       happened=f"at most {sizes_uT} uT",
                       holds=bool(np.isfinite(change_T).all() and (np.abs(change_T).max(axis=(1, 2)) > 0).all())),
        error_case(AREA, "motion of a skin that is poked near its free edge",
                   should="translation and rotation together displace the poked place in the direction of the press",
                   happened=f"{np.abs(slides.spin_rad).max():.2g} rad, relative error {error:.1e}", error=error,
                   limit=ROUNDING),
        condition_case(AREA, "force that is needed for this motion",
                       should="above 0, and at most the friction of the tip",
                       happened=f"at most {friction_used.max():.3g} of the friction of the tip",
                       holds=bool((friction_used > 0).all() and (friction_used <= 1).all())),
    ]  # fmt: skip


def force_control(skin: Skin) -> list[Case]:
    """Run cases of force control: a force must lead to the same depth during loading and unloading."""
    assert skin.hold is not None
    sizes = {"modulus_Pa": skin.modulus_Pa, "thickness_m": skin.thickness_m, "tip_radius_m": skin.tip_radius_m}
    depth_m = skin.thickness_m * np.concatenate([PRESSES, PRESSES[::-1]])
    force_N = slide.force_at(depth_m, **sizes)
    error = float(np.abs(slide.depth_at(force_N, **sizes) - depth_m).max() / skin.thickness_m)
    beyond_N = force_N.max() * np.array([1.0, 2.0, 1e6])
    held_m, counted_n = slide.depth_at(beyond_N, **sizes), slide.count_clipped(beyond_N, **sizes)
    deepest = held_m / (slide.DEEPEST * skin.thickness_m)
    return [
        error_case(AREA, f"force control up to a depth of {slide.DEEPEST:g} of the thickness, and back to 0",
                   should="the depth computed from a force is the depth that causes this force, in both directions",
                   happened=f"{force_N.max():.3g} N at most; error {error:.1e} of the thickness", error=error,
                   limit=1e-6),
        condition_case(AREA, "a force that would need more than the greatest allowed depth",
                       should="the depth is limited to the greatest allowed depth, and this is counted",
                       happened=f"{beyond_N[-1]:.2g} N: {deepest[-1]:.6f} of the greatest depth; {counted_n} counted",
                       holds=bool(np.abs(deepest - 1).max() < ROUNDING and counted_n == 2)),
    ]  # fmt: skip


def _drag(board: Board, skin: Skin, path_m: Float[np.ndarray, "p 3"], mu: float) -> TangentialResponse:
    return drag_tip(board, skin, path_m[None], tilt=np.zeros((1, 2)), friction=Friction(coefficient=mu))


def _path(
    skin: Skin, start_m: Float[np.ndarray, "2"], way_m: Float[np.ndarray, " p"], share: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "p 3"]:
    """Return the stops of a drag along x: displacements `way_m` from `start_m`, at depths `share` * thickness."""
    return np.column_stack([start_m[0] + way_m, np.full(len(way_m), start_m[1]), share * skin.thickness_m])


def _springs(skin: Skin) -> float:
    assert skin.hold is not None
    return skin.hold.springs_N_per_m


def _layer_N_per_m(skin: Skin, share: float) -> float:
    """Return the tangential stiffness of the layer under a tip at the depth `share` * thickness."""
    depth_m = share * skin.thickness_m
    table = shear.at_depth(depth_m, thickness_m=skin.thickness_m, tip_radius_m=skin.tip_radius_m, base=skin.base)
    shear_Pa = shear_moduli_Pa(skin, np.array([depth_m]))[0]
    return float(shear_Pa * table.stiffness_m)
