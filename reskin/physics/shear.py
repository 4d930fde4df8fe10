"""Friction on a tip that is dragged over the skin, and the resulting shear of the elastic layer. SI units."""

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
    """Section `terms.friction` of the settings: Coulomb friction between tip and skin."""

    coefficient: Annotated[float, Field(ge=0, le=10)]


@dataclass(frozen=True)
class DragForce:
    """Tangential force at each of t places of a tip's path."""

    force_N: Float[np.ndarray, "t 2"]  # force on the skin, in the direction of the tip's motion
    elastic_m: Float[np.ndarray, "t 2"]  # place of the tip minus the rest position of the material under the tip
    sliding: Bool[np.ndarray, " t"]


def drag_force(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    *,
    stiffness_N_per_m: Float[np.ndarray, "t 2 2"] | Float[np.ndarray, " t"] | float,
    friction: float,
) -> DragForce:
    """Return the friction force along the path of a tip that touches down at `path_m[0]`.

    The method is return mapping (Simo & Hughes 1998): each step of the path is first assumed to be elastic. If the
    resulting force exceeds Coulomb's limit mu F, the tip slides and the force is reduced to the limit. After a step
    that begins or ends without contact, the force is zero, because the place where the tip lifted off or touched down
    is unknown.

    Parameters
    ----------
    path_m : places of the tip.
    normal_N : normal force at each place; 0 means no contact.
    stiffness_N_per_m : tangential stiffness: one number, one number per place, or one symmetric matrix per place.
    friction : friction coefficient mu.
    """
    stiffness = np.asarray(stiffness_N_per_m, dtype=float)
    if stiffness.ndim < 3:
        stiffness = np.where(np.eye(2, dtype=bool), np.broadcast_to(stiffness, normal_N.shape)[:, None, None], 0.0)
    _check_drag(path_m, normal_N, stiffness, friction)
    limit_N, in_contact = friction * normal_N, normal_N > 0
    force_N, elastic_m = np.zeros(path_m.shape), np.zeros(path_m.shape)
    sliding = np.zeros(len(path_m), dtype=bool)
    for now in range(1, len(path_m)):
        if not (in_contact[now] and in_contact[now - 1]):
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


REACH = 5.0  # tables extend this far beyond the contact, in thicknesses; material farther away does not move
WIDEST = 3.0  # largest contact radius in thicknesses; `layer.WAVES_KH` is too coarse for larger contacts
RIM_MAX = 1.2  # largest height of the rim in thicknesses, as in `deformation`; nodes in the rim move like the surface
STEP = 0.75  # largest rotation (half the curl) per integration step; for mu = 0.8, one step suffices down to 0.6 mm
STEEPEST = 1.5  # largest rotation for which the step size was verified (mu = 0.8 at a depth of 1.2 mm)
TABLE_R_N, TABLE_Z_N = 512, 80  # numbers of radii and heights in a table; fine enough for linear interpolation
DEPTH_STEP_M = 10e-6  # step between tabulated depths, over which the stiffness changes by 1 % and dB by 0.1 uT


@dataclass(frozen=True)
class Traction:
    """An axisymmetric tangential traction with total force Q, given by its Hankel transform.

    The transform is Q sum_i weights_i cos(k x_i).
    """

    radius_m: float
    x_m: Float[np.ndarray, " q"]
    weights: Float[np.ndarray, " q"]  # their sum is 1


@dataclass(frozen=True)
class WaveResponse:
    """Displacement of the layer due to a wave of tangential traction T, as a function of wave number k times height z.

    If T is along the wave vector, the displacement in units of T / 2Gk is w' along the wave vector and -i w upwards. If
    T is across the wave vector, the displacement in units of T / Gk is v in the direction of T. Primes are derivatives
    with respect to kz. G is the shear modulus.
    """

    w: Float[np.ndarray, "z k"]
    w_slope: Float[np.ndarray, "z k"]
    w_spin: Float[np.ndarray, "z k"]  # w'' - w
    v: Float[np.ndarray, "z k"]
    v_slope: Float[np.ndarray, "z k"]


@dataclass(frozen=True)
class ShearMap:
    """Displacement due to a force Q along x, and half of its curl, on a grid with equal steps in r and in z.

    All values are divided by Q / G, where G is the shear modulus. At the angle f from the x axis, the components along
    x, y and z are A + B cos 2f, B sin 2f and C cos f for the displacement, and -E sin 2f, D + E cos 2f and S sin f for
    the half curl. The last axis of `parts` is A, B, C in 1/m and D, E, S in 1/m^2.
    """

    r_m: Float[np.ndarray, " i"]
    z_m: Float[np.ndarray, " j"]
    parts: Float[np.ndarray, "i j 6"]
    stiffness_m: float  # tangential stiffness divided by G
    steepest_per_m2: float  # largest half curl in the map, divided by Q / G


