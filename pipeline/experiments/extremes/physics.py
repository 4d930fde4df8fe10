"""Laws of the simulated physics, and skins and presses at the limits of what is allowed.

References are magpylib, closed forms, published fits, rings of pressure, central differences, computations in finer
steps, 50-digit arithmetic and symmetries. The functions compute errors, so that tests can call them with other inputs.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from functools import lru_cache, partial
from itertools import product
from typing import Any

import magpylib
import mpmath
import numpy as np
from jaxtyping import Float
from scipy.constants import micro, milli
from scipy.special import j0, j1

from pipeline.description import norm_error
from pipeline.experiments.extremes.cases import (
    Case,
    World,
    largest,
    max_error,
    relative_error,
    scaled_error,
)
from reskin.physics import deformation, layer, magnet, shear, slide
from reskin.physics.aging import Prony, advance
from reskin.physics.board import Board
from reskin.physics.layer import IndentedLayer
from reskin.physics.magnet import Dipoles, Polarity, Quadrature, change_of_field, place_nodes
from reskin.physics.shear import Friction
from reskin.physics.skin import Skin, changes_of_field, forces, press_motion, shear_moduli_Pa
from reskin.seeds import rng_for
from reskin.simulation.contact import drag_tip
from reskin.simulation.rig import FORCE_RANGE_N, read_force

ROUNDING = "Only rounding errors occur."
MU_0 = "Values of mu_0 from different years (CODATA) differ by up to 1e-9."
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # rotation by a quarter turn about z

# Magnetic fields ------------------------------------------------------------------------------------------------


def box_places_m(seed: int, side_m: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """Return random places outside a cube, from 0.9 to 50 sides from its centre, and places inside it."""
    rng = rng_for(seed, "extremes", "box")
    directions = rng.standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    outside_m = side_m * directions * np.geomspace(0.9, 50, len(directions))[:, None]
    return outside_m, side_m * rng.uniform(-0.49, 0.49, (500, 3))


def box(places_m: Float[np.ndarray, "n 3"], side_m: float = 0.5 * milli) -> float:
    """Return the largest relative error of the field of a cube, from magpylib."""
    truth_T = magpylib.magnet.Cuboid(polarization=(0, 0, 1), dimension=(side_m,) * 3).getB(places_m)
    error_T = magnet.cuboid_field(places_m, 1.0, sides_m=(side_m,) * 3) - truth_T
    return float((np.linalg.norm(error_T, axis=1) / np.linalg.norm(truth_T, axis=1)).max())


def array(
    places_m: Float[np.ndarray, "n 3"],
    thickness_m: float,
    polarity: Polarity,
    cubes_n: tuple[int, int] = magnet.CUBES_N,
) -> float:
    """Return the error of the field of the magnets that magnetise a skin, from the sum of magpylib's cubes."""
    side_m, swaps = magnet.CUBE_SIDE_M, -1 if polarity == "checkerboard" else 1
    heights_m = (-magnet.ARRAY_BELOW_M - side_m / 2, thickness_m + magnet.ARRAY_ABOVE_M + side_m / 2)
    cubes = [
        magpylib.magnet.Cuboid(
            polarization=(0, 0, magnet.ARRAY_REMANENCE_T * swaps ** (i + j)), dimension=(side_m,) * 3,
            position=((i - (cubes_n[0] - 1) / 2) * side_m, (j - (cubes_n[1] - 1) / 2) * side_m, z_m),
        )
        for i, j, z_m in product(*map(range, cubes_n), heights_m)
    ]  # fmt: skip
    found_T = magnet.array_field(places_m, thickness_m, polarity, cubes_n=cubes_n)
    return scaled_error(found_T, magpylib.getB(cubes, places_m, sumup=True))


def maxwell(thickness_m: float, polarity: Polarity, seed: int) -> float:
    """Return the larger of |div B| and |curl B| in the skin, relative to the largest derivative at the same place."""
    step_m = micro
    low, high = np.array([-9e-3, -9e-3, 0.05 * thickness_m]), np.array([9e-3, 9e-3, 0.95 * thickness_m])
    places_m = rng_for(seed, "extremes", "array").uniform(low, high, (200, 3))
    steps_m = (np.eye(3)[:, None] * np.array([step_m, -step_m])[:, None]).reshape(6, 3)
    b_T = magnet.array_field((places_m[:, None] + steps_m).reshape(-1, 3), thickness_m, polarity)
    slope = -np.diff(b_T.reshape(-1, 3, 2, 3), axis=2)[:, :, 0] / (2 * step_m)
    divergence = np.abs(np.trace(slope, axis1=1, axis2=2))
    curl = np.abs(slope - slope.transpose(0, 2, 1)).max(axis=(1, 2))
    return float((np.maximum(divergence, curl) / np.abs(slope).max(axis=(1, 2))).max())


