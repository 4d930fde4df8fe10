"""Contact and force against closed forms, published fits and rings of pressure. In: a design of skins. Out: checks.

Refuses to know magnets, and where the material goes (`kinematics`).
"""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.constants import kilo, milli
from scipy.integrate import quad
from scipy.special import ellipe, ellipk, j0, j1

from pipeline.experiments.verification.checks import Check, worst
from pipeline.physics import flow, layer, slip
from pipeline.physics.skin import SkinDesign

HALF_SPACE_M = 100.0  # a layer that a tip of millimetres does not feel the base of
HELD_BACK = 1.770  # integral of 1 - compliance (PHYSICS 4; Dimitriadis et al. 2002 fit 1.780)
BONDED = (1.0, 1.133, 1.283, 0.769, 0.0975)  # Dimitriadis et al. 2002, powers of chi = sqrt(R d) / h
RINGS_N = 40


def check_contact(skin: SkinDesign) -> list[Check]:
    """Check the layer's compliance, and the force down to the published solutions' 0.6 of the thickness."""
    h_m, tip_m = skin.thickness_mm * milli, skin.tip_radius_mm * milli
    modulus_Pa = skin.modulus_kPa * kilo
    within_m = layer.VERIFIED_DEPTH * h_m * np.arange(1, 7) / 6
    return [
        *_compliance(),
        *_sliding(tip_m),
        *_thick(tip_m),
        *_published(within_m, h_m, tip_m),
        *_laws(within_m, h_m, tip_m, modulus_Pa),
    ]


def force_N(
    depth_m: Float[np.ndarray, " n"], thickness_m: float, tip_m: float, modulus_Pa: float = 1.0
) -> Float[np.ndarray, " n"]:
    """Give the product's force on a bonded skin, for 1 Pa unless said."""
    return layer.force(depth_m, thickness_m=thickness_m, tip_radius_m=tip_m, modulus_Pa=modulus_Pa, base="bonded")


def hertz_N(depth_m: Float[np.ndarray, " n"], tip_m: float) -> Float[np.ndarray, " n"]:
    """Give Hertz's force on an incompressible half-space of 1 Pa: 16/9 E sqrt(R) d^1.5."""
    return 16 / 9 * np.sqrt(tip_m) * depth_m**1.5


def _compliance() -> list[Check]:
    import mpmath

    kh = np.geomspace(1e-3, 300, 60)
    with mpmath.workdps(50):
        truth = [
            float((mpmath.sinh(2 * a) - 2 * a) / (mpmath.cosh(2 * a) + 2 * a**2 + 1))
            for a in map(mpmath.mpf, kh.tolist())
        ]
    found = layer.compliance(kh)
    missing, _ = quad(lambda a: 1 - layer.compliance(np.array([a]))[0], 0, 40)
    return [
        Check("bonded layer", "compliance, kh 1e-3-300", "its formula in 50 digits (mpmath)",
              float(np.abs(found / truth - 1).max()), "1", 3e-12,
              "the series' next term, and 1 - 1 + ... at kh = 1/4, which costs 3 digits"),
        Check("bonded layer", "a0: what a half-space lacks adds up", f"{HELD_BACK:.3f}", abs(missing - HELD_BACK), "1",
              5e-4, "three printed decimals"),
    ]  # fmt: skip


def _sliding(tip_m: float) -> list[Check]:
    """Check the layer that slides on its base against a dense solve of its equation, of fourth order in z."""
    import mpmath

    kh = np.geomspace(0.01, 30, 12)
    with mpmath.workdps(50):
        truth = [float(_solved(mpmath.mpf(a))) for a in kh.tolist()]
    depth_m = tip_m * np.array([1e-6, 1e-5])
    sliding_N = layer.force(depth_m, thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, modulus_Pa=1.0, base="slipping")
    return [
        Check("sliding layer", "compliance, kh 0.01-30", "a dense solve of four conditions, 50 digits (mpmath)",
              float(np.abs(slip.compliance(kh) / truth - 1).max()), "1", 1e-12, "rounding, 1 - 1 + ... at small kh"),
        Check("force, thick layer", "Hertz's, on a sliding base too", "16/9 E sqrt(R) d^1.5 (Hertz 1882)",
              float(np.abs(sliding_N / hertz_N(depth_m, tip_m) - 1).max()), "1", 1e-4, "as on a bonded one"),
    ]  # fmt: skip


