"""Linear theory of an incompressible elastic layer under a spherical tip: contact, force and displacements.

All values are in SI units. The layer is either bonded to a rigid base, or slips on the base without friction. The
pressure of the tip on the layer is written as a sum of waves J0(kr), where r is the distance from the axis of the tip
and k is the wave number. The displacements of the material are then Hankel integrals over these waves.

At the height z, a wave displaces the material vertically by W J0(kr) and radially by U J1(kr), where U = -W'. The prime
denotes the derivative with respect to kz. For a bonded base, W = a (sinh kz - kz cosh kz) + b kz sinh kz, with two
constants a and b. In the names of variables, kh is the wave number times the thickness h of the layer, and kz is the
wave number times the height.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import exp, expm1
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import j0, j1

from reskin.errors import ParamsError

Base = Literal["bonded", "slipping"]

# Largest depth, as a fraction of the thickness, for which Long et al. (2011) verified their solution by comparing it
# with finite elements.
VERIFIED_DEPTH = 0.6
CURVE_N = 48  # number of contact radii on the force curve


def _gauss(top: float, points_n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    x, w = np.polynomial.legendre.leggauss(points_n)
    return top * (x + 1) / 2, top * w / 2


# Nodes and weights of three Gauss quadratures:
# CONTACT is for integrals over the contact, in units of the contact radius.
# KERNEL is for the kernel of the integral equation, up to kh = 24. For larger kh, the integrand 1 - compliance is
# negligible, because it decreases as exp(-2 kh).
# WAVES is for displacements, up to kh = 40. In a skin with a thickness of 2 mm, this is a wavelength of 0.3 mm.
CONTACT_X, CONTACT_W = _gauss(1.0, 48)
KERNEL_KH, KERNEL_W = _gauss(24.0, 160)
WAVES_KH, WAVES_W = _gauss(40.0, 240)


@dataclass(frozen=True)
class Contact:
    """The contact between tip and layer: its radius, the depth of the tip, and the pressure.

    The pressure is represented by its Hankel transform p^(k), which is given by
    p^(k) / 2G = sum_i weights_i cos(k x_i), where G is the shear modulus.
    """

    radius_m: float
    depth_m: float
    x_m: Float[np.ndarray, " q"]  # the lengths x_i
    weights_m2: Float[np.ndarray, " q"]


@dataclass(frozen=True)
class Waves:
    """A pressure on the layer, represented as a sum of w waves J0(k r)."""

    k_per_m: Float[np.ndarray, " w"]  # wave numbers k
    amplitude_m: Float[np.ndarray, " w"]  # p^(k) dk / 2G, where p^(k) is the Hankel transform (see `Contact`)
    thickness_m: float
    base: Base


@dataclass(frozen=True)
class Displacement:
    """The displacement of s points of the material, and the gradient of the displacement.

    In the names of the derivatives, the first letter is the component of the displacement, and the second letter is the
    coordinate. For example, `r_z` is the derivative of the outward component with respect to z.
    """

    r_m: Float[np.ndarray, " s"]  # outward component
    z_m: Float[np.ndarray, " s"]  # upward component
    r_r: Float[np.ndarray, " s"]
    r_z: Float[np.ndarray, " s"]
    z_r: Float[np.ndarray, " s"]
    z_z: Float[np.ndarray, " s"]
    hoop: Float[np.ndarray, " s"]  # outward component divided by the distance from the axis


def bonded_compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Return the compliance of the surface of a bonded layer to a pressure wave, relative to a half-space.

    The compliance is the displacement of the surface per pressure. It is divided here by the compliance of an
    infinitely thick layer. With A = kh, the result is (sinh 2A - 2A) / (cosh 2A + 2 A^2 + 1). The code divides the
    numerator and the denominator by exp(2A) / 2 to avoid overflow.
    """
    # The upper limit keeps `double**2` finite. It has no effect on the result, which is 1 at this limit.
    double = np.minimum(2 * kh, 1e3)
    fade = np.exp(-double)
    s = double**2
    series = 2 * fade * double * s / 6 * (1 + s / 20 * (1 + s / 42 * (1 + s / 72 * (1 + s / 110))))
    sinh_part = np.where(double < 0.5, series, 1 - fade**2 - 2 * double * fade)
    return sinh_part / (1 + fade**2 + (s + 2) * fade)


