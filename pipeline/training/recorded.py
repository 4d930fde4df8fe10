"""The recorded boards of a scene: how they are oriented (section `compare` of the scene), and their presses."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.fitting.axes import BoardAxes
from pipeline.fitting.law_fit import AlignedPresses
from pipeline.fitting.presses import pool_skins
from pipeline.settings import Row, SectionWithRows, Settings
from reskin import io
from reskin.data.rows import Rows, Selection, load_rows
from reskin.errors import ParamsError
from reskin.universal.layout import BoardLayout, read_layout


class Compare(SectionWithRows):
    """Settings section `compare`, which states how recorded boards, their labels and their skins are oriented.

    Experiments compare, rig and new_board read it, and so does `reskin add`. In a scene's file, `layout` is either the
    layout of a board, in the form of the files in `reskin/layouts`, or the name of one of these files.
    """

    layout: BoardLayout
    labels_mirrored: bool  # whether y of the labels points opposite to y of the board

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        given, key = section.get("layout"), f"{where}.layout"
        if isinstance(given, str) and Path(given).suffix:
            problem = f"{given} is the name of a file, and DVC would not notice when this file changes"
            raise ParamsError(f"{key}: {problem}. Replace the name by the content of the file, as `reskin new` does.")
        if isinstance(given, str):
            return section | {"layout": read_layout(given).model_dump(mode="json")}
        return section

    @property
    def axes(self) -> BoardAxes:
        """The orientation of the boards."""
        layout = self.layout
        return BoardAxes(
            layout.setup(), layout.turns_deg, layout.centre_mm, self.labels_mirrored, f"layout {layout.name}"
        )


@dataclass(frozen=True)
class RecordedBoards:
    """The recorded boards of a scene.

    - rows: all readings with a known place, in the coordinates of the labels and along the chips' axes.
    - axes: the conversion to the axes of the board.
    - presses: means over the readings of each press with a known place and force, in the axes of the board. The keys
        are names of boards, or `board/skin` for boards with several skins.
    """

    rows: Rows
    axes: BoardAxes
    presses: Mapping[str, AlignedPresses]


def read_boards(settings: Settings, indentations: Path) -> RecordedBoards:
    """Read the recorded boards of a scene; raise ParamsError unless there are two or more with known forces."""
    files = [indentations / f"{name}.parquet" for name in settings.captures_in(indentations)]
    axes = settings.section(Compare, "compare").axes
    skins = pool_skins([io.read_readings(file) for file in files])
    if len(skins) < 2:
        where, what = f"scene {settings.scene}", "boards with known forces"
        raise ParamsError(where, what, "two or more", len(skins), "Add recordings of another board.")
    presses = {board: axes.align(pooled) for board, pooled in skins.items()}
    return RecordedBoards(load_rows(files, settings.section(Selection, "selection")), axes, presses)
