"""Checks of the simulator's mechanics: contact, force, friction and deformation of indentations, and the resulting dB.

dB is the change of the magnetic field at the chips due to an indentation (also called a poke).
The references are closed forms, published fits, an approximation of the contact by rings of uniform pressure, finite
differences, computations in finer steps, and symmetries.
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import mpmath
import numpy as np
from jaxtyping import Float
from scipy.constants import kilo, micro, milli
from scipy.integrate import quad
from scipy.special import ellipe, ellipk, j0, j1

from pipeline.experiments.verification.checks import (
    Check,
    max_error,
    no_spread,
    norm_error,
    relative_error,
    scaled_error,
)
from pipeline.experiments.verification.signals import TURN, field_of
from reskin.data.grid import CENTRE_MM, protocol
from reskin.physics import deformation, layer, shear, slide
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.layer import IndentedLayer
from reskin.physics.magnet import Dipoles, Polarity, Quadrature
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, press_motion

HALF_SPACE_M = 100.0  # under a tip of a few millimetres, a layer of this thickness behaves as if infinitely thick
A0 = 1.770  # integral of (1 - compliance) over kh; the value that Dimitriadis et al. (2002) fitted is 1.780
# Coefficients of the power series in chi = sqrt(R d) / h, by which Dimitriadis et al. (2002) multiply Hertz's force
BONDED = (1.0, 1.133, 1.283, 0.769, 0.0975)
RINGS_N = 40  # number of rings of pressure that cover a contact
SKIN_FORCE = "force of the skin"
FRICTION = 0.8  # coefficient of friction
# Values of wave number k * thickness h at which the compliance of a layer is checked
BONDED_KH, SLIDING_KH = np.geomspace(1e-3, 300, 60), np.geomspace(0.01, 30, 12)


def check_contact(skin: SkinDesign) -> list[Check]:
    """Check the compliance of a layer, and compare the force with published solutions up to 0.6 of the thickness.

    The compliance is the displacement of the surface under a wave of pressure, relative to a half-space (an infinitely
    thick layer). It depends on the product of the wave number k and the thickness h.
    """
    bonded = IndentedLayer(skin.thickness_mm * milli, skin.tip_radius_mm * milli, "bonded")
    sliding = IndentedLayer(bonded.thickness_m, bonded.tip_radius_m, "slipping")
    depth_m = layer.VERIFIED_DEPTH * bonded.thickness_m * np.arange(1, 7) / 6
    return [
        bonded_compliance(), compliance_integral(),
        sliding_compliance(), hertz("slipping", bonded.tip_radius_m),
        hertz("bonded", bonded.tip_radius_m), *sneddon(bonded.tip_radius_m * np.array([0.1, 0.3, 0.7]), bonded),
        dimitriadis(depth_m, bonded), long_2011(depth_m, bonded),
        *(rings(float(depth_m.max()), press) for press in (bonded, sliding)),
        *scaling(depth_m, bonded, skin.modulus_kPa * kilo),
    ]  # fmt: skip


def force_N(depth_m: Float[np.ndarray, " n"], press: IndentedLayer, modulus_Pa: float = 1.0) -> Float[np.ndarray, " n"]:
    """Return the simulator's indentation force in N, by default for a Young's modulus of 1 Pa."""
    return layer.force(depth_m, **asdict(press), modulus_Pa=modulus_Pa)


def hertz_N(depth_m: Float[np.ndarray, " n"], tip_m: float) -> Float[np.ndarray, " n"]:
    """Return Hertz's force of a sphere on an incompressible half-space with E = 1 Pa: 16/9 E sqrt(R) d^1.5."""
    return 16 / 9 * np.sqrt(tip_m) * depth_m**1.5


def bonded_compliance(kh: Float[np.ndarray, " w"] = BONDED_KH) -> Check:
    with mpmath.workdps(50):
        truth = [
            float((mpmath.sinh(2 * a) - 2 * a) / (mpmath.cosh(2 * a) + 2 * a**2 + 1))
            for a in map(mpmath.mpf, kh.tolist())
        ]
    return Check("bonded layer", "compliance for kh (wave number * thickness) from 1e-3 to 300",
                 "the same formula, evaluated with 50 digits (mpmath)",
                 relative_error(layer.bonded_compliance(kh), np.array(truth)), "1", 3e-12,
                 "Up to kh = 1/4, the simulator sums a series, whose omitted terms cause an error. Just above 1/4, it "
                 "subtracts almost equal numbers, so that 3 of 16 digits are lost.")  # fmt: skip


