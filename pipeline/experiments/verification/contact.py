"""Laws of contact, force and friction, against closed forms, published fits and rings of pressure. Out: checks.

Refuses to know magnets, and where the material goes (`kinematics`).
"""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import mpmath
import numpy as np
from jaxtyping import Float
from scipy.constants import kilo, milli
from scipy.integrate import quad
from scipy.special import ellipe, ellipk, j0, j1

from pipeline.experiments.verification.checks import Check, relative, worst
from reskin.physics import layer, shear
from reskin.physics import layer as slip
from reskin.physics import shear as friction
from reskin.physics.layer import Press
from reskin.physics.skin import SkinDesign

HALF_SPACE_M = 100.0  # a layer that a tip of millimetres does not feel the base of
HELD_BACK = 1.770  # integral of 1 - compliance (PHYSICS 4; Dimitriadis et al. 2002 fit 1.780)
BONDED = (1.0, 1.133, 1.283, 0.769, 0.0975)  # Dimitriadis et al. 2002, powers of chi = sqrt(R d) / h
RINGS_N = 40
SKIN_FORCE = "force of the skin"
FRICTION = 0.8
BONDED_KH, SLIDING_KH = np.geomspace(1e-3, 300, 60), np.geomspace(0.01, 30, 12)


def check_contact(skin: SkinDesign) -> list[Check]:
    """Check the layer's compliance, the force down to the published solutions' 0.6 of the thickness, and friction."""
    bonded = Press(skin.thickness_mm * milli, skin.tip_radius_mm * milli, "bonded")
    sliding = Press(bonded.thickness_m, bonded.tip_radius_m, "slipping")
    depth_m = layer.VERIFIED_DEPTH * bonded.thickness_m * np.arange(1, 7) / 6
    return [
        bonded_compliance(), held_back(),
        sliding_compliance(), hertz("slipping", bonded.tip_radius_m),
        hertz("bonded", bonded.tip_radius_m), *sneddon(bonded.tip_radius_m * np.array([0.1, 0.3, 0.7]), bonded),
        dimitriadis(depth_m, bonded), long_2011(depth_m, bonded),
        *(rings(float(depth_m.max()), press) for press in (bonded, sliding)),
        *scaling(depth_m, bonded, skin.modulus_kPa * kilo),
    ]  # fmt: skip


def force_N(depth_m: Float[np.ndarray, " n"], press: Press, modulus_Pa: float = 1.0) -> Float[np.ndarray, " n"]:
    """Give the product's force, for 1 Pa unless said."""
    return layer.force(depth_m, **asdict(press), modulus_Pa=modulus_Pa)


def hertz_N(depth_m: Float[np.ndarray, " n"], tip_m: float) -> Float[np.ndarray, " n"]:
    """Give Hertz's force on an incompressible half-space of 1 Pa: 16/9 E sqrt(R) d^1.5."""
    return 16 / 9 * np.sqrt(tip_m) * depth_m**1.5


def bonded_compliance(kh: Float[np.ndarray, " w"] = BONDED_KH) -> Check:
    with mpmath.workdps(50):
        truth = [
            float((mpmath.sinh(2 * a) - 2 * a) / (mpmath.cosh(2 * a) + 2 * a**2 + 1))
            for a in map(mpmath.mpf, kh.tolist())
        ]
    return Check("bonded layer", "compliance, kh 1e-3-300", "its formula in 50 digits (mpmath)",
                 relative(layer.compliance(kh), np.array(truth)), "1", 3e-12,
                 "the series' next term, and 1 - 1 + ... at kh = 1/4, which costs 3 digits")  # fmt: skip


def held_back() -> Check:
    missing, _ = quad(lambda a: 1 - layer.compliance(np.array([a]))[0], 0, 40)
    return Check("bonded layer", "a0: what a half-space lacks adds up", f"{HELD_BACK:.3f}", abs(missing - HELD_BACK),
                 "1", 5e-4, "three printed decimals")  # fmt: skip


def sliding_compliance(kh: Float[np.ndarray, " w"] = SLIDING_KH) -> Check:
    with mpmath.workdps(50):
        truth = [float(dense_profile(mpmath.mpf(a))(mpmath.mpf(a))) for a in kh.tolist()]
    return Check("sliding layer", "compliance, kh 0.01-30", "a dense solve of four conditions, 50 digits (mpmath)",
                 relative(slip.compliance_on_slip(kh), np.array(truth)), "1", 1e-12,
                 "rounding, 1 - 1 + ... at small kh")  # fmt: skip


