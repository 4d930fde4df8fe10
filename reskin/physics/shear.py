"""A dragged tip: Coulomb friction along its path, and the shear of the elastic layer under it. SI units."""

from dataclasses import dataclass
from functools import lru_cache
from math import sqrt
from typing import Annotated, no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from pydantic import Field
from scipy.special import j0, j1

from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.physics import deformation, layer


class Friction(Strict):
    """Section `terms.friction`: Coulomb friction between tip and skin."""

    coefficient: Annotated[float, Field(ge=0, le=10)]


@dataclass(frozen=True)
class DragForce:
    """Tangential force at each place of a path; the rest position of the material under the tip is path - elastic."""

    force_N: Float[np.ndarray, "t 2"]  # on the skin, so along the tip's motion
    elastic_m: Float[np.ndarray, "t 2"]
    sliding: Bool[np.ndarray, " t"]


def drag_force(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    *,
    stiffness_N_per_m: Float[np.ndarray, "t 2 2"] | Float[np.ndarray, " t"] | float,
    friction: float,
) -> DragForce:
    """Return the friction force along the path of a tip that first touches at `path_m[0]`.

    Return mapping (Simo & Hughes 1998): an elastic trial step, whose force is scaled back radially to Coulomb's disc
    |Q| <= mu F by slip. A step sticks or slides only if both its ends are in contact; otherwise the spring is released,
    because the place where the tip lifted or touched is unknown.

    Parameters
    ----------
    path_m : places of the tip.
    normal_N : normal force at each place; 0 is no contact.
    stiffness_N_per_m : tangential stiffness: a number, one per place, or symmetric matrices for anisotropic skins.
    friction : coefficient mu.
    """
    stiffness = np.asarray(stiffness_N_per_m, dtype=float)
    if stiffness.ndim < 3:
        stiffness = np.where(np.eye(2, dtype=bool), np.broadcast_to(stiffness, normal_N.shape)[:, None, None], 0.0)
    _check_drag(path_m, normal_N, stiffness, friction)
    limit_N, touching = friction * normal_N, normal_N > 0
    force_N, elastic_m = np.zeros(path_m.shape), np.zeros(path_m.shape)
    sliding = np.zeros(len(path_m), dtype=bool)
    for now in range(1, len(path_m)):
        if not (touching[now] and touching[now - 1]):
            continue
        trial_m = elastic_m[now - 1] + path_m[now] - path_m[now - 1]
        trial_N = np.hypot(*(stiffness[now] @ trial_m))
        sliding[now] = trial_N > limit_N[now]
        elastic_m[now] = trial_m * (limit_N[now] / trial_N) if sliding[now] else trial_m
        force_N[now] = stiffness[now] @ elastic_m[now]
    return DragForce(force_N, elastic_m, sliding)


def _check_drag(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    stiffness: Float[np.ndarray, "t 2 2"],
    friction: float,
) -> None:
    if not np.isfinite(path_m).all():
        raise ParamsError("drag", "every place", "finite", "NaN or infinity", "Correct the path.")
    along = np.diagonal(stiffness, axis1=1, axis2=2)
    for what, unit, values in (("normal force", "N", normal_N), ("stiffness", "N/m", along)):
        if not (np.isfinite(values) & (values >= 0)).all():
            worst = values[~(np.isfinite(values) & (values >= 0))][0]
            raise ParamsError("drag", what, f"0 {unit} or more and finite", f"{worst}", "Check its sign.")
    if not 0 <= friction < np.inf:
        raise ParamsError("drag", "friction", "0 or more and finite", f"{friction}", "Check the scene.")


REACH = 5.0  # in thicknesses beyond the contact, as in `deformation`: material farther away does not move
WIDEST = 3.0  # largest contact radius in thicknesses; `layer.WAVES_KH` does not sample the waves of larger contacts
RIM_MAX = 1.2  # of the thickness, as in `deformation`; a rim above the thickness moves like the surface
STEP = 0.75  # largest half curl per step: on the nominal skin, one step suffices to 0.6 mm with mu 0.8
STEEPEST = 1.5  # largest half curl that was compared with finer steps: mu 0.8 at 1.2 mm
TABLE_R_N, TABLE_Z_N = 512, 80  # fine enough for linear interpolation
DEPTH_STEP_M = 10e-6  # between tabulated depths; stiffness changes by 1 % per step, dB by 0.1 uT