def compliance_integral() -> Check:
    missing, _ = quad(lambda a: 1 - layer.bonded_compliance(np.array([a]))[0], 0, 40)
    return Check("bonded layer", "a0, the integral of (1 - compliance) over kh", f"{A0:.3f}",
                 abs(missing - A0), "1", 5e-4, "The reference value has three decimals.")  # fmt: skip


def sliding_compliance(kh: Float[np.ndarray, " w"] = SLIDING_KH) -> Check:
    with mpmath.workdps(50):
        truth = [float(dense_profile(mpmath.mpf(a))(mpmath.mpf(a))) for a in kh.tolist()]
    return Check("sliding layer", "compliance for kh (wave number * thickness) from 0.01 to 30",
                 "solution of the four boundary conditions with 50 digits (mpmath)",
                 relative_error(layer.slipping_compliance(kh), np.array(truth)), "1", 1e-12,
                 "Rounding errors are largest at small kh, where almost equal numbers are subtracted.")  # fmt: skip


def dense_profile(kh: Any) -> Callable[[Any], Any]:
    """Return the function W(z), which is the vertical displacement in a layer on a sliding base under a pressure wave.

    The pressure on the surface is a wave with wave number k and amplitude 2 G k, where G is the shear modulus. The
    height z is in units of 1 / k. W satisfies four boundary conditions: W'' + W = 0 on both faces of the layer, W = 0
    on the base, and 3 W' - W''' = 2 on the surface.
    """
    basis = (mpmath.sinh, mpmath.cosh, lambda z: z * mpmath.sinh(z), lambda z: z * mpmath.cosh(z))
    conditions = (({0: 1}, 0), ({2: 1, 0: 1}, 0), ({2: 1, 0: 1}, kh), ({1: 1.5, 3: -0.5}, kh))
    rows = [
        [sum(c * mpmath.diff(w, z, n) for n, c in derivatives.items()) for w in basis] for derivatives, z in conditions
    ]
    weights = mpmath.lu_solve(mpmath.matrix(rows), mpmath.matrix([0, 0, 0, 1]))
    return lambda z: sum(weight * w(z) for weight, w in zip(weights, basis, strict=True))


def hertz(base: layer.Base, tip_m: float) -> Check:
    depth_m = tip_m * np.array([1e-6, 1e-5])
    law, reason = {
        "bonded": ("Hertz's law on a bonded base, for depths d up to 1e-5 of the tip radius R",
                   "Three small effects cause an error: the finite thickness h (sqrt(R d) / h, below 2e-7), Hertz's "
                   "approximation of the sphere by a paraboloid (d / R, 1e-5), and the interpolation of the force by "
                   "a spline."),
        "slipping": ("Hertz's law on a sliding base, for depths d up to 1e-5 of the tip radius R",
                     "The same three effects as on a bonded base cause an error."),
    }[base]  # fmt: skip
    error = relative_error(force_N(depth_m, IndentedLayer(HALF_SPACE_M, tip_m, base)), hertz_N(depth_m, tip_m))
    return Check("force of a thick layer", law, "16/9 E sqrt(R) d^1.5 (Hertz 1882)", error, "1", 1e-4, reason)


def sneddon(radii_m: Float[np.ndarray, " n"], press: IndentedLayer) -> list[Check]:
    tip_m = press.tip_radius_m
    thick = asdict(press) | {"thickness_m": HALF_SPACE_M}
    contacts = [layer.contact_of_radius(float(a), **thick) for a in radii_m]
    log = np.log((tip_m + radii_m) / (tip_m - radii_m))
    sneddon_N = 4 / 3 * ((radii_m**2 + tip_m**2) / 2 * log - radii_m * tip_m)
    found_N = np.array([4 * np.pi / 3 * contact.weights_m2.sum() for contact in contacts])
    found_m = np.array([contact.depth_m for contact in contacts])
    law = "Sneddon's law of a sphere, for contact radii a up to 0.7 of the tip radius"
    base = "The reference is for a half-space. The finite thickness h changes the result by a / h, which is below 2e-5."
    return [
        Check("force of a thick layer", law, "Sneddon 1965", relative_error(found_N, sneddon_N), "1", 1e-4, base),
        Check(
            "depth in a thick layer", law, "Sneddon 1965", relative_error(found_m, radii_m * log / 2), "1", 1e-4, base
        ),
    ]


def _to_depths(depth_m: Float[np.ndarray, " n"]) -> str:
    return f"bonded layer, depths from {depth_m.min() / milli:g} to {depth_m.max() / milli:g} mm"