def dipoles(seed: int) -> tuple[float, float]:
    """Return the errors of the field of dipoles at rest, and of its change if they move and turn, from magpylib."""
    rng = rng_for(seed, "extremes", "dipoles")
    # If the dipoles were centred at the origin, a wrong sign of the separation could go unnoticed.
    rest = rng.uniform((2e-3, -9e-3, 1e-3), (9e-3, 4e-3, 3e-3), (60, 3)), 1e-5 * rng.standard_normal((60, 3))
    moved = rest[0] + 1e-4 * rng.standard_normal((60, 3)), rest[1] + 1e-6 * rng.standard_normal((60, 3))
    chips_m = rng.uniform((-3e-3, -3e-3, -2e-3), (3e-3, 3e-3, -1e-3), (5, 3))
    rest_T, moved_T = (
        magpylib.getB([magpylib.misc.Dipole(moment=m, position=x) for x, m in zip(*of, strict=True)], chips_m,
                      sumup=True)
        for of in (rest, moved)
    )  # fmt: skip
    change = scaled_error(change_of_field(rest, moved, chips_m), moved_T - rest_T)
    return scaled_error(magnet.field(*rest, chips_m), rest_T), change


# Forces of an elastic layer ---------------------------------------------------------------------------------------

HALF_SPACE_M = 100.0  # under a tip of a few millimetres, a layer of this thickness behaves as if infinitely thick
# Number of rings of pressure, and largest value of wave number * outer radius. Waves down to the width of a ring must
# be kept, because the pressures would otherwise alternate from ring to ring.
RINGS_N, KEPT_WAVES = 60, 400.0


def force_N(depth_m: Float[np.ndarray, " n"], indented: IndentedLayer) -> Float[np.ndarray, " n"]:
    """Return the simulator's force in N for a Young's modulus of 1 Pa."""
    return layer.force(depth_m, **asdict(indented), modulus_Pa=1.0)


def hertz_N(depth_m: Float[np.ndarray, " n"], tip_m: float) -> Float[np.ndarray, " n"]:
    """Return Hertz's force of a sphere on an incompressible half-space with E = 1 Pa: 16/9 E sqrt(R) d^1.5."""
    return 16 / 9 * np.sqrt(tip_m) * depth_m**1.5


def compliance(kh: Float[np.ndarray, " w"], base: layer.Base) -> float:
    """Return the error of the compliance for waves of wave number * thickness, from the boundary conditions."""
    with mpmath.workdps(50):
        truth = [float(profile(mpmath.mpf(a), base)(mpmath.mpf(a))) for a in kh.tolist()]
    return relative_error(simulated_compliance(kh, base), np.array(truth))


def simulated_compliance(kh: Float[np.ndarray, "*any"], base: layer.Base) -> Float[np.ndarray, "*any"]:
    return layer.bonded_compliance(kh) if base == "bonded" else layer.slipping_compliance(kh)


def profile(kh: Any, base: layer.Base) -> Callable[[Any], Any]:
    """Return W(z), the vertical displacement in a layer under a wave of pressure of amplitude 2 G k.

    k is the wave number and G the shear modulus; the height z is in units of 1 / k. W satisfies four conditions:
    W'' + W = 0 and 3 W' - W''' = 2 on the surface; W = 0 on the base, and also W' = 0 if it is bonded, or W'' + W = 0
    if the layer slips on it.
    """
    basis = (mpmath.sinh, mpmath.cosh, lambda z: z * mpmath.sinh(z), lambda z: z * mpmath.cosh(z))
    no_shear = {2: 1, 0: 1}
    held = {1: 1} if base == "bonded" else no_shear
    conditions = (({0: 1}, 0), (held, 0), (no_shear, kh), ({1: 1.5, 3: -0.5}, kh))
    rows = [
        [sum(c * mpmath.diff(w, z, n) for n, c in derivatives.items()) for w in basis] for derivatives, z in conditions
    ]
    weights = mpmath.lu_solve(mpmath.matrix(rows), mpmath.matrix([0, 0, 0, 1]))
    return lambda z: sum(weight * w(z) for weight, w in zip(weights, basis, strict=True))


def hertz(tip_m: float, base: layer.Base) -> float:
    depth_m = tip_m * np.array([1e-6, 1e-5])
    return relative_error(force_N(depth_m, IndentedLayer(HALF_SPACE_M, tip_m, base)), hertz_N(depth_m, tip_m))


def sneddon(tip_m: float, base: layer.Base) -> float:
    """Return the error of force and depth of a sphere for contact radii up to 0.7 of its radius."""
    radii_m = tip_m * np.array([0.1, 0.3, 0.7])
    log = np.log((tip_m + radii_m) / (tip_m - radii_m))
    truth_N = 4 / 3 * ((radii_m**2 + tip_m**2) / 2 * log - radii_m * tip_m)
    contacts = [
        layer.contact_of_radius(float(a), thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, base=base) for a in radii_m
    ]
    found_N = np.array([4 * np.pi / 3 * contact.weights_m2.sum() for contact in contacts])
    depth_m = np.array([contact.depth_m for contact in contacts])
    return largest(relative_error(found_N, truth_N), relative_error(depth_m, radii_m * log / 2))


