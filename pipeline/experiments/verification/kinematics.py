"""Laws of where the material goes: volume, gradient, base and tip. In: a press and a depth. Out: checks.

Looks at `layer`'s waves and at `flow.follow`, which every table and every poke is made from. Refuses to know fields.
"""

import numpy as np
from jaxtyping import Float

from pipeline.experiments.verification.checks import Check, farthest, worst
from reskin.physics import layer, slide
from reskin.physics import layer as flow
from reskin.physics.skin import Dipoles, Skin, press_slides

STEPS_N = 12  # of 0.1 mm at 1.2 mm (PHYSICS 0)
STEP_M = 1e-7  # of finite differences
HELD = {"bonded": "stays", "slipping": "keeps its height"}


def check_kinematics(press: flow.Press, depth_m: float) -> list[Check]:
    """Check one linear step and the whole flow down to a depth."""
    far = far_out(press, depth_m) if press.base == "slipping" else []
    return [*one_small_step(press, depth_m), *whole_flow(press, depth_m), *sunken_surface(press, depth_m), *far]


def descent(depth_m: float, steps_n: int = STEPS_N) -> Float[np.ndarray, " d"]:
    """List depths from 0 in even steps, the first cut in four and in two, where the contact grows as the root."""
    even = np.linspace(0, depth_m, steps_n + 1)
    return np.concatenate([[0.0, even[1] / 4, even[1] / 2], even[1:]])


def one_small_step(press: flow.Press, depth_m: float) -> list[Check]:
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
    name, differences = "one small step", "central differences over 0.1 um"
    length = "of strains near 1: step squared over length squared"
    return [
        Check(name, "div u = 0", differences, farthest(numeric[0] + numeric[3] + numeric[4], 0.0), "1", 1e-6, length),
        Check(name, "gradient of u", differences, farthest(np.stack([u.r_r, u.z_r, u.r_z, u.z_z, u.hoop]), numeric),
              "1", 1e-6, length),
        Check(name, f"the {press.base} base {HELD[press.base]}", "0 m", _off(base.r_m, base.z_m, press), "m", 1e-17,
              "rounding: 1e-14 of the depth"),
        Check(name, "the surface lies on the tip", "a sphere", farthest(sunken.z_m, sphere_m) / depth_m,
              "of the depth", 0.005, "waves shorter than 1/6 of the thickness are cut"),
    ]  # fmt: skip


def _off(r_m: Float[np.ndarray, " s"], z_m: Float[np.ndarray, " s"], press: flow.Press) -> float:
    return float(np.abs([z_m] if press.base == "slipping" else [r_m, z_m]).max())


def whole_flow(press: flow.Press, depth_m: float) -> list[Check]:
    h_m = press.thickness_m
    r_m, z_m = _places(h_m, 25, 11)
    inside = len(r_m)
    # The places, their neighbours for finite differences, and the base: one flow for all of them.
    shifts = [(0.0, 0.0), (STEP_M, 0.0), (-STEP_M, 0.0), (0.0, STEP_M), (0.0, -STEP_M)]
    base_m = np.linspace(0, 4 * h_m, 40)
    all_r_m = np.concatenate([*(r_m + dr_m for dr_m, _ in shifts), base_m])
    all_z_m = np.concatenate([*(z_m + dz_m for _, dz_m in shifts), np.zeros_like(base_m)])
    depths_m = descent(depth_m)
    end = flow.follow(all_r_m, all_z_m, depths_m, press=press)[-1]
    _, right, left, above, below, base = np.split(np.stack([end.r_m, end.z_m]), inside * np.arange(1, 6), axis=1)
    numeric = np.stack([right - left, above - below], axis=1) / (2 * STEP_M)  # 2 (r, z), 2 (by r0, by z0), places
    f, hoop = end.f[:inside], end.hoop[:inside]
    gradient = max(farthest(f, numeric.transpose(2, 0, 1)), farthest(hoop, end.r_m[:inside] / r_m))
    return [
        Check("flow", f"det F = 1 in {STEPS_N} steps", "1", farthest(np.linalg.det(f) * hoop, 1.0), "1", 0.02,
              "second order in the steps; worst at the contact's edge"),
        Check("flow", "F is the gradient of the map", "central differences over 0.1 um", gradient, "1", 1e-5,
              "of stretches near 1: step squared over length squared"),
        Check("flow", f"the {press.base} base {HELD[press.base]}", "0 m", _off(base[0] - base_m, base[1], press), "m",
              1e-16, f"rounding of {len(depths_m) - 1} steps; its table is 0 there to the last bit"),
    ]  # fmt: skip