def dense_profile(kh: Any) -> Callable[[Any], Any]:
    """Solve for W under a pressure of 1 in 2 G k: W'' + W = 0 at both faces, W = 0 below, 3 W' - W''' = 2 above."""
    basis = (mpmath.sinh, mpmath.cosh, lambda z: z * mpmath.sinh(z), lambda z: z * mpmath.cosh(z))
    conditions = (({0: 1}, 0), ({2: 1, 0: 1}, 0), ({2: 1, 0: 1}, kh), ({1: 1.5, 3: -0.5}, kh))
    rows = [[sum(c * mpmath.diff(w, z, n) for n, c in of.items()) for w in basis] for of, z in conditions]
    weights = mpmath.lu_solve(mpmath.matrix(rows), mpmath.matrix([0, 0, 0, 1]))
    return lambda z: sum(weight * w(z) for weight, w in zip(weights, basis, strict=True))


def hertz(base: layer.Base, tip_m: float) -> Check:
    depth_m = tip_m * np.array([1e-6, 1e-5])
    law, reason = {
        "bonded": ("Hertz's, d / R to 1e-5", "the base is felt as sqrt(R d) / h, 2e-7; a sphere is no paraboloid: "
                   "d / R, 1e-5; the curve is a spline"),
        "slipping": ("Hertz's, on a sliding base too", "as on a bonded one"),
    }[base]  # fmt: skip
    error = relative(force_N(depth_m, Press(HALF_SPACE_M, tip_m, base)), hertz_N(depth_m, tip_m))
    return Check("force, thick layer", law, "16/9 E sqrt(R) d^1.5 (Hertz 1882)", error, "1", 1e-4, reason)


def sneddon(radii_m: Float[np.ndarray, " n"], press: Press) -> list[Check]:
    tip_m = press.tip_radius_m
    thick = asdict(press) | {"thickness_m": HALF_SPACE_M}
    contacts = [layer.contact_of_radius(float(a), **thick) for a in radii_m]
    log = np.log((tip_m + radii_m) / (tip_m - radii_m))
    sneddon_N = 4 / 3 * ((radii_m**2 + tip_m**2) / 2 * log - radii_m * tip_m)
    found_N = np.array([4 * np.pi / 3 * contact.weights_m2.sum() for contact in contacts])
    found_m = np.array([contact.depth_m for contact in contacts])
    law, base = "a sphere's, contact radius to 0.7 R", "the base is felt as a / h, 2e-5"
    return [
        Check("force, thick layer", law, "Sneddon 1965", relative(found_N, sneddon_N), "1", 1e-4, base),
        Check("depth, thick layer", law, "Sneddon 1965", relative(found_m, radii_m * log / 2), "1", 1e-4, base),
    ]


def _to_depths(depth_m: Float[np.ndarray, " n"]) -> str:
    return f"bonded layer, {depth_m.min() / milli:g}-{depth_m.max() / milli:g} mm"


def dimitriadis(depth_m: Float[np.ndarray, " n"], press: Press) -> Check:
    chi = np.sqrt(press.tip_radius_m * depth_m) / press.thickness_m
    bonded_N = hertz_N(depth_m, press.tip_radius_m) * np.polynomial.polynomial.polyval(chi, BONDED)
    return Check(SKIN_FORCE, _to_depths(depth_m), "Dimitriadis et al. 2002, bonded",
                 relative(force_N(depth_m, press), bonded_N), "1", 0.10,
                 "a series in chi = sqrt(R d) / h, from chi^2 on low: 8 % at chi = 0.5 against rings of pressure"
                 )  # fmt: skip


def long_2011(depth_m: Float[np.ndarray, " n"], press: Press) -> Check:
    h_m, tip_m = press.thickness_m, press.tip_radius_m
    omega, flat = (tip_m * depth_m / h_m**2) ** 1.5, h_m / tip_m
    alpha, beta = 10.05 - 0.63 * np.sqrt(flat) * (3.1 + flat**2), 4.8 - 4.23 * flat**2
    psi = (1 + 2.3 * omega) / (1 + 1.15 * np.cbrt(omega) + alpha * omega + beta * omega**2)
    return Check(SKIN_FORCE, _to_depths(depth_m), "Long et al. 2011",
                 relative(force_N(depth_m, press), hertz_N(depth_m, tip_m) / psi), "1", 0.05,
                 "a fit to finite elements of large deformation, made for 0.3 <= R/h <= 12.7, d/h <= 0.6")  # fmt: skip


def rings(depth_m: float, press: Press) -> Check:
    edges_m, pressure = ring_pressures(depth_m, press)
    rings_N = float(2 / 3 * np.pi * (pressure * np.diff(edges_m**2)).sum())
    return Check(SKIN_FORCE, f"{press.base} layer, {depth_m / milli:g} mm", f"{RINGS_N} rings of even pressure",
                 abs(float(force_N(np.array([depth_m]), press)[0]) / rings_N - 1), "1", 0.01,
                 "a ring is 2.5 % of the contact's radius")  # fmt: skip