def long_2011(depth_m: Float[np.ndarray, " n"], indented: IndentedLayer) -> float:
    h_m, tip_m = indented.thickness_m, indented.tip_radius_m
    omega, flat = (tip_m * depth_m / h_m**2) ** 1.5, h_m / tip_m
    alpha, beta = 10.05 - 0.63 * np.sqrt(flat) * (3.1 + flat**2), 4.8 - 4.23 * flat**2
    psi = (1 + 2.3 * omega) / (1 + 1.15 * np.cbrt(omega) + alpha * omega + beta * omega**2)
    return relative_error(force_N(depth_m, indented), hertz_N(depth_m, tip_m) / psi)


def rings(depth_m: float, indented: IndentedLayer) -> float:
    edges_m, pressure = ring_pressures(depth_m, indented)
    truth_N = float((pressure * np.pi * np.diff(edges_m**2)).sum())
    return abs(float(force_N(np.array([depth_m]), indented)[0]) / truth_N - 1)


def ring_pressures(depth_m: float, indented: IndentedLayer) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
    """Return edges in m and uniform pressures in Pa of rings under a sphere pressed into a layer with E = 1 Pa.

    Under each ring, either the surface touches the sphere or the pressure is zero. The deflection by a ring is the
    Hankel integral of the ring's pressure times the layer's compliance (Johnson 1985, 5.8). The compliance is the
    simulator's, so this is a reference for the contact only; the cases `compliance_*` verify the compliance.
    """
    reach_m = 1.15 * indented.contact(depth_m).radius_m
    edges_m = np.linspace(0, reach_m, RINGS_N + 1)
    middles_m = (edges_m[1:] + edges_m[:-1]) / 2
    x, w = np.polynomial.legendre.leggauss(16 * RINGS_N)
    k_per_m, weights = KEPT_WAVES / reach_m * (x + 1) / 2, KEPT_WAVES / reach_m * w / 2
    relative = simulated_compliance(k_per_m * indented.thickness_m, indented.base)
    disc = edges_m * j1(np.outer(k_per_m, edges_m))
    ring = np.diff(disc, axis=1) / k_per_m[:, None]  # Hankel transform of a ring of unit pressure
    sinks_m = (j0(np.outer(middles_m, k_per_m)) * (weights * relative)) @ ring * 3 / 2  # 1 / (2 G) with G = E / 3
    sphere_m = depth_m - indented.tip_radius_m + np.sqrt(indented.tip_radius_m**2 - middles_m**2)
    touching = np.ones(RINGS_N, dtype=bool)
    while True:
        pressure_Pa = np.zeros(RINGS_N)
        pressure_Pa[touching] = np.linalg.solve(sinks_m[np.ix_(touching, touching)], sphere_m[touching])
        if not (pressure_Pa < 0).any():
            return edges_m, pressure_Pa
        touching &= pressure_Pa > 0


def sticking(radius_m: float) -> float:
    ratio = shear.tangential_stiffness_m(shear.stick_traction(radius_m, HALF_SPACE_M), HALF_SPACE_M) / radius_m
    return abs(ratio / (16 / 3) - 1)


def sliding(radius_m: float, tip_m: float, base: layer.Base) -> float:
    contact = layer.contact_of_radius(radius_m, thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, base=base)
    return abs(shear.tangential_stiffness_m(shear.slip_traction(contact), HALF_SPACE_M) / radius_m / (40 / 9) - 1)


# Deformation ------------------------------------------------------------------------------------------------------

STEPS_N = 12  # number of depth steps of a press
STEP_M = 1e-7  # distance from a place to each of its two neighbours in central differences
DEEP = 0.6  # depth / thickness up to which the simulator's deformation is verified


def descent(depth_m: float, steps_n: int = STEPS_N) -> Float[np.ndarray, " d"]:
    """Return depths from 0 to `depth_m` in equal steps, with additional stops at a quarter and half of the first step.

    The additional stops are needed because the contact radius grows as the square root of the depth.
    """
    even = np.linspace(0, depth_m, steps_n + 1)
    return np.concatenate([[0.0, even[1] / 4, even[1] / 2], even[1:]])


def inside_m(h_m: float, r_n: int, z_n: int) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Return distances from the tip's axis, and heights, of places in a layer of thickness `h_m`."""
    r_m, z_m = np.meshgrid(np.linspace(0.035, 2.5, r_n) * h_m, np.linspace(0.03, 0.97, z_n) * h_m, indexing="ij")
    return r_m.ravel(), z_m.ravel()


