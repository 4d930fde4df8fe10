"""Where the skin's material goes under a poke. In: thickness, tip, depths, places, SI. Out: moved places and rotation.

Small steps, each a displacement of `layer` at the present place, so that volume is kept; tabulated once, for the map is
axisymmetric. Refuses to know magnets, chips and force.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import RectBivariateSpline

from pipeline.errors import ParamsError, complain
from pipeline.physics import layer

REACH = 5.0  # in thicknesses, past the contact: what lies beyond does not move; 4 from the axis costs up to 17 % of dB
STEP = 0.05  # of the thickness, about: 0.1 mm in a skin of 2 mm
EXACT_N = 16  # depths that get a step of their own; a protocol has six
DET_F_ERROR_MAX = 0.1
RIM_MAX = 1.2  # of the thickness: waves that end at the surface grow as exp(kz) above it
COARSE_R_N, COARSE_Z_N = 56, 16  # where the flow is computed
MARKS_N = 48  # on the surface, closer towards the axis
PRESSURES_N = 6  # 4 and 8 move the marks by less than 0.03 mm at 1.2 mm
DAMPING = 1e-3
FINE_R_N, FINE_Z_N = 512, 80  # where it is tabulated, so that linear interpolation is enough


@dataclass(frozen=True)
class FlowMap:
    """Places and rotation of material that rested at (r0, z0), at depths from 0 on; equal steps in r0 and in z0."""

    r0_m: Float[np.ndarray, " i"]
    z0_m: Float[np.ndarray, " j"]
    depth_m: Float[np.ndarray, " d"]
    moved: Float[np.ndarray, "d 3 i j"]  # outward_m, up_m, angle_rad from z towards r
    det_f: Float[np.ndarray, "d p q"]  # on the coarser grid on which the flow was computed


@dataclass(frozen=True)
class Moved:
    """The nodes that move, where they go, and by what angle about which horizontal axis they turn."""

    i: Int[np.ndarray, " m"]
    nodes_m: Float[np.ndarray, "m 3"]
    angle_rad: Float[np.ndarray, " m"]
    axis: Float[np.ndarray, "m 3"]


@dataclass(frozen=True)
class Material:
    """Present places of material points, and the gradient F of the map from rest; other entries of F are zero."""

    r_m: Float[np.ndarray, " s"]
    z_m: Float[np.ndarray, " s"]
    f: Float[np.ndarray, "s 2 2"]  # rows and columns: r, z
    hoop: Float[np.ndarray, " s"]


@lru_cache(maxsize=8)
def tabulate(thickness_m: float, tip_radius_m: float, depths_m: tuple[float, ...]) -> FlowMap:
    """Follow the material down to the deepest of `depths_m` in steps of about `STEP`, and tabulate each."""
    layer.refuse_layer(np.array(depths_m), thickness_m, tip_radius_m)
    if not max(depths_m, default=0.0) > 0:
        raise ParamsError(complain("poke", "deepest depth", "above 0 m", f"{depths_m}", "Poke the skin."))
    depth_m = steps(depths_m, thickness_m)
    deepest = layer.contact_of_depth(float(depth_m[-1]), thickness_m=thickness_m, tip_radius_m=tip_radius_m)
    reach_m = deepest.radius_m + REACH * thickness_m
    r_m, z_m = reach_m * np.linspace(0, 1, COARSE_R_N) ** 1.5, thickness_m * np.linspace(0, 1, COARSE_Z_N)
    fine_r_m, fine_z_m = np.linspace(0, r_m[-1], FINE_R_N), np.linspace(0, z_m[-1], FINE_Z_N)
    r0_m, z0_m = (part.ravel() for part in np.meshgrid(r_m, z_m, indexing="ij"))
    path = follow(r0_m, z0_m, depth_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m)
    moved = np.zeros((len(depth_m), 3, FINE_R_N, FINE_Z_N))
    rest = path[0]
    for here, at in zip(moved, path, strict=True):
        for part, change in zip(here, (at.r_m - rest.r_m, at.z_m - rest.z_m, angle(at.f)), strict=True):
            part[:] = RectBivariateSpline(r_m, z_m, change.reshape(COARSE_R_N, COARSE_Z_N))(fine_r_m, fine_z_m)
    moved[:, :2, :, 0] = 0.0  # the base is glued, though the material on it shears and so turns
    det_f = np.stack([np.linalg.det(at.f) * at.hoop for at in path]).reshape(-1, COARSE_R_N, COARSE_Z_N)
    if not np.abs(det_f - 1).max() <= DET_F_ERROR_MAX:
        rule = f"such that material keeps its volume within {DET_F_ERROR_MAX:.0%}"
        raise ParamsError(complain("poke", "depth", rule, f"{1e3 * max(depths_m):.3g} mm", "Poke less deep."))
    return FlowMap(fine_r_m, fine_z_m, depth_m, moved, det_f)


def move(flow: FlowMap, nodes_m: Float[np.ndarray, "s 3"], poke_m: Float[np.ndarray, "3"]) -> Moved:
    """Move the nodes within reach of a poke (x, y, depth): linear between the table's places and depths."""
    x_m, y_m = nodes_m[:, 0] - poke_m[0], nodes_m[:, 1] - poke_m[1]
    r2_m2 = x_m * x_m + y_m * y_m
    here = at_depth(flow, float(poke_m[2]))
    i = np.flatnonzero(r2_m2 < flow.r0_m[-1] ** 2) if poke_m[2] > 0 else np.arange(0)
    r_m, z_m = np.sqrt(r2_m2.take(i)), nodes_m[:, 2].take(i)
    outward_m, up_m, angle_rad = _between(here, r_m / flow.r0_m[1], z_m / flow.z0_m[1])
    # On the axis nothing moves sideways or turns, so any direction will do there.
    off_axis = r_m > 0
    safe_m = np.where(off_axis, r_m, 1.0)
    cos, sin = np.where(off_axis, x_m.take(i) / safe_m, 1.0), y_m.take(i) / safe_m
    moved_m = nodes_m.take(i, axis=0) + np.stack([outward_m * cos, outward_m * sin, up_m], axis=1)
    return Moved(i, moved_m, angle_rad, np.stack([-sin, cos, np.zeros_like(cos)], axis=1))


