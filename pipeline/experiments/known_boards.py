"""The recorded boards of a scene, in the axes that the universal model and its reference methods use."""

from pathlib import Path

from pipeline.experiments.compare import Compare, chip_rotations, make_setup, pool_skins, to_board_axes
from pipeline.experiments.results import read_captures
from pipeline.settings import Settings
from pipeline.training.jobs import read_data
from pipeline.training.universal_variants import Frame, KnownBoards
from reskin.errors import ParamsError
from reskin.physics.skin import SkinDesign


def read_known_boards(settings: Settings, indentations: Path, folds: Path) -> KnownBoards:
    """Read the recorded boards of a scene (two or more), rotated to the board axes defined by section `compare`."""
    data, section = read_data(settings, indentations, folds), settings.section(Compare, "compare")
    skins = pool_skins(read_captures(indentations, tuple(settings.captures_in(indentations))))
    if len(skins) < 2:
        raise ParamsError(f"scene {settings.scene}", "boards with known forces", "two or more", len(skins), "Add one.")
    setup = make_setup(section, settings.shared_section(SkinDesign, "skin"))
    frame = Frame(chip_rotations(section), section.labels_middle_mm, section.labels_mirrored)
    return KnownBoards(data, frame, setup, {board: to_board_axes(presses, section) for board, presses in skins.items()})
