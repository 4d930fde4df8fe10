"""Cases of skins and indentations at the limits of what is allowed, compared with references.

There are four references: indentations in steps four times as fine and without tables of displacements, rings of
pressure on a layer with the textbook compliance, magpylib's closed form of a magnetised box, and the exact scaling of
lengths.
"""

from dataclasses import asdict, replace

import magpylib
import numpy as np
from jaxtyping import Float
from scipy.constants import milli, mu_0
from scipy.special import j0, j1

from pipeline.experiments.stability.cases import Case, error_case
from pipeline.experiments.verification import mechanics
from pipeline.experiments.verification.checks import no_spread
from reskin.physics import layer, magnet, slide
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.magnet import Quadrature, change_of_field, place_nodes
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, forces

AREA = "physics"
# The simulation and its reference use the same nodes, so that the errors of the quadrature cancel.
COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)
PLACE_M = np.array([2.3, -1.1]) * milli  # place of the indentation; no node is on the tip's axis there
DEPTHS = (0.6, 0.66, slide.DEEPEST)  # depths / thickness
FINER = 4  # number of steps of the reference / number of steps of the simulator
STEPS_N = 40  # steps of the simulator over a depth of one thickness
RINGS_N, KEPT_WAVES = 160, 400.0  # number of rings of pressure; largest value of wave number * outer radius
SIZES = (0.1, 1.0, 10.0)  # tip radius / thickness
PRESSED = 0.4  # depth / min(thickness, tip radius)
GAPS_MM, CELL_SHARE = (1.1, 0.4, 0.2), 0.5  # gaps between skin and chips; cell size / gap
SLID_M = 0.1 * milli  # displacement of the sliding skin
THICKNESSES_MM = (0.2, 20.0)  # thicknesses of the scaled skins


def extreme_cases(board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, seed: int) -> list[Case]:
    """Run cases of deep indentations, sharp and blunt tips, chips close to the skin, and thin and thick skins."""
    spread_free = no_spread(spreads)
    drawn_board = draw_board(board, spread_free, seed=seed, name="b0")
    drawn_skin = draw_skin(skin, spread_free, seed=seed, name="b0_s0", rule=COARSE)
    return [*deep(drawn_board, drawn_skin), *tips(skin.base), *near(skin), *scaled(drawn_board, drawn_skin)]


def deep(board: Board, skin: Skin) -> list[Case]:
    """Run cases of deep indentations: compare the field change dB with dB computed in finer steps without tables."""
    cases = []
    for share in DEPTHS:
        depth_m = share * skin.thickness_m
        _, (found_T,) = changes_of_field(board, skin, np.array([[*PLACE_M, depth_m]]))
        fine_m = mechanics.descent(depth_m + skin.depth_zero_m, FINER * round(STEPS_N * share))
        moved = mechanics.follow_dipoles(skin, PLACE_M, fine_m)
        truth_T = change_of_field((skin.nodes_m, skin.moments_A_m2), moved, board.chips_m)
        error = _error(found_T, truth_T)
        cases.append(
            error_case(AREA, f"dB of a press to {share:g} of the thickness",
                       should=f"the same dB as with {FINER} times as many depth steps and without tables",
                       happened=f"relative error {error:.1e}", error=error, limit=0.02)
        )  # fmt: skip
    return cases


def tips(base: layer.Base) -> list[Case]:
    """Run cases of sharp and blunt tips: compare the simulator's force with the force of rings of uniform pressure."""
    cases = []
    for size in SIZES:
        thickness_m, tip_m = 2 * milli, 2 * milli * size
        depth_m = PRESSED * min(thickness_m, tip_m)
        sizes = {"thickness_m": thickness_m, "tip_radius_m": tip_m}
        found_N = layer.force(np.array([depth_m]), **sizes, modulus_Pa=1e6, base=base)[0]
        contact = layer.contact_of_depth(depth_m, **sizes, base=base)
        truth_N = ring_force_N(depth_m, thickness_m, tip_m, 1e6, base, reach_m=1.15 * contact.radius_m)
        error = abs(found_N / truth_N - 1)
        cases.append(
            error_case(AREA, f"a tip whose radius is {size:g} times the thickness",
                       should=f"the same force as {RINGS_N} rings of pressure under the tip",
                       happened=f"{found_N:.4g} N, rings {truth_N:.4g} N: relative error {error:.1e}",
                       error=float(error), limit=0.01)
        )  # fmt: skip
    return cases


