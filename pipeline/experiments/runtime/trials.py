"""What all quadratures are tried on. In: board, design, name, pokes. Out: a `Trial`, and its skin on any nodes.

The skin is that of its name but for its unevenness: amplitude and filler scale what every quadrature sums, over 3 mm,
and move the errors by less than 0.05 % of dB. Refuses to know rules of quadrature, errors and times.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.constants import milli

from pipeline.core.errors import ParamsError
from pipeline.physics import magnet
from pipeline.physics.board import Board, Spreads
from pipeline.physics.nodes import Nodes, Quadrature
from pipeline.physics.skin import Skin, SkinDesign, draw_skin

COARSEST = Quadrature(cell_m=20e-3, layers_n=1)  # its nodes are replaced


@dataclass(frozen=True)
class Pokes:
    """Every place, seen from the skin's middle, at every depth."""

    places_mm: tuple[tuple[float, float], ...]
    depths_mm: tuple[float, ...]


@dataclass(frozen=True)
class Trial:
    """One skin on its board, and pokes as commanded, depth after depth."""

    board: Board
    design: SkinDesign
    skin: Skin
    depths_mm: tuple[float, ...]
    pokes_m: Float[np.ndarray, "n 3"]


def draw_trial(board: Board, design: SkinDesign, *, spreads: Spreads, seed: int, name: str, pokes: Pokes) -> Trial:
    """Draw the skin called `name`, even, and lay the pokes on its pattern wherever that sits on the board."""
    even = spreads.model_copy(update={"skin_amplitude": 0.0, "skin_filler": 0.0})
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
    return replace(
        trial.skin,
        nodes_m=rest.nodes_m + np.append(trial.skin.seat_m, 0.0),
        moments_A_m2=magnet.moments(j_T, rest.volumes_m3),
    )
