"""Friction on a tip that is dragged over the skin, and the shear of the elastic layer due to the friction.

All values are in SI units. The friction exerts a tangential force on the surface of the layer. This force displaces and
rotates the material under the tip.
"""

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
    """The tangential force and the state of the contact at each of t places on the path of a tip."""

    force_N: Float[np.ndarray, "t 2"]  # force on the skin, in the direction of the tip's motion
    # place of the tip, minus the place at which the material under the tip was before it was touched
    elastic_m: Float[np.ndarray, "t 2"]
    sliding: Bool[np.ndarray, " t"]  # whether the tip slides over the skin; otherwise, it sticks to the skin


def drag_force(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    *,
    stiffness_N_per_m: Float[np.ndarray, "t 2 2"],
    friction: float,
) -> DragForce:
    """Return the friction force along the path of a tip that touches the skin first at `path_m[0]`.

    The method is called return mapping (Simo & Hughes 1998). In each step of the path, the tip is first assumed to
    stick to the skin, so that the step only deforms the layer. If the resulting tangential force exceeds Coulomb's
    limit mu F, where F is the normal force, the tip slides, and the force is reduced to the limit. After a step that
    begins or ends without contact, the force is assumed to be zero, because it is unknown where in this step the tip
    touched the skin.

    Parameters
    ----------
    path_m : places of the tip
    normal_N : normal force at each place; 0 if the tip does not touch the skin
    stiffness_N_per_m : tangential stiffness of the layer at each place, a symmetric matrix
    friction : friction coefficient mu
    """
    _check_drag(path_m, normal_N, stiffness_N_per_m, friction)
    limit_N, in_contact = friction * normal_N, normal_N > 0
    force_N, elastic_m = np.zeros(path_m.shape), np.zeros(path_m.shape)
    sliding = np.zeros(len(path_m), dtype=bool)
    for now in range(1, len(path_m)):
        if not (in_contact[now] and in_contact[now - 1]):
            continue
        trial_m = elastic_m[now - 1] + path_m[now] - path_m[now - 1]
        trial_N = np.hypot(*(stiffness_N_per_m[now] @ trial_m))
        sliding[now] = trial_N > limit_N[now]
        elastic_m[now] = trial_m * (limit_N[now] / trial_N) if sliding[now] else trial_m
        force_N[now] = stiffness_N_per_m[now] @ elastic_m[now]
    return DragForce(force_N, elastic_m, sliding)


def _check_drag(
    path_m: Float[np.ndarray, "t 2"],
    normal_N: Float[np.ndarray, " t"],
    stiffness: Float[np.ndarray, "t 2 2"],
    friction: float,
) -> None:
    if not np.isfinite(path_m).all():
        raise ParamsError("drag", "every place of the tip", "finite", "NaN or infinity", "Correct the path of the tip.")
    along = np.diagonal(stiffness, axis1=1, axis2=2)
    for what, unit, values in (("normal force", "N", normal_N), ("stiffness", "N/m", along)):
        if not (np.isfinite(values) & (values >= 0)).all():
            worst = values[~(np.isfinite(values) & (values >= 0))][0]
            raise ParamsError(
                "drag", what, f"0 {unit} or more and finite", f"{worst}", "Correct this value or its sign."
            )
    if not 0 <= friction < np.inf:
        raise ParamsError(
            "drag", "friction", "0 or more and finite", f"{friction}", "Correct the friction coefficient."
        )


WIDEST = 3.0  # largest contact radius in thicknesses; for larger contacts, `layer.WAVES_KH` would be too coarse
# Largest height of the bulging rim around the tip in thicknesses, as in `deformation`. Nodes in the rim are above the
# table, and are displaced like the surface.
RIM_MAX = 1.2
# Largest rotation (half of the curl of the displacement) in one integration step. For a friction coefficient of 0.8,
# one step suffices up to a depth of 0.6 mm.
STEP = 0.75
# Largest rotation for which the accuracy with this step size was verified. It occurs for a friction coefficient of 0.8
# at a depth of 1.2 mm.
STEEPEST = 1.5
TABLE_R_N, TABLE_Z_N = 512, 80  # numbers of radii and heights in a table; so many that linear interpolation suffices
# Difference between successive tabulated depths. Over this difference, the stiffness changes by 1 % and dB by 0.1 uT.
DEPTH_STEP_M = 10e-6


@dataclass(frozen=True)
class Traction:
    """A tangential traction (force per area) on the surface of the layer.

    The traction is axisymmetric and has the same direction everywhere. It is represented by its Hankel transform, which
    is Q sum_i weights_i cos(k x_i), where Q is the total force and k is the wave number.
    """

    radius_m: float  # contact radius
    x_m: Float[np.ndarray, " q"]  # the lengths x_i
    weights: Float[np.ndarray, " q"]  # the sum of the weights is 1