def ring_force_N(
    depth_m: float, thickness_m: float, tip_radius_m: float, modulus_Pa: float, base: layer.Base, *, reach_m: float
) -> float:
    """Return the force of a sphere pressed into a layer, approximated by rings of uniform pressure up to `reach_m`.

    Under each ring, either the surface touches the sphere or the pressure is zero. The deflection by a ring is the
    Hankel integral of the ring's pressure times the layer's compliance (Johnson 1985, 5.8). With A = wave number *
    thickness, the compliance is (cosh 2A - 1) / (sinh 2A + 2A) on a sliding base, and
    (sinh 2A - 2A) / (cosh 2A + 2 A^2 + 1) on a bonded base.
    """
    edges_m = np.linspace(0, reach_m, RINGS_N + 1)
    middles_m = (edges_m[1:] + edges_m[:-1]) / 2
    x, w = np.polynomial.legendre.leggauss(6 * RINGS_N)
    k_per_m, weights = KEPT_WAVES / reach_m * (x + 1) / 2, KEPT_WAVES / reach_m * w / 2
    twice = np.minimum(2 * k_per_m * thickness_m, 600.0)
    if base == "slipping":
        compliance = (np.cosh(twice) - 1) / (np.sinh(twice) + twice)
    else:
        compliance = (np.sinh(twice) - twice) / (np.cosh(twice) + twice**2 / 2 + 1)
    disc = edges_m * j1(np.outer(k_per_m, edges_m))
    ring = (disc[:, 1:] - disc[:, :-1]) / k_per_m[:, None]  # Hankel transform of a ring of unit pressure
    shear_Pa = modulus_Pa / 3
    sinks_m = (j0(np.outer(middles_m, k_per_m)) * (weights * compliance)) @ ring / (2 * shear_Pa)
    sphere_m = depth_m - tip_radius_m + np.sqrt(tip_radius_m**2 - middles_m**2)
    touching = np.ones(RINGS_N, dtype=bool)
    pressure_Pa = np.zeros(RINGS_N)
    while True:
        pressure_Pa[:] = 0
        pressure_Pa[touching] = np.linalg.solve(sinks_m[np.ix_(touching, touching)], sphere_m[touching])
        if not (pressure_Pa < 0).any():
            break
        touching &= pressure_Pa > 0
    return float((pressure_Pa * np.pi * np.diff(edges_m**2)).sum())


def near(skin: SkinDesign) -> list[Case]:
    """Run cases of a uniformly magnetised skin that slides over close chips: compare dB of dipoles with dB of a box."""
    cases, side_m, thickness_m = [], 20 * milli, skin.thickness_mm * milli
    j_T = np.array([0.6, -0.3, 1.0]) * skin.saturation_T
    box = magpylib.magnet.Cuboid(polarization=j_T, dimension=(side_m, side_m, thickness_m))
    for gap_mm in GAPS_MM:
        chips_m = np.array([[0.3, -0.2, -gap_mm], [7.1, 0.4, -gap_mm], [9.4, 9.1, -gap_mm]]) * milli
        nodes = place_nodes(thickness_m, Quadrature(CELL_SHARE * gap_mm * milli, 6))
        moments = nodes.volumes_m3[:, None] * j_T / mu_0
        slid_m = nodes.nodes_m + np.array([SLID_M, 0.0, 0.0])
        found_T = magnet.field(slid_m, moments, chips_m) - magnet.field(nodes.nodes_m, moments, chips_m)
        middle_m = np.array([0.0, 0.0, thickness_m / 2])
        truth_T = box.getB(chips_m - middle_m - (SLID_M, 0.0, 0.0)) - box.getB(chips_m - middle_m)
        error = _error(found_T, truth_T)
        cases.append(
            error_case(AREA, f"chips {gap_mm:g} mm under a skin that slides by {SLID_M / milli:g} mm",
                       should=f"the same dB as a magnetised box (magpylib), for cells {CELL_SHARE:g} of the gap wide",
                       happened=f"{len(moments)} dipoles, relative error {error:.1e}", error=error, limit=0.03)
        )  # fmt: skip
    return cases


def scaled(board: Board, skin: Skin) -> list[Case]:
    """Run cases in which all lengths are scaled: dB must not change, and forces must scale with the length squared."""
    poke_m = np.array([[*PLACE_M, 0.45 * skin.thickness_m]])
    (force_N,), (_, (change_T,)) = forces(skin, poke_m[:, 2]), changes_of_field(board, skin, poke_m)
    cases = []
    for thickness_mm in THICKNESSES_MM:
        scale = thickness_mm * milli / skin.thickness_m
        other, chips = scale_skin(skin, scale), replace(board, chips_m=board.chips_m * scale)
        (other_N,) = forces(other, scale * poke_m[:, 2])
        _, (other_T,) = changes_of_field(chips, other, scale * poke_m)
        error = max(_error(other_T, change_T), abs(float(other_N / (scale**2 * force_N)) - 1))
        cases.append(
            error_case(AREA, f"a skin of {thickness_mm:g} mm thickness, with all other lengths scaled too",
                       should="dB is unchanged, and force is proportional to length squared",
                       happened=f"{other_N:.3g} N, relative error {error:.1e}", error=error, limit=1e-6)
        )  # fmt: skip
    return cases


def scale_skin(skin: Skin, scale: float) -> Skin:
    """Multiply all lengths of a skin by `scale`. The material is unchanged, so spring stiffness scales with length."""
    hold = skin.hold
    if hold is not None:
        x_m, y_m = hold.give_m
        hold = slide.Hold(
            **asdict(hold)
            | {"give_m": (scale * x_m, scale * y_m), "lets_go_m2": scale**2 * hold.lets_go_m2}
            | {"springs_N_per_m": scale * hold.springs_N_per_m}
        )
    return replace(
        skin, nodes_m=scale * skin.nodes_m, moments_A_m2=scale**3 * skin.moments_A_m2, seat_m=scale * skin.seat_m,
        sides_m=(scale * skin.sides_m[0], scale * skin.sides_m[1]), thickness_m=scale * skin.thickness_m,
        tip_radius_m=scale * skin.tip_radius_m, depth_zero_m=scale * skin.depth_zero_m, hold=hold,
    )  # fmt: skip


def _error(found: Float[np.ndarray, "k 3"], truth: Float[np.ndarray, "k 3"]) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