def slipping_compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Return the compliance of the surface of a slipping layer to a pressure wave, relative to a half-space.

    The compliance is defined as in `bonded_compliance`. With A = kh, the result is (cosh 2A - 1) / (sinh 2A + 2A)
    (Johnson 1985, section 5.8). The code divides the numerator and the denominator by exp(2A) / 2 to avoid overflow.
    For long waves, where A is close to 0, the result is replaced by its limit A / 2.
    """
    double = np.minimum(2 * kh, 1e3)
    fade = np.exp(-double)
    long_waves = double < 1e-4
    rest = np.where(long_waves, 1.0, 1 - fade**2 + 2 * double * fade)
    return np.where(long_waves, double / 4, np.expm1(-double) ** 2 / rest)


def contact_of_radius(radius_m: float, *, thickness_m: float, tip_radius_m: float, base: Base) -> Contact:
    """Compute the pressure and the depth of a contact with a given radius.

    The method is that of Lebedev & Ufliand (1958). The Hankel transform of the pressure is written as the integral of
    chi(x) cos(kx) dx from 0 to the contact radius, where chi is an unknown function. With this form, the pressure is
    zero outside the contact for any function chi. The surface in the contact takes the shape of a sphere of radius R if
    chi solves the Fredholm equation chi - K chi = 2/pi (depth - x artanh(x/R)), where K is the integral operator whose
    kernel is `_kernel`. This equation contains the depth, which is also unknown. The depth follows from the condition
    chi(radius) = 0, which holds because the pressure is finite at the edge of the contact.
    """
    x_m, weights_m = radius_m * CONTACT_X, radius_m * CONTACT_W
    points_m = np.append(x_m, radius_m)
    kernel = _kernel(points_m, x_m, thickness_m, base) * weights_m
    sources = np.stack([np.ones_like(points_m), points_m * np.arctanh(points_m / tip_radius_m)], axis=1)
    inside = np.linalg.solve(np.eye(len(x_m)) - kernel[:-1], sources[:-1])
    flat, round_ = sources[-1] + kernel[-1] @ inside
    depth_m = round_ / flat
    return Contact(radius_m, depth_m, x_m, 2 / np.pi * weights_m * (inside @ (depth_m, -1)))


@lru_cache(maxsize=4096)
def contact_of_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: Base) -> Contact:
    """Compute the contact at an indentation depth, which must be above 0.

    The contact radius is determined by finding the root of the difference in depth.
    """

    def depth_error_m(radius_m: float) -> float:
        contact = contact_of_radius(radius_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
        return contact.depth_m - depth_m

    # Find bounds of the contact radius a. With the tip radius R and the depth d, a^2 is R d for a thick layer. It is 4
    # R d for a thin bonded layer, whose material can only flow sideways.
    top_m = min(2.1 * np.sqrt(tip_radius_m * depth_m), 0.999 * tip_radius_m)
    radius_m = float(brentq(depth_error_m, 1e-3 * np.sqrt(tip_radius_m * depth_m), top_m, rtol=1e-12))
    return contact_of_radius(radius_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)


@dataclass(frozen=True)
class IndentedLayer:
    """An elastic layer, and the spherical tip that presses the layer."""

    thickness_m: float
    tip_radius_m: float
    base: Base  # whether the layer is bonded to the base or slips on it

    def contact(self, depth_m: float) -> Contact:
        """Return the contact at an indentation depth in m."""
        return contact_of_depth(depth_m, thickness_m=self.thickness_m, tip_radius_m=self.tip_radius_m, base=self.base)


def force(
    depth_m: Float[np.ndarray, " n"],
    *,
    thickness_m: float,
    tip_radius_m: float,
    modulus_Pa: float,
    base: Base,
) -> Float[np.ndarray, " n"]:
    """Return the normal force in N between a linear elastic layer and the tip, at each depth.

    The force is 0 at depths of 0 or less, because then the tip does not touch the layer. This function does not include
    the stiffening of the layer at large depths, unlike `slide.force_at`.

    Raises
    ------
    ParamsError
        If a property of the layer or the tip is invalid, or a depth reaches the thickness or the tip radius.
    """
    check_layer(depth_m, thickness_m, tip_radius_m)
    if not (np.isfinite(modulus_Pa) and modulus_Pa >= 0):
        raise ParamsError(
            "layer", "modulus", "0 Pa or more and finite", f"{modulus_Pa}", "Correct modulus_kPa of the skin."
        )
    root_m = np.sqrt(np.maximum(depth_m, 0.0))
    return modulus_Pa * root_m**3 * _force_curve(thickness_m, tip_radius_m, base)(root_m)


def check_layer(depth_m: Float[np.ndarray, " n"], thickness_m: float, tip_radius_m: float) -> None:
    """Check the sizes of the layer and the tip, and the depths of indentations.

    Raises
    ------
    ParamsError
        If the thickness or the tip radius is not positive and finite, or if a depth is not finite or is not below both.
    """
    for what, size_m in (("thickness", thickness_m), ("tip radius", tip_radius_m)):
        if not 0 < size_m < np.inf:
            raise ParamsError("layer", what, "above 0 m and finite", f"{size_m}", "State this length in m.")
    limit_m = min(thickness_m, tip_radius_m)
    if not (np.isfinite(depth_m) & (depth_m < limit_m)).all():
        rule = f"finite and below {1e3 * limit_m:.3g} mm, the smaller of the skin's thickness and the tip's radius"
        raise ParamsError(
            "poke", "depth", rule, f"{1e3 * np.max(depth_m):.3g} mm", "Reduce the depth of the indentation."
        )


def waves(contact: Contact, thickness_m: float, base: Base) -> Waves:
    """Decompose the pressure of a contact into waves.

    The amplitudes of the upper half of the wave numbers are multiplied by a cos^2 window, which decreases to zero.
    Without this window, the displacement would oscillate near the edge of the contact.
    """
    window = np.cos(np.pi * np.maximum(WAVES_KH / WAVES_KH[-1] - 0.5, 0)) ** 2
    pressure_m2 = np.cos(np.outer(WAVES_KH / thickness_m, contact.x_m)) @ contact.weights_m2
    return Waves(WAVES_KH / thickness_m, pressure_m2 * window * WAVES_W / thickness_m, thickness_m, base)


def displacement(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], pressure: Waves) -> Displacement:
    """Return the displacement of points of the material due to a pressure on the surface.

    The points are at the distance r from the axis and at the height z. The components of the displacement are
    u_r = sum of amplitude g'(kz) J1(kr) and u_z = -sum of amplitude g(kz) J0(kr). Both sums are over all waves of the
    pressure. The function g (`_bonded_wave` or `_slipping_wave`) is the depth profile of a wave: a wave with amplitude
    p^ displaces material at the height z downwards by p^ g(kz) / (2G k), where G is the shear modulus. At the surface,
    g(kh) is the compliance of the layer relative to a half-space (see `bonded_compliance`).
    """
    top = float(np.max(r_m, initial=0.0) * pressure.k_per_m[-1])
    table = _bessel_table(1 << max(8, int(np.ceil(top)).bit_length()))
    rows = np.stack([pressure.k_per_m, pressure.thickness_m * pressure.k_per_m, pressure.amplitude_m])
    out_m, hoop, up_m, squeeze, r_z, z_r = _sum_waves(r_m, z_m, rows, pressure.base == "slipping", table)
    return Displacement(r_m=out_m, z_m=up_m, r_r=squeeze - hoop, r_z=r_z, z_r=z_r, z_z=-squeeze, hoop=hoop)


@lru_cache(maxsize=64)
def _force_curve(thickness_m: float, tip_radius_m: float, base: Base) -> CubicSpline:
    # Return a spline for F / (E d^1.5) as a function of sqrt(d), where F is the force, E is Young's modulus and d is
    # the depth. This ratio is smooth in sqrt(d), so that few nodes suffice. At d = 0, the contact is small compared
    # with the layer, so that the theory of Hertz is valid. It gives the value 16/9 sqrt(R), where R is the tip radius.
    deepest_m = (1 - 1e-6) * min(thickness_m, tip_radius_m)
    widest = contact_of_depth(deepest_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
    radii_m = widest.radius_m * np.linspace(0, 1, CURVE_N)[1:]
    contacts = [contact_of_radius(a, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base) for a in radii_m]
    root = np.sqrt([0.0] + [contact.depth_m for contact in contacts])
    ratio = [4 * np.pi / 3 * contact.weights_m2.sum() / contact.depth_m**1.5 for contact in contacts]
    return CubicSpline(root, [16 / 9 * np.sqrt(tip_radius_m), *ratio])


def _kernel(
    points_m: Float[np.ndarray, " p"], x_m: Float[np.ndarray, " q"], thickness_m: float, base: Base
) -> Float[np.ndarray, "p q"]:
    # Return the kernel K of the Fredholm equation in `contact_of_radius`. It is 2/pi times the integral over k of
    # (1 - compliance) cos(k point) cos(k x).
    compliance = bonded_compliance if base == "bonded" else slipping_compliance
    missing = KERNEL_W / thickness_m * (1 - compliance(KERNEL_KH))
    k_per_m = KERNEL_KH / thickness_m
    return 2 / np.pi * np.cos(np.outer(points_m, k_per_m)) * missing @ np.cos(np.outer(k_per_m, x_m))


BESSEL_STEP = 1 / 256  # step of the argument in the table of Bessel functions


@njit(cache=True, error_model="numpy")
@no_type_check
def _bonded_factors(kh):
    """Return the factors of g in `_bonded_wave` that are the same at all heights."""
    base = exp(-2 * kh)
    size = (1 + base) ** 2 + 4 * kh * kh * base
    return (1 + base) / size, 2 * kh / size * exp(-kh), 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _bonded_wave(kz, kh, factors):
    """Return the depth profile g of one wave in a bonded layer, and the first two derivatives of g.

    The profile is evaluated at the height z. With A = kh, z' = kz and t = A - z', it is
    g = [cosh A (sinh z' + t cosh z') - A cosh t - A z' sinh t] / (cosh^2 A + A^2). The code divides the numerator and
    the denominator by exp(2A) / 4, so that all exponents are negative or zero inside the layer.
    """
    t = kh - kz
    top, fade = exp(-t), exp(-kz)
    low, high = fade * fade, top * top
    near, far = factors[0] * top, factors[1] * fade
    g = near * (1 + t - (1 - t) * low) - far * (1 + kz + (1 - kz) * high)
    slope = near * t * (1 - low) + far * kz * (1 + high)
    bend = near * (t * (1 + low) - (1 - low)) + far * (1 + high - kz * (1 - high))
    return g, slope, bend


@njit(cache=True, error_model="numpy")
@no_type_check
def _slipping_factors(kh):
    """Return the factors of g in `_slipping_wave` that are the same at all heights."""
    fade, second = exp(-2 * kh), -expm1(-2 * kh)
    return second * (1 + fade) + 4 * kh * fade, (1 + kh) - (1 - kh) * fade, second


@njit(cache=True, error_model="numpy")
@no_type_check
def _slipping_wave(kz, kh, factors):
    """Return the depth profile g of one wave in a slipping layer, and the first two derivatives of g.

    The profile is evaluated at the height z. With A = kh and z' = kz, it is
    g = [(sinh A + A cosh A) sinh z' - z' sinh A cosh z'] / (sinh A cosh A + A). At the base, both the vertical
    displacement W and the shear stress, which is proportional to W'' + W, are zero. Therefore, g is an odd function of
    z'. The code multiplies the numerator and the denominator by 4 exp(-2A), so that all exponents are negative or zero
    inside the layer.
    """
    size, first, second = factors
    top, low = exp(kz - kh), exp(-kh - kz)
    odd, even = (top - low) / size, (top + low) / size
    g = first * odd - kz * second * even
    slope = (first - second) * even - kz * second * odd
    bend = (first - 2 * second) * odd - kz * second * even
    return g, slope, bend


@njit(cache=True, error_model="numpy")
@no_type_check
def _between(table, low, share):
    # Interpolate J0 and J1 between the rows `low` and `low + 1` of the table. The interpolating polynomials are cubic
    # and have the exact values and slopes of the functions at both rows. The error is below 1e-12.
    j0_a, j1_a, slope_a = table[low, 0], table[low, 1], table[low, 2]
    j0_b, j1_b, slope_b = table[low + 1, 0], table[low + 1, 1], table[low + 1, 2]
    rest = 1 - share
    a, b = rest * rest * (1 + 2 * share), share * share * (3 - 2 * share)
    da, db = BESSEL_STEP * share * rest * rest, -BESSEL_STEP * share * share * rest
    return a * j0_a + b * j0_b - da * j1_a - db * j1_b, a * j1_a + b * j1_b + da * slope_a + db * slope_b


@njit(cache=True, error_model="numpy")
@no_type_check
def _sum_waves(r_m, z_m, waves, slipping, table):
    """Sum the displacements due to all waves at s points, and the derivatives of the displacements.

    The rows of `waves` are the wave number k, kh and the amplitude. The rows of the result are u_r, hoop, u_z,
    -du_z/dz, du_r/dz and du_z/dr, where hoop is u_r divided by r.
    """
    sums = np.zeros((6, len(r_m)))
    for w in range(waves.shape[1]):
        k, kh, amplitude = waves[0, w], waves[1, w], waves[2, w]
        steep, of_kh = amplitude * k, _slipping_factors(kh) if slipping else _bonded_factors(kh)
        for s in range(len(r_m)):
            g, slope, bend = _slipping_wave(k * z_m[s], kh, of_kh) if slipping else _bonded_wave(k * z_m[s], kh, of_kh)
            position = k * r_m[s] / BESSEL_STEP
            low = int(position)
            j0_, j1_ = _between(table, low, position - low)
            sums[0, s] += amplitude * slope * j1_
            sums[1, s] += steep * slope / 2
            sums[2, s] -= amplitude * g * j0_
            sums[3, s] += steep * slope * j0_
            sums[4, s] += steep * bend * j1_
            sums[5, s] += steep * g * j1_
    for s in range(len(r_m)):
        if r_m[s] > 0:
            sums[1, s] = sums[0, s] / r_m[s]  # for r = 0, `sums[1]` already contains the limit of this quotient
    return sums


@lru_cache(maxsize=4)
def _bessel_table(top: int) -> Float[np.ndarray, "x 3"]:
    """Tabulate J0, J1 and J1' = J0 - J1 / x from 0 to `top`, in steps of `BESSEL_STEP`."""
    x = BESSEL_STEP * np.arange(round(top / BESSEL_STEP) + 2)
    with np.errstate(invalid="ignore"):
        slope = np.where(x > 0, j0(x) - j1(x) / x, 0.5)
    return np.stack([j0(x), j1(x), slope], axis=1)