@dataclass(frozen=True)
class ShearDisplacement:
    """Displacement of each node, and half of the curl of the displacement, which is the vector of a small rotation."""

    displacement_m: Float[np.ndarray, "s 3"]
    half_curl: Float[np.ndarray, "s 3"]


def slip_traction(contact: layer.Contact) -> Traction:
    """Return the traction q of a sliding tip, which is proportional to the pressure p (Coulomb's law: q = mu p).

    This traction is used at all stops of a drag, because the tip slides from the first one or two millimetres on. With
    it, the tangential stiffness is lower than with `stick_traction`: by 19 to 20 % on the nominal skin at depths of 0.2
    to 1.2 mm, and by 1/6 on a thick layer.
    """
    return Traction(contact.radius_m, contact.x_m, contact.weights_m2 / contact.weights_m2.sum())


def stick_traction(radius_m: float, thickness_m: float) -> Traction:
    """Return the axisymmetric traction that displaces the whole contact by the same amount, as a sticking tip does.

    The term B of `ShearMap`, which makes the displacement non-uniform, is neglected. The Hankel transform of the
    traction is the integral of chi(x) cos(kx) dx over the contact, as in `layer.contact_of_radius`. The function chi is
    the solution of chi - K chi = 1, with the kernel K from `_kernel`. For a thick layer, K is zero and chi is constant.
    The traction is then proportional to (a^2 - r^2)^(-1/2), with the contact radius a (Mindlin's solution).
    """
    x_m, weights_m = radius_m * layer.CONTACT_X, radius_m * layer.CONTACT_W
    kernel = _kernel(x_m, thickness_m) * weights_m
    chi = np.linalg.solve(np.eye(len(x_m)) - kernel, np.ones_like(x_m))
    return Traction(radius_m, x_m, weights_m * chi / (weights_m @ chi))


def tangential_stiffness_m(traction: Traction, thickness_m: float) -> float:
    """Return the tangential stiffness k_t of the layer, divided by the shear modulus G.

    k_t is the force divided by the mean displacement along the force; the traction is the weight of this mean.
    According to Parseval's theorem, k_t / G = 8 pi / I, where I is the integral of q(k)^2 (w' + 2v) dk. Here q(k) is
    the Hankel transform of the traction for a force of 1, and w' and v are those of `WaveResponse` at the surface. For
    a half-space, w' + 2v is 3 and I has a closed form. The effect of the base is subtracted from this form (see
    `_kernel`).
    """
    chi = traction.weights / (traction.radius_m * layer.CONTACT_W)
    base_effect = _kernel(traction.x_m, thickness_m) @ traction.weights
    return float(16 / 3 / (traction.weights @ (chi - base_effect)))


@lru_cache(maxsize=32)
def tabulate_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: layer.Base) -> ShearMap:
    """Tabulate the shear of the layer under a tip that slides at this depth, for radii up to `deformation.reach`.

    `base` affects only the contact. For the shear, the base is always fixed sideways, because a layer that slips freely
    cannot be sheared.
    """
    layer.check_layer(np.array([depth_m]), thickness_m, tip_radius_m)
    if not depth_m > 0:
        raise ParamsError("drag", "depth", "above 0 m", f"{depth_m}", "Press deeper.")
    contact = layer.contact_of_depth(depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
    reach_m = thickness_m * deformation.reach(tip_radius_m / thickness_m, base)
    return tabulate(slip_traction(contact), thickness_m, reach_m)


def at_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: layer.Base) -> ShearMap:
    """Return the shear map at a depth, by linear interpolation between tabulated depths.

    Below the first tabulated depth (`DEPTH_STEP_M`), the force is almost zero, and the map of the first tabulated depth
    is used.
    """
    steps = max(depth_m / DEPTH_STEP_M, 1.0)
    first, share = int(steps), steps - int(steps)
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
    """Tabulate the shear of the layer due to a traction, by default up to `REACH` thicknesses beyond the contact."""
    if not 0 < traction.radius_m <= WIDEST * thickness_m < np.inf:
        rule, got = f"above 0 m and at most {WIDEST} thicknesses", f"{traction.radius_m} m on {thickness_m} m"
        raise ParamsError("drag", "contact radius", rule, got, "Press less deep.")
    if reach_m is None:
        reach_m = traction.radius_m + REACH * thickness_m
    r_m = np.linspace(0, reach_m, TABLE_R_N)
    z_m = np.linspace(0, thickness_m, TABLE_Z_N)
    parts = evaluate_map(traction, r_m, z_m, thickness_m=thickness_m)
    parts[:, 0, :3] = 0.0  # the displacement at the base is zero, but the half curl is not
    d, e, s = np.moveaxis(parts[..., 3:], 2, 0)
    # The half curl is largest at the angle f = 0 or 90 degrees.
    steepest_per_m2 = max(np.abs(d + e).max(), np.hypot(d - e, s).max())
    return ShearMap(r_m, z_m, parts, tangential_stiffness_m(traction, thickness_m), float(steepest_per_m2))