def _solved(kh: Any) -> Any:
    """Sink the surface by a pressure of 1 in 2 G k: W'' + W = 0 at both faces, W = 0 below, 3 W' - W''' = 2 above."""
    import mpmath

    basis = (mpmath.sinh, mpmath.cosh, lambda z: z * mpmath.sinh(z), lambda z: z * mpmath.cosh(z))
    conditions = (({0: 1}, 0), ({2: 1, 0: 1}, 0), ({2: 1, 0: 1}, kh), ({1: 1.5, 3: -0.5}, kh))
    rows = [[sum(c * mpmath.diff(w, at, n) for n, c in of.items()) for w in basis] for of, at in conditions]
    weights = mpmath.lu_solve(mpmath.matrix(rows), mpmath.matrix([0, 0, 0, 1]))
    return sum(weight * w(kh) for weight, w in zip(weights, basis, strict=True))


def _thick(tip_m: float) -> list[Check]:
    tiny_m = tip_m * np.array([1e-6, 1e-5])
    radii_m = tip_m * np.array([0.1, 0.3, 0.7])
    contacts = [
        layer.contact_of_radius(float(a), thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, base="bonded") for a in radii_m
    ]
    log = np.log((tip_m + radii_m) / (tip_m - radii_m))
    sneddon_N = 4 / 3 * ((radii_m**2 + tip_m**2) / 2 * log - radii_m * tip_m)
    found_N = np.array([4 * np.pi / 3 * one.weights_m2.sum() for one in contacts])
    found_m = np.array([one.depth_m for one in contacts])
    base = "the base is felt as a / h, 2e-5"
    return [
        Check("force, thick layer", "Hertz's, d / R to 1e-5", "16/9 E sqrt(R) d^1.5 (Hertz 1882)",
              float(np.abs(force_N(tiny_m, HALF_SPACE_M, tip_m) / hertz_N(tiny_m, tip_m) - 1).max()), "1", 1e-4,
              "the base is felt as sqrt(R d) / h, 2e-7; a sphere is no paraboloid: d / R, 1e-5; the curve is a spline"),
        Check("force, thick layer", "a sphere's, contact radius to 0.7 R", "Sneddon 1965",
              float(np.abs(found_N / sneddon_N - 1).max()), "1", 1e-4, base),
        Check("depth, thick layer", "a sphere's, contact radius to 0.7 R", "Sneddon 1965",
              float(np.abs(found_m / (radii_m * log / 2) - 1).max()), "1", 1e-4, base),
    ]  # fmt: skip


def _published(depth_m: Float[np.ndarray, " n"], h_m: float, tip_m: float) -> list[Check]:
    chi = np.sqrt(tip_m * depth_m) / h_m
    bonded_N = hertz_N(depth_m, tip_m) * np.polynomial.polynomial.polyval(chi, BONDED)
    found_N = force_N(depth_m, h_m, tip_m)
    long_N = long_2011_N(depth_m, h_m, tip_m)
    deepest_m = float(depth_m.max())
    depths = f"{depth_m.min() / milli:g}-{deepest_m / milli:g} mm"
    return [
        Check("force of the skin", f"bonded layer, {depths}", "Dimitriadis et al. 2002, bonded",
              float(np.abs(found_N / bonded_N - 1).max()), "1", 0.10,
              "a series in chi = sqrt(R d) / h, from chi^2 on low: 8 % at chi = 0.5 against rings of pressure"),
        Check("force of the skin", f"bonded layer, {depths}", "Long et al. 2011",
              float(np.abs(found_N / long_N - 1).max()), "1", 0.05,
              "a fit to finite elements of large deformation, made for 0.3 <= R/h <= 12.7, d/h <= 0.6"),
        *(_against_rings(deepest_m, flow.Press(h_m, tip_m, base)) for base in ("bonded", "slipping")),
    ]  # fmt: skip


