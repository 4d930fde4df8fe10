"""A fingerprint of the simulation: equal as long as equal indentations give equal fields and forces."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.constants import micro, milli

from reskin.config import parse
from reskin.physics.board import BoardDesign, Spreads, draw_board
from reskin.physics.magnet import Quadrature
from reskin.physics.skin import SkinDesign, changes_of_field, draw_skin, forces

RULE = Quadrature(cell_m=0.8e-3, layers_n=5)  # as scene quick
BOARD = BoardDesign(
    chips_xy_mm=((0.0, 0.0), (-7.0, 0.0), (0.0, -7.0), (7.0, 0.0), (0.0, 7.0)),
    chips_turn_deg=(0.0, 180.0, 270.0, 90.0, 0.0),
    gap_mm=1.1,
)
PLACES_MM = ((0.0, 0.0), (4.0, -2.0), (-6.0, 4.0), (8.0, 4.0))
DEPTHS_MM = (0.2, 0.6, 1.2)
DIGITS = 4  # significant digits: rounding errors are smaller, changes of the physics larger


def fingerprint(sections: Mapping[str, Any]) -> str:
    """Return a digest of fields and forces of two skins under some indentations, and of the rig and chip settings.

    A refactoring keeps the fingerprint; a change of the physics or of a setting changes it.
    """
    design = parse(SkinDesign, sections["skin"], "skin")
    spreads = parse(Spreads, sections["spreads"], "spreads")
    indentations_m = milli * np.array([(*place, depth) for place in PLACES_MM for depth in DEPTHS_MM])
    simulated = []
    for name in ("b0", "b1"):
        board = draw_board(BOARD, spreads, seed=0, name=name)
        skin = draw_skin(design, spreads, seed=0, name=f"{name}_s0", rule=RULE)
        rest_T, change_T = changes_of_field(board, skin, indentations_m)
        simulated += [rest_T.ravel() / micro, change_T.ravel() / micro, forces(skin, indentations_m[:, 2])]
    rounded = [f"{value:.{DIGITS - 1}e}" for value in np.concatenate(simulated)]
    content = json.dumps([rounded, sections["rig"], sections["chip"]], sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()[:16]
