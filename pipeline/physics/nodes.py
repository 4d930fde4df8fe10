"""Where the skin is summed. In: its sizes and a rule of quadrature. Out: nodes and the volume that each stands for.

Cells end at the magnets' seams, where the magnetisation bends; over the thickness lie Gauss-Legendre nodes, because
midpoint layers cost up to 74 % of dB (PHYSICS 0). Refuses to know fields, moments and chips.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.constants import milli

from pipeline.core.config import Strict
from pipeline.core.errors import ParamsError
from pipeline.physics.magnet import seams_m

SKIN_SIDE_M = 20e-3  # authors' CAD
SKIN_SIDES_M = (SKIN_SIDE_M, SKIN_SIDE_M)
SEAMS_M = seams_m(SKIN_SIDE_M)  # of the 4x4 array of 0.25 in cubes that magnetises the authors' skin


class Rule(Strict):
    """A rule of quadrature as a scene writes it: the nearer the chips, the finer it must be (question runtime)."""

    cell_mm: Annotated[float, Field(gt=0, le=20)]
    layers_n: Annotated[int, Field(ge=1, le=100)]

    def quadrature(self) -> "Quadrature":
        """Give it in SI."""
        return Quadrature(self.cell_mm * milli, self.layers_n)


@dataclass(frozen=True)
class Quadrature:
    """A rule: cells at most so wide, and so many Gauss nodes over the thickness."""

    cell_m: float
    layers_n: int


CHOSEN = Quadrature(cell_m=0.5e-3, layers_n=6)  # 42 x 42 x 6 nodes; dB within 2 % of cells half as wide (test_skin)


@dataclass(frozen=True)
class Nodes:
    """Nodes of a skin at rest; x and y from its middle, z from the base (0) to the top."""

    nodes_m: Float[np.ndarray, "s 3"]
    volumes_m3: Float[np.ndarray, " s"]


def place_nodes(thickness_m: float, rule: Quadrature = CHOSEN, *, sides_m: tuple[float, float] = SKIN_SIDES_M) -> Nodes:
    """Fill the skin with midpoints of cells that end at seams and edges, times Gauss nodes in z."""
    if not (thickness_m > 0 and rule.cell_m > 0 and rule.layers_n > 0):
        got = f"{thickness_m:.3g} m, {rule.cell_m:.3g} m and {rule.layers_n}"
        raise ParamsError("quadrature", "thickness, cell and layers", "above 0", got, "Mend the design.")
    (along_x_m, widths_x_m), (along_y_m, widths_y_m) = (_cells(side_m, rule) for side_m in sides_m)
    gauss, weights = np.polynomial.legendre.leggauss(rule.layers_n)
    x_m, y_m, z_m = np.meshgrid(along_x_m, along_y_m, (1 + gauss) / 2 * thickness_m, indexing="ij")
    volumes_m3 = np.einsum("i,j,k->ijk", widths_x_m, widths_y_m, weights / 2 * thickness_m)
    return Nodes(np.stack([x_m, y_m, z_m], axis=-1).reshape(-1, 3), volumes_m3.ravel())


def _cells(side_m: float, rule: Quadrature) -> tuple[Float[np.ndarray, " i"], Float[np.ndarray, " i"]]:
    """Give the middles and the widths of the cells along one side."""
    marks_m = (-side_m / 2, *seams_m(side_m), side_m / 2)
    spans = [np.linspace(a, b, ceil((b - a) / rule.cell_m - 1e-9) + 1) for a, b in pairwise(marks_m)]
    centres_m = np.concatenate([(edges[1:] + edges[:-1]) / 2 for edges in spans])
    return centres_m, np.concatenate([np.diff(edges) for edges in spans])