@dataclass(frozen=True)
class Traction:
    """An axisymmetric tangential traction, as weights of its transform: q^(k) / Q = sum of weights * cos(k x)."""

    radius_m: float
    x_m: Float[np.ndarray, " q"]
    weights: Float[np.ndarray, " q"]  # sum 1


@dataclass(frozen=True)
class WaveResponse:
    """Response of the layer to a wave of tangential traction T as a function of kz; primes are derivatives in kz.

    In the plane of the wave, the displacement in units of T / 2Gk is w' along the wave and -i w upwards; across the
    wave, it is v in units of T / Gk.
    """

    w: Float[np.ndarray, "z k"]
    w_slope: Float[np.ndarray, "z k"]
    w_spin: Float[np.ndarray, "z k"]  # w'' - w
    v: Float[np.ndarray, "z k"]
    v_slope: Float[np.ndarray, "z k"]


@dataclass(frozen=True)
class ShearMap:
    """Displacement and half curl at (r, z) for a force Q along x, divided by Q / G; equal steps in r and in z.

    Parts A, B, C in 1/m: displacement A + B cos 2f, B sin 2f, C cos f along x, y, z at the angle f from x.
    Parts D, E, S in 1/m^2: half curl -E sin 2f, D + E cos 2f, S sin f.
    """

    r_m: Float[np.ndarray, " i"]
    z_m: Float[np.ndarray, " j"]
    parts: Float[np.ndarray, "i j 6"]
    stiffness_m: float  # k_t / G
    steepest_per_m2: float  # the largest half curl


@dataclass(frozen=True)
class ShearDisplacement:
    """Displacement of each node, and half of its curl, which is the rotation vector for small rotations."""

    displacement_m: Float[np.ndarray, "s 3"]
    half_curl: Float[np.ndarray, "s 3"]


def slip_traction(contact: layer.Contact) -> Traction:
    """Return the traction of a sliding tip: Coulomb's q = mu p, which has the shape of the pressure.

    It is used for a whole drag, which slides except for its first millimetre or two. Its k_t is below that of
    `stick_traction` by 19 to 20 % on the nominal skin at 0.2 to 1.2 mm, and by 1/6 on a thick layer.
    """
    return Traction(contact.radius_m, contact.x_m, contact.weights_m2 / contact.weights_m2.sum())


def stick_traction(radius_m: float, thickness_m: float) -> Traction:
    """Return the traction of a sticking tip: the axisymmetric traction that moves the contact rigidly, apart from B.

    chi - K chi = 1 (see `layer.contact_of_radius`). For a thick layer chi is constant, which is Mindlin's traction
    (a^2 - r^2)^(-1/2).
    """
    x_m, weights_m = radius_m * layer.CONTACT_X, radius_m * layer.CONTACT_W
    kernel = _kernel(x_m, thickness_m) * weights_m
    chi = np.linalg.solve(np.eye(len(x_m)) - kernel, np.ones_like(x_m))
    return Traction(radius_m, x_m, weights_m * chi / (weights_m @ chi))


def tangential_stiffness_m(traction: Traction, thickness_m: float) -> float:
    """Return k_t / G: the force divided by the mean displacement along it, weighted with the traction, as for work.

    By Parseval's theorem it is 8 pi / integral of q^2 (w' + 2v) dk at the surface; the part for a half-space, with 3
    for the bracket, is in closed form.
    """
    chi = traction.weights / (traction.radius_m * layer.CONTACT_W)
    held = _kernel(traction.x_m, thickness_m) @ traction.weights
    return float(16 / 3 / (traction.weights @ (chi - held)))