def _against_rings(depth_m: float, press: flow.Press) -> Check:
    found_N = layer.force(np.array([depth_m]), **asdict(press), modulus_Pa=1.0)
    layer_and_depth = f"{press.base} layer, {depth_m / milli:g} mm"
    return Check("force of the skin", layer_and_depth, f"{RINGS_N} rings of even pressure",
                 abs(float(found_N[0]) / rings_N(depth_m, press) - 1), "1", 0.01,
                 "a ring is 2.5 % of the contact's radius")  # fmt: skip


def _laws(depth_m: Float[np.ndarray, " n"], h_m: float, tip_m: float, modulus_Pa: float) -> list[Check]:
    once_N = force_N(depth_m, h_m, tip_m)
    exact_N = [
        4
        * np.pi
        / 3
        * layer.contact_of_depth(float(d), thickness_m=h_m, tip_radius_m=tip_m, base="bonded").weights_m2.sum()
        for d in depth_m
    ]
    return [
        Check("force of the skin", "proportional to E", "itself, at 1 Pa",
              worst(force_N(depth_m, h_m, tip_m, modulus_Pa), modulus_Pa * once_N), "1", 1e-13, "rounding"),
        Check("force of the skin", "three times the size, nine times the force", "itself, scaled",
              worst(force_N(3 * depth_m, 3 * h_m, 3 * tip_m), 9 * once_N), "1", 1e-9,
              "the spline's knots are found by a root search to 1e-12"),
        Check("force of the skin", "the curve passes through each contact", "the contact itself",
              worst(once_N, np.array(exact_N)), "1", 1e-6, "a cubic spline over 48 contacts"),
    ]  # fmt: skip


def long_2011_N(depth_m: Float[np.ndarray, " n"], h_m: float, tip_m: float) -> Float[np.ndarray, " n"]:
    """Give the force of Long et al. 2011 on a bonded incompressible layer of 1 Pa: Hertz's over psi."""
    omega, flat = (tip_m * depth_m / h_m**2) ** 1.5, h_m / tip_m
    alpha, beta = 10.05 - 0.63 * np.sqrt(flat) * (3.1 + flat**2), 4.8 - 4.23 * flat**2
    psi = (1 + 2.3 * omega) / (1 + 1.15 * np.cbrt(omega) + alpha * omega + beta * omega**2)
    return hertz_N(depth_m, tip_m) / psi


def rings_N(depth_m: float, press: flow.Press) -> float:
    """Give the force, for 1 Pa, of rings of even pressure that put ring after ring on the sphere, at a given depth."""
    h_m, tip_m, radius_m = press.thickness_m, press.tip_radius_m, press.contact(depth_m).radius_m
    surface = layer.compliance if press.base == "bonded" else slip.compliance
    edges_m = radius_m * np.linspace(0, 1, RINGS_N + 1)
    middles_m = (edges_m[1:] + edges_m[:-1]) / 2
    discs_m = np.array([[_sinking_m(r, edge, h_m, surface) for edge in edges_m[1:]] for r in middles_m])
    rings_m = np.diff(discs_m, axis=1, prepend=0.0)
    pressure = np.linalg.solve(rings_m, depth_m - (tip_m - np.sqrt(tip_m**2 - middles_m**2)))
    return float(2 / 3 * np.pi * (pressure * np.diff(edges_m**2)).sum())


def _sinking_m(r_m: float, disc_m: float, h_m: float, surface: Callable[[Any], Any]) -> float:
    # Under unit pressure / 2G on a disc: that of a half-space (elliptic integrals) less the hold of the base.
    m = (min(r_m, disc_m) / max(r_m, disc_m)) ** 2
    free = 2 / np.pi * max(r_m, disc_m) * (ellipe(m) if r_m <= disc_m else ellipe(m) - (1 - m) * ellipk(m))
    k = np.linspace(1e-3, 25, 1500) / h_m
    held = disc_m * j1(k * disc_m) / k * (1 - surface(k * h_m)) * j0(k * r_m)
    return float(free - np.trapezoid(held, k))
