"""Where the material goes: volume, gradient, base and tip. In: a design and a depth. Out: checks.

Looks at `layer`'s waves and at `flow.follow`, which every table and every poke is made from. Refuses to know magnets.
"""

import numpy as np
from jaxtyping import Float
from scipy.constants import milli

from pipeline.experiments.verification.checks import Check, worst
from pipeline.physics import flow, layer
from pipeline.physics.skin import SkinDesign

STEPS_N = 12  # of 0.1 mm at 1.2 mm (PHYSICS 0)
STEP_M = 1e-7  # of finite differences
HELD = {"bonded": "stays", "slipping": "keeps its height"}


def check_kinematics(skin: SkinDesign, depth_m: float) -> list[Check]:
    """Check one linear step and the whole flow down to a depth."""
    press = flow.Press(skin.thickness_mm * milli, skin.tip_radius_mm * milli, skin.base)
    return [*_linear(depth_m, press), *_volume(depth_m, press), *_surface(depth_m, press), *_far(depth_m, press)]


def descent(depth_m: float, steps_n: int) -> Float[np.ndarray, " d"]:
    """List depths from 0 in even steps, the first cut in four and in two, where the contact grows as the root."""
    even = np.linspace(0, depth_m, steps_n + 1)
    return np.concatenate([[0.0, even[1] / 4, even[1] / 2], even[1:]])


def _linear(depth_m: float, press: flow.Press) -> list[Check]:
    h_m, tip_m = press.thickness_m, press.tip_radius_m
    contact = press.contact(depth_m)
    waves = layer.waves(contact, h_m, press.base)
    r_m, z_m = _places(h_m, 17, 9)
    u = layer.displacement(r_m, z_m, waves)
    right, left = (layer.displacement(r_m + side * STEP_M, z_m, waves) for side in (1, -1))
    above, below = (layer.displacement(r_m, z_m + side * STEP_M, waves) for side in (1, -1))
    analytic = np.stack([u.r_r, u.z_r, u.r_z, u.z_z, u.hoop])
    slopes = [right.r_m - left.r_m, right.z_m - left.z_m, above.r_m - below.r_m, above.z_m - below.z_m]
    numeric = np.stack([*(slope / (2 * STEP_M) for slope in slopes), u.r_m / r_m])
    divergence = numeric[0] + numeric[3] + numeric[4]
    base = layer.displacement(r_m, np.zeros_like(r_m), waves)
    under_m = 0.95 * contact.radius_m * np.linspace(0, 1, 30)
    sunken = layer.displacement(under_m, np.full(30, h_m), waves)
    sphere_m = tip_m - np.sqrt(tip_m**2 - under_m**2) - depth_m
    return [
        Check("one small step", "div u = 0", "central differences over 0.1 um", float(np.abs(divergence).max()), "1",
              1e-6, "of strains near 1: step squared over length squared"),
        Check("one small step", "gradient of u", "central differences over 0.1 um",
              float(np.abs(analytic - numeric).max()), "1", 1e-6,
              "of strains near 1: step squared over length squared"),
        Check("one small step", f"the {press.base} base {HELD[press.base]}", "0 m", _off(base.r_m, base.z_m, press),
              "m", 1e-17, "rounding: 1e-14 of the depth"),
        Check("one small step", "the surface lies on the tip", "a sphere",
              float(np.abs(sunken.z_m - sphere_m).max() / depth_m), "of the depth", 0.005,
              "waves shorter than 1/6 of the thickness are cut"),
    ]  # fmt: skip


def _off(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], press: flow.Press) -> float:
    return float(np.abs([z_m] if press.base == "slipping" else [r_m, z_m]).max())


