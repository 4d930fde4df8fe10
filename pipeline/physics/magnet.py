"""How a skin is magnetised. In: an array of magnets as wide as it, places in the slab. Out: field, magnetisation in T.

The powder's own field is left out (<= 2.5 %, PHYSICS 8), and so are tolerances of the array.
Refuses to know quadrature, chips, pokes and what differs from skin to skin.
"""

from itertools import product
from math import ceil
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.constants import mu_0

from pipeline.core.errors import ParamsError

CUBE_SIDE_M = 6.35e-3  # 0.25 in cubes
CUBES_N = (4, 4)  # along x and along y, under the authors' skin of 20 x 20 mm
ARRAY_BELOW_M = 0.50e-3  # from the skin's base down to the lower cubes' faces, authors' CAD
ARRAY_ABOVE_M = 0.25e-3  # from the skin's top up to the upper cubes' faces, authors' CAD
ARRAY_REMANENCE_T = 1.32  # N42 cubes, assumed

Polarity = Literal["checkerboard", "same"]  # the paper does not say; upper and lower cubes attract in both


def cuboid_field(
    observers_m: Float[np.ndarray, "o 3"], polarization_T: float, *, sides_m: tuple[float, float, float]
) -> Float[np.ndarray, "o 3"]:
    """Give the field, in tesla, of a box around the origin that is magnetised along z.

    Two charged rectangles (Engel-Herbert & Hesjedal, J. Appl. Phys. 97:074504, 2005), plus J inside.
    The lines through the box's edges are left to the caller: there the logarithms are infinite.
    """
    half_m = np.array(sides_m) / 2
    b_T = np.zeros_like(observers_m)
    for sx, sy, sz in product((1, -1), repeat=3):
        x, y, z = (observers_m - half_m * (sx, sy, sz)).T
        r = np.sqrt(x * x + y * y + z * z)
        # asinh(y / hypot(x, z)) is log(y + r) less what both ends share, and keeps its digits where y < 0.
        b_T[:, 0] -= sx * sy * sz * np.arcsinh(y / np.hypot(x, z))
        b_T[:, 1] -= sx * sy * sz * np.arcsinh(x / np.hypot(y, z))
        b_T[:, 2] += sx * sy * sz * np.arctan(x * y / (z * r))
    b_T *= polarization_T / (4 * np.pi)
    b_T[:, 2] += polarization_T * (np.abs(observers_m) < half_m).all(axis=1)
    return b_T


def cubes_along(side_m: float) -> int:
    """Count the cubes along a side of a skin: enough to cover it, as the authors' four do (assumed of other skins)."""
    return ceil(side_m / CUBE_SIDE_M - 1e-9)


def seams_m(side_m: float) -> tuple[float, ...]:
    """Say where two cubes touch along a side, from the skin's middle; there the magnetisation bends."""
    n = cubes_along(side_m)
    return tuple(CUBE_SIDE_M * (i - n / 2) for i in range(1, n))


def array_field(
    nodes_m: Float[np.ndarray, "s 3"], thickness_m: float, polarity: Polarity, *, cubes_n: tuple[int, int] = CUBES_N
) -> Float[np.ndarray, "s 3"]:
    """Sum the field of so many cubes below, and as many above, at places in the slab, in tesla."""
    if not (nodes_m[:, 2].min() >= 0 and nodes_m[:, 2].max() <= thickness_m):
        got = f"{nodes_m[:, 2].min():.3g} ... {nodes_m[:, 2].max():.3g} m"
        raise ParamsError("magnet array", "places", "inside the slab", got, "Magnetise the skin at rest.")
    middles_m = [(np.arange(n) - (n - 1) / 2) * CUBE_SIDE_M for n in cubes_n]
    heights_m = (-ARRAY_BELOW_M - CUBE_SIDE_M / 2, thickness_m + ARRAY_ABOVE_M + CUBE_SIDE_M / 2)
    b_T = np.zeros_like(nodes_m)
    for (i, x_m), (j, y_m) in product(*map(enumerate, middles_m)):
        sign = -1 if polarity == "checkerboard" and (i + j) % 2 else 1
        for z_m in heights_m:
            b_T += cuboid_field(nodes_m - (x_m, y_m, z_m), sign * ARRAY_REMANENCE_T, sides_m=(CUBE_SIDE_M,) * 3)
    return b_T


def magnetise(b_T: Float[np.ndarray, "s 3"], *, saturation_T: float, half_field_T: float) -> Float[np.ndarray, "s 3"]:
    """Give the magnetisation J that a field leaves in the powder: phi Br u^3 / (1 + u^3) along B, u = |B| / B_half."""
    u = np.linalg.norm(b_T, axis=1, keepdims=True) / half_field_T
    # u^2 / half_field_T stands for u^3 / |B|, which is finite where the field vanishes (seam crossings).
    return saturation_T * b_T * u**2 / half_field_T / (1 + u**3)


def moments(j_T: Float[np.ndarray, "s 3"], volumes_m3: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 3"]:
    """Turn magnetisation into the dipole moment of each cell, in A m^2."""
    return j_T * (volumes_m3 / mu_0)[:, None]