def at_depth(flow: FlowMap, depth_m: float) -> Float[np.ndarray, "3 i j"]:
    """Give the table at one depth: exact at the depths it was made for, linear between them."""
    if not -np.inf < depth_m <= flow.depth_m[-1]:
        rule = f"finite and at most {1e3 * flow.depth_m[-1]:.4g} mm, the deepest that is tabulated"
        raise ParamsError(complain("poke", "depth", rule, f"{1e3 * depth_m:.4g} mm", "Tabulate deeper."))
    if depth_m <= 0:
        return flow.moved[0]
    above = int(np.searchsorted(flow.depth_m, depth_m))
    low_m, high_m = flow.depth_m[above - 1], flow.depth_m[above]
    share = (depth_m - low_m) / (high_m - low_m)
    if share == 1:
        return flow.moved[above]
    return (1 - share) * flow.moved[above - 1] + share * flow.moved[above]


def steps(depths_m: tuple[float, ...], thickness_m: float) -> Float[np.ndarray, " d"]:
    """List the depths of the flow: 0, every depth asked for, and between them equal steps of about `STEP`.

    More than `EXACT_N` depths are met by half steps instead, to be interpolated between. The first step is cut in four
    and in two: there the contact's radius changes as the root of the depth.
    """
    first_m, asked_m = STEP * thickness_m, {depth for depth in depths_m if depth > 0}
    if len(asked_m) > EXACT_N:
        asked_m = set(np.linspace(0, max(depths_m), 1 + int(np.ceil(2 * max(depths_m) / first_m))).tolist())
    early_m = {depth for depth in (first_m / 4, first_m / 2) if depth < max(depths_m)}
    stops = sorted({0.0} | early_m | asked_m)
    parts = [max(1, round((b - a) / first_m)) for a, b in pairwise(stops)]
    spans = [np.linspace(a, b, part_n + 1)[1:] for (a, b), part_n in zip(pairwise(stops), parts, strict=True)]
    return np.concatenate([[0.0], *spans])


def follow(
    r_m: Float[np.ndarray, " s"],
    z_m: Float[np.ndarray, " s"],
    depths_m: Float[np.ndarray, " d"],
    *,
    thickness_m: float,
    tip_radius_m: float,
) -> list[Material]:
    """Carry material from rest through the given depths; one `Material` for each.

    Marks on the surface go along: a pressure that fitted the surface at rest would leave the sunken one 0.3 mm behind a
    tip at 1.2 mm, so each step finds the pressure anew that brings the marks onto the sphere.
    """
    contacts = [
        layer.contact_of_depth(float(depth), thickness_m=thickness_m, tip_radius_m=tip_radius_m)
        for depth in depths_m[1:]
    ]
    marks_m = (contacts[-1].radius_m if contacts else 0.0) * np.linspace(0, 1, MARKS_N) ** 2
    r_m, z_m = np.append(marks_m, r_m), np.append(np.full(MARKS_N, thickness_m), z_m)
    path = [Material(r_m, z_m, np.tile(np.eye(2), (len(r_m), 1, 1)), np.ones(len(r_m)))]
    for contact in contacts:
        path.append(_carry(path[-1], _press(path[-1], contact, thickness_m, tip_radius_m)))
        if not path[-1].z_m.max() < RIM_MAX * thickness_m:
            rule = f"such that the rim stays below {RIM_MAX} of the skin's thickness"
            raise ParamsError(complain("poke", "depth", rule, f"{1e3 * contact.depth_m:.3g} mm", "Poke less deep."))
    return [Material(at.r_m[MARKS_N:], at.z_m[MARKS_N:], at.f[MARKS_N:], at.hoop[MARKS_N:]) for at in path]


