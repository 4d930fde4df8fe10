"""All checks of the simulator, in the order of its chain. In: a scene's designs. Out: the rows of one table.

Refuses to know how a check is done (the modules beside it) and how a table looks.
"""

from dataclasses import dataclass

from pipeline.experiments.verification.checks import Check
from pipeline.experiments.verification.contact import check_contact
from pipeline.experiments.verification.electronics import check_electronics
from pipeline.experiments.verification.field import check_field
from pipeline.experiments.verification.frames import check_frames
from pipeline.experiments.verification.kinematics import check_kinematics
from pipeline.experiments.verification.poke import check_poke, check_quadrature
from pipeline.experiments.verification.relaxation import check_relaxation
from pipeline.experiments.verification.sideways import check_sideways
from pipeline.physics.board import BoardDesign, Spreads
from pipeline.physics.nodes import Quadrature
from pipeline.physics.sensor import ChipDesign
from pipeline.physics.skin import SkinDesign


@dataclass(frozen=True)
class Designs:
    """What a scene's boards, skins and chips are like, and the rule that its skins are summed by."""

    board: BoardDesign
    spreads: Spreads
    skin: SkinDesign
    chip: ChipDesign
    rule: Quadrature


def verify(of: Designs, *, depths_m: tuple[float, ...], seed: int) -> list[Check]:
    """Measure every law against its reference, for the designs and depths of a scene."""
    return [
        *check_field(of.skin, seed),
        *check_contact(of.skin),
        *check_kinematics(of.skin, max(depths_m)),
        *check_sideways(of.skin),
        *check_quadrature(of.board, of.spreads, skin=of.skin, rule=of.rule, depths_m=depths_m, seed=seed),
        *check_poke(of.board, of.spreads, skin=of.skin, depths_m=depths_m, seed=seed),
        *check_relaxation(),
        *check_electronics(of.chip, seed),
        *check_frames(of.chip.gain_sel, len(of.board.places_mm), seed),
    ]
