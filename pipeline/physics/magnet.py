"""The magnetised skin at rest. In: how it was magnetised. Out: a lattice of dipoles, and J at its nodes.

Simplified: the array's field is that of an endless checkerboard, as a Fourier series; the powder's own field is
left out (<= 2.5 %, PHYSICS 8). Refuses to know chips, pokes and what differs from skin to skin.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.constants import mu_0

SKIN_SIDE_M = 20e-3  # authors' CAD
CUBE_SIDE_M = 6.35e-3  # the 4x4 array of 0.25 in cubes: seams at 0 and +-6.35 mm
ARRAY_BELOW_M = 0.50e-3  # magnet faces below and above the skin, authors' CAD
ARRAY_ABOVE_M = 0.25e-3
ARRAY_REMANENCE_T = 1.32  # N42 cubes, assumed
HARMONICS = (1, 3, 5, 7)  # of the square wave; all the others change J by 3 %

CELL_M = 0.64e-3  # wished lateral size of a cell; cells end at seams
LAYERS_N = 6  # Gauss-Legendre nodes in z: midpoint layers would cost up to 74 % of dB (PHYSICS 0)

Polarity = Literal["checkerboard", "same"]


@dataclass(frozen=True)
class Lattice:
    """Nodes of the skin at rest; z runs from the bonded base (0) up to the thickness."""

    nodes_m: Float[np.ndarray, "s 3"]
    volumes_m3: Float[np.ndarray, " s"]


def lattice(thickness_m: float) -> Lattice:
    """Lay cells that end at the seams, with Gauss nodes over the thickness."""
    seams_m = np.array([-SKIN_SIDE_M / 2, -CUBE_SIDE_M, 0.0, CUBE_SIDE_M, SKIN_SIDE_M / 2])
    spans = [np.linspace(a, b, round((b - a) / CELL_M) + 1) for a, b in pairwise(seams_m)]
    centres_m = np.concatenate([(edges[1:] + edges[:-1]) / 2 for edges in spans])
    widths_m = np.concatenate([np.diff(edges) for edges in spans])
    gauss, weights = np.polynomial.legendre.leggauss(LAYERS_N)
    x, y, z = np.meshgrid(centres_m, centres_m, (1 + gauss) / 2 * thickness_m, indexing="ij")
    volumes_m3 = np.einsum("i,j,k->ijk", widths_m, widths_m, weights / 2 * thickness_m)
    return Lattice(np.stack([x, y, z], axis=-1).reshape(-1, 3), volumes_m3.ravel())


def array_field(nodes_m: Float[np.ndarray, "s 3"], thickness_m: float) -> Float[np.ndarray, "s 3"]:
    """Give the field between two endless checkerboards of cubes that attract each other, in tesla.

    Each face is a sheet of charge +-Br; its harmonic sin(m kx) sin(n ky) decays as exp(-k_mn distance).
    """
    x_m, y_m, z_m = nodes_m.T
    b_T = np.zeros((3, len(nodes_m)))
    for m, n in ((m, n) for m in HARMONICS for n in HARMONICS):
        kx, ky = m * np.pi / CUBE_SIDE_M, n * np.pi / CUBE_SIDE_M
        k = np.hypot(kx, ky)
        sheet_T = ARRAY_REMANENCE_T * 8 / (np.pi**2 * m * n) * (1 - np.exp(-k * CUBE_SIDE_M))
        below_T = sheet_T * np.exp(-k * (z_m + ARRAY_BELOW_M))
        above_T = sheet_T * np.exp(-k * (thickness_m + ARRAY_ABOVE_M - z_m))
        b_T[0] -= (below_T - above_T) * kx / k * np.cos(kx * x_m) * np.sin(ky * y_m)
        b_T[1] -= (below_T - above_T) * ky / k * np.sin(kx * x_m) * np.cos(ky * y_m)
        b_T[2] += (below_T + above_T) * np.sin(kx * x_m) * np.sin(ky * y_m)
    return b_T.T


def magnetise(
    nodes_m: Float[np.ndarray, "s 3"],
    thickness_m: float,
    *,
    polarity: Polarity,
    saturation_T: float,
    half_field_T: float,
) -> Float[np.ndarray, "s 3"]:
    """Give the magnetisation J at each node: partly saturated along the array's field (PHYSICS 3), in tesla.

    `same` stands for one uniform field of the array's strength, along z.
    """
    if polarity == "same":
        b_T = np.tile([0.0, 0.0, ARRAY_REMANENCE_T / 2], (len(nodes_m), 1))
    else:
        b_T = array_field(nodes_m, thickness_m)
    strength_T = np.linalg.norm(b_T, axis=1, keepdims=True)
    u = strength_T / half_field_T
    # u^2 / half_field_T stands for u^3 / |B|, which is finite where the field vanishes (seam crossings).
    return saturation_T * b_T * u**2 / half_field_T / (1 + u**3)


def moments(j_T: Float[np.ndarray, "s 3"], volumes_m3: Float[np.ndarray, " s"]) -> Float[np.ndarray, "s 3"]:
    """Turn magnetisation into the dipole moment of each cell, in A m^2."""
    return j_T * (volumes_m3 / mu_0)[:, None]