@lru_cache(maxsize=4)
def finite_steps(indented: IndentedLayer, depth_m: float) -> tuple[float, float]:
    """Return the errors of the volume, and of the deformation gradient, after a press in several steps."""
    r_m, z_m = inside_m(indented.thickness_m, 16, 9)
    shifts = [(0.0, 0.0), (STEP_M, 0.0), (-STEP_M, 0.0), (0.0, STEP_M), (0.0, -STEP_M)]
    all_r_m, all_z_m = (np.concatenate([of + shift[axis] for shift in shifts]) for axis, of in enumerate((r_m, z_m)))
    end = deformation.follow(all_r_m, all_z_m, descent(depth_m), press=indented)[-1]
    _, right, left, above, below = np.split(np.stack([end.r_m, end.z_m]), 5, axis=1)
    # Axes: displaced coordinate (r, z); initial coordinate of the derivative (r, z); place.
    numeric = np.stack([right - left, above - below], axis=1) / (2 * STEP_M)
    f, hoop = end.f[: len(r_m)], end.hoop[: len(r_m)]
    gradient = largest(max_error(f, numeric.transpose(2, 0, 1)), max_error(hoop, end.r_m[: len(r_m)] / r_m))
    return max_error(np.linalg.det(f) * hoop, 1.0), gradient


def surface(indented: IndentedLayer, depth_m: float) -> float:
    """Return how far the surface misses the tip in the contact, or enters it beside the contact, over the depth."""
    h_m, tip_m, radius_m = indented.thickness_m, indented.tip_radius_m, indented.contact(depth_m).radius_m
    end = deformation.follow(radius_m * np.linspace(0, 1.4, 40), np.full(40, h_m), descent(depth_m), press=indented)[-1]
    above_m = end.z_m - (h_m - depth_m + tip_m - np.sqrt(tip_m**2 - np.minimum(end.r_m, tip_m) ** 2))
    return largest(max_error(above_m[end.r_m < 0.95 * radius_m], 0.0), float(above_m.max())) / depth_m


def far_field(indented: IndentedLayer, depth_m: float) -> float:
    """Return the error of the growth of r^2 far from the tip, where r is the distance from the tip's axis.

    The layer is incompressible: pi * thickness * growth is the volume between the initial and the deformed surface.
    """
    h_m, top_n = indented.thickness_m, 400
    far_m = [grid_m.ravel() for grid_m in np.meshgrid(np.array([4.0, 5.0, 6.0]) * h_m, np.linspace(0, h_m, 7))]
    r_m = np.append(np.linspace(0, 4 * h_m, top_n), far_m[0])
    end = deformation.follow(r_m, np.append(np.full(top_n, h_m), far_m[1]), descent(depth_m), press=indented)[-1]
    dent_m3 = np.pi * np.trapezoid(h_m - end.z_m[:top_n], end.r_m[:top_n] ** 2)
    return max_error((end.r_m**2 - r_m**2)[top_n:] * np.pi * h_m / dent_m3, 1.0)


# Presses on a skin ------------------------------------------------------------------------------------------------

PLACE_M = np.array([2.3, -1.1]) * milli  # no node of the skin is on the axis of a tip at this place


def follow_dipoles(skin: Skin, place_m: Float[np.ndarray, "2"], depths_m: Float[np.ndarray, " d"]) -> Dipoles:
    """Return the dipoles of a pressed skin without the simulator's tables: each dipole is followed through the depths.

    Each moment is rotated by R of the polar decomposition F = R U of the deformation gradient F at the dipole, from a
    singular value decomposition. No dipole may be on the tip's axis. `depths_m` are true depths.
    """
    away_m = skin.nodes_m[:, :2] - place_m
    r_m = np.linalg.norm(away_m, axis=1)
    indented = IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
    end = deformation.follow(r_m, skin.nodes_m[:, 2], depths_m, press=indented)[-1]
    outward = np.column_stack([away_m / r_m[:, None], np.zeros_like(r_m)])
    places_m = np.column_stack([place_m + end.r_m[:, None] * outward[:, :2], end.z_m])
    u, _, vt = np.linalg.svd(end.f)
    plane = np.stack([(skin.moments_A_m2 * outward).sum(axis=1), skin.moments_A_m2[:, 2]], axis=1)
    turned = np.einsum("sij,sj->si", u @ vt, plane)
    aside = skin.moments_A_m2 - plane[:, :1] * outward - plane[:, 1:] * (0, 0, 1)
    after = places_m, aside + turned[:, :1] * outward + turned[:, 1:] * (0, 0, 1)
    if skin.hold is None:
        return after
    slides = press_motion(skin, skin.hold, np.append(place_m, depths_m[-1])[None])
    return slide.apply(slides, 0, after, skin.seat_m)


