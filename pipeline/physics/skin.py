"""One skin, and the change of field that pokes make. In: a design, a name, a board, pokes. Out: tesla and newtons.

A skin is drawn from a generator that bears its name: skin 7 stays the same when skin 8 is added.
Refuses to know chips' electronics, protocols and labels: pokes come as true places in the board's frame.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.constants import kilo, milli

from pipeline.physics import dipole, layer, magnet
from pipeline.physics.board import Board, Spreads
from pipeline.seeds import rng_for
from pipeline.strict import Strict

FILLER_WAVES_N = 64  # plane waves that make up a skin's unevenness


class SkinDesign(Strict):
    """What all skins of a scene have in common, the tip that pokes them included."""

    polarity: magnet.Polarity
    saturation_T: Annotated[float, Field(ge=0, le=1)]  # phi Br: volume fraction times remanence of the powder
    half_field_T: Annotated[float, Field(gt=0, le=10)]  # field that magnetises the powder to half of that
    thickness_mm: Annotated[float, Field(gt=0, le=20)]
    modulus_kPa: Annotated[float, Field(ge=0, le=1e6)]
    tip_radius_mm: Annotated[float, Field(gt=0, le=50)]


@dataclass(frozen=True)
class Skin:
    """One skin at rest on its board, in the board's frame."""

    name: str
    nodes_m: Float[np.ndarray, "s 3"]
    moments_A_m2: Float[np.ndarray, "s 3"]
    thickness_m: float
    modulus_Pa: float
    tip_radius_m: float
    depth_zero_m: float  # added to a commanded depth


def draw_skin(design: SkinDesign, spreads: Spreads, *, seed: int, name: str) -> Skin:
    """Draw the skin called `name`, as it sits on its board."""
    rng = rng_for(seed, "skin", name)
    amplitude, thickness, modulus = np.exp(
        np.array([spreads.skin_amplitude, spreads.skin_thickness, spreads.skin_modulus]) * rng.standard_normal(3)
    )
    seat_mm = spreads.skin_seat_mm * rng.standard_normal(2)
    depth_zero_mm = spreads.skin_depth_zero_mm * rng.standard_normal()
    thickness_m = float(design.thickness_mm * milli * thickness)
    rest = magnet.lattice(thickness_m)
    j_T = amplitude * magnet.magnetise(
        rest.nodes_m,
        thickness_m,
        polarity=design.polarity,
        saturation_T=design.saturation_T,
        half_field_T=design.half_field_T,
    )
    filler = _filler(rest.nodes_m[:, :2], spreads, rng)
    return Skin(
        name=name,
        nodes_m=rest.nodes_m + np.append(seat_mm, 0.0) * milli,
        moments_A_m2=magnet.moments(j_T * filler[:, None], rest.volumes_m3),
        thickness_m=thickness_m,
        modulus_Pa=float(design.modulus_kPa * kilo * modulus),
        tip_radius_m=design.tip_radius_mm * milli,
        depth_zero_m=float(depth_zero_mm * milli),
    )


def changes_of_field(
    board: Board, skin: Skin, pokes_m: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "n k 3"]]:
    """Give the field at rest, and how each poke (x, y, depth) changes it, at the chips, in tesla.

    The change is summed node by node over what moves, never as the difference of two large sums. No contact (true
    depth of zero or less): exactly zero.
    """
    rest_T = dipole.field_of_each(skin.nodes_m, skin.moments_A_m2, board.chips_m)
    changes_T = np.zeros((len(pokes_m), *board.chips_m.shape))
    for poke_i, (x_m, y_m, depth_m) in enumerate(pokes_m):
        depth_m += skin.depth_zero_m
        if depth_m <= 0:
            continue
        dent = layer.dent_under_sphere(depth_m, skin.tip_radius_m, skin.thickness_m)
        away_m = skin.nodes_m[:, :2] - (x_m, y_m)
        moves = np.einsum("si,si->s", away_m, away_m) < (layer.REACH * dent.width_m) ** 2
        moved_m, turned = _deform(skin.nodes_m[moves], skin.moments_A_m2[moves], away_m[moves], dent)
        each_T = dipole.field_of_each(moved_m, turned, board.chips_m) - rest_T[:, moves]
        changes_T[poke_i] = each_T.sum(axis=1)
    return rest_T.sum(axis=1), changes_T


def forces(skin: Skin, depth_m: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Give the force that the tip feels at commanded depths, in newtons, positive in compression."""
    return layer.force(
        depth_m + skin.depth_zero_m,
        radius_m=skin.tip_radius_m,
        thickness_m=skin.thickness_m,
        modulus_Pa=skin.modulus_Pa,
    )


def _deform(
    nodes_m: Float[np.ndarray, "s 3"],
    moments: Float[np.ndarray, "s 3"],
    away_m: Float[np.ndarray, "s 2"],
    dent: layer.Dent,
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    # Moments turn with the material (R m, not F m: magnetisation does not feel stretch, Danas & Reis 2024).
    r_m = np.hypot(away_m[:, 0], away_m[:, 1])
    ex, ey = away_m.T / np.maximum(r_m, np.finfo(float).tiny)
    outward_m, up_m = layer.displacement(r_m, nodes_m[:, 2], dent)
    moved_m = nodes_m + np.column_stack([outward_m * ex, outward_m * ey, up_m])
    cos, sin = layer.rotation(layer.gradient(r_m, nodes_m[:, 2], dent))
    mx, my, mz = moments.T
    radial = mx * ex + my * ey
    gain = (cos - 1) * radial + sin * mz
    return moved_m, np.column_stack([mx + gain * ex, my + gain * ey, cos * mz - sin * radial])


def _filler(xy_m: Float[np.ndarray, "s 2"], spreads: Spreads, rng: np.random.Generator) -> Float[np.ndarray, " s"]:
    # A smooth random factor as a sum of plane waves: it knows no lattice, so a finer one sees the same skin.
    waves = rng.standard_normal((FILLER_WAVES_N, 2)) / (spreads.skin_filler_length_mm * milli)
    phases = rng.uniform(0, 2 * np.pi, FILLER_WAVES_N)
    uneven = np.sqrt(2 / FILLER_WAVES_N) * np.cos(xy_m @ waves.T + phases).sum(axis=1)
    return np.exp(spreads.skin_filler * uneven)