@lru_cache(maxsize=32)
def tabulate_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: layer.Base) -> ShearMap:
    """Tabulate the shear under a tip that slides at this depth, out to the reach at the deepest verified depth.

    `base` affects only the contact. Sideways the base is always fixed; otherwise no force could act on the layer.
    """
    layer.check_layer(np.array([depth_m]), thickness_m, tip_radius_m)
    if not depth_m > 0:
        raise ParamsError("drag", "depth", "above 0 m", f"{depth_m}", "Press deeper.")
    contact = layer.contact_of_depth(depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
    reach_m = thickness_m * deformation.reach(tip_radius_m / thickness_m, base)
    return tabulate(slip_traction(contact), thickness_m, reach_m)


def at_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: layer.Base) -> ShearMap:
    """Interpolate the map linearly between tabulated depths, so that it is continuous in the depth.

    Below the first tabulated depth (`DEPTH_STEP_M`), where the force is close to zero, it is the map of that depth.
    """
    at = max(depth_m / DEPTH_STEP_M, 1.0)
    first, share = int(at), at - int(at)
    low, high = (
        tabulate_depth(DEPTH_STEP_M * i, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
        for i in (first, first + 1)
    )
    return ShearMap(
        low.r_m,
        low.z_m,
        low.parts + share * (high.parts - low.parts),
        low.stiffness_m + share * (high.stiffness_m - low.stiffness_m),
        low.steepest_per_m2 + share * (high.steepest_per_m2 - low.steepest_per_m2),
    )


def tabulate(traction: Traction, thickness_m: float, reach_m: float | None = None) -> ShearMap:
    """Tabulate the shear due to a traction, by default to `REACH` thicknesses beyond the contact."""
    if not 0 < traction.radius_m <= WIDEST * thickness_m < np.inf:
        rule, got = f"above 0 m and at most {WIDEST} thicknesses", f"{traction.radius_m} m on {thickness_m} m"
        raise ParamsError("drag", "contact radius", rule, got, "Press less deep.")
    if reach_m is None:
        reach_m = traction.radius_m + REACH * thickness_m
    r_m = np.linspace(0, reach_m, TABLE_R_N)
    z_m = np.linspace(0, thickness_m, TABLE_Z_N)
    parts = evaluate_map(traction, r_m, z_m, thickness_m=thickness_m)
    parts[:, 0, :3] = 0.0  # the base is fixed, but the material on it shears and therefore rotates
    d, e, s = np.moveaxis(parts[..., 3:], 2, 0)
    # Values at f = 0 and 90 degrees; in between it is smaller.
    steepest_per_m2 = max(np.abs(d + e).max(), np.hypot(d - e, s).max())
    return ShearMap(r_m, z_m, parts, tangential_stiffness_m(traction, thickness_m), float(steepest_per_m2))


def evaluate_map(
    traction: Traction, r_m: Float[np.ndarray, " i"], z_m: Float[np.ndarray, " j"], *, thickness_m: float
) -> Float[np.ndarray, "i j 6"]:
    """Return the parts of `ShearMap` on a grid: Hankel integrals with J0, J2, J1, as matrix products.

    A traction q along x has the components q cos f along a wave of direction f and -q sin f across it; the integrals
    over f are Bessel functions.
    """
    k_per_m = layer.WAVES_KH / thickness_m
    window = np.cos(np.pi * np.maximum(layer.WAVES_KH / layer.WAVES_KH[-1] - 0.5, 0)) ** 2  # avoids ringing
    waves = np.cos(np.outer(k_per_m, traction.x_m)) @ traction.weights * window
    of = waves * layer.WAVES_W / thickness_m / (8 * np.pi)
    at = wave_response(np.outer(z_m, k_per_m), layer.WAVES_KH)
    kr = np.outer(r_m, k_per_m)
    bessel0, bessel1 = j0(kr), j1(kr)
    bessel2 = np.where(kr > 0, 2 * bessel1 / np.where(kr > 0, kr, 1.0) - bessel0, 0.0)
    products = (
        (bessel0, of * (2 * at.v + at.w_slope)),
        (bessel2, of * (2 * at.v - at.w_slope)),
        (bessel1, of * 2 * at.w),
        (bessel0, of * k_per_m * (2 * at.v_slope + at.w_spin) / 2),
        (bessel2, of * k_per_m * (2 * at.v_slope - at.w_spin) / 2),
        (bessel1, of * k_per_m * 2 * at.v),
    )
    return np.stack([bessel @ profile.T for bessel, profile in products], axis=2)


def wave_response(kz: Float[np.ndarray, "z k"], kh: Float[np.ndarray, " k"]) -> WaveResponse:
    """Return the response of the layer, fixed at its base, to a wave of tangential traction on top.

    w = [A z' cosh t - t cosh A sinh z'] / (cosh^2 A + A^2), v = sinh z' / cosh A, A = kh, z' = kz, t = A - z': the W of
    `layer` with W''' = 3 W' at the top. Numerators and denominators are divided by exp(2A) / 4, so that no exponent is
    positive inside the layer.
    """
    t = kh - kz
    top, low, high = np.exp(-t), np.exp(-2 * kz), np.exp(-2 * t)
    base = np.exp(-2 * kh)
    size = (1 + base) ** 2 + 4 * kh**2 * base
    near, far = (1 + base) / size * top, 2 * kh / size * np.exp(-kh - kz)
    return WaveResponse(
        w=far * kz * (1 + high) - near * t * (1 - low),
        w_slope=far * (1 + high - kz * (1 - high)) + near * (1 - low - t * (1 + low)),
        w_spin=2 * near * (1 + low) - 2 * far * (1 - high),
        v=top * (1 - low) / (1 + base),
        v_slope=top * (1 + low) / (1 + base),
    )


def shear_displacement(
    of: ShearMap,
    places_m: Float[np.ndarray, "s 3"],
    centre_m: Float[np.ndarray, "2"],
    *,
    force_N: Float[np.ndarray, "2"],
    modulus_Pa: float,
) -> ShearDisplacement:
    """Return the linear displacement and half curl due to a force around `centre_m`; the modulus is Young's, 3 G."""
    lowest_m, highest_m = places_m[:, 2].min(initial=0.0), places_m[:, 2].max(initial=0.0)
    if not (0 <= lowest_m and highest_m <= RIM_MAX * of.z_m[-1]):
        rule, got = f"0 to {RIM_MAX} of the thickness", f"{lowest_m:.3g} to {highest_m:.3g} m"
        raise ParamsError("drag", "height of nodes", rule, got, "Press less deep.")
    shear_m2 = _over_modulus(force_N, modulus_Pa)
    return ShearDisplacement(*_at_places(of.parts, (of.r_m[1], of.z_m[1]), places_m, centre_m, shear_m2))


def shear_in_steps(
    of: ShearMap,
    places_m: Float[np.ndarray, "s 3"],
    centre_m: Float[np.ndarray, "2"],
    *,
    force_N: Float[np.ndarray, "2"],
    modulus_Pa: float,
) -> ShearDisplacement:
    """Return the finite shear of nodes that `deformation` has moved, in midpoint steps.

    `centre_m` is the rest position of the material under the tip, where `deformation` is centred too: the tip's place
    minus Q / k_t (`DragForce.elastic_m`). With mu 0.8, dB differs from that with 24 steps by up to 1.2 % down to 0.8 mm
    and 3 % at 1.2 mm; with a single `shear_displacement` of the nodes at rest, by 13 to 90 %.
    """
    shear_m2 = _over_modulus(force_N, modulus_Pa)
    steepest = of.steepest_per_m2 * float(np.hypot(*shear_m2))
    if not steepest <= STEEPEST:
        rule, remedy = f"at most {STEEPEST} anywhere", "Drag with less friction, or less far before it slips."
        raise ParamsError("drag", "half of the curl", rule, f"{steepest:.3g}", remedy)
    steps_n = max(1, int(np.ceil(steepest / STEP)))
    part_N, ahead_m = force_N / steps_n, shear_m2 / of.stiffness_m / steps_n
    moved_m, half_curl = np.zeros_like(places_m), np.zeros_like(places_m)
    for step_i in range(steps_n):
        at_m, there_m = places_m + moved_m, centre_m + step_i * ahead_m
        first = shear_displacement(of, at_m, there_m, force_N=part_N, modulus_Pa=modulus_Pa)
        half_m = at_m + first.displacement_m / 2
        middle = shear_displacement(of, half_m, there_m + ahead_m / 2, force_N=part_N, modulus_Pa=modulus_Pa)
        moved_m += middle.displacement_m
        half_curl += middle.half_curl  # additive in simple shear, like F
    return ShearDisplacement(moved_m, half_curl)


def rotation_from_curl(half_curl: Float[np.ndarray, "s 3"]) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s 3"]]:
    """Return angle and axis of R in F = R U: the arc tangent of the half curl, exact in plane strain."""
    size = np.sqrt((half_curl**2).sum(axis=1))
    axis = half_curl / np.where(size > 0, size, 1.0)[:, None]
    axis[size == 0] = (1.0, 0.0, 0.0)  # without rotation, any axis will do
    return np.arctan(size), axis


def _over_modulus(force_N: Float[np.ndarray, "2"], modulus_Pa: float) -> Float[np.ndarray, "2"]:
    if not 0 < modulus_Pa < np.inf:
        raise ParamsError("drag", "modulus", "above 0 Pa and finite", f"{modulus_Pa}", "Drag a solid skin.")
    return force_N * (3 / modulus_Pa)  # incompressible: G = E / 3


@njit(cache=True, fastmath=False)
@no_type_check
def _at_places(parts, steps, places, centre, force):
    # Bilinear interpolation of the parts, then combined for the direction of the force.
    r_n, z_n, _ = parts.shape
    moved, half_curl = np.zeros_like(places), np.zeros_like(places)
    at, (fx, fy) = np.empty(6), force
    for i in range(len(places)):
        x, y = places[i, 0] - centre[0], places[i, 1] - centre[1]
        r = sqrt(x * x + y * y)
        at_r, at_z = r / steps[0], min(places[i, 2] / steps[1], z_n - 1.0)
        if at_r >= r_n - 1:
            continue  # out of reach
        j, k = int(at_r), min(int(at_z), z_n - 2)
        share_r, share_z = at_r - j, at_z - k
        for p in range(6):
            near = parts[j, k, p] + share_z * (parts[j, k + 1, p] - parts[j, k, p])
            far = parts[j + 1, k, p] + share_z * (parts[j + 1, k + 1, p] - parts[j + 1, k, p])
            at[p] = near + share_r * (far - near)
        a, b, c, d, e, s = at
        # On the axis, the parts that depend on the direction are zero, so any direction will do.
        cos, sin = (x / r, y / r) if r > 0 else (1.0, 0.0)
        along, across = fx * cos + fy * sin, fx * sin - fy * cos
        twice_x, twice_y = 2 * along * cos - fx, 2 * along * sin - fy
        moved[i, 0], moved[i, 1], moved[i, 2] = a * fx + b * twice_x, a * fy + b * twice_y, c * along
        half_curl[i, 0], half_curl[i, 1], half_curl[i, 2] = -d * fy - e * twice_y, d * fx + e * twice_x, s * across
    return moved, half_curl


def _kernel(x_m: Float[np.ndarray, " q"], thickness_m: float) -> Float[np.ndarray, "q q"]:
    # 2/pi times the integral of (1 - (w' + 2v) / 3) cos(k x) cos(k x') dk: the effect of the base, relative to the 3 of
    # a half-space.
    at = wave_response(layer.KERNEL_KH[None], layer.KERNEL_KH)
    missing = layer.KERNEL_W / thickness_m * (1 - (at.w_slope[0] + 2 * at.v[0]) / 3)
    waves = np.cos(np.outer(x_m, layer.KERNEL_KH / thickness_m))
    return 2 / np.pi * (waves * missing) @ waves.T