def in_fine_steps(board: Board, skin: Skin, share: float, steps_n: int) -> float:
    """Return the error of dB of a press to `share` of the thickness, from a computation in fine steps."""
    depth_m = share * skin.thickness_m
    _, (found_T,) = changes_of_field(board, skin, np.array([[*PLACE_M, depth_m]]))
    moved = follow_dipoles(skin, PLACE_M, descent(depth_m + skin.depth_zero_m, steps_n))
    return norm_error(found_T, change_of_field((skin.nodes_m, skin.moments_A_m2), moved, board.chips_m))


def symmetries(
    chips_m: Float[np.ndarray, "k 3"], skin: Skin, polarity: Polarity, place_m: Float[np.ndarray, "2"] = PLACE_M
) -> float:
    """Return the error of dB if board, skin and press are turned by a quarter turn, mirrored or shifted together.

    The skin must be exact and its rig rigid. A turn or mirroring swaps the poles of a checkerboard.
    """

    def change(chips_m: Float[np.ndarray, "k 3"], skin: Skin, poke_m: Float[np.ndarray, "3"]) -> Any:
        eyes = np.tile(np.eye(3), (len(chips_m), 1, 1))
        return changes_of_field(Board("bare", chips_m, eyes, eyes, np.zeros_like(chips_m)), skin, poke_m[None])[1][0]

    sign = -1 if polarity == "checkerboard" else 1
    mirror, shift_m = np.diag([-1.0, 1.0, 1.0]), np.array([0.4, -0.7, 0.0]) * milli
    poke_m = np.append(place_m, 0.3 * skin.thickness_m)
    shifted = replace(skin, nodes_m=skin.nodes_m + shift_m, seat_m=skin.seat_m + shift_m[:2])
    here_T = change(chips_m, skin, poke_m)
    return largest(
        scaled_error(change(chips_m @ TURN.T, skin, poke_m @ TURN.T), sign * here_T @ TURN.T),
        scaled_error(change(chips_m @ mirror, skin, poke_m @ mirror), sign * here_T @ mirror),
        scaled_error(change(chips_m + shift_m, shifted, poke_m + shift_m), here_T),
    )


def near(world: World, gap_mm: float) -> float:
    """Return the error of dB of dipoles in cells of half the gap, from a magnetised box, if a uniform skin slides."""
    side_m, thickness_m, slid_m = 20 * milli, world.indented.thickness_m, 0.1 * milli
    j_T = np.array([0.6, -0.3, 1.0]) * world.design.saturation_T
    solid = magpylib.magnet.Cuboid(polarization=j_T, dimension=(side_m, side_m, thickness_m))
    chips_m = np.array([[0.3, -0.2, -gap_mm], [7.1, 0.4, -gap_mm], [9.4, 9.1, -gap_mm]]) * milli
    nodes = place_nodes(thickness_m, Quadrature(0.5 * gap_mm * milli, 6))
    moments = magnet.moments(np.tile(j_T, (len(nodes.nodes_m), 1)), nodes.volumes_m3)
    moved_m, middle_m = nodes.nodes_m + np.array([slid_m, 0.0, 0.0]), np.array([0.0, 0.0, thickness_m / 2])
    found_T = magnet.field(moved_m, moments, chips_m) - magnet.field(nodes.nodes_m, moments, chips_m)
    return norm_error(found_T, solid.getB(chips_m - middle_m - (slid_m, 0.0, 0.0)) - solid.getB(chips_m - middle_m))


def scaled(board: Board, skin: Skin, thickness_m: float) -> float:
    """Return the error of dB, which is unchanged, and of the force / length^2, if all lengths are scaled."""
    scale, hold = thickness_m / skin.thickness_m, skin.hold
    if hold is not None:
        changes = {"lets_go_N": scale**2 * hold.lets_go_N, "springs_N_per_m": scale * hold.springs_N_per_m}
        hold = replace(hold, give_m=(scale * hold.give_m[0], scale * hold.give_m[1]), **changes)
    other = replace(
        skin, nodes_m=scale * skin.nodes_m, moments_A_m2=scale**3 * skin.moments_A_m2, seat_m=scale * skin.seat_m,
        sides_m=(scale * skin.sides_m[0], scale * skin.sides_m[1]), thickness_m=scale * skin.thickness_m,
        tip_radius_m=scale * skin.tip_radius_m, depth_zero_m=scale * skin.depth_zero_m, hold=hold,
    )  # fmt: skip
    poke_m = np.array([[*PLACE_M, 0.45 * skin.thickness_m]])
    _, change_T = changes_of_field(board, skin, poke_m)
    _, other_T = changes_of_field(replace(board, chips_m=board.chips_m * scale), other, scale * poke_m)
    force = relative_error(forces(other, scale * poke_m[:, 2]), scale**2 * forces(skin, poke_m[:, 2]))
    return largest(norm_error(other_T, change_T), force)


