"""Positions and orientations of a board's chips, as far as they are known.

No byte says it: five chips are taken for the paper's board, forty for its sleeve.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from reskin.config import parse
from reskin.data.grid import CENTRE_MM
from reskin.simulation.defaults import nominal
from reskin.simulation.protocols import SKIN_MM
from reskin.simulation.settings import BoardKind

ASIDE_MM = 5.0  # between chips whose places nobody knows, so that they can be drawn


@dataclass(frozen=True)
class Layout:
    """Places in the frame of labels, in mm; `turn` holds the chips' axes in the board's frame."""

    known: bool
    chips_mm: Float64[np.ndarray, "k 2"]
    turn: Float64[np.ndarray, "k 3 3"]
    corner_mm: tuple[float, float]
    skin_mm: tuple[float, float]


def layout_of(chips_n: int) -> Layout:
    """Find the nominal board with this number of chips; others are drawn in a row."""
    for name, words in nominal("boards").items():
        kind = parse(BoardKind, words, f"nominal board {name}")
        if len(kind.design.places_mm) == chips_n:
            half_mm = np.array(kind.skin_mm) / 2
            centre_mm = np.full(2, CENTRE_MM) if kind.skin_mm == SKIN_MM else half_mm
            turn = Rotation.from_euler("z", np.array(kind.design.turns_deg)[:, None], degrees=True).as_matrix()
            corner_mm = centre_mm - half_mm
            chips_mm = centre_mm + np.array(kind.design.places_mm)
            return Layout(True, chips_mm, turn, (float(corner_mm[0]), float(corner_mm[1])), kind.skin_mm)
    chips_mm = np.column_stack([ASIDE_MM * (0.5 + np.arange(chips_n)), np.full(chips_n, ASIDE_MM)])
    return Layout(False, chips_mm, np.tile(np.eye(3), (chips_n, 1, 1)), (0.0, 0.0), (ASIDE_MM * chips_n, 2 * ASIDE_MM))