def dimitriadis(depth_m: Float[np.ndarray, " n"], press: IndentedLayer) -> Check:
    chi = np.sqrt(press.tip_radius_m * depth_m) / press.thickness_m
    bonded_N = hertz_N(depth_m, press.tip_radius_m) * np.polynomial.polynomial.polyval(chi, BONDED)
    return Check(SKIN_FORCE, _to_depths(depth_m), "Dimitriadis et al. 2002, bonded",
                 relative_error(force_N(depth_m, press), bonded_N), "1", 0.10,
                 "The reference is a power series in chi = sqrt(R d) / h, whose terms from chi^2 on are too small. At "
                 "chi = 0.5, its force is 8 % below the force of the check that uses rings of pressure."
                 )  # fmt: skip


def long_2011(depth_m: Float[np.ndarray, " n"], press: IndentedLayer) -> Check:
    h_m, tip_m = press.thickness_m, press.tip_radius_m
    omega, flat = (tip_m * depth_m / h_m**2) ** 1.5, h_m / tip_m
    alpha, beta = 10.05 - 0.63 * np.sqrt(flat) * (3.1 + flat**2), 4.8 - 4.23 * flat**2
    psi = (1 + 2.3 * omega) / (1 + 1.15 * np.cbrt(omega) + alpha * omega + beta * omega**2)
    return Check(SKIN_FORCE, _to_depths(depth_m), "Long et al. 2011",
                 relative_error(force_N(depth_m, press), hertz_N(depth_m, tip_m) / psi), "1", 0.05,
                 "The reference is a formula that was fitted to finite-element simulations of large deformations, for "
                 "0.3 <= R/h <= 12.7 and d/h <= 0.6 (tip radius R, thickness h, depth d).")  # fmt: skip


def rings(depth_m: float, press: IndentedLayer) -> Check:
    edges_m, pressure = ring_pressures(depth_m, press)
    rings_N = float(2 / 3 * np.pi * (pressure * np.diff(edges_m**2)).sum())
    return Check(SKIN_FORCE, f"{press.base} layer, depth of {depth_m / milli:g} mm",
                 f"{RINGS_N} rings of uniform pressure in the contact",
                 abs(float(force_N(np.array([depth_m]), press)[0]) / rings_N - 1), "1", 0.01,
                 "Rings can only approximate the pressure. Each ring is 2.5 % of the contact radius wide.")  # fmt: skip


def ring_pressures(depth_m: float, press: IndentedLayer) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " p"]]:
    """Divide the simulator's contact area into rings, and find the uniform pressure on each ring.

    The pressures are chosen such that the surface touches the tip at the middle of each ring (collocation). Returns the
    radii of the ring edges, and the pressures in units of 2 G, where G is the shear modulus.
    """
    h_m, tip_m, radius_m = press.thickness_m, press.tip_radius_m, press.contact(depth_m).radius_m
    edges_m = radius_m * np.linspace(0, 1, RINGS_N + 1)
    middles_m = (edges_m[1:] + edges_m[:-1]) / 2
    discs_m = np.array([[_disc_deflection_m(r, edge, h_m, press.base) for edge in edges_m[1:]] for r in middles_m])
    rings_m = np.diff(discs_m, axis=1, prepend=0.0)
    return edges_m, np.linalg.solve(rings_m, depth_m - (tip_m - np.sqrt(tip_m**2 - middles_m**2)))


def _disc_deflection_m(r_m: float, disc_m: float, h_m: float, base: layer.Base) -> float:
    """Return the deflection of the surface at radius `r_m` for a uniform pressure of 2 G on a disc of radius `disc_m`.

    G is the shear modulus. The result is the deflection of a half-space (elliptic integrals) minus the effect of the
    base.
    """
    m = (min(r_m, disc_m) / max(r_m, disc_m)) ** 2
    free = 2 / np.pi * max(r_m, disc_m) * (ellipe(m) if r_m <= disc_m else ellipe(m) - (1 - m) * ellipk(m))
    k = np.linspace(1e-3, 25, 1500) / h_m
    surface = layer.bonded_compliance if base == "bonded" else layer.slipping_compliance
    base_effect = disc_m * j1(k * disc_m) / k * (1 - surface(k * h_m)) * j0(k * r_m)
    return float(free - np.trapezoid(base_effect, k))