def no_stiffness(world: World) -> float:
    """Return the difference in T of dB of a skin with E = 0 from a skin that is not held; inf if its force is not 0."""
    soft, poke_m = world.draw_held(modulus_kPa=0.0), np.array([[*PLACE_M, 0.3 * world.indented.thickness_m]])
    soft_T, free_T = (changes_of_field(world.board, skin, poke_m)[1] for skin in (soft, replace(soft, hold=None)))
    return max_error(soft_T, free_T) if forces(soft, poke_m[:, 2])[0] == 0 else np.inf


def rigid(world: World) -> float:
    """Return the error of dB of a skin with E = 1 GPa, whose tip cannot slip; inf if its force is not clipped."""
    hard, poke_m = world.draw_held(modulus_kPa=1e6), np.array([[*PLACE_M, 0.3 * world.indented.thickness_m]])
    assert hard.hold is not None
    stuck = replace(hard, hold=replace(hard.hold, friction=1e12))
    hard_T, stuck_T = (changes_of_field(world.board, skin, poke_m)[1] for skin in (hard, stuck))
    pushed_N = np.array([[0.0, 0.0, forces(hard, poke_m[:, 2])[0]]])
    read_N, clipped_n = read_force(pushed_N, noise_N=0.0, rng=rng_for(0, "extremes"))
    return max_error(hard_T, stuck_T) if clipped_n == 1 and read_N[0, 2] == FORCE_RANGE_N[2] else np.inf


# A drag -----------------------------------------------------------------------------------------------------------


def lifted_drag(board: Board, skin: Skin) -> float:
    """Return the error of the tangential force, over its first limit, of a tip that is lifted after a drag.

    The layer and the springs of the base are springs in series: 1 / stiffness = 1 / layer + 1 / springs. The force is
    this stiffness times the stretch. The stretch is at most the drag, and at most what friction allowed at each stop.
    """
    assert skin.hold is not None
    held_m, depth, errors = 0.1 * milli, 0.35, []  # the drag; its depth / thickness, the largest of any scene
    for stops_n in (3, 12):
        share = np.append(depth, np.linspace(depth, 0, stops_n + 1))
        way_m = np.append(0.0, np.full(stops_n + 1, held_m))
        path_m = np.column_stack([way_m, np.zeros_like(way_m), share * skin.thickness_m])
        path_m[:, :2] += skin.seat_m
        found = drag_tip(board, skin, path_m[None], tilt=np.zeros((1, 2)), friction=Friction(coefficient=1.0))
        limit_N, indented = forces(skin, path_m[:, 2]), IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
        tables_m = [shear.at_depth(depth_m, **asdict(indented)).stiffness_m for depth_m in path_m[1:-1, 2]]
        layers_N_per_m = shear_moduli_Pa(skin, path_m[1:-1, 2]) * tables_m
        give_m_per_N = 1 / layers_N_per_m + 1 / skin.hold.springs_N_per_m
        reach_m = np.minimum.accumulate(np.minimum(held_m, limit_N[1:-1] * give_m_per_N))
        errors.append(max_error(found.force_N[0, 1:, 0], np.append(reach_m / give_m_per_N, 0.0)) / limit_N[0])
    return largest(*errors)


# Relaxation -------------------------------------------------------------------------------------------------------

STATE = np.array([0.7, -0.2, 0.4])  # state of the relaxation before a time step, one value per relaxation time


def stiff(ratio: float) -> Prony:
    """Return a Prony series with three relaxation times: 1 ms, `ratio` ms, and their geometric mean."""
    return Prony(np.array([1e-3, 1e-3 * np.sqrt(ratio), 1e-3 * ratio]), np.array([0.3, 0.2, 0.1]))


def relaxation_step(dt_s: float, prony: Prony) -> float:
    """Return the error of one time step of the relaxation, from its formula with 50 digits."""
    with mpmath.workdps(50):
        truth = []
        for q, tau, share in zip(STATE.tolist(), prony.tau_s.tolist(), prony.share.tolist(), strict=True):
            x = mpmath.mpf(dt_s) / mpmath.mpf(tau)
            mean = (1 - mpmath.exp(-x)) / x
            truth.append(float(mpmath.exp(-x) * mpmath.mpf(q) + mpmath.mpf(share) * mpmath.mpf(1.3) * mean))
    return scaled_error(advance(STATE, 1.3, dt_s, prony), np.array(truth))


def stiff_relaxation(ratios: tuple[float, ...], steps: tuple[float, ...]) -> float:
    return largest(*(relaxation_step(1e-3 * dt, stiff(ratio)) for ratio, dt in product(ratios, steps)))


# The list ---------------------------------------------------------------------------------------------------------

