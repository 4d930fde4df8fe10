"""An incompressible elastic layer under a spherical tip: contact, force and linear displacements. SI units.

The layer is bonded to a rigid base or slips on it. Fields are Hankel integrals over waves J0(kr) of the pressure; kh
and kz are the wave number times the thickness and the height, primes are derivatives with respect to kz. For a bonded
base, W = a (sinh z' - z' cosh z') + b z' sinh z' and U = -W'/k, z' = kz.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import exp, expm1
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import njit
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import j0, j1

from reskin.errors import ParamsError

Base = Literal["bonded", "slipping"]

VERIFIED_DEPTH = 0.6  # of the thickness: Long et al. 2011 compared with finite elements up to this depth
CURVE_N = 48  # contact radii of the force curve


def _gauss(top: float, points_n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    x, w = np.polynomial.legendre.leggauss(points_n)
    return top * (x + 1) / 2, top * w / 2


CONTACT_X, CONTACT_W = _gauss(1.0, 48)  # over the radius of the contact
KERNEL_KH, KERNEL_W = _gauss(24.0, 160)  # 1 - compliance falls as exp(-2 kh)
WAVES_KH, WAVES_W = _gauss(40.0, 240)  # the shortest wave of the field is 0.3 mm long in a skin of 2 mm


@dataclass(frozen=True)
class Contact:
    """Contact pressure, as weights of its Hankel transform: p^(k) / 2G = sum of weights * cos(k x)."""

    radius_m: float
    depth_m: float
    x_m: Float[np.ndarray, " q"]
    weights_m2: Float[np.ndarray, " q"]


@dataclass(frozen=True)
class Waves:
    """A pressure as waves J0(k r): wave numbers, and the amplitude p^(k) dk / 2G of each."""

    k_per_m: Float[np.ndarray, " w"]
    amplitude_m: Float[np.ndarray, " w"]
    thickness_m: float
    base: Base


@dataclass(frozen=True)
class Displacement:
    """Displacement (outward, up) and its gradient: `r_z` is the derivative of the outward part along z."""

    r_m: Float[np.ndarray, " s"]
    z_m: Float[np.ndarray, " s"]
    r_r: Float[np.ndarray, " s"]
    r_z: Float[np.ndarray, " s"]
    z_r: Float[np.ndarray, " s"]
    z_z: Float[np.ndarray, " s"]
    hoop: Float[np.ndarray, " s"]


def bonded_compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Return the surface compliance of a bonded layer to a pressure wave, relative to that of a half-space.

    (sinh 2A - 2A) / (cosh 2A + 2 A^2 + 1), A = kh, with numerator and denominator divided by exp(2A) / 2 to avoid
    overflow.
    """
    double = np.minimum(2 * kh, 1e3)  # the compliance is 1 there, and squares stay finite
    fade = np.exp(-double)
    s = double**2
    series = 2 * fade * double * s / 6 * (1 + s / 20 * (1 + s / 42 * (1 + s / 72 * (1 + s / 110))))
    sinh_part = np.where(double < 0.5, series, 1 - fade**2 - 2 * double * fade)
    return sinh_part / (1 + fade**2 + (s + 2) * fade)


