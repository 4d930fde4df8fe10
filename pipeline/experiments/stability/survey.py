"""All stiff, extreme and broken cases. In: a scene's designs. Out: the rows of one table.

Refuses to know how a case is tried (the modules beside it) and how a table looks.
"""

from pipeline.experiments.stability.cases import Case
from pipeline.experiments.stability.chip import survey_chip
from pipeline.experiments.stability.drag import survey_drag
from pipeline.experiments.stability.physics import survey_physics
from pipeline.experiments.stability.relaxing import survey_relaxing
from pipeline.experiments.stability.wire import survey_wire
from pipeline.physics.board import BoardDesign, Spreads
from pipeline.physics.sensor import ChipDesign
from pipeline.physics.skin import SkinDesign


def survey(board: BoardDesign, spreads: Spreads, *, skin: SkinDesign, chip: ChipDesign, seed: int) -> list[Case]:
    """Try every case of physics, chip and wire on the designs of a scene."""
    chips_n = len(board.places_mm)
    return [
        *survey_relaxing(),
        *survey_physics(board, spreads, skin=skin, seed=seed),
        *survey_drag(skin),
        *survey_chip(chip, chips_n, seed),
        *survey_wire(chip.gain_sel, chips_n, seed),
    ]