def scaling(depth_m: Float[np.ndarray, " n"], press: IndentedLayer, modulus_Pa: float) -> list[Check]:
    once_N = force_N(depth_m, press)
    larger = IndentedLayer(3 * press.thickness_m, 3 * press.tip_radius_m, press.base)
    exact_N = [4 * np.pi / 3 * press.contact(float(d)).weights_m2.sum() for d in depth_m]
    return [
        Check(SKIN_FORCE, "proportional to Young's modulus E", "the force for E = 1 Pa, multiplied by E",
              scaled_error(force_N(depth_m, press, modulus_Pa), modulus_Pa * once_N), "1", 1e-13,
              "Only rounding errors occur."),
        Check(SKIN_FORCE, "nine times as large if all lengths are three times as large",
              "the force before scaling, multiplied by nine",
              scaled_error(force_N(3 * depth_m, larger), 9 * once_N), "1", 1e-9,
              "The nodes of the force curve, which is a spline, depend on a root search that stops at 1e-12."),
        Check(SKIN_FORCE, "interpolated over the depth by a spline", "the force without interpolation, at each depth",
              scaled_error(once_N, np.array(exact_N)), "1", 1e-6,
              "The cubic spline through 48 nodes is not exact between the nodes."),
    ]  # fmt: skip


def check_sideways(skin: SkinDesign) -> list[Check]:
    """Check the tangential stiffness of a thick layer, and the friction force along a straight drag."""
    tip_m, modulus_Pa = skin.tip_radius_mm * milli, skin.modulus_kPa * kilo
    radius_m = 0.1 * tip_m
    limit_N, stiffness = FRICTION * modulus_Pa * radius_m**2, modulus_Pa * radius_m
    return [
        sticking(radius_m), sliding(radius_m, tip_m, skin.base),
        straight_drag(np.linspace(0, 3e-3, 31), limit_N, stiffness_N_per_m=stiffness, coefficient=FRICTION),
    ]  # fmt: skip


def sticking(radius_m: float) -> Check:
    ratio = shear.tangential_stiffness_m(shear.stick_traction(radius_m, HALF_SPACE_M), HALF_SPACE_M) / radius_m
    return Check("tangential stiffness of a thick layer", "tip that sticks: 16/3 * shear modulus * contact radius a",
                 "Mindlin 1949, Poisson's ratio 1/2", abs(ratio / (16 / 3) - 1), "1", 1e-3,
                 "The integral over the contact is computed as a sum. In addition, the finite thickness h changes the "
                 "stiffness by a / h, which is below 3e-6."
                 )  # fmt: skip


def sliding(radius_m: float, tip_m: float, base: layer.Base) -> Check:
    contact = layer.contact_of_radius(radius_m, thickness_m=HALF_SPACE_M, tip_radius_m=tip_m, base=base)
    ratio = shear.tangential_stiffness_m(shear.slip_traction(contact), HALF_SPACE_M) / radius_m
    return Check("tangential stiffness of a thick layer", "tip that slides: 40/9 * shear modulus * contact radius",
                 "Cerruti's integral of a shear stress proportional to Hertz's pressure, in closed form",
                 abs(ratio / (40 / 9) - 1), "1", 2e-3,
                 "Hertz approximates the sphere by a paraboloid. At a contact radius of a tenth of the tip radius, "
                 "this changes the pressure a little.")  # fmt: skip


def straight_drag(
    path_m: Float[np.ndarray, " t"], limit_N: float, *, stiffness_N_per_m: float, coefficient: float
) -> Check:
    places_m, normal_N = np.column_stack([path_m, np.zeros_like(path_m)]), np.full_like(path_m, limit_N / coefficient)
    drag = shear.drag_force(places_m, normal_N, stiffness_N_per_m=stiffness_N_per_m, friction=coefficient)
    truth_N = np.minimum(stiffness_N_per_m * path_m, limit_N)
    return Check("friction", "tangential force of a straight drag",
                 "the smaller of stiffness * distance and coefficient of friction * normal force",
                 float(np.abs(drag.force_N[:, 0] - truth_N).max() / limit_N), "1", 1e-12,
                 "Only the rounding errors of 30 steps occur."
                 )  # fmt: skip


STEPS_N = 12  # number of depth steps of an indentation; for a depth of 1.2 mm, each step is 0.1 mm
STEP_M = 1e-7  # distance from a place to each of its two neighbours in central differences
HELD = {"bonded": "does not move", "slipping": "keeps its height"}  # how the base constrains the material on it


def check_kinematics(press: layer.IndentedLayer, depth_m: float) -> list[Check]:
    """Check the deformation of a layer in one linear step, and in an indentation to `depth_m` in several steps."""
    far = far_field(press, depth_m) if press.base == "slipping" else []
    return [*one_small_step(press, depth_m), *finite_deformation(press, depth_m), *sunken_surface(press, depth_m), *far]


