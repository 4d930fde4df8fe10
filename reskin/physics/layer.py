"""The elastic layer under a round tip: contact, force, and displacement of the material. SI units.

Waves of pressure on a layer that is bonded to its base or slips on it, summed to displacements and gradients.
"""

from dataclasses import asdict, dataclass
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


def compliance_on_slip(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Give the sinking of the surface under a wave of pressure, relative to that of a half-space.

    (cosh 2A - 1) / (sinh 2A + 2A), A = kh, with both sides divided by exp(2A) / 2; A / 2 for long waves.
    """
    double = np.minimum(2 * kh, 1e3)
    fade = np.exp(-double)
    long_waves = double < 1e-4
    rest = np.where(long_waves, 1.0, 1 - fade**2 + 2 * double * fade)
    return np.where(long_waves, double / 4, np.expm1(-double) ** 2 / rest)


BESSEL_STEP = 1 / 256  # between tabulated Bessel functions


@njit(cache=True, error_model="numpy")
@no_type_check
def bonded_whole(kh):
    """Give what `bonded` needs of the layer as a whole; it is the same at every height."""
    base = exp(-2 * kh)
    size = (1 + base) ** 2 + 4 * kh * kh * base
    return (1 + base) / size, 2 * kh / size * exp(-kh), 0.0


@njit(cache=True, error_model="numpy")
@no_type_check
def bonded(kz, kh, of):
    """Give g of one wave at height z of a layer that is held at its base, and its first two derivatives by kz.

    g = [cosh A (sinh z' + t cosh z') - A cosh t - A z' sinh t] / (cosh^2 A + A^2), t = A - z': the W of PHYSICS 4 with
    a and b put in. All of it is divided by exp(2A) / 4, so that no exponent is positive inside the layer.
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
def sliding_whole(kh):
    """Give what `sliding` needs of the layer as a whole; it is the same at every height."""
    fade, second = exp(-2 * kh), -expm1(-2 * kh)
    return second * (1 + fade) + 4 * kh * fade, (1 + kh) - (1 - kh) * fade, second


@njit(cache=True, error_model="numpy")
@no_type_check
def sliding(kz, kh, of):
    """Give g of one wave at height z, and its first two derivatives by kz; g(kh) is the surface's `compliance`.

    g = [(sinh A + A cosh A) sinh z' - z' sinh A cosh z'] / (sinh A cosh A + A): the odd solution, for at the base both
    W and W'' + W (the shear) vanish. All of it is multiplied by 4 exp(-2A), so that no exponent is positive inside.
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
    # Cubic Hermite between points BESSEL_STEP apart, with the true slopes: wrong by less than 1e-12.
    j0_a, j1_a, slope_a = table[low, 0], table[low, 1], table[low, 2]
    j0_b, j1_b, slope_b = table[low + 1, 0], table[low + 1, 1], table[low + 1, 2]
    rest = 1 - share
    a, b = rest * rest * (1 + 2 * share), share * share * (3 - 2 * share)
    da, db = BESSEL_STEP * share * rest * rest, -BESSEL_STEP * share * share * rest
    return a * j0_a + b * j0_b - da * j1_a - db * j1_b, a * j1_a + b * j1_b + da * slope_a + db * slope_b


@njit(cache=True, error_model="numpy")
@no_type_check
def sum_waves(r_m, z_m, waves, slipping, table):
    """Sum waves [k, k h, amplitude; w] at places [s] for `layer.displacement`: the rows of the result are its parts."""
    sums = np.zeros((6, len(r_m)))
    for w in range(waves.shape[1]):
        k, kh, amplitude = waves[0, w], waves[1, w], waves[2, w]
        steep, of = amplitude * k, sliding_whole(kh) if slipping else bonded_whole(kh)
        for s in range(len(r_m)):
            g, slope, bend = sliding(k * z_m[s], kh, of) if slipping else bonded(k * z_m[s], kh, of)
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
            sums[1, s] = sums[0, s] / r_m[s]  # on the axis: its limit
    return sums


def bessel(top: float) -> Float[np.ndarray, "x 3"]:
    """Tabulate J0, J1 and J1' = J0 - J1 / x from 0 to at least `top`."""
    return _bessel_to(1 << max(8, int(np.ceil(top)).bit_length()))


@lru_cache(maxsize=4)
def _bessel_to(top: int) -> Float[np.ndarray, "x 3"]:
    x = BESSEL_STEP * np.arange(round(top / BESSEL_STEP) + 2)
    with np.errstate(invalid="ignore"):
        slope = np.where(x > 0, j0(x) - j1(x) / x, 0.5)
    return np.stack([j0(x), j1(x), slope], axis=1)


Base = Literal["bonded", "slipping"]

VERIFIED_DEPTH = 0.6  # of the thickness: Long et al. 2011 compared with finite elements up to here
CURVE_N = 48  # contact radii of the force curve


def _gauss(top: float, points_n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    x, w = np.polynomial.legendre.leggauss(points_n)
    return top * (x + 1) / 2, top * w / 2


CONTACT_X, CONTACT_W = _gauss(1.0, 48)  # over the radius of the contact
KERNEL_KH, KERNEL_W = _gauss(24.0, 160)  # 1 - compliance falls as exp(-2 kh)
WAVES_KH, WAVES_W = _gauss(40.0, 240)  # the shortest wave of the field is 0.3 mm long in a skin of 2 mm


@dataclass(frozen=True)
class Contact:
    """Pressure under the tip, as weights of its transform: p^(k) / 2G = sum of weights * cos(k x)."""

    radius_m: float
    depth_m: float
    x_m: Float[np.ndarray, " q"]
    weights_m2: Float[np.ndarray, " q"]


@dataclass(frozen=True)
class Waves:
    """A pressure as waves J0(k r): wave numbers, and for each p^(k) dk / 2G."""

    k_per_m: Float[np.ndarray, " w"]
    amplitude_m: Float[np.ndarray, " w"]
    thickness_m: float
    base: Base


@dataclass(frozen=True)
class Displacement:
    """Displacement, outward and up, and its gradient: `r_z` is the derivative of the outward part along z."""

    r_m: Float[np.ndarray, " s"]
    z_m: Float[np.ndarray, " s"]
    r_r: Float[np.ndarray, " s"]
    r_z: Float[np.ndarray, " s"]
    z_r: Float[np.ndarray, " s"]
    z_z: Float[np.ndarray, " s"]
    hoop: Float[np.ndarray, " s"]


def compliance(kh: Float[np.ndarray, " w"]) -> Float[np.ndarray, " w"]:
    """Give the sinking of the surface under a wave of pressure, relative to that of a half-space.

    (sinh 2A - 2A) / (cosh 2A + 2 A^2 + 1), A = kh, with both sides divided by exp(2A) / 2, so that nothing overflows.
    """
    double = np.minimum(2 * kh, 1e3)  # there it is 1, and squares stay finite
    fade = np.exp(-double)
    s = double**2
    series = 2 * fade * double * s / 6 * (1 + s / 20 * (1 + s / 42 * (1 + s / 72 * (1 + s / 110))))
    sinh_part = np.where(double < 0.5, series, 1 - fade**2 - 2 * double * fade)
    return sinh_part / (1 + fade**2 + (s + 2) * fade)


def contact_of_radius(radius_m: float, *, thickness_m: float, tip_radius_m: float, base: Base) -> Contact:
    """Find pressure and depth for a contact of this radius, from a Fredholm equation (Lebedev & Ufliand 1958).

    p^(k) = integral of chi(x) cos(kx) makes the pressure vanish outside; chi - K chi = 2/pi (depth - x artanh(x/R))
    puts the surface on the sphere; the depth is the one that gives chi(radius) = 0, a pressure finite at the edge.
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
    """Find the contact at this depth, above 0."""

    def miss_m(radius_m: float) -> float:
        here = contact_of_radius(radius_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)
        return here.depth_m - depth_m

    # A thick layer has a^2 = R d; a thin one, that can only flow aside, 4 R d.
    top_m = min(2.1 * np.sqrt(tip_radius_m * depth_m), 0.999 * tip_radius_m)
    radius_m = float(brentq(miss_m, 1e-3 * np.sqrt(tip_radius_m * depth_m), top_m, rtol=1e-12))
    return contact_of_radius(radius_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m, base=base)


def beyond_verified(depth_m: Float[np.ndarray, " n"], thickness_m: float) -> Bool[np.ndarray, " n"]:
    """Flag the depths for which no published solution vouches."""
    return depth_m >= VERIFIED_DEPTH * thickness_m


def force(
    depth_m: Float[np.ndarray, " n"],
    *,
    thickness_m: float,
    tip_radius_m: float,
    modulus_Pa: float,
    base: Base,
) -> Float[np.ndarray, " n"]:
    """Give the force on the tip in newtons; a depth of zero or less is no contact: no force."""
    refuse_layer(depth_m, thickness_m, tip_radius_m)
    if not (np.isfinite(modulus_Pa) and modulus_Pa >= 0):
        raise ParamsError("layer", "modulus", "0 Pa or more", f"{modulus_Pa}", "Check the skin's modulus.")
    root_m = np.sqrt(np.maximum(depth_m, 0.0))
    return modulus_Pa * root_m**3 * _force_curve(thickness_m, tip_radius_m, base)(root_m)


def refuse_layer(depth_m: Float[np.ndarray, " n"], thickness_m: float, tip_radius_m: float) -> None:
    """Raise for a layer or a tip that cannot be, and for a poke through the layer or past the tip's half."""
    for what, size_m in (("thickness", thickness_m), ("tip radius", tip_radius_m)):
        if not 0 < size_m < np.inf:
            raise ParamsError("layer", what, "above 0 m and finite", f"{size_m}", "Check its unit.")
    limit_m = min(thickness_m, tip_radius_m)
    if not (np.isfinite(depth_m) & (depth_m < limit_m)).all():
        rule = f"finite and below {1e3 * limit_m:.3g} mm, the lesser of thickness and tip radius"
        raise ParamsError("poke", "depth", rule, f"{1e3 * np.max(depth_m):.3g} mm", "Poke less deep.")


def waves(contact: Contact, thickness_m: float, base: Base) -> Waves:
    """Write the contact's pressure as waves; a cos^2 window over the shortest half of them hides the cut."""
    window = np.cos(np.pi * np.maximum(WAVES_KH / WAVES_KH[-1] - 0.5, 0)) ** 2
    pressure_m2 = np.cos(np.outer(WAVES_KH / thickness_m, contact.x_m)) @ contact.weights_m2
    return Waves(WAVES_KH / thickness_m, pressure_m2 * window * WAVES_W / thickness_m, thickness_m, base)


def displacement(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], of: Waves) -> Displacement:
    """Sum the waves at (r, z): u_r = sum of amplitude g' J1, u_z = -sum of amplitude g J0 (PHYSICS 4: U = -W'/k)."""
    table = bessel(float(np.max(r_m, initial=0.0) * of.k_per_m[-1]))
    waves = np.stack([of.k_per_m, of.thickness_m * of.k_per_m, of.amplitude_m])
    out_m, hoop, up_m, squeeze, r_z, z_r = sum_waves(r_m, z_m, waves, of.base == "slipping", table)
    return Displacement(r_m=out_m, z_m=up_m, r_r=squeeze - hoop, r_z=r_z, z_r=z_r, z_z=-squeeze, hoop=hoop)


def depth_profile(
    kz: Float[np.ndarray, "s w"], kh: Float[np.ndarray, " w"], base: Base = "bonded"
) -> tuple[Float[np.ndarray, "s w"], Float[np.ndarray, "s w"], Float[np.ndarray, "s w"]]:
    """Give k W 2G / p^ = g at height z, and its first two derivatives by kz; g(kh) is the surface's `compliance`."""
    of_all, of_one = (bonded_whole, bonded) if base == "bonded" else (sliding_whole, sliding)
    found = [[of_one(z, h, of_all(h)) for z, h in zip(row, kh, strict=True)] for row in kz]
    g, slope, bend = np.array(found).transpose(2, 0, 1)
    return g, slope, bend


@lru_cache(maxsize=64)
def _force_curve(thickness_m: float, tip_radius_m: float, base: Base) -> CubicSpline:
    # F / E d^1.5 over sqrt(d): smooth, and Hertz's 16/9 sqrt(R) at 0, where the layer is thick beside the contact.
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
    # 2/pi integral of (1 - compliance) cos(k at) cos(k x) dk.
    surface = compliance if base == "bonded" else compliance_on_slip
    missing = KERNEL_W / thickness_m * (1 - surface(KERNEL_KH))
    k_per_m = KERNEL_KH / thickness_m
    return 2 / np.pi * np.cos(np.outer(at_m, k_per_m)) * missing @ np.cos(np.outer(k_per_m, x_m))


STEP = 0.025  # of `depth_unit`: 0.05 mm in a skin of 2 mm; half of it changes dB by 0.3 % (slipping), 0.6 % (bonded)
# Where the flow is stepped, whatever depths are asked for. The first step is cut in four and in two: there the
# contact's radius changes as the root of the depth.
LADDER = np.array([0.0, STEP / 4, STEP / 2, *(STEP * np.arange(1, round(1 / STEP) + 1))])
RIM_MAX = 1.2  # of the thickness: waves that end at the surface grow as exp(kz) above it
MARKS_N = 48  # on the surface, closer towards the axis
PRESSURES_N = 6  # 4 and 8 move the marks by less than 0.03 mm at 1.2 mm
DAMPING = 1e-3


@dataclass(frozen=True)
class Press:
    """What is pressed by what."""

    thickness_m: float
    tip_radius_m: float
    base: Base

    def contact(self, depth_m: float) -> Contact:
        """Give the contact at a depth."""
        return contact_of_depth(depth_m, thickness_m=self.thickness_m, tip_radius_m=self.tip_radius_m, base=self.base)


@dataclass(frozen=True)
class Material:
    """Present places of material points, and the gradient F of the map from rest; other entries of F are zero."""

    r_m: Float[np.ndarray, " s"]
    z_m: Float[np.ndarray, " s"]
    f: Float[np.ndarray, "s 2 2"]  # rows and columns: r, z
    hoop: Float[np.ndarray, " s"]


def follow(
    r_m: Float[np.ndarray, " s"],
    z_m: Float[np.ndarray, " s"],
    depths_m: Float[np.ndarray, " d"],
    press: Press,
) -> list[Material]:
    """Carry material from rest through the given depths; one `Material` for each.

    Marks on the surface go along: a pressure that fitted the surface at rest would leave the sunken one 0.3 mm behind a
    tip at 1.2 mm, so each step finds the pressure anew that brings the marks onto the sphere.
    """
    path = [with_marks(r_m, z_m, press)]
    for depth_m in depths_m[1:]:
        path.append(sink(path[-1], float(depth_m), press))
    return [without_marks(at) for at in path]


def sink(material: Material, depth_m: float, press: Press) -> Material:
    """Carry material, its marks first, one step on to a greater depth."""
    return carry(material, change(material, depth_m, press), depth_m, press)


def carry(material: Material, waves: Waves, depth_m: float, press: Press) -> Material:
    """Carry material, with marks or without, by the change of pressure that brings the marks to a depth."""
    sunken = _carry(material, waves)
    if not sunken.z_m.max() < RIM_MAX * press.thickness_m:
        rule = f"such that the rim stays below {RIM_MAX} of the skin's thickness"
        got = f"{depth_m / press.thickness_m:.3g} of the thickness"
        raise ParamsError("poke", "depth", rule, got, "Poke less deep.")
    return sunken


def angle(f: Float[np.ndarray, "s 2 2"]) -> Float[np.ndarray, " s"]:
    """Give the angle from z towards r of the R in F = R U."""
    return np.arctan2(f[:, 0, 1] - f[:, 1, 0], f[:, 0, 0] + f[:, 1, 1])


def depth_unit(size: float) -> float:
    """Give, in thicknesses, a smooth bound of all depths: below the lesser of thickness and tip radius (`size`)."""
    return size / (1 + size**4) ** 0.25


def steps(depths_m: tuple[float, ...], press: Press) -> Float[np.ndarray, " d"]:
    """List depths to follow: 0, the `LADDER`'s down to the deepest asked for, and every depth asked for."""
    ladder_m = press.thickness_m * depth_unit(press.tip_radius_m / press.thickness_m) * LADDER
    return np.unique(np.append(ladder_m[ladder_m < max(depths_m)], depths_m))


def with_marks(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], press: Press) -> Material:
    """Put the marks before material at rest; they reach as far as the widest contact, whatever depth is asked for."""
    widest = press.contact(press.thickness_m * depth_unit(press.tip_radius_m / press.thickness_m))
    r_m = np.append(widest.radius_m * np.linspace(0, 1, MARKS_N) ** 2, r_m)
    return resting(r_m, np.append(np.full(MARKS_N, press.thickness_m), z_m))


def resting(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"]) -> Material:
    """Give material at rest."""
    return Material(r_m, z_m, np.tile(np.eye(2), (len(r_m), 1, 1)), np.ones(len(r_m)))


def without_marks(material: Material) -> Material:
    """Take the marks away."""
    return Material(*(getattr(material, name)[MARKS_N:] for name in Material.__dataclass_fields__))


def change(material: Material, depth_m: float, press: Press) -> Waves:
    """Find the change of pressure that brings the marks, which stand first in `material`, to a greater depth.

    It is made of pressures of spheres on smaller contacts, and brings all marks inside the contact from where they are
    to the tip: least squares, damped, for waves shorter than the depth do not reach the marks.
    """
    contact = press.contact(depth_m)
    inside = np.flatnonzero(material.r_m[:MARKS_N] < contact.radius_m)
    r_m, z_m = material.r_m[inside], material.z_m[inside]
    radii_m = contact.radius_m * np.arange(1, PRESSURES_N + 1) / PRESSURES_N
    parts = [contact_of_radius(a_m, **asdict(press)) for a_m in radii_m]
    pressures = [waves(part, press.thickness_m, press.base) for part in parts]
    parted = [displacement(r_m, z_m, pressure) for pressure in pressures]
    height_m = np.sqrt(press.tip_radius_m**2 - r_m**2)
    towards = np.stack([u.z_m - r_m / height_m * u.r_m for u in parted], axis=1) / [part.depth_m for part in parts]
    missing_m = press.thickness_m - contact.depth_m + press.tip_radius_m - height_m - z_m
    damping = DAMPING * np.linalg.norm(towards, 2) * np.eye(PRESSURES_N)
    share = np.linalg.lstsq(np.vstack([towards, damping]), np.append(missing_m, np.zeros(PRESSURES_N)))[0]
    amplitudes = np.stack(
        [pressure.amplitude_m / part.depth_m for pressure, part in zip(pressures, parts, strict=True)]
    )
    return Waves(pressures[0].k_per_m, share @ amplitudes, press.thickness_m, press.base)


def _carry(material: Material, change: Waves) -> Material:
    # Midpoint rule: the change is that of the place where the material is half way; F by the chain rule through it.
    first = displacement(material.r_m, material.z_m, change)
    half_r_m, half_z_m = material.r_m + first.r_m / 2, material.z_m + first.z_m / 2
    second = displacement(half_r_m, half_z_m, change)
    eye = np.eye(2)
    half = (eye + _plane(first) / 2) @ material.f
    stretch = material.hoop * (1 + second.hoop * (1 + first.hoop / 2))
    return Material(material.r_m + second.r_m, material.z_m + second.z_m, material.f + _plane(second) @ half, stretch)


def _plane(u: Displacement) -> Float[np.ndarray, "s 2 2"]:
    return np.stack([np.stack([u.r_r, u.r_z], axis=-1), np.stack([u.z_r, u.z_z], axis=-1)], axis=-2)