def sunken_surface(press: flow.Press, depth_m: float) -> list[Check]:
    h_m, tip_m, radius_m = press.thickness_m, press.tip_radius_m, press.contact(depth_m).radius_m
    end = flow.follow(radius_m * np.linspace(0, 1.4, 40), np.full(40, h_m), descent(depth_m), press=press)[-1]
    above_m = end.z_m - (h_m - depth_m + tip_m - np.sqrt(tip_m**2 - np.minimum(end.r_m, tip_m) ** 2))
    touches = end.r_m < 0.95 * radius_m
    return [
        Check("flow", "the sunken surface lies on the tip", "a sphere", farthest(above_m[touches], 0.0) / depth_m,
              "of the depth", 0.02, "six pressures a step"),
        Check("flow", "nothing beside the contact pierces the tip", "a sphere",
              max(0.0, float(above_m.max() / depth_m)), "of the depth", 0.02, "as above"),
    ]  # fmt: skip


def far_out(press: flow.Press, depth_m: float) -> list[Check]:
    """Check, of a sliding skin, that what flows in under the tip flows out through every circle around it."""
    h_m = press.thickness_m
    r_m, z_m = (part.ravel() for part in np.meshgrid(np.array([4.0, 5.0, 6.0]) * h_m, np.linspace(0, h_m, 7)))
    end = flow.follow(r_m, z_m, descent(depth_m), press=press)[-1]
    grown_m2 = end.r_m**2 - r_m**2
    return [
        Check("flow", "far out all heights move by what the tip displaces", "the mean over heights and circles",
              worst(grown_m2, np.full_like(grown_m2, grown_m2.mean())), "1", 0.03,
              "waves fade as exp(-pi r / h) past the contact; the map goes on in closed form from 5 thicknesses on"),
    ]  # fmt: skip


def _places(h_m: float, r_n: int, z_n: int) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    r_m, z_m = np.meshgrid(np.linspace(0.035, 2.5, r_n) * h_m, np.linspace(0.03, 0.97, z_n) * h_m, indexing="ij")
    return r_m.ravel(), z_m.ravel()


def followed(skin: Skin, place_m: Float[np.ndarray, "2"], depths_m: Float[np.ndarray, " d"]) -> Dipoles:
    """Carry all dipoles of a skin through a poke down to true depths, without a table; then it slides as one.

    Each moment turns by the R of F = R U from a singular value decomposition. None may lie on the poke's axis.
    """
    away_m = skin.nodes_m[:, :2] - place_m
    r_m = np.linalg.norm(away_m, axis=1)
    press = flow.Press(skin.thickness_m, skin.tip_radius_m, skin.base)
    end = flow.follow(r_m, skin.nodes_m[:, 2], depths_m, press=press)[-1]
    outward = np.column_stack([away_m / r_m[:, None], np.zeros_like(r_m)])
    places_m = np.column_stack([place_m + end.r_m[:, None] * outward[:, :2], end.z_m])
    u, _, vt = np.linalg.svd(end.f)
    plane = np.stack([(skin.moments_A_m2 * outward).sum(axis=1), skin.moments_A_m2[:, 2]], axis=1)
    turned = np.einsum("sij,sj->si", u @ vt, plane)
    aside = skin.moments_A_m2 - plane[:, :1] * outward - plane[:, 1:] * (0, 0, 1)
    after = places_m, aside + turned[:, :1] * outward + turned[:, 1:] * (0, 0, 1)
    if skin.hold is None:
        return after
    slides = press_slides(skin, skin.hold, np.append(place_m, depths_m[-1])[None])
    return slide.apply(slides, 0, after, skin.seat_m)