def slipping_compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Return the surface compliance of a slipping layer to a pressure wave, relative to that of a half-space.

    (cosh 2A - 1) / (sinh 2A + 2A), A = kh (Johnson 1985, 5.8), with numerator and denominator divided by exp(2A) / 2 to
    avoid overflow; A / 2 for long waves.
    """
    double = np.minimum(2 * kh, 1e3)
    fade = np.exp(-double)
    long_waves = double < 1e-4
    rest = np.where(long_waves, 1.0, 1 - fade**2 + 2 * double * fade)
    return np.where(long_waves, double / 4, np.expm1(-double) ** 2 / rest)


def contact_of_radius(radius_m: float, *, thickness_m: float, tip_radius_m: float, base: Base) -> Contact:
    """Solve for pressure and depth of a contact of this radius, by a Fredholm equation (Lebedev & Ufliand 1958).

    p^(k) = integral of chi(x) cos(kx) makes the pressure vanish outside the contact. chi - K chi =
    2/pi (depth - x artanh(x/R)) puts the surface on the sphere. The depth follows from chi(radius) = 0: the pressure is
    finite at the edge.
    """
    x_m, weights_m = radius_m * CONTACT_X, radius_m * CONTACT_W
    at_m = np.append(x_m, radius_m)
    kernel = _kernel(at_m, x_m, thickness_m, base) * weights_m
    sources = np.stack([np.ones_like(at_m), at_m * np.arctanh(at_m / tip_radius_m)], axis=1)
    inside = np.linalg.solve(np.eye(len(x_m)) - kernel[:-1], sources[:-1])
    flat, round_ = sources[-1] + kernel[-1] @ inside
    depth_m = round_ / flat
    return Contact(radius_m, depth_m, x_m, 2 / np.pi * weights_m * (inside @ (depth_m, -1)))


@lru_cache(maxsize=4096)
def contact_of_depth(depth_m: float, *, thickness_m: float, tip_radius_m: float, base: Base) -> Contact:
    """Solve for the contact at a depth above 0."""

    def miss_m(radius_m: float) -> float:
        here = contact_of_radius(radius_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
        return here.depth_m - depth_m

    # A thick layer has a^2 = R d; a thin layer, whose material can only flow sideways, has a^2 = 4 R d.
    top_m = min(2.1 * np.sqrt(tip_radius_m * depth_m), 0.999 * tip_radius_m)
    radius_m = float(brentq(miss_m, 1e-3 * np.sqrt(tip_radius_m * depth_m), top_m, rtol=1e-12))
    return contact_of_radius(radius_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)


@dataclass(frozen=True)
class IndentedLayer:
    """A layer, how its base is held, and the spherical tip that presses it."""

    thickness_m: float
    tip_radius_m: float
    base: Base

    def contact(self, depth_m: float) -> Contact:
        """Return the contact at an indentation depth in m."""
        return contact_of_depth(depth_m, thickness_m=self.thickness_m, tip_radius_m=self.tip_radius_m, base=self.base)


def beyond_verified(depth_m: Float[np.ndarray, " n"], thickness_m: float) -> Bool[np.ndarray, " n"]:
    """Flag the depths beyond the range of the published solutions."""
    return depth_m >= VERIFIED_DEPTH * thickness_m


def force(
    depth_m: Float[np.ndarray, " n"],
    *,
    thickness_m: float,
    tip_radius_m: float,
    modulus_Pa: float,
    base: Base,
) -> Float[np.ndarray, " n"]:
    """Return the normal force of a linear elastic layer on the tip in N; 0 without contact (depth of 0 or less).

    The simulated skin presses back with `slide.force_at`, which multiplies this force by the stiffening of the layer.

    Raises
    ------
    ParamsError
        If layer, tip or modulus is impossible, or if the depth reaches the lesser of thickness and tip radius.
    """
    check_layer(depth_m, thickness_m, tip_radius_m)
    if not (np.isfinite(modulus_Pa) and modulus_Pa >= 0):
        raise ParamsError("layer", "modulus", "0 Pa or more", f"{modulus_Pa}", "Check the skin's modulus.")
    root_m = np.sqrt(np.maximum(depth_m, 0.0))
    return modulus_Pa * root_m**3 * _force_curve(thickness_m, tip_radius_m, base)(root_m)


def check_layer(depth_m: Float[np.ndarray, " n"], thickness_m: float, tip_radius_m: float) -> None:
    """Raise `ParamsError` for an impossible layer or tip, or a depth beyond the layer or the tip's radius."""
    for what, size_m in (("thickness", thickness_m), ("tip radius", tip_radius_m)):
        if not 0 < size_m < np.inf:
            raise ParamsError("layer", what, "above 0 m and finite", f"{size_m}", "Check its unit.")
    limit_m = min(thickness_m, tip_radius_m)
    if not (np.isfinite(depth_m) & (depth_m < limit_m)).all():
        rule = f"finite and below {1e3 * limit_m:.3g} mm, the lesser of thickness and tip radius"
        raise ParamsError("poke", "depth", rule, f"{1e3 * np.max(depth_m):.3g} mm", "Poke less deep.")


