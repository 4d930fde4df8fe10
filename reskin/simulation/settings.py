"""Settings of a simulation: boards, skins, protocols and the rig."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, model_validator
from scipy.constants import milli

from reskin.config import Strict, parse
from reskin.layouts import with_geometry
from reskin.physics.board import BoardDesign, Spreads
from reskin.physics.chip import ChipDesign
from reskin.physics.magnet import QuadratureSettings
from reskin.physics.skin import SkinDesign
from reskin.simulation.contact import Terms
from reskin.simulation.defaults import SHARED
from reskin.simulation.protocols import Drag, Grid, Hand, Protocol
from reskin.simulation.rig import Rig

MAIN = "grid"  # name of the main protocol, whose captures have the same names as their skins
Count = Annotated[int, Field(ge=1, le=1000)]
Side_mm = Annotated[float, Field(gt=0, le=500)]


class BoardKind(Strict):
    """Settings of one kind of board: how many boards and skins of this kind are simulated, and their design.

    In place of `design` and `skin_mm`, a file may name a `layout` of the folder `reskin/layouts`.
    """

    letter: Annotated[str, Field(pattern="^[a-z]$")]  # first letter of the names of all boards and skins of this kind
    boards_n: Count
    skins_per_board_n: Count
    design: BoardDesign
    skin_mm: tuple[Side_mm, Side_mm]  # sides of the skin along x and y
    quadrature: QuadratureSettings  # how the skin is divided into cells to compute its field

    @property
    def skin_m(self) -> tuple[float, float]:
        return self.skin_mm[0] * milli, self.skin_mm[1] * milli


class SimulationSettings(Strict):
    """All settings of a simulation.

    The boards and protocols are from section `simulate` of a scene. The other settings are from `nominal.yaml` and are
    the same for all simulations.
    """

    boards: Annotated[dict[str, BoardKind], Field(min_length=1)]
    protocols: Annotated[dict[str, Protocol], Field(min_length=1)]
    rig: Rig
    skin: SkinDesign
    chip: ChipDesign
    spreads: Spreads
    terms: Terms

    @model_validator(mode="after")
    def _check_references(self) -> "SimulationSettings":
        used = {term for protocol in self.protocols.values() for term in protocol.terms}
        if used != self.terms.named():
            raise ValueError(
                f"terms must be those that the protocols list ({sorted(used)}), but section terms contains "
                f"{sorted(self.terms.named())}"
            )
        for name, protocol in self.protocols.items():
            if protocol.boards not in self.boards:
                raise ValueError(
                    f"protocol {name}: boards must be one of {sorted(self.boards)}, not {protocol.boards!r}"
                )
            if isinstance(protocol, Hand) and protocol.tilt_sd_deg > 0 and "friction" not in protocol.terms:
                raise ValueError(f"protocol {name}: a tilted stylus (tilt_sd_deg) needs the term friction")
            if isinstance(protocol, Drag) and "friction" not in protocol.terms:
                raise ValueError(
                    f"protocol {name}: a drag needs the term friction, because only friction shears the skin"
                )
            kind, skins_n = self.boards[protocol.boards], protocol.skins_n
            if skins_n > (have_n := kind.boards_n * kind.skins_per_board_n):
                raise ValueError(
                    f"protocol {name}: skins_n {skins_n} is more than the {have_n} skins of {protocol.boards} boards"
                )
        if len({kind.letter for kind in self.boards.values()}) < len(self.boards):
            raise ValueError("two kinds of boards have the same letter; each kind must have a letter of its own")
        return self

    @model_validator(mode="after")
    def _check_main_protocol(self) -> "SimulationSettings":
        if MAIN not in self.protocols or not isinstance(self.protocols[MAIN], Grid):
            raise ValueError(f"protocols must include a grid named {MAIN}")
        return self

    @property
    def main(self) -> Grid:
        """The settings of the main protocol, whose captures are used for training and testing."""
        main = self.protocols[MAIN]
        assert isinstance(main, Grid), "checked above"
        return main

    @property
    def main_boards(self) -> BoardKind:
        return self.boards[self.main.boards]


def parse_simulation(section: Mapping[str, Any], shared: Mapping[str, Any], where: str) -> SimulationSettings:
    """Parse the settings of a simulation.

    Parameters
    ----------
    section : section `simulate` of a scene
    shared : the sections of `nominal.yaml` that all simulations use; `terms` that no protocol lists are ignored
    where : name of the section for error messages
    """
    protocols, boards = section.get("protocols"), section.get("boards")
    if isinstance(boards, Mapping):
        section = {**section, "boards": {name: with_geometry(kind) for name, kind in boards.items()}}
    named = {
        term
        for protocol in (protocols.values() if isinstance(protocols, Mapping) else ())
        for term in (protocol.get("terms", ()) if isinstance(protocol, Mapping) else ())
    }
    terms = {name: values for name, values in shared["terms"].items() if name in named}
    return parse(SimulationSettings, {**section, **{name: shared[name] for name in SHARED}, "terms": terms}, where)