def descent(depth_m: float, steps_n: int = STEPS_N) -> Float[np.ndarray, " d"]:
    """Return depths from 0 to `depth_m` in equal steps, with additional stops at a quarter and half of the first step.

    The additional stops are needed because the contact radius grows as the square root of the depth.
    """
    even = np.linspace(0, depth_m, steps_n + 1)
    return np.concatenate([[0.0, even[1] / 4, even[1] / 2], even[1:]])


def one_small_step(press: layer.IndentedLayer, depth_m: float) -> list[Check]:
    h_m, tip_m, contact = press.thickness_m, press.tip_radius_m, press.contact(depth_m)
    waves = layer.waves(contact, h_m, press.base)
    r_m, z_m = _places(h_m, 17, 9)
    u = layer.displacement(r_m, z_m, waves)
    right, left = (layer.displacement(r_m + side * STEP_M, z_m, waves) for side in (1, -1))
    above, below = (layer.displacement(r_m, z_m + side * STEP_M, waves) for side in (1, -1))
    slopes = [right.r_m - left.r_m, right.z_m - left.z_m, above.r_m - below.r_m, above.z_m - below.z_m]
    numeric = np.stack([*(slope / (2 * STEP_M) for slope in slopes), u.r_m / r_m])
    base = layer.displacement(r_m, np.zeros_like(r_m), waves)
    under_m = 0.95 * contact.radius_m * np.linspace(0, 1, 30)
    sunken = layer.displacement(under_m, np.full(30, h_m), waves)
    sphere_m = tip_m - np.sqrt(tip_m**2 - under_m**2) - depth_m
    name, differences = "one linear step of the deformation", "central differences with steps of 0.1 um"
    length = (
        "The strains are near 1. The relative error of central differences is the square of step / length, where "
        "length is the distance over which the strains change."
    )
    return [
        Check(name, "volume is conserved: div u = 0 (displacement u)", differences,
              max_error(numeric[0] + numeric[3] + numeric[4], 0.0), "1", 1e-6, length),
        Check(name, "gradient of the displacement u", differences,
              max_error(np.stack([u.r_r, u.z_r, u.r_z, u.z_z, u.hoop]), numeric), "1", 1e-6, length),
        Check(name, f"material on the {press.base} base {HELD[press.base]}", "0 m", _off(base.r_m, base.z_m, press),
              "m", 1e-17, "Rounding errors are about 1e-14 of the depth."),
        Check(name, "surface in the contact has the shape of the tip", "a sphere",
              max_error(sunken.z_m, sphere_m) / depth_m, "of the depth", 0.005,
              "The pressure is a sum of waves. Waves shorter than 1/6 of the thickness are omitted, so that the shape "
              "of the surface is not exact."),
    ]  # fmt: skip


def _off(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], press: layer.IndentedLayer) -> float:
    return float(np.abs([z_m] if press.base == "slipping" else [r_m, z_m]).max())


def finite_deformation(press: layer.IndentedLayer, depth_m: float) -> list[Check]:
    h_m = press.thickness_m
    r_m, z_m = _places(h_m, 25, 11)
    inside = len(r_m)
    # A single call to `follow` tracks all points: the places, their neighbours for central differences, and the base.
    shifts = [(0.0, 0.0), (STEP_M, 0.0), (-STEP_M, 0.0), (0.0, STEP_M), (0.0, -STEP_M)]
    base_m = np.linspace(0, 4 * h_m, 40)
    all_r_m = np.concatenate([*(r_m + dr_m for dr_m, _ in shifts), base_m])
    all_z_m = np.concatenate([*(z_m + dz_m for _, dz_m in shifts), np.zeros_like(base_m)])
    depths_m = descent(depth_m)
    end = deformation.follow(all_r_m, all_z_m, depths_m, press=press)[-1]
    _, right, left, above, below, base = np.split(np.stack([end.r_m, end.z_m]), inside * np.arange(1, 6), axis=1)
    # Axes of `numeric`: displaced coordinate (r, z); initial coordinate of the derivative (r, z); place.
    numeric = np.stack([right - left, above - below], axis=1) / (2 * STEP_M)
    f, hoop = end.f[:inside], end.hoop[:inside]
    gradient = max(max_error(f, numeric.transpose(2, 0, 1)), max_error(hoop, end.r_m[:inside] / r_m))
    return [
        Check("deformation in steps", f"volume is conserved in {STEPS_N} steps: det F = 1 (deformation gradient F)",
              "1", max_error(np.linalg.det(f) * hoop, 1.0), "1", 0.02,
              "The error is of second order in the size of the steps, and is largest at the edge of the contact."),
        Check("deformation in steps", "F is the gradient of the positions after the deformation",
              "central differences with steps of 0.1 um", gradient, "1", 1e-5,
              "The stretches are near 1. The relative error of central differences is the square of step / length, "
              "where length is the distance over which the stretches change."),
        Check("deformation in steps", f"material on the {press.base} base {HELD[press.base]}", "0 m",
              _off(base[0] - base_m, base[1], press), "m", 1e-16,
              f"Only the rounding errors of {len(depths_m) - 1} steps occur."),
    ]  # fmt: skip