def waves(contact: Contact, thickness_m: float, base: Base) -> Waves:
    """Decompose the contact pressure into waves; a cos^2 window over the shorter half avoids ringing."""
    window = np.cos(np.pi * np.maximum(WAVES_KH / WAVES_KH[-1] - 0.5, 0)) ** 2
    pressure_m2 = np.cos(np.outer(WAVES_KH / thickness_m, contact.x_m)) @ contact.weights_m2
    return Waves(WAVES_KH / thickness_m, pressure_m2 * window * WAVES_W / thickness_m, thickness_m, base)


def displacement(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], of: Waves) -> Displacement:
    """Sum the waves at (r, z): u_r = sum of amplitude g' J1, u_z = -sum of amplitude g J0."""
    top = float(np.max(r_m, initial=0.0) * of.k_per_m[-1])
    table = _bessel_table(1 << max(8, int(np.ceil(top)).bit_length()))
    waves = np.stack([of.k_per_m, of.thickness_m * of.k_per_m, of.amplitude_m])
    out_m, hoop, up_m, squeeze, r_z, z_r = _sum_waves(r_m, z_m, waves, of.base == "slipping", table)
    return Displacement(r_m=out_m, z_m=up_m, r_r=squeeze - hoop, r_z=r_z, z_r=z_r, z_z=-squeeze, hoop=hoop)


def depth_profile(
    kz: Float[np.ndarray, "s w"], kh: Float[np.ndarray, " w"], base: Base = "bonded"
) -> tuple[Float[np.ndarray, "s w"], Float[np.ndarray, "s w"], Float[np.ndarray, "s w"]]:
    """Return g = k W 2G / p^ at height z and its first two derivatives in kz; g(kh) is the surface compliance."""
    of_all, of_one = (_bonded_factors, _bonded_wave) if base == "bonded" else (_slipping_factors, _slipping_wave)
    found = [[of_one(z, h, of_all(h)) for z, h in zip(row, kh, strict=True)] for row in kz]
    g, slope, bend = np.array(found).transpose(2, 0, 1)
    return g, slope, bend


