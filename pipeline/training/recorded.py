"""How the recorded boards of a scene are oriented (section `compare` of the scene)."""

from dataclasses import replace
from pathlib import Path

from pipeline.fitting.axes import BoardAxes
from pipeline.settings import Row, SectionWithRows, Settings
from reskin.errors import ParamsError
from reskin.universal.layout import BoardLayout, read_layout

START_AWAY_um_mm = 5.0  # assumed slide of the law at which fits start


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
        start = replace(layout.law, away_um_mm=START_AWAY_um_mm)
        return BoardAxes(
            layout.setup(), start, layout.turns_deg, layout.centre_mm, self.labels_mirrored, f"layout {layout.name}"
        )