BASES: tuple[layer.Base, ...] = ("bonded", "slipping")
DEPTH_SHARES = np.arange(1, 7) / 10  # depths / thickness; the published fits end at 0.6


def _with_base(world: World, base: layer.Base) -> IndentedLayer:
    return replace(world.indented, base=base)


def _with_tip(base: layer.Base, size: float) -> float:
    """Return the error of the force of a tip whose radius is `size` times the thickness."""
    indented = IndentedLayer(2 * milli, 2 * milli * size, base)
    return rings(0.4 * min(indented.thickness_m, indented.tip_radius_m), indented)


def _deep(world: World, base: layer.Base) -> tuple[IndentedLayer, float]:
    return _with_base(world, base), DEEP * world.indented.thickness_m


def _fit_depths_m(world: World) -> Float[np.ndarray, " n"]:
    return DEPTH_SHARES * world.indented.thickness_m


def _rigid_rig(world: World) -> Skin:
    """Return the skin on a rig that does not yield; a rig that yields more along x than along y breaks the symmetry."""
    hold = world.design.hold
    return world.draw(hold=None if hold is None else hold.model_copy(update={"give_um": (0.0, 0.0)}))


_law = partial(Case, "physics")


def _deformation(base: layer.Base) -> tuple[Case, ...]:
    def deep(error: Callable[[IndentedLayer, float], float]) -> Callable[[World], float]:
        return lambda world: error(*_deep(world, base))

    case, pressed = partial(_law, full=base == "bonded"), f"{base} layer pressed to {DEEP:g} of its thickness"
    differences = "The error of central differences is (step / length)^2, the length over which strains change."
    return (
        case(f"volume_{base}", f"{pressed} in steps: volume", "det F = 1 (deformation gradient F)",
             deep(lambda *of: finite_steps(*of)[0]), 0.02,
             "The error is of second order in the steps, and largest at the edge of the contact."),
        case(f"gradient_{base}", f"{pressed} in steps: F", "central differences with steps of 0.1 um",
             deep(lambda *of: finite_steps(*of)[1]), 1e-5, differences),
        case(f"surface_{base}", f"{pressed}: surface at the tip", "a sphere, which the surface does not enter",
             deep(surface), 0.02, "In each step, the pressure is a sum of only six basis pressures.",
             unit="of the depth"),
    )  # fmt: skip