@lru_cache(maxsize=64)
def _force_curve(thickness_m: float, tip_radius_m: float, base: Base) -> CubicSpline:
    # F / (E d^1.5) over sqrt(d) is smooth. At 0, where the contact is small compared with the layer, it is Hertz's
    # 16/9 sqrt(R).
    deepest_m = (1 - 1e-6) * min(thickness_m, tip_radius_m)
    widest = contact_of_depth(deepest_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
    radii_m = widest.radius_m * np.linspace(0, 1, CURVE_N)[1:]
    contacts = [contact_of_radius(a, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base) for a in radii_m]
    root = np.sqrt([0.0] + [one.depth_m for one in contacts])
    share = [4 * np.pi / 3 * one.weights_m2.sum() / one.depth_m**1.5 for one in contacts]
    return CubicSpline(root, [16 / 9 * np.sqrt(tip_radius_m), *share])


def _kernel(
    at_m: Float[np.ndarray, " p"], x_m: Float[np.ndarray, " q"], thickness_m: float, base: Base
) -> Float[np.ndarray, "p q"]:
    # 2/pi times the integral of (1 - compliance) cos(k at) cos(k x) dk.
    surface = bonded_compliance if base == "bonded" else slipping_compliance
    missing = KERNEL_W / thickness_m * (1 - surface(KERNEL_KH))
    k_per_m = KERNEL_KH / thickness_m
    return 2 / np.pi * np.cos(np.outer(at_m, k_per_m)) * missing @ np.cos(np.outer(k_per_m, x_m))


BESSEL_STEP = 1 / 256  # between tabulated Bessel functions


@njit(cache=True, error_model="numpy")
@no_type_check
def _bonded_factors(kh):
    """Compute the factors of `_bonded_wave` that do not depend on the height."""
    base = exp(-2 * kh)
    size = (1 + base) ** 2 + 4 * kh * kh * base
    return (1 + base) / size, 2 * kh / size * exp(-kh), 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def _bonded_wave(kz, kh, of):
    """Return g of one wave at height z of a bonded layer, and its first two derivatives with respect to kz.

    g = [cosh A (sinh z' + t cosh z') - A cosh t - A z' sinh t] / (cosh^2 A + A^2), A = kh, z' = kz, t = A - z'.
    Numerator and denominator are divided by exp(2A) / 4, so that no exponent is positive inside the layer.
    """
    t = kh - kz
    top, fade = exp(-t), exp(-kz)
    low, high = fade * fade, top * top
    near, far = of[0] * top, of[1] * fade
    g = near * (1 + t - (1 - t) * low) - far * (1 + kz + (1 - kz) * high)
    slope = near * t * (1 - low) + far * kz * (1 + high)
    bend = near * (t * (1 + low) - (1 - low)) + far * (1 + high - kz * (1 - high))
    return g, slope, bend


@njit(cache=True, error_model="numpy")
@no_type_check
def _slipping_factors(kh):
    """Compute the factors of `_slipping_wave` that do not depend on the height."""
    fade, second = exp(-2 * kh), -expm1(-2 * kh)
    return second * (1 + fade) + 4 * kh * fade, (1 + kh) - (1 - kh) * fade, second


@njit(cache=True, error_model="numpy")
@no_type_check
def _slipping_wave(kz, kh, of):
    """Return g of one wave at height z of a slipping layer, and its first two derivatives with respect to kz.

    g = [(sinh A + A cosh A) sinh z' - z' sinh A cosh z'] / (sinh A cosh A + A): the odd solution, because both W and
    the shear W'' + W vanish at the base. Numerator and denominator are multiplied by 4 exp(-2A), so that no exponent is
    positive inside the layer.
    """
    size, first, second = of
    top, low = exp(kz - kh), exp(-kh - kz)
    odd, even = (top - low) / size, (top + low) / size
    g = first * odd - kz * second * even
    slope = (first - second) * even - kz * second * odd
    bend = (first - 2 * second) * odd - kz * second * even
    return g, slope, bend


@njit(cache=True, error_model="numpy")
@no_type_check
def _between(table, low, share):
    # Cubic Hermite interpolation of J0 and J1 between tabulated points, with exact slopes: error below 1e-12.
    j0_a, j1_a, slope_a = table[low, 0], table[low, 1], table[low, 2]
    j0_b, j1_b, slope_b = table[low + 1, 0], table[low + 1, 1], table[low + 1, 2]
    rest = 1 - share
    a, b = rest * rest * (1 + 2 * share), share * share * (3 - 2 * share)
    da, db = BESSEL_STEP * share * rest * rest, -BESSEL_STEP * share * share * rest
    return a * j0_a + b * j0_b - da * j1_a - db * j1_b, a * j1_a + b * j1_b + da * slope_a + db * slope_b


@njit(cache=True, error_model="numpy")
@no_type_check
def _sum_waves(r_m, z_m, waves, slipping, table):
    """Sum waves [k, kh, amplitude; w] at places [s]; return rows u_r, hoop, u_z, squeeze, du_r/dz, du_z/dr."""
    sums = np.zeros((6, len(r_m)))
    for w in range(waves.shape[1]):
        k, kh, amplitude = waves[0, w], waves[1, w], waves[2, w]
        steep, of = amplitude * k, _slipping_factors(kh) if slipping else _bonded_factors(kh)
        for s in range(len(r_m)):
            g, slope, bend = _slipping_wave(k * z_m[s], kh, of) if slipping else _bonded_wave(k * z_m[s], kh, of)
            at = k * r_m[s] / BESSEL_STEP
            low = int(at)
            j0_, j1_ = _between(table, low, at - low)
            sums[0, s] += amplitude * slope * j1_
            sums[1, s] += steep * slope / 2
            sums[2, s] -= amplitude * g * j0_
            sums[3, s] += steep * slope * j0_
            sums[4, s] += steep * bend * j1_
            sums[5, s] += steep * g * j1_
    for s in range(len(r_m)):
        if r_m[s] > 0:
            sums[1, s] = sums[0, s] / r_m[s]  # on the axis, the limit above
    return sums


@lru_cache(maxsize=4)
def _bessel_table(top: int) -> Float[np.ndarray, "x 3"]:
    """Tabulate J0, J1 and J1' = J0 - J1 / x from 0 to `top`, `BESSEL_STEP` apart."""
    x = BESSEL_STEP * np.arange(round(top / BESSEL_STEP) + 2)
    with np.errstate(invalid="ignore"):
        slope = np.where(x > 0, j0(x) - j1(x) / x, 0.5)
    return np.stack([j0(x), j1(x), slope], axis=1)
