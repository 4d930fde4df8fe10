"""Where the skin's material goes under a poke. In: a press, depths, places, SI. Out: present places and gradients.

Small steps, each a displacement of `layer` at the present place, so that volume is kept. Refuses to know nodes, magnets
and force; `flow_map` tabulates what is found here.
"""

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from pipeline.core.errors import ParamsError
from pipeline.physics import layer

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
    base: layer.Base

    def contact(self, depth_m: float) -> layer.Contact:
        """Give the contact at a depth."""
        return layer.contact_of_depth(
            depth_m, thickness_m=self.thickness_m, tip_radius_m=self.tip_radius_m, base=self.base
        )


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


def carry(material: Material, waves: layer.Waves, depth_m: float, press: Press) -> Material:
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


def change(material: Material, depth_m: float, press: Press) -> layer.Waves:
    """Find the change of pressure that brings the marks, which stand first in `material`, to a greater depth.

    It is made of pressures of spheres on smaller contacts, and brings all marks inside the contact from where they are
    to the tip: least squares, damped, for waves shorter than the depth do not reach the marks.
    """
    contact = press.contact(depth_m)
    inside = np.flatnonzero(material.r_m[:MARKS_N] < contact.radius_m)
    r_m, z_m = material.r_m[inside], material.z_m[inside]
    radii_m = contact.radius_m * np.arange(1, PRESSURES_N + 1) / PRESSURES_N
    parts = [layer.contact_of_radius(a_m, **asdict(press)) for a_m in radii_m]
    pressures = [layer.waves(part, press.thickness_m, press.base) for part in parts]
    parted = [layer.displacement(r_m, z_m, pressure) for pressure in pressures]
    height_m = np.sqrt(press.tip_radius_m**2 - r_m**2)
    towards = np.stack([u.z_m - r_m / height_m * u.r_m for u in parted], axis=1) / [part.depth_m for part in parts]
    missing_m = press.thickness_m - contact.depth_m + press.tip_radius_m - height_m - z_m
    damping = DAMPING * np.linalg.norm(towards, 2) * np.eye(PRESSURES_N)
    share = np.linalg.lstsq(np.vstack([towards, damping]), np.append(missing_m, np.zeros(PRESSURES_N)))[0]
    amplitudes = np.stack(
        [pressure.amplitude_m / part.depth_m for pressure, part in zip(pressures, parts, strict=True)]
    )
    return layer.Waves(pressures[0].k_per_m, share @ amplitudes, press.thickness_m, press.base)


def _carry(material: Material, change: layer.Waves) -> Material:
    # Midpoint rule: the change is that of the place where the material is half way; F by the chain rule through it.
    first = layer.displacement(material.r_m, material.z_m, change)
    half_r_m, half_z_m = material.r_m + first.r_m / 2, material.z_m + first.z_m / 2
    second = layer.displacement(half_r_m, half_z_m, change)
    eye = np.eye(2)
    half = (eye + _plane(first) / 2) @ material.f
    stretch = material.hoop * (1 + second.hoop * (1 + first.hoop / 2))
    return Material(material.r_m + second.r_m, material.z_m + second.z_m, material.f + _plane(second) @ half, stretch)


def _plane(u: layer.Displacement) -> Float[np.ndarray, "s 2 2"]:
    return np.stack([np.stack([u.r_r, u.r_z], axis=-1), np.stack([u.z_r, u.z_z], axis=-1)], axis=-2)
