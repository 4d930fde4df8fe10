"""What all quadratures are tried on. In: board, design, name, pokes. Out: a `Trial`, and its skin on any nodes.

The skin is that of its name but for its unevenness and its rotation: amplitude and filler scale what every quadrature
sums, over 3 mm, and move the errors by less than 0.05 % of dB. Refuses to know errors and times.
"""

from dataclasses import dataclass, replace
from itertools import pairwise, product
from math import ceil
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field
from scipy.constants import milli

from reskin.config import Strict
from reskin.errors import ParamsError
from reskin.physics import magnet
from reskin.physics.board import Board, Spreads
from reskin.physics.magnet import SEAMS_M, SKIN_SIDE_M, Nodes, Quadrature
from reskin.physics.skin import Skin, SkinDesign, draw_skin

COARSEST = Quadrature(cell_m=20e-3, layers_n=1)  # its nodes are replaced
Positive = Annotated[float, Field(gt=0)]


class Pokes(Strict):
    """Every place, seen from the skin's middle, at every depth."""

    places_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)]
    depths_mm: Annotated[tuple[Positive, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Trial:
    """One skin on its board, and pokes as commanded, depth after depth."""

    board: Board
    design: SkinDesign
    skin: Skin
    depths_mm: tuple[float, ...]
    pokes_m: Float[np.ndarray, "n 3"]


def draw_trial(board: Board, design: SkinDesign, *, spreads: Spreads, seed: int, name: str, pokes: Pokes) -> Trial:
    """Draw the skin called `name`, even and straight, and lay the pokes on its pattern wherever that sits."""
    even = spreads.model_copy(update=dict.fromkeys(("skin_amplitude", "skin_filler", "skin_rotation_deg"), 0.0))
    skin = draw_skin(design, even, seed=seed, name=name, rule=COARSEST)
    pokes_m = milli * np.array([(*place, depth) for depth, place in product(pokes.depths_mm, pokes.places_mm)])
    pokes_m[:, :2] += skin.seat_m
    if not (pokes_m[:, 2] + skin.depth_zero_m > 0).all():
        got = f"{pokes_m[:, 2].min() + skin.depth_zero_m:.3g} m"
        raise ParamsError(f"skin {name}", "true depth of every poke", "above 0 m", got, "Poke deeper.")
    return Trial(board, design, skin, pokes.depths_mm, pokes_m)


def laid(trial: Trial, rest: Nodes) -> Skin:
    """Give the trial's skin on these nodes (from its middle and its base), magnetised as any skin is."""
    b_T = magnet.array_field(rest.nodes_m, trial.skin.thickness_m, trial.design.polarity)
    j_T = magnet.magnetise(b_T, saturation_T=trial.design.saturation_T, half_field_T=trial.design.half_field_T)
    nodes_m = rest.nodes_m + np.append(trial.skin.seat_m, 0.0)
    return replace(trial.skin, nodes_m=nodes_m, moments_A_m2=magnet.moments(j_T, rest.volumes_m3))


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
    spans_m = pairwise((-SKIN_SIDE_M / 2, *SEAMS_M, SKIN_SIDE_M / 2))
    edges_m = [np.linspace(a, b, ceil((b - a) / rule.cell_m - 1e-9) + 1) for a, b in spans_m]
    starts_m, widths_m = np.concatenate([e[:-1] for e in edges_m]), np.concatenate([np.diff(e) for e in edges_m])
    share, weight = _gauss(per_cell_n)
    z_share, z_weight = _gauss(rule.layers_n)
    x_m, x_weight_m = starts_m[:, None] + widths_m[:, None] * share, widths_m[:, None] * weight
    return _product(x_m.ravel(), x_weight_m.ravel(), thickness_m * z_share, thickness_m * z_weight)


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