@dataclass(frozen=True)
class WaveResponse:
    """The displacement of the layer due to waves of tangential traction, for z heights and k wave numbers.

    The displacement is described by two functions w and v of kz, the wave number times the height. A prime denotes the
    derivative with respect to kz, T is the amplitude of the traction, and G is the shear modulus. If the traction is
    along the wave vector, the displacement along the wave vector is w' T / 2Gk, and the displacement upwards is
    -i w T / 2Gk. If the traction is across the wave vector, the displacement is v T / Gk in the direction of the
    traction.
    """

    w: Float[np.ndarray, "z k"]
    w_slope: Float[np.ndarray, "z k"]  # w'
    w_spin: Float[np.ndarray, "z k"]  # w'' - w
    v: Float[np.ndarray, "z k"]
    v_slope: Float[np.ndarray, "z k"]  # v'


@dataclass(frozen=True)
class ShearMap:
    """A table of the displacement due to a tangential force Q along x, and of half of the curl of the displacement.

    The table has equally spaced distances r from the axis of the tip and equally spaced heights z. It contains six
    values A, B, C, D, E and S for each r and z, which have been divided by Q / G, where G is the shear modulus. At the
    angle f from the x axis, the components along x, y and z are

    - A + B cos 2f, B sin 2f and C cos f for the displacement,
    - -E sin 2f, D + E cos 2f and S sin f for half of the curl.
    """

    r_m: Float[np.ndarray, " i"]
    z_m: Float[np.ndarray, " j"]
    parts: Float[np.ndarray, "i j 6"]  # A, B and C in 1/m, and D, E and S in 1/m^2
    stiffness_m: float  # tangential stiffness of the layer, divided by G
    steepest_per_m2: float  # largest magnitude of half of the curl in the table, divided by Q / G


@dataclass(frozen=True)
class ShearDisplacement:
    """The displacement and the rotation of s nodes due to a shear of the layer."""

    displacement_m: Float[np.ndarray, "s 3"]
    # Half of the curl of the displacement. If the rotation is small, this is the rotation vector.
    half_curl: Float[np.ndarray, "s 3"]


def slip_traction(contact: layer.Contact) -> Traction:
    """Return the traction q of a sliding tip.

    According to Coulomb's law q = mu p, the traction is proportional to the pressure p. The simulation uses this
    traction at all stops of a drag, although the tip still sticks at the first stops. The
    reason is that the tip begins to slide after one or two millimetres. The tangential stiffness for this traction is
    lower than for `stick_traction`: by 19 to 20 % on the nominal skin at depths of 0.2 to 1.2 mm, and by 1/6 on a very
    thick layer.
    """
    return Traction(contact.radius_m, contact.x_m, contact.weights_m2 / contact.weights_m2.sum())


def stick_traction(radius_m: float, thickness_m: float) -> Traction:
    """Return the traction of a tip that sticks to the skin, so that it displaces the whole contact by the same amount.

    The result is approximate: the term B of `ShearMap`, which makes the displacement non-uniform, is neglected. As in
    `layer.contact_of_radius`, the Hankel transform of the traction is written as the integral of chi(x) cos(kx) dx over
    the contact. The function chi is the solution of chi - K chi = 1, where K is the integral operator whose kernel is
    `_kernel`. For a very thick layer, K is zero and chi is constant. The traction is then proportional to
    (a^2 - r^2)^(-1/2), where a is the contact radius and r is the distance from the axis. This is Mindlin's solution.
    """
    x_m, weights_m = radius_m * layer.CONTACT_X, radius_m * layer.CONTACT_W
    kernel = _kernel(x_m, thickness_m) * weights_m
    chi = np.linalg.solve(np.eye(len(x_m)) - kernel, np.ones_like(x_m))
    return Traction(radius_m, x_m, weights_m * chi / (weights_m @ chi))


def tangential_stiffness_m(traction: Traction, thickness_m: float) -> float:
    """Return the tangential stiffness k_t of the layer, divided by the shear modulus G.

    The stiffness k_t is the total force divided by the mean displacement of the contact along the force. In this mean,
    the displacement of each place is weighted by the traction at this place. According to Parseval's theorem, k_t / G =
    8 pi / I, where I is the integral of q(k)^2 (w' + 2v) dk. In this integral, q(k) is the Hankel transform of the
    traction for a force of 1, and w' and v are the functions of `WaveResponse` at the surface. For an infinitely thick
    layer, w' + 2v is 3, and the integral is known in closed form. For a layer of finite thickness, the effect of the
    base is subtracted from this closed form (see `_kernel`).
    """
    chi = traction.weights / (traction.radius_m * layer.CONTACT_W)
    base_effect = _kernel(traction.x_m, thickness_m) @ traction.weights
    return float(16 / 3 / (traction.weights @ (chi - base_effect)))