def sunken_surface(press: layer.IndentedLayer, depth_m: float) -> list[Check]:
    h_m, tip_m, radius_m = press.thickness_m, press.tip_radius_m, press.contact(depth_m).radius_m
    end = deformation.follow(radius_m * np.linspace(0, 1.4, 40), np.full(40, h_m), descent(depth_m), press=press)[-1]
    above_m = end.z_m - (h_m - depth_m + tip_m - np.sqrt(tip_m**2 - np.minimum(end.r_m, tip_m) ** 2))
    touches = end.r_m < 0.95 * radius_m
    reason = "In each step, the pressure is a sum of only six basis pressures, so that the surface is no exact sphere."
    return [
        Check("deformation in steps", "surface in the contact has the shape of the tip", "a sphere",
              max_error(above_m[touches], 0.0) / depth_m, "of the depth", 0.02, reason),
        Check("deformation in steps", "surface beside the contact does not enter the tip", "a sphere",
              max(0.0, float(above_m.max() / depth_m)), "of the depth", 0.02, reason),
    ]  # fmt: skip


def far_field(press: layer.IndentedLayer, depth_m: float) -> list[Check]:
    """Check how far the material moves outwards at a large distance from the tip, if the base slips.

    r is the distance of a material point from the tip's axis. As the layer is incompressible, r^2 must grow by the same
    amount at all points, whatever their height and their distance.
    """
    h_m = press.thickness_m
    r_m, z_m = (grid_m.ravel() for grid_m in np.meshgrid(np.array([4.0, 5.0, 6.0]) * h_m, np.linspace(0, h_m, 7)))
    end = deformation.follow(r_m, z_m, descent(depth_m), press=press)[-1]
    grown_m2 = end.r_m**2 - r_m**2
    return [
        Check("deformation in steps", "far from the tip, the squared distance r^2 grows by the same amount everywhere",
              "the mean over all heights and distances",
              scaled_error(grown_m2, np.full_like(grown_m2, grown_m2.mean())), "1", 0.03,
              "Waves that decay as exp(-pi r / h) disturb this rule near the contact. The simulator relies on the rule "
              "only outside its tables, which end 5 thicknesses h beyond the contact."),
    ]  # fmt: skip


def _places(h_m: float, r_n: int, z_n: int) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    r_m, z_m = np.meshgrid(np.linspace(0.035, 2.5, r_n) * h_m, np.linspace(0.03, 0.97, z_n) * h_m, indexing="ij")
    return r_m.ravel(), z_m.ravel()


def follow_dipoles(skin: Skin, place_m: Float[np.ndarray, "2"], depths_m: Float[np.ndarray, " d"]) -> Dipoles:
    """Return the dipoles of a skin that has been indented and has slid on its base.

    The depth increases in the steps `depths_m` (true depths). Unlike the simulator, this function computes the motion
    of each dipole directly, without interpolation in tables. Each moment is rotated by R, the rotation in the polar
    decomposition F = R U of the deformation gradient F at the dipole. The decomposition is computed by singular value
    decomposition. No dipole may be on the tip's axis.
    """
    away_m = skin.nodes_m[:, :2] - place_m
    r_m = np.linalg.norm(away_m, axis=1)
    press = layer.IndentedLayer(skin.thickness_m, skin.tip_radius_m, skin.base)
    end = deformation.follow(r_m, skin.nodes_m[:, 2], depths_m, press=press)[-1]
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


