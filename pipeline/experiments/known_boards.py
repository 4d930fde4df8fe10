"""The recorded boards of a scene, in the axes that the universal model and its reference methods use."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.experiments.compare import Compare, chip_rotations, make_setup, pool_skins, to_board_axes
from pipeline.experiments.results import read_captures
from pipeline.settings import Settings
from pipeline.training.jobs import SceneData, read_data
from pipeline.training.universal_variants import Frame, KnownBoards
from reskin.errors import ParamsError
from reskin.physics.skin import SkinDesign
from reskin.schema import Readings


def read_known_boards(settings: Settings, indentations: Path, folds: Path) -> KnownBoards:
    """Read the recorded boards of a scene (two or more), rotated to the board axes defined by section `compare`."""
    data, section = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    known = align_boards(data, section, read_captures(indentations, tuple(settings.captures_in(indentations))))
    if len(known.presses) < 2:
        what = "boards with known forces"
        raise ParamsError(
            f"scene {settings.scene}", what, "two or more", len(known.presses), "Add recordings of another board."
        )
    return known


def align_boards(data: SceneData, section: Compare, captures: Sequence[Readings]) -> KnownBoards:
    """Rotate the boards of captures with known places and forces to the board axes defined by `section`."""
    setup = make_setup(section, data.settings.shared_section(SkinDesign, "skin"))
    frame = Frame(chip_rotations(section), section.labels_middle_mm, section.labels_mirrored)
    skins = pool_skins(captures)
    return KnownBoards(data, frame, setup, {board: to_board_axes(presses, section) for board, presses in skins.items()})