@lru_cache(maxsize=32)
def tabulate_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: layer.Base) -> ShearMap:
    """Tabulate the shear of the layer under a tip that slides at a given depth.

    The table extends to the same radius as the tables of `deformation`. The argument `base` affects only the size and
    the pressure of the contact. For the shear, the lower side of the layer is always assumed to be fixed sideways,
    because a layer that slips freely on its base would move as a whole instead of being sheared.
    """
    layer.check_layer(np.array([depth_m]), thickness_m, tip_radius_m)
    if not depth_m > 0:
        raise ParamsError("drag", "depth", "above 0 m", f"{depth_m}", "Increase the depth of the drag.")
    contact = layer.contact_of_depth(depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
    reach_m = thickness_m * deformation.reach(tip_radius_m / thickness_m, base)
    return tabulate(slip_traction(contact), thickness_m, reach_m)


def at_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: layer.Base) -> ShearMap:
    """Return the shear map at a depth, by linear interpolation between tabulated depths.

    If the depth is smaller than the first tabulated depth (`DEPTH_STEP_M`), the map of the first tabulated depth is
    returned. The error is negligible, because the force is almost zero at such small depths.
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


def tabulate(traction: Traction, thickness_m: float, reach_m: float) -> ShearMap:
    """Tabulate the shear of the layer due to a traction for distances from the axis up to `reach_m`."""
    if not 0 < traction.radius_m <= WIDEST * thickness_m < np.inf:
        rule = f"above 0 m and at most {WIDEST} times the skin's thickness"
        got = f"{traction.radius_m} m on a skin with a thickness of {thickness_m} m"
        raise ParamsError("drag", "contact radius", rule, got, "Reduce the depth of the drag.")
    r_m = np.linspace(0, reach_m, TABLE_R_N)
    z_m = np.linspace(0, thickness_m, TABLE_Z_N)
    parts = evaluate_map(traction, r_m, z_m, thickness_m=thickness_m)
    parts[:, 0, :3] = 0.0  # the displacement at the base is zero, but half of its curl is not
    d, e, s = np.moveaxis(parts[..., 3:], 2, 0)
    # At given r and z, the magnitude of the curl is largest at the angle f = 0 or f = 90 degrees.
    steepest_per_m2 = max(np.abs(d + e).max(), np.hypot(d - e, s).max())
    return ShearMap(r_m, z_m, parts, tangential_stiffness_m(traction, thickness_m), float(steepest_per_m2))


def evaluate_map(
    traction: Traction, r_m: Float[np.ndarray, " i"], z_m: Float[np.ndarray, " j"], *, thickness_m: float
) -> Float[np.ndarray, "i j 6"]:
    """Compute the values of `ShearMap.parts` on a grid of distances r and heights z.

    The values are Hankel integrals, which are computed as matrix products. If the wave vector of a wave is at the angle
    f from the x axis, a traction q along x has the component q cos f along the wave vector and the component -q sin f
    across it. The integrals over all angles f result in the Bessel functions J0, J1 and J2.
    """
    k_per_m = layer.WAVES_KH / thickness_m
    # This window avoids oscillations near the edge of the contact, as in `layer.waves`.
    window = np.cos(np.pi * np.maximum(layer.WAVES_KH / layer.WAVES_KH[-1] - 0.5, 0)) ** 2
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
    """Return the response of a layer whose base is fixed to waves of tangential traction on its surface.

    With A = kh, z' = kz and t = A - z', the functions of the response are v = sinh z' / cosh A and w = [A z' cosh t - t
    cosh A sinh z'] / (cosh^2 A + A^2). The function w has the form of the solution W in module `layer`, with the
    boundary condition W''' = 3 W' at the surface. The code divides the numerators and the denominators by exp(2A) / 4,
    so that all exponents are negative or zero inside the layer.
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
    """Interpolate the displacement and half of its curl in a shear map, for a tangential force.

    The displacement is that of the linear theory, which is valid only for small forces. For larger forces, see
    `shear_in_steps`.

    Parameters
    ----------
    shear_map : the table
    places_m : places at which the displacement is computed
    centre_m : centre of the contact, at which the force acts
    force_N : tangential force on the skin
    modulus_Pa : Young's modulus, which is 3 G
    """
    lowest_m, highest_m = places_m[:, 2].min(initial=0.0), places_m[:, 2].max(initial=0.0)
    if not (0 <= lowest_m and highest_m <= RIM_MAX * shear_map.z_m[-1]):
        rule, got = f"0 to {RIM_MAX} times the skin's thickness", f"{lowest_m:.3g} to {highest_m:.3g} m"
        raise ParamsError("drag", "height of nodes", rule, got, "Reduce the depth of the drag.")
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
    """Compute the displacement and the rotation of nodes due to a tangential force that may be large.

    The force is increased in steps, and each step is integrated by the midpoint rule. The accuracy was verified for a
    friction coefficient of 0.8, by comparing the resulting field change dB with the result of 24 steps. The difference
    is up to 1.2 % for depths up to 0.8 mm, and 3 % at 1.2 mm. If `shear_displacement` were applied once to the nodes of
    the undeformed skin instead, the difference would be 13 to 90 %.

    Parameters
    ----------
    shear_map : table of the shear at the depth of the tip
    places_m : positions of the nodes, after an indentation with the centre `centre_m` has moved them (`deformation`)
    centre_m : place at which the material under the tip was before it was touched, which is the place of the tip minus
        `DragForce.elastic_m`
    force_N : tangential force on the skin
    modulus_Pa : Young's modulus
    """
    shear_m2 = _over_modulus(force_N, modulus_Pa)
    steepest = shear_map.steepest_per_m2 * float(np.hypot(*shear_m2))
    if not steepest <= STEEPEST:
        rule, remedy = f"at most {STEEPEST} everywhere", "Reduce the friction coefficient or the depth of the drag."
        raise ParamsError("drag", "half of the curl of the displacement", rule, f"{steepest:.3g}", remedy)
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
        half_curl += middle.half_curl  # in simple shear, the curls of successive steps add up
    return ShearDisplacement(moved_m, half_curl)


def rotation_from_curl(half_curl: Float[np.ndarray, "s 3"]) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "s 3"]]:
    """Return the angle in rad and the axis of the rotation R in the polar decomposition F = R U, for each node.

    F is the deformation gradient. The angle is the arc tangent of the magnitude of half of the curl. This is exact for
    plane strain, and an approximation for other deformations.
    """
    size = np.sqrt((half_curl**2).sum(axis=1))
    axis = half_curl / np.where(size > 0, size, 1.0)[:, None]
    axis[size == 0] = (1.0, 0.0, 0.0)  # if there is no rotation, any axis is correct
    return np.arctan(size), axis


def _over_modulus(force_N: Float[np.ndarray, "2"], modulus_Pa: float) -> Float[np.ndarray, "2"]:
    if not 0 < modulus_Pa < np.inf:
        raise ParamsError(
            "drag", "modulus", "above 0 Pa and finite", f"{modulus_Pa}", "Correct modulus_kPa of the skin."
        )
    return force_N * (3 / modulus_Pa)  # the shear modulus G of an incompressible material is a third of Young's modulus


@njit(cache=True, fastmath=False)
@no_type_check
def _at_places(parts, steps, places, centre, force):
    # For each place, interpolate the six values of `ShearMap.parts` bilinearly in r and z. Then combine these values
    # according to the direction of the force and the direction from the centre of the contact to the place.
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
        # On the axis of the tip, the direction from the centre to the place is undefined. Any direction gives the
        # correct result, because all values that are multiplied by functions of the direction are zero there.
        cos, sin = (x / r, y / r) if r > 0 else (1.0, 0.0)
        along, across = fx * cos + fy * sin, fx * sin - fy * cos
        twice_x, twice_y = 2 * along * cos - fx, 2 * along * sin - fy
        moved[i, 0], moved[i, 1], moved[i, 2] = a * fx + b * twice_x, a * fy + b * twice_y, c * along
        half_curl[i, 0], half_curl[i, 1], half_curl[i, 2] = -d * fy - e * twice_y, d * fx + e * twice_x, s * across
    return moved, half_curl


def _kernel(x_m: Float[np.ndarray, " q"], thickness_m: float) -> Float[np.ndarray, "q q"]:
    # Return the kernel K(x, x') that describes the effect of the base. It is 2/pi times the integral of (1 - (w' + 2v)
    # / 3) cos(k x) cos(k x') dk, where w' and v are the functions of `WaveResponse` at the surface. For an infinitely
    # thick layer, w' + 2v is 3, so that the kernel is 0.
    response = wave_response(layer.KERNEL_KH[None], layer.KERNEL_KH)
    missing = layer.KERNEL_W / thickness_m * (1 - (response.w_slope[0] + 2 * response.v[0]) / 3)
    waves = np.cos(np.outer(x_m, layer.KERNEL_KH / thickness_m))
    return 2 / np.pi * (waves * missing) @ waves.T