def evaluate_map(
    traction: Traction, r_m: Float[np.ndarray, " i"], z_m: Float[np.ndarray, " j"], *, thickness_m: float
) -> Float[np.ndarray, "i j 6"]:
    """Compute `ShearMap.parts` on a grid: Hankel integrals with J0, J1 and J2, as matrix products.

    If the wave vector is at the angle f from the x axis, a traction q along x has the component q cos f along the wave
    vector and the component -q sin f across it. The integrals over f are Bessel functions.
    """
    k_per_m = layer.WAVES_KH / thickness_m
    window = np.cos(np.pi * np.maximum(layer.WAVES_KH / layer.WAVES_KH[-1] - 0.5, 0)) ** 2  # avoids ringing
    waves = np.cos(np.outer(k_per_m, traction.x_m)) @ traction.weights * window
    amplitude = waves * layer.WAVES_W / thickness_m / (8 * np.pi)
    response = wave_response(np.outer(z_m, k_per_m), layer.WAVES_KH)
    kr = np.outer(r_m, k_per_m)
    bessel0, bessel1 = j0(kr), j1(kr)
    bessel2 = np.where(kr > 0, 2 * bessel1 / np.where(kr > 0, kr, 1.0) - bessel0, 0.0)
    products = (
        (bessel0, amplitude * (2 * response.v + response.w_slope)),
        (bessel2, amplitude * (2 * response.v - response.w_slope)),
        (bessel1, amplitude * 2 * response.w),
        (bessel0, amplitude * k_per_m * (2 * response.v_slope + response.w_spin) / 2),
        (bessel2, amplitude * k_per_m * (2 * response.v_slope - response.w_spin) / 2),
        (bessel1, amplitude * k_per_m * 2 * response.v),
    )
    return np.stack([bessel @ profile.T for bessel, profile in products], axis=2)