CASES: tuple[Case, ...] = (
    _law("box_outside", "field of a box, 0.9 to 50 sides from its centre", "magpylib Cuboid",
         lambda w: box(box_places_m(w.seed, 0.5 * milli)[0]), 2e-9,
         "The terms of the eight corners are about 1 and sum to 8e-6 at 50 sides. Each of both programs makes rounding "
         "errors of a few 1e-15 in this sum."),
    _law("box_inside", "field inside a box", "magpylib Cuboid",
         lambda w: box(box_places_m(w.seed, 0.5 * milli)[1]), 1e-12,
         "In magpylib's logarithms near an edge, almost equal numbers are subtracted: rounding errors grow 2e4-fold."),
    _law("array", "field of the magnets that magnetise the skin", "32 magpylib Cuboids",
         lambda w: array(place_nodes(w.indented.thickness_m, Quadrature(1.5e-3, 3)).nodes_m, w.indented.thickness_m,
                         w.design.polarity), 1e-12,
         "Rounding errors are increased where cubes meet, because their contributions almost cancel there."),
    _law("maxwell", "div B = 0 and curl B = 0 in the skin", "central differences",
         lambda w: maxwell(w.indented.thickness_m, w.design.polarity, w.seed), 1e-4,
         "Central differences have a relative error of (step / distance to a magnet)^2, at most (1/250)^2."),
    _law("dipoles", "field of dipoles", "magpylib Dipole", lambda w: dipoles(w.seed)[0], 1e-8, MU_0),
    _law("dipoles_moved", "change of the field if dipoles move and turn", "magpylib Dipole, field after minus before",
         lambda w: dipoles(w.seed)[1], 1e-7, f"{MU_0} The change is a tenth of the fields."),
    *(_law(f"compliance_{base}", f"{base} layer: compliance for wave number * thickness from 0.01 to 30",
           "the four boundary conditions with 50 digits (mpmath)",
           partial(lambda base, _: compliance(np.geomspace(0.01, 30, 12), base), base), limit,
           reason)
      for base, limit, reason in (
          ("bonded", 3e-12, "Just above 1/4, almost equal numbers are subtracted, so that 3 of 16 digits are lost."),
          ("slipping", 1e-12, "For long waves, almost equal numbers are subtracted."))),
    *(_law(f"hertz_{base}", f"force of a thick {base} layer at depths up to 1e-5 of the tip radius",
           "16/9 E sqrt(R) d^1.5 (Hertz 1882)", partial(lambda base, w: hertz(w.indented.tip_radius_m, base), base),
           1e-4, "Hertz takes the sphere as a paraboloid (d / R = 1e-5); the force is interpolated by a spline.")
      for base in BASES),
    _law("sneddon", "force and depth of a sphere in a thick layer, contact radius up to 0.7 of the tip radius",
         "Sneddon 1965", lambda w: sneddon(w.indented.tip_radius_m, "bonded"), 1e-4,
         "The finite thickness h changes the result by contact radius / h, which is below 2e-5."),
    _law("long_2011", "force of a bonded layer, depths up to 0.6 of the thickness", "Long et al. 2011",
         lambda w: long_2011(_fit_depths_m(w), _with_base(w, "bonded")), 0.05,
         "The reference is a fit to finite-element simulations of large deformations."),
    *(_law(f"rings_{base}_{size:g}", f"force of a {base} layer, tip radius {size:g} times the thickness",
           f"{RINGS_N} rings of pressure", partial(lambda base, size, _: _with_tip(base, size), base, size), 1e-3,
           "The pressure is uniform on each ring, and waves shorter than a ring is wide are omitted.",
           full=(base, size) != ("slipping", 1.0))
      for base, size in product(BASES, (0.1, 1.0, 10.0))),
    _law("sticking", "tangential stiffness of a thick layer under a tip that sticks",
         "16/3 * shear modulus * contact radius (Mindlin 1949)", lambda w: sticking(0.1 * w.indented.tip_radius_m),
         1e-3, "The integral over the contact is computed as a sum."),
    _law("sliding", "tangential stiffness of a thick layer under a tip that slides",
         "40/9 * shear modulus * contact radius (Cerruti, Hertz's pressure)",
         lambda w: sliding(0.1 * w.indented.tip_radius_m, w.indented.tip_radius_m, w.indented.base), 2e-3,
         "Hertz takes the sphere as a paraboloid, which changes the pressure a little."),
    *_deformation("slipping"), *_deformation("bonded"),
    _law("far_field", "slipping layer, far from the tip: growth of the squared distance r^2",
         "volume of the dent / (pi * thickness), at all heights and distances",
         lambda w: far_field(*_deep(w, "slipping")), 0.01,
         "The volume is not conserved exactly near the edge of the contact, as in case volume_slipping."),
    *(_law(f"depth_{share:g}", f"dB of a press to {share:g} of the thickness",
           "dB in finer steps, without tables, rotations by SVD",
           partial(lambda share, w: in_fine_steps(w.board, w.skin, share, round(40 * share)), share), 0.02,
           "A total error of 2 % is accepted for the field change of a press.", full=share < slide.DEEPEST)
      for share in (0.1, 0.3, 0.6, 0.66, slide.DEEPEST)),
    _law("symmetries", "dB if board, skin and press are turned, mirrored or shifted together",
         "dB turned, mirrored or unchanged; negated if the poles of a checkerboard are swapped",
         lambda w: symmetries(w.board.chips_m, _rigid_rig(w), w.design.polarity), 1e-9, ROUNDING),
    *(_law(f"gap_{gap_mm:g}mm", f"dB at chips {gap_mm:g} mm under a skin that slides by 0.1 mm",
           "a magnetised box (magpylib)", partial(near, gap_mm=gap_mm), 0.03,
           "Dipoles in cells of half the gap represent the skin.", full=gap_mm < 0.4)
      for gap_mm in (1.1, 0.4, 0.2)),
    *(_law(f"thickness_{size_mm:g}mm", f"a skin of {size_mm:g} mm thickness, all other lengths scaled too",
           "dB unchanged, force proportional to length squared",
           partial(lambda size_mm, w: scaled(w.board, w.skin, size_mm * milli), size_mm), 1e-6,
           "The contact radius is the result of a root search.")
      for size_mm in (0.2, 20.0)),
    _law("no_stiffness", "force and dB of a skin with E = 0", "no force, dB only from the layer's deformation",
         no_stiffness, 0.0, "Exact.", unit="T"),
    _law("rigid", "dB of a skin with E = 1 GPa, whose force is clipped to the sensor's range",
         "dB as if the tip cannot slip", rigid, 0.0, "Exact.", unit="T"),
    _law("lifted_drag", "tangential force of a tip that drags the skin and is lifted in 3 and in 12 stops",
         "limited by the springs and by the smallest friction limit so far; 0 at the end",
         lambda w: lifted_drag(w.board, w.draw_held()), 1e-9, ROUNDING),
    _law("stiff_relaxation", "one time step of the relaxation, tau_max / tau_min 1e8, dt / tau_min 1e-16 to 1e8",
         "the same formula with 50 digits (mpmath)",
         lambda _: stiff_relaxation((1e3, 1e8), (1e-16, 1e-9, 1e-3, 1.0, 40.0, 1e8)), 1e-14,
         "Only the rounding errors of a few dozen operations occur."),
)  # fmt: skip
