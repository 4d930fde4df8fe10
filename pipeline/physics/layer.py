"""The skin under a round tip. In: thickness, tip, depth, base, SI. Out: contact, force, displacement and gradient.

Incompressible elastic layer on a rigid base that holds it (bonded) or lets it slide (`slip`), endless sideways,
frictionless sphere, linear: small changes of depth. Refuses to know magnets, and what many small changes add up to.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from pipeline.core.errors import ParamsError
from pipeline.physics import slip
from pipeline.physics.waves import bessel, bonded, bonded_whole, sliding, sliding_whole, sum_waves

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
    surface = compliance if base == "bonded" else slip.compliance
    missing = KERNEL_W / thickness_m * (1 - surface(KERNEL_KH))
    k_per_m = KERNEL_KH / thickness_m
    return 2 / np.pi * np.cos(np.outer(at_m, k_per_m)) * missing @ np.cos(np.outer(k_per_m, x_m))
