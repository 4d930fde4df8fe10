"""How a skin is magnetised. In: an array of magnets as wide as it, places in the slab. Out: field, magnetisation in T.

The powder's own field is left out, which costs some 7 % of dB (measured: table left_out of scene quick), and so are
tolerances of the array.
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
    for signs in product((1, -1), repeat=3):
        b_T += np.prod(signs) * _corner(observers_m - half_m * signs)
    b_T *= polarization_T / (4 * np.pi)
    b_T[:, 2] += polarization_T * (np.abs(observers_m) < half_m).all(axis=1)
    return b_T


def _corner(from_m: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3"]:
    """Give what one corner of a box adds to its field, of 4 pi / J."""
    x, y, z = from_m.T
    xx, yy, zz = x * x, y * y, z * z
    # asinh(y / hypot(x, z)) is log(y + r) less what both ends share, and keeps its digits where y < 0.
    along_x, along_y = -np.arcsinh(y / np.sqrt(xx + zz)), -np.arcsinh(x / np.sqrt(yy + zz))
    return np.stack([along_x, along_y, np.arctan(x * y / (z * np.sqrt(xx + yy + zz)))], axis=1)


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
    """Sum the field of so many cubes below, and as many above, at places in the slab, in tesla.

    Cubes that touch share corners: each corner is computed once, with the signs of all its cubes added up.
    """
    if not (nodes_m[:, 2].min() >= 0 and nodes_m[:, 2].max() <= thickness_m):
        got = f"{nodes_m[:, 2].min():.3g} ... {nodes_m[:, 2].max():.3g} m"
        raise ParamsError("magnet array", "places", "inside the slab", got, "Magnetise the skin at rest.")
    signs = np.ones(cubes_n) if polarity == "same" else (-1.0) ** np.add.outer(*map(np.arange, cubes_n))
    # Of a cube the corner on its right counts +, the one on its left -; along y and z likewise.
    weights = -np.diff(-np.diff(np.pad(signs, 1), axis=0), axis=1)
    below_m, above_m = -ARRAY_BELOW_M, thickness_m + ARRAY_ABOVE_M
    faces_m = {below_m: 1, below_m - CUBE_SIDE_M: -1, above_m + CUBE_SIDE_M: 1, above_m: -1}
    b_T = np.zeros_like(nodes_m)
    for i, j in zip(*np.nonzero(weights), strict=True):
        x_m, y_m = (CUBE_SIDE_M * (at - n / 2) for at, n in zip((i, j), cubes_n, strict=True))
        for z_m, top in faces_m.items():
            b_T += weights[i, j] * top * _corner(nodes_m - (x_m, y_m, z_m))
    return b_T * ARRAY_REMANENCE_T / (4 * np.pi)


def magnetise(b_T: Float[np.ndarray, "s 3"], *, saturation_T: float, half_field_T: float) -> Float[np.ndarray, "s 3"]:
    """Give the magnetisation J that a field leaves in the powder: phi Br u^3 / (1 + u^3) along B, u = |B| / B_half."""
    u = np.linalg.norm(b_T, axis=1, keepdims=True) / half_field_T
    # u^2 / half_field_T stands for u^3 / |B|, which is finite where the field vanishes (seam crossings).
    return saturation_T * b_T * u**2 / half_field_T / (1 + u**3)


def moments(j_T: Float[np.ndarray, "s 3"], volumes_m3: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 3"]:
    """Turn magnetisation into the dipole moment of each cell, in A m^2."""
    return j_T * (volumes_m3 / mu_0)[:, None]