# A skin is simulated by dipoles at the nodes of a quadrature rule.
COARSE = Quadrature(cell_m=2.2e-3, layers_n=4)  # rule for checks whose result does not depend on the rule
DENSE = Quadrature(cell_m=1.5e-3, layers_n=4)  # rule for checks of the errors due to tables and steps
PLACE_STRIDE = 5  # every fifth of the protocol's 65 places is checked
REFERENCE_STEPS_N = 16  # number of depth steps of an indentation in the reference
# Errors of this size are not visible in readings: they are a third of a chip's noise, so that noise and error together
# have an rms that is only 5 % larger than the rms of the noise.
UNSEEN_uT = 1.0
DB = "field change dB of pokes"
TOTAL_ERROR = "A total error of 2 % is accepted for the field change of a poke."
# Places of indentations at which no node is on the tip's axis, where the outward direction would be undefined
PLACES_M = np.array([[1.1, -2.3], [-4.2, 0.7], [5.3, 6.1]]) * milli
Places = Float[np.ndarray, "p 2"]


def check_indentations(
    board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, rule: Quadrature, depths_m: tuple[float, ...], seed: int
) -> list[Check]:
    """Check dB of indentations on a scene's first skin, and symmetries of dB on a skin without spreads."""
    first_board, exact = draw_board(board, spreads, seed=seed, name="b0"), no_spread(spreads)

    def skin_of(rule: Quadrature, design: SkinDesign = skin, spreads: Spreads = spreads) -> Skin:
        return draw_skin(design, spreads, seed=seed, name="b0_s0", rule=rule)

    cells, layers = Quadrature(rule.cell_m / 2, rule.layers_n), Quadrature(rule.cell_m, 2 * rule.layers_n)
    fine, stronger = (
        (skin_of(cells), skin_of(layers)),
        skin.model_copy(update={"saturation_T": 2.5 * skin.saturation_T}),
    )
    dense = skin_of(DENSE)
    # The rig yields differently along x and y, so dB is symmetric only if the rig is rigid.
    rigid = (
        skin
        if skin.hold is None
        else skin.model_copy(update={"hold": skin.hold.model_copy(update={"give_um": (0.0, 0.0)})})
    )
    return [
        *quadrature(first_board, skin_of(rule), fine, rules=(rule, cells, layers),
                    pokes_m=each_depth(_grid_m(), depths_m)),
        approximations(first_board, dense, min(depths_m), "shallowest"),
        approximations(first_board, dense, max(depths_m), "deepest"),
        *symmetries(draw_board(board, exact, seed=seed, name="b0"), skin_of(COARSE, rigid, exact), skin.polarity),
        amplitude(first_board, skin_of(COARSE), skin_of(COARSE, stronger),
                  pokes_m=each_depth(PLACES_M, (0.3 * skin.thickness_mm * milli,))),
    ]  # fmt: skip


def quadrature(
    board: Board,
    skin: Skin,
    fine: tuple[Skin, Skin],
    *,
    rules: tuple[Quadrature, Quadrature, Quadrature],
    pokes_m: Float[np.ndarray, "n 3"],
    unseen_uT: float = UNSEEN_uT,
) -> list[Check]:
    """Check that the quadrature rule of a skin is fine enough.

    dB of the skin is compared with dB of the same skin with narrower cells, and with more layers (`fine`). `rules` are
    the quadrature rules of the three skins. Differences below `unseen_uT` in a channel are not visible in readings.
    """
    found_T, cells_T, layers_T = (changes_of_field(board, variant, pokes_m)[1] for variant in (skin, *fine))
    size_T = np.linalg.norm(cells_T, axis=(1, 2), keepdims=True)
    allowed_T = np.maximum(0.02 * size_T, unseen_uT * micro)
    used, cells, layers = rules
    narrower = f"cells of {cells.cell_m / milli:g} mm instead of {used.cell_m / milli:g} mm"
    subject = "skin represented by dipoles (quadrature), pressed at "
    subject += f"{len(np.unique(pokes_m[:, :2], axis=0))} places of the protocol and at all depths"
    return [
        Check(DB, subject, narrower, norm_error(found_T, cells_T), "1", 0.02, TOTAL_ERROR),
        Check(DB, f"{subject}: largest error of a channel", narrower,
              float((np.abs(found_T - cells_T) / allowed_T).max()), "of the allowed error", 1.0,
              f"The allowed error is 2 % of the poke's field change, or {unseen_uT:g} uT if that is more. An error "
              f"of {unseen_uT:g} uT is not visible in readings, because it is a third of a chip's noise."),
        Check(DB, subject,
              f"{layers.layers_n} layers instead of {used.layers_n}", norm_error(found_T, layers_T), "1", 0.005,
              "Gauss quadrature over the height converges fast. The allowed error is therefore a quarter of the error "
              "that is allowed for the cells."),
    ]  # fmt: skip


