"""How the skin gives way under a spherical tip. In: place in the layer, dent. Out: displacement, rotation, force.

Closed forms for an incompressible layer on a bonded base: linear in depth, axisymmetric, endless sideways. Linear
means det F falls to 0.4 at 1.2 mm and dB is off by 7-23 % (PHYSICS 0). Refuses to know magnets and chips.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.errors import ParamsError, complain

REACH = 4.0  # in dent widths: material farther away moves less than 0.3 % of the depth, and is left at rest
DEPTH_MAX = 0.75  # of the thickness: there det F reaches 0 under the tip, and the linear map folds


@dataclass(frozen=True)
class Dent:
    """One poke: how deep, how wide (the `a` of exp(-r^2 / 2 a^2)), in a layer how thick."""

    depth_m: float
    width_m: float
    thickness_m: float


@dataclass(frozen=True)
class Gradient:
    """Deformation gradient F = I + grad u in cylinder coordinates; the remaining four entries are zero."""

    rr: Float[np.ndarray, " s"]
    rz: Float[np.ndarray, " s"]
    zr: Float[np.ndarray, " s"]
    zz: Float[np.ndarray, " s"]
    hoop: Float[np.ndarray, " s"]


def dent_under_sphere(depth_m: float, radius_m: float, thickness_m: float) -> Dent:
    """Match the dent to the sphere: same depth and same curvature at its lowest point, so a^2 = 2 R d."""
    if not 0 < depth_m < DEPTH_MAX * thickness_m:
        rule = f"above 0 and below {DEPTH_MAX} of the {1e3 * thickness_m:.3g} mm thickness"
        raise ParamsError(complain("poke", "depth", rule, f"{1e3 * depth_m:.3g} mm", "Poke less deep."))
    return Dent(depth_m, float(np.sqrt(2 * radius_m * depth_m)), thickness_m)


def displacement(
    r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], dent: Dent
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Give the outward and the upward displacement of material at (r, z), in m.

    w = -d s(z/h) (1-q) exp(-q) and u = d s'(z/h) r exp(-q) / 2h with q = r^2 / 2a^2: div u = 0, no net volume is
    displaced (a rim rises), and s = t^2 (2-t) has s(0) = s'(0) = 0 and s(1) = 1: a bonded base.
    """
    q = (r_m / dent.width_m) ** 2 / 2
    fade = np.exp(-q)
    s, slope, _ = _profile(z_m / dent.thickness_m)
    outward_m = dent.depth_m / (2 * dent.thickness_m) * slope * r_m * fade
    return outward_m, -dent.depth_m * s * (1 - q) * fade


def gradient(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], dent: Dent) -> Gradient:
    """Give the deformation gradient at (r, z), from the derivatives of `displacement`."""
    q = (r_m / dent.width_m) ** 2 / 2
    fade = np.exp(-q)
    s, slope, bend = _profile(z_m / dent.thickness_m)
    strain = dent.depth_m / dent.thickness_m * slope * fade
    return Gradient(
        rr=1 + strain * (1 - 2 * q) / 2,
        rz=dent.depth_m / (2 * dent.thickness_m**2) * bend * r_m * fade,
        zr=dent.depth_m / dent.width_m**2 * s * r_m * (2 - q) * fade,
        zz=1 - strain * (1 - q),
        hoop=1 + strain / 2,
    )


def rotation(f: Gradient) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Give cos and sin of the angle by which material turns from z towards r: the R of F = R U, exactly."""
    cos, sin = f.rr + f.zz, f.rz - f.zr
    size = np.hypot(cos, sin)
    return cos / size, sin / size


def force(
    depth_m: Float[np.ndarray, " n"], *, radius_m: float, thickness_m: float, modulus_Pa: float
) -> Float[np.ndarray, " n"]:
    """Give the force on a sphere in newtons: Hertz (nu = 1/2) times Dimitriadis et al. 2002 for a bonded layer.

    A depth of zero or less is no contact: no force.
    """
    depth_m = np.maximum(depth_m, 0.0)
    chi = np.sqrt(radius_m * depth_m) / thickness_m
    bonded = 1 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    return 16 / 9 * modulus_Pa * np.sqrt(radius_m) * depth_m**1.5 * bonded


def _profile(
    t: Float[np.ndarray, " s"],
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    # Share of the dent that reaches relative height t, and its two derivatives.
    return t**2 * (2 - t), 4 * t - 3 * t**2, 4 - 6 * t
