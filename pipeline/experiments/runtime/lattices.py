"""Nodes that the product does not use, to compare with. In: thickness and a rule. Out: nodes and their volumes.

Refuses to know magnets, pokes and errors.
"""

from itertools import pairwise
from math import ceil

import numpy as np
from jaxtyping import Float
from scipy.constants import milli

from pipeline.physics.nodes import SEAMS_M, SKIN_SIDE_M, Nodes, Quadrature


def written(rule: Quadrature) -> str:
    """Write a rule as rows and figures do."""
    return f"{rule.cell_m / milli:.3g} mm x {rule.layers_n}"


def midpoints(thickness_m: float, rule: Quadrature) -> Nodes:
    """Fill the skin with the middles of equal boxes that heed no seam: the lattice one would take first."""
    side_m, _, high_m = box_m(thickness_m, rule)
    side_n = round(SKIN_SIDE_M / side_m)
    x_m = side_m * (np.arange(side_n) + 0.5) - SKIN_SIDE_M / 2
    z_m = high_m * (np.arange(rule.layers_n) + 0.5)
    return _product(x_m, np.full(side_n, side_m), z_m, np.full(rule.layers_n, high_m))


def box_m(thickness_m: float, rule: Quadrature) -> tuple[float, float, float]:
    """Give the sides of the boxes whose middles `midpoints` are."""
    side_m = SKIN_SIDE_M / ceil(SKIN_SIDE_M / rule.cell_m - 1e-9)
    return side_m, side_m, thickness_m / rule.layers_n


def gauss_everywhere(thickness_m: float, rule: Quadrature, *, per_cell_n: int) -> Nodes:
    """Fill the skin with cells that end at the seams, each with Gauss nodes along x and y too: an order higher."""
    spans_m = list(pairwise((-SKIN_SIDE_M / 2, *SEAMS_M, SKIN_SIDE_M / 2)))
    parts = [ceil((b - a) / rule.cell_m - 1e-9) for a, b in spans_m]
    edges_m = [np.linspace(a, b, part_n + 1) for (a, b), part_n in zip(spans_m, parts, strict=True)]
    starts_m = np.concatenate([edges[:-1] for edges in edges_m])
    widths_m = np.concatenate([np.diff(edges) for edges in edges_m])
    share, weight = _gauss(per_cell_n)
    z_share, z_weight = _gauss(rule.layers_n)
    return _product(
        (starts_m[:, None] + widths_m[:, None] * share).ravel(),
        (widths_m[:, None] * weight).ravel(),
        thickness_m * z_share,
        thickness_m * z_weight,
    )


def _gauss(points_n: int) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    x, w = np.polynomial.legendre.leggauss(points_n)
    return (1 + x) / 2, w / 2


def _product(
    x_m: Float[np.ndarray, " i"],
    x_weight_m: Float[np.ndarray, " i"],
    z_m: Float[np.ndarray, " j"],
    z_weight_m: Float[np.ndarray, " j"],
) -> Nodes:
    # x and y alike, as the skin is.
    nodes_m = np.stack(np.meshgrid(x_m, x_m, z_m, indexing="ij"), axis=-1).reshape(-1, 3)
    return Nodes(nodes_m, np.einsum("i,j,k->ijk", x_weight_m, x_weight_m, z_weight_m).ravel())