def approximations(board: Board, skin: Skin, depth_m: float, kind: str, places_m: Places = PLACES_M) -> Check:
    """Compare the simulator's dB with dB of magpylib dipoles, whose motion is computed in fine steps without tables."""
    pokes_m = each_depth(places_m, (depth_m,))
    _, found_T = changes_of_field(board, skin, pokes_m)
    before_T = field_of((skin.nodes_m, skin.moments_A_m2), board.chips_m)
    depths_m = descent(depth_m + skin.depth_zero_m, REFERENCE_STEPS_N)
    moved = [follow_dipoles(skin, place_m, depths_m) for place_m in places_m]
    truth_T = np.stack([field_of(dipoles, board.chips_m) - before_T for dipoles in moved])
    subject = f"simulation with tables of the deformation and few depth steps, {kind} depth ({depth_m / milli:g} mm)"
    reference = (
        f"simulation without tables: each dipole is moved in {REFERENCE_STEPS_N} steps and rotated by SVD, and "
        "magpylib computes the fields"
    )
    return Check(DB, subject, reference, norm_error(found_T, truth_T), "1", 0.02, TOTAL_ERROR)


def symmetries(board: Board, skin: Skin, polarity: Polarity, places_m: Places = PLACES_M) -> list[Check]:
    """Check three symmetries of dB on a skin without manufacturing spreads.

    If board, skin and indentations are rotated or mirrored together, dB must be rotated or mirrored in the same way. If
    they are shifted together, dB must not change.
    """
    sign = -1 if polarity == "checkerboard" else 1  # a quarter turn or mirroring x swaps the poles of a checkerboard
    mirror, shift_m = np.diag([-1.0, 1.0, 1.0]), np.array([0.4, -0.7, 0.0]) * milli
    pokes_m = each_depth(places_m, (0.3 * skin.thickness_m,))
    here_T = _change(board.chips_m, skin, pokes_m)
    turned_T = _change(board.chips_m @ TURN.T, skin, pokes_m @ TURN.T)
    mirrored_T = _change(board.chips_m @ mirror, skin, pokes_m @ mirror)
    shifted = replace(skin, nodes_m=skin.nodes_m + shift_m, seat_m=skin.seat_m + shift_m[:2])
    shifted_T = _change(board.chips_m + shift_m, shifted, pokes_m + shift_m)
    rounding = "Only rounding errors occur, because the simulation must not depend on the direction."
    name = f"{DB}, {polarity}"
    return [
        Check(name, "a quarter turn of board and poke", "the original dB, turned (and negated for a checkerboard)",
              scaled_error(turned_T, sign * here_T @ TURN.T), "1", 1e-9, rounding),
        Check(name, "a mirror image of board and poke",
              "the original dB, mirrored (and negated for a checkerboard)",
              scaled_error(mirrored_T, sign * here_T @ mirror), "1", 1e-9, rounding),
        Check(name, "skin, poke and chips moved together", "the original dB",
              scaled_error(shifted_T, here_T), "1", 1e-9, rounding),
    ]  # fmt: skip


def amplitude(
    board: Board, skin: Skin, stronger: Skin, *, pokes_m: Float[np.ndarray, "n 3"], factor: float = 2.5
) -> Check:
    """Check that dB of skin `stronger`, which is magnetised `factor` times as strongly, is `factor` times as large."""
    once_T, more_T = (_change(board.chips_m, variant, pokes_m) for variant in (skin, stronger))
    return Check(DB, "proportional to the magnetisation", f"the original dB, multiplied by {factor:g}",
                 scaled_error(more_T, factor * once_T), "1", 1e-12, "Only rounding errors occur.")  # fmt: skip


def _change(
    chips_m: Float[np.ndarray, "k 3"], skin: Skin, pokes_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n k 3"]:
    eyes = np.tile(np.eye(3), (len(chips_m), 1, 1))
    return changes_of_field(Board("bare", chips_m, eyes, eyes, np.zeros_like(chips_m)), skin, pokes_m)[1]


def _grid_m() -> Places:
    plan = protocol((1.0,), 1)
    return (np.column_stack([plan.x_mm - CENTRE_MM, plan.y_mm - CENTRE_MM]) * milli)[::PLACE_STRIDE]


def each_depth(places_m: Places, depths_m: tuple[float, ...]) -> Float[np.ndarray, "n 3"]:
    """Return pokes (x, y, depth) at all places for each depth, sorted by depth."""
    return np.column_stack([np.tile(places_m, (len(depths_m), 1)), np.repeat(depths_m, len(places_m))])