def wave_response(kz: Float[np.ndarray, "z k"], kh: Float[np.ndarray, " k"]) -> WaveResponse:
    """Return the response of a layer that is fixed at the base to a wave of tangential traction on top.

    With A = kh, z' = kz and t = A - z', the functions are v = sinh z' / cosh A and w = [A z' cosh t - t cosh A sinh z']
    / (cosh^2 A + A^2). The function w is the solution W of `layer` with the boundary condition W''' = 3 W' at the top.
    Numerators and denominators are divided by exp(2A) / 4, so that no exponent is positive inside the layer.
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
    shear_map: ShearMap,
    places_m: Float[np.ndarray, "s 3"],
    centre_m: Float[np.ndarray, "2"],
    *,
    force_N: Float[np.ndarray, "2"],
    modulus_Pa: float,
) -> ShearDisplacement:
    """Interpolate the linear displacement and the half curl at `places_m`, for a tangential force at `centre_m`.

    `modulus_Pa` is Young's modulus, 3 G.
    """
    lowest_m, highest_m = places_m[:, 2].min(initial=0.0), places_m[:, 2].max(initial=0.0)
    if not (0 <= lowest_m and highest_m <= RIM_MAX * shear_map.z_m[-1]):
        rule, got = f"0 to {RIM_MAX} times the thickness", f"{lowest_m:.3g} to {highest_m:.3g} m"
        raise ParamsError("drag", "height of nodes", rule, got, "Press less deep.")
    shear_m2 = _over_modulus(force_N, modulus_Pa)
    return ShearDisplacement(
        *_at_places(shear_map.parts, (shear_map.r_m[1], shear_map.z_m[1]), places_m, centre_m, shear_m2)
    )


def shear_in_steps(
    shear_map: ShearMap,
    places_m: Float[np.ndarray, "s 3"],
    centre_m: Float[np.ndarray, "2"],
    *,
    force_N: Float[np.ndarray, "2"],
    modulus_Pa: float,
) -> ShearDisplacement:
    """Return the finite shear of nodes that `deformation` has already moved, computed in steps by the midpoint rule.

    `centre_m` is the rest position of the material under the tip: the place of the tip minus `DragForce.elastic_m`. The
    nodes must have been moved by an indentation with the same centre. With mu = 0.8, the resulting field change dB
    differs from that of 24 steps by up to 1.2 % for depths up to 0.8 mm, and by 3 % at 1.2 mm. If `shear_displacement`
    were applied once to the nodes at rest, dB would differ by 13 to 90 %.
    """
    shear_m2 = _over_modulus(force_N, modulus_Pa)
    steepest = shear_map.steepest_per_m2 * float(np.hypot(*shear_m2))
    if not steepest <= STEEPEST:
        rule, remedy = f"at most {STEEPEST} everywhere", "Drag with less friction, or less far before it slips."
        raise ParamsError("drag", "half of the curl", rule, f"{steepest:.3g}", remedy)
    steps_n = max(1, int(np.ceil(steepest / STEP)))
    part_N, ahead_m = force_N / steps_n, shear_m2 / shear_map.stiffness_m / steps_n
    moved_m, half_curl = np.zeros_like(places_m), np.zeros_like(places_m)
    for step_i in range(steps_n):
        nodes_m, step_centre_m = places_m + moved_m, centre_m + step_i * ahead_m
        first = shear_displacement(shear_map, nodes_m, step_centre_m, force_N=part_N, modulus_Pa=modulus_Pa)
        half_m = nodes_m + first.displacement_m / 2
        middle_m = step_centre_m + ahead_m / 2
        middle = shear_displacement(shear_map, half_m, middle_m, force_N=part_N, modulus_Pa=modulus_Pa)
        moved_m += middle.displacement_m
        half_curl += middle.half_curl  # in simple shear, half curls of successive steps add up
    return ShearDisplacement(moved_m, half_curl)


def rotation_from_curl(half_curl: Float[np.ndarray, "s 3"]) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s 3"]]:
    """Return the angles in rad and axes of the rotations R in the polar decomposition F = R U.

    The angle is the arc tangent of the magnitude of the half curl, which is exact in plane strain.
    """
    size = np.sqrt((half_curl**2).sum(axis=1))
    axis = half_curl / np.where(size > 0, size, 1.0)[:, None]
    axis[size == 0] = (1.0, 0.0, 0.0)  # without rotation, the axis has no effect
    return np.arctan(size), axis


def _over_modulus(force_N: Float[np.ndarray, "2"], modulus_Pa: float) -> Float[np.ndarray, "2"]:
    if not 0 < modulus_Pa < np.inf:
        raise ParamsError("drag", "modulus", "above 0 Pa and finite", f"{modulus_Pa}", "Check the skin's modulus.")
    return force_N * (3 / modulus_Pa)  # incompressible: G = E / 3


@njit(cache=True, fastmath=False)
@no_type_check
def _at_places(parts, steps, places, centre, force):
    # Interpolate `ShearMap.parts` bilinearly at each place, then combine the parts A to S for the direction of the
    # force.
    r_n, z_n, _ = parts.shape
    moved, half_curl = np.zeros_like(places), np.zeros_like(places)
    values, (fx, fy) = np.empty(6), force
    for i in range(len(places)):
        x, y = places[i, 0] - centre[0], places[i, 1] - centre[1]
        r = sqrt(x * x + y * y)
        at_r, at_z = r / steps[0], min(places[i, 2] / steps[1], z_n - 1.0)
        if at_r >= r_n - 1:
            continue  # material beyond the table does not move
        j, k = int(at_r), min(int(at_z), z_n - 2)
        share_r, share_z = at_r - j, at_z - k
        for p in range(6):
            near = parts[j, k, p] + share_z * (parts[j, k + 1, p] - parts[j, k, p])
            far = parts[j + 1, k, p] + share_z * (parts[j + 1, k + 1, p] - parts[j + 1, k, p])
            values[p] = near + share_r * (far - near)
        a, b, c, d, e, s = values
        # On the axis, the parts that depend on the direction are zero, so the direction has no effect.
        cos, sin = (x / r, y / r) if r > 0 else (1.0, 0.0)
        along, across = fx * cos + fy * sin, fx * sin - fy * cos
        twice_x, twice_y = 2 * along * cos - fx, 2 * along * sin - fy
        moved[i, 0], moved[i, 1], moved[i, 2] = a * fx + b * twice_x, a * fy + b * twice_y, c * along
        half_curl[i, 0], half_curl[i, 1], half_curl[i, 2] = -d * fy - e * twice_y, d * fx + e * twice_x, s * across
    return moved, half_curl


def _kernel(x_m: Float[np.ndarray, " q"], thickness_m: float) -> Float[np.ndarray, "q q"]:
    # Return the kernel K(x, x') for the effect of the base: 2/pi times the integral of (1 - (w' + 2v) / 3) cos(k x)
    # cos(k x') dk. For a half-space, w' + 2v = 3, so the kernel is 0.
    response = wave_response(layer.KERNEL_KH[None], layer.KERNEL_KH)
    missing = layer.KERNEL_W / thickness_m * (1 - (response.w_slope[0] + 2 * response.v[0]) / 3)
    waves = np.cos(np.outer(x_m, layer.KERNEL_KH / thickness_m))
    return 2 / np.pi * (waves * missing) @ waves.T