def angle(f: Float[np.ndarray, "s 2 2"]) -> Float[np.ndarray, " s"]:
    """Give the angle from z towards r of the R in F = R U."""
    return np.arctan2(f[:, 0, 1] - f[:, 1, 0], f[:, 0, 0] + f[:, 1, 1])


def _press(material: Material, contact: layer.Contact, thickness_m: float, tip_radius_m: float) -> layer.Waves:
    # The change of pressure, made of pressures of spheres on smaller contacts, that brings all marks inside the contact
    # from where they are to the tip: least squares, damped, for waves shorter than the depth do not reach the marks.
    inside = np.flatnonzero(material.r_m[:MARKS_N] < contact.radius_m)
    r_m, z_m = material.r_m[inside], material.z_m[inside]
    radii_m = contact.radius_m * np.arange(1, PRESSURES_N + 1) / PRESSURES_N
    parts = [layer.contact_of_radius(a_m, thickness_m=thickness_m, tip_radius_m=tip_radius_m) for a_m in radii_m]
    pressures = [layer.waves(part, thickness_m) for part in parts]
    changes = [layer.displacement(r_m, z_m, pressure) for pressure in pressures]
    height_m = np.sqrt(tip_radius_m**2 - r_m**2)
    towards = np.stack([u.z_m - r_m / height_m * u.r_m for u in changes], axis=1) / [part.depth_m for part in parts]
    missing_m = thickness_m - contact.depth_m + tip_radius_m - height_m - z_m
    damping = DAMPING * np.linalg.norm(towards, 2) * np.eye(PRESSURES_N)
    share = np.linalg.lstsq(np.vstack([towards, damping]), np.append(missing_m, np.zeros(PRESSURES_N)))[0]
    amplitudes = np.stack(
        [pressure.amplitude_m / part.depth_m for pressure, part in zip(pressures, parts, strict=True)]
    )
    return layer.Waves(pressures[0].k_per_m, share @ amplitudes, thickness_m)


def _carry(material: Material, change: layer.Waves) -> Material:
    # Midpoint rule: the change is that of the place where the material is half way; F by the chain rule through it.
    first = layer.displacement(material.r_m, material.z_m, change)
    half_r_m, half_z_m = material.r_m + first.r_m / 2, material.z_m + first.z_m / 2
    second = layer.displacement(half_r_m, half_z_m, change)
    eye = np.eye(2)
    half = (eye + _plane(first) / 2) @ material.f
    stretch = material.hoop * (1 + second.hoop * (1 + first.hoop / 2))
    return Material(material.r_m + second.r_m, material.z_m + second.z_m, material.f + _plane(second) @ half, stretch)


def _between(
    table: Float[np.ndarray, "3 i j"], at_r: Float[np.ndarray, " m"], at_z: Float[np.ndarray, " m"]
) -> list[Float[np.ndarray, " m"]]:
    # Bilinear, at places given in steps of the table.
    _, r_n, z_n = table.shape
    low_r, low_z = np.minimum(at_r.astype(np.intp), r_n - 2), np.minimum(at_z.astype(np.intp), z_n - 2)
    share_r, share_z = at_r - low_r, at_z - low_z
    corner = low_r * z_n + low_z
    found = []
    for part in table.reshape(3, -1):
        low, high = part.take(corner), part.take(corner + z_n)
        near = low + share_z * (part.take(corner + 1) - low)
        far = high + share_z * (part.take(corner + z_n + 1) - high)
        found.append(near + share_r * (far - near))
    return found


def _plane(u: layer.Displacement) -> Float[np.ndarray, "s 2 2"]:
    return np.stack([np.stack([u.r_r, u.r_z], axis=-1), np.stack([u.z_r, u.z_z], axis=-1)], axis=-2)
