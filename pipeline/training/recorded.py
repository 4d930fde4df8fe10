"""The recorded boards of a scene: how they are oriented (section `compare` of the scene), and their presses."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pipeline.settings import Row, SectionWithRows, Settings
from reskin import io
from reskin.data.rows import Rows, Selection, load_rows
from reskin.errors import ParamsError
from reskin.physics.board import BoardDesign
from reskin.physics.skin import SkinDesign
from reskin.universal.axes import BoardAxes
from reskin.universal.law import AlignedPresses, Setup
from reskin.universal.layout import BoardLayout, as_layout, paper_layout, read_layout
from reskin.universal.presses import pool_skins

Side_mm = Annotated[float, Field(gt=0, le=500)]


class Compare(SectionWithRows):
    """Settings section `compare`, which states how recorded boards, their labels and their skins are oriented.

    Experiments compare, rig and new_board read it, and so does `reskin add`. A scene's file may describe the board by
    one key `layout` instead of `tip_radius_mm` and the keys from `design` to `labels_middle_mm`. The value of `layout`
    is either the layout of a board, in the form of the files in `reskin/universal/layouts`, or the name of one of these
    files.
    """

    layout: BoardLayout | None = None
    design: BoardDesign
    skin_mm: tuple[Side_mm, Side_mm]
    skin_flipped: bool  # whether all magnetic poles are swapped, as by a quarter turn of a checkerboard skin
    labels_middle_mm: tuple[float, float]  # label (x, y) of the place at the board's middle
    labels_mirrored: bool  # whether y of the labels points opposite to y of the board
    tip_radius_mm: Annotated[float, Field(gt=0, le=50)]

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        if "layout" not in section:
            return section
        given, key = section["layout"], f"{where}.layout"
        if isinstance(given, str) and Path(given).suffix:
            problem = f"{given} is the name of a file, and DVC would not notice when this file changes"
            raise ParamsError(f"{key}: {problem}. Replace the name by the content of the file, as `reskin new` does.")
        layout = read_layout(given) if isinstance(given, str) else as_layout(given, key)
        design = {
            "chips_xy_mm": layout.chips_mm.tolist(), "chips_turn_deg": list(layout.turns_deg), "gap_mm": layout.gap_mm,
        }  # fmt: skip
        of_layout = {
            "layout": layout.model_dump(mode="json"), "design": design, "skin_mm": layout.skin.size_mm,
            "skin_flipped": layout.skin.flipped, "labels_middle_mm": layout.centre_mm,
            "tip_radius_mm": layout.tip_radius_mm,
        }  # fmt: skip
        if twice := sorted(section.keys() & of_layout.keys() - {"layout"}):
            raise ParamsError(
                f"{where}: {', '.join(twice)} cannot be set together with layout. Change the layout instead."
            )
        return section | of_layout

    def axes(self, design: SkinDesign) -> BoardAxes:
        """Return the orientation of the boards. `design` is the nominal skin, unless a layout describes the skin."""
        turns_deg, middle_mm = tuple(self.design.turns_deg), self.labels_middle_mm
        if self.layout is not None:
            keys = "compare.layout", "centre_mm"
            stated_by = f"layout {self.layout.name}"
            return BoardAxes(self.layout.setup(), turns_deg, middle_mm, self.labels_mirrored, stated_by, *keys)
        chips_mm = np.array(self.design.places_mm)
        setup = Setup(design, chips_mm, self.design.gap_mm, self.skin_mm, self.skin_flipped, self.tip_radius_mm)
        return BoardAxes(setup, turns_deg, middle_mm, self.labels_mirrored)

    def board_layout(self, scene: str) -> BoardLayout:
        """Return the layout of the boards; without `layout`, it is the paper's layout with the values of this section.

        Raises
        ------
        ParamsError : no layout can describe the boards, for example because a chip is turned by 45 degrees
        """
        if self.layout is not None:
            return self.layout
        paper = paper_layout().model_dump(mode="json")
        chips = [
            {"x_mm": x_mm, "y_mm": y_mm, "turn_deg": turn_deg}
            for (x_mm, y_mm), turn_deg in zip(self.design.places_mm, self.design.turns_deg, strict=True)
        ]
        own = {
            "name": scene, "chips": chips, "centre_mm": self.labels_middle_mm, "gap_mm": self.design.gap_mm,
            "skin": paper["skin"] | {"size_mm": self.skin_mm, "flipped": self.skin_flipped},
            "tip_radius_mm": self.tip_radius_mm,
        }  # fmt: skip
        return as_layout(paper | own, f"scene {scene}: compare")


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
    axes = settings.section(Compare, "compare").axes(settings.shared_section(SkinDesign, "skin"))
    skins = pool_skins([io.read_readings(file) for file in files])
    if len(skins) < 2:
        where, what = f"scene {settings.scene}", "boards with known forces"
        raise ParamsError(where, what, "two or more", len(skins), "Add recordings of another board.")
    presses = {board: axes.align(pooled) for board, pooled in skins.items()}
    return RecordedBoards(load_rows(files, settings.section(Selection, "selection")), axes, presses)