def _volume(depth_m: float, press: flow.Press) -> list[Check]:
    h_m = press.thickness_m
    r_m, z_m = _places(h_m, 25, 11)
    inside = len(r_m)
    # The places, their neighbours for finite differences, and the base: one flow for all of them.
    shifts = [(0.0, 0.0), (STEP_M, 0.0), (-STEP_M, 0.0), (0.0, STEP_M), (0.0, -STEP_M)]
    base_m = np.linspace(0, 4 * h_m, 40)
    all_r_m = np.concatenate([*(r_m + dr_m for dr_m, _ in shifts), base_m])
    all_z_m = np.concatenate([*(z_m + dz_m for _, dz_m in shifts), np.zeros_like(base_m)])
    depths_m = descent(depth_m, STEPS_N)
    end = flow.follow(all_r_m, all_z_m, depths_m, press=press)[-1]
    place = np.stack([end.r_m, end.z_m])
    _, right, left, above, below, base = np.split(place, inside * np.arange(1, 6), axis=1)
    numeric = np.stack([right - left, above - below], axis=1) / (2 * STEP_M)  # 2 (r, z), 2 (by r0, by z0), places
    f, hoop = end.f[:inside], end.hoop[:inside]
    det = np.linalg.det(f) * hoop
    gradient = max(np.abs(f - numeric.transpose(2, 0, 1)).max(), np.abs(hoop - end.r_m[:inside] / r_m).max())
    return [
        Check("flow", f"det F = 1 in {STEPS_N} steps", "1", float(np.abs(det - 1).max()), "1", 0.02,
              "second order in the steps; worst at the contact's edge"),
        Check("flow", "F is the gradient of the map", "central differences over 0.1 um", float(gradient), "1", 1e-5,
              "of stretches near 1: step squared over length squared"),
        Check("flow", f"the {press.base} base {HELD[press.base]}", "0 m", _off(base[0] - base_m, base[1], press), "m",
              1e-16, f"rounding of {len(depths_m) - 1} steps; its table is 0 there to the last bit"),
    ]  # fmt: skip


def _surface(depth_m: float, press: flow.Press) -> list[Check]:
    h_m, tip_m, radius_m = press.thickness_m, press.tip_radius_m, press.contact(depth_m).radius_m
    surface_m = radius_m * np.linspace(0, 1.4, 40)
    end = flow.follow(surface_m, np.full(40, h_m), descent(depth_m, STEPS_N), press=press)[-1]
    above_m = end.z_m - (h_m - depth_m + tip_m - np.sqrt(tip_m**2 - np.minimum(end.r_m, tip_m) ** 2))
    touches = end.r_m < 0.95 * radius_m
    return [
        Check("flow", "the sunken surface lies on the tip", "a sphere",
              float(np.abs(above_m[touches]).max() / depth_m), "of the depth", 0.02,
              "six pressures a step"),
        Check("flow", "nothing beside the contact pierces the tip", "a sphere",
              max(0.0, float(above_m.max() / depth_m)), "of the depth", 0.02, "as above"),
    ]  # fmt: skip


def _far(depth_m: float, press: flow.Press) -> list[Check]:
    """Check, of a sliding skin, that what flows in under the tip flows out through every circle around it."""
    if press.base == "bonded":
        return []
    h_m = press.thickness_m
    r_m, z_m = (part.ravel() for part in np.meshgrid(np.array([4.0, 5.0, 6.0]) * h_m, np.linspace(0, h_m, 7)))
    end = flow.follow(r_m, z_m, descent(depth_m, STEPS_N), press=press)[-1]
    grown_m2 = end.r_m**2 - r_m**2
    return [
        Check("flow", "far out all heights move by what the tip displaces", "the mean over heights and circles",
              worst(grown_m2, np.full_like(grown_m2, grown_m2.mean())), "1", 0.03,
              "waves fade as exp(-pi r / h) past the contact; the map goes on in closed form from 5 thicknesses on"),
    ]  # fmt: skip


def _places(h_m: float, r_n: int, z_n: int) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    r_m, z_m = np.meshgrid(np.linspace(0.035, 2.5, r_n) * h_m, np.linspace(0.03, 0.97, z_n) * h_m, indexing="ij")
    return r_m.ravel(), z_m.ravel()