def ring_pressures(depth_m: float, press: Press) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
    """Give the edges of the rings over the product's contact, and their pressures for 1 Pa."""
    h_m, tip_m, radius_m = press.thickness_m, press.tip_radius_m, press.contact(depth_m).radius_m
    edges_m = radius_m * np.linspace(0, 1, RINGS_N + 1)
    middles_m = (edges_m[1:] + edges_m[:-1]) / 2
    discs_m = np.array([[_sinking_m(r, edge, h_m, press.base) for edge in edges_m[1:]] for r in middles_m])
    rings_m = np.diff(discs_m, axis=1, prepend=0.0)
    return edges_m, np.linalg.solve(rings_m, depth_m - (tip_m - np.sqrt(tip_m**2 - middles_m**2)))


def _sinking_m(r_m: float, disc_m: float, h_m: float, base: layer.Base) -> float:
    # Under unit pressure / 2G on a disc: that of a half-space (elliptic integrals) less the hold of the base.
    m = (min(r_m, disc_m) / max(r_m, disc_m)) ** 2
    free = 2 / np.pi * max(r_m, disc_m) * (ellipe(m) if r_m <= disc_m else ellipe(m) - (1 - m) * ellipk(m))
    k = np.linspace(1e-3, 25, 1500) / h_m
    surface = layer.compliance if base == "bonded" else slip.compliance_on_slip
    held = disc_m * j1(k * disc_m) / k * (1 - surface(k * h_m)) * j0(k * r_m)
    return float(free - np.trapezoid(held, k))


def scaling(depth_m: Float[np.ndarray, " n"], press: Press, modulus_Pa: float) -> list[Check]:
    once_N = force_N(depth_m, press)
    larger = Press(3 * press.thickness_m, 3 * press.tip_radius_m, press.base)
    exact_N = [4 * np.pi / 3 * press.contact(float(d)).weights_m2.sum() for d in depth_m]
    return [
        Check(SKIN_FORCE, "proportional to E", "itself, at 1 Pa",
              worst(force_N(depth_m, press, modulus_Pa), modulus_Pa * once_N), "1", 1e-13, "rounding"),
        Check(SKIN_FORCE, "three times the size, nine times the force", "itself, scaled",
              worst(force_N(3 * depth_m, larger), 9 * once_N), "1", 1e-9,
              "the spline's knots are found by a root search to 1e-12"),
        Check(SKIN_FORCE, "the curve passes through each contact", "the contact itself",
              worst(once_N, np.array(exact_N)), "1", 1e-6, "a cubic spline over 48 contacts"),
    ]  # fmt: skip


def check_sideways(skin: SkinDesign) -> list[Check]:
    """Check the stiffness of a thick layer and the friction along a straight drag."""
    tip_m, modulus_Pa = skin.tip_radius_mm * milli, skin.modulus_kPa * kilo
    radius_m = 0.1 * tip_m
    limit_N, stiffness = FRICTION * modulus_Pa * radius_m**2, modulus_Pa * radius_m
    return [
        sticking(radius_m), sliding(radius_m, tip_m, skin.base),
        straight_drag(np.linspace(0, 3e-3, 31), limit_N, stiffness_N_per_m=stiffness, coefficient=FRICTION),
    ]  # fmt: skip


def sticking(radius_m: float) -> Check:
    ratio = shear.stiffness_m(shear.stick(radius_m, HALF_SPACE_M), HALF_SPACE_M) / radius_m
    return Check("sideways stiffness, thick layer", "a tip that sticks: 16/3 G a", "Mindlin 1949, nu = 1/2",
                 abs(ratio / (16 / 3) - 1), "1", 1e-3, "the base is felt as a / h, 3e-6; sums over the contact"
                 )  # fmt: skip


def sliding(radius_m: float, tip_m: float, base: layer.Base) -> Check:
    contact = layer.contact_of_radius(radius_m, thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, base=base)
    ratio = shear.stiffness_m(shear.slip(contact), HALF_SPACE_M) / radius_m
    return Check("sideways stiffness, thick layer", "q = mu p of Hertz: 40/9 G a", "Cerruti's integral in closed form",
                 abs(ratio / (40 / 9) - 1), "1", 2e-3, "contact radius R / 10: a sphere is no paraboloid")  # fmt: skip


def straight_drag(
    path_m: Float[np.ndarray, " t"], limit_N: float, *, stiffness_N_per_m: float, coefficient: float
) -> Check:
    places_m, normal_N = np.column_stack([path_m, np.zeros_like(path_m)]), np.full_like(path_m, limit_N / coefficient)
    found = friction.drag(places_m, normal_N, stiffness_N_per_m=stiffness_N_per_m, friction=coefficient)
    truth_N = np.minimum(stiffness_N_per_m * path_m, limit_N)
    return Check("friction", "Q = min(k s, mu F) along a straight drag", "itself, by hand",
                 float(np.abs(found.force_N[:, 0] - truth_N).max() / limit_N), "1", 1e-12, "rounding of 30 steps"
                 )  # fmt: skip
