"""The layouts of boards that come with the project: one YAML file per board, the only place where its geometry stands.

File reskin.yaml explains each key. A file that is only for simulations may omit the keys that only a universal model
needs. Simulated boards and the nominal skin take their geometry from these files by the functions of this module;
`reskin.universal.layout` reads and checks whole layouts.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from reskin.config import Strict, parse, read_yaml
from reskin.errors import ParamsError, did_you_mean

FOLDER = Path(__file__).parent
PAPER = "reskin"  # the layout of the paper's board
SKIN = ("thickness_mm", "polarity", "flipped", "magnetisation")  # what all simulated skins have from this layout
Coordinate = Annotated[float, Field(ge=-200, le=200)]
Side = Annotated[float, Field(gt=0, le=500)]


def file_of(name: str) -> Path:
    """Return the file of a layout.

    Raises
    ------
    ParamsError : no layout has this name
    """
    known = sorted(file.stem for file in FOLDER.glob("*.yaml"))
    if name not in known:
        raise ParamsError(
            f"{name}: this is neither a YAML file nor the name of a layout in {FOLDER} ({', '.join(known)})."
            f"{did_you_mean(name, known)} To write your own layout, copy {FOLDER / 'reskin.yaml'} and edit the copy."
        )
    return FOLDER / f"{name}.yaml"


class ChipPlace(Strict):
    """Position of a chip relative to the board's centre, and rotation of the chip's axes about z.

    The rotation is counterclockwise if seen from above the skin. With 90, for example, the x axis of the chip points in
    the direction of the board's y axis.
    """

    x_mm: Coordinate
    y_mm: Coordinate
    turn_deg: Literal[0, 90, 180, 270]


class _Skin(Strict, extra="ignore"):
    size_mm: tuple[Side, Side]


class _Geometry(Strict, extra="ignore"):
    """The keys of a layout that simulated boards have; the others are those of reskin.yaml (see `geometry`)."""

    chips: Annotated[tuple[ChipPlace, ...], Field(min_length=1)]
    gap_mm: Annotated[float, Field(gt=0, le=20)]
    tiles: dict[str, Any] | None = None
    skin: _Skin


def geometry(name: str) -> dict[str, Any]:
    """Return the settings `design` and `skin_mm` of simulated boards (`reskin.simulation.settings.BoardKind`).

    Raises
    ------
    ParamsError : the layout is invalid, or its skin or its tip differs from that of the paper's layout. All simulated
        skins have the thickness, polarity, magnetisation and tip of the paper's layout.
    """
    file = file_of(name)
    content, paper = read_yaml(file), read_yaml(file_of(PAPER))
    layout = parse(_Geometry, content, str(file))
    given = {"tip_radius_mm": content.get("tip_radius_mm"), **{f"skin.{key}": content["skin"].get(key) for key in SKIN}}
    same = {"tip_radius_mm": paper["tip_radius_mm"], **{f"skin.{key}": paper["skin"][key] for key in SKIN}}
    if different := [key for key, value in given.items() if value is not None and value != same[key]]:
        raise ParamsError(
            f"{file}: {', '.join(different)} differs from {PAPER}.yaml, but all simulated skins have the values of "
            f"that file. Remove these keys, or change {PAPER}.yaml."
        )
    design = {
        "chips_xy_mm": [[chip.x_mm, chip.y_mm] for chip in layout.chips],
        "chips_turn_deg": [chip.turn_deg for chip in layout.chips],
        "gap_mm": layout.gap_mm,
    }
    tiles = {} if layout.tiles is None else {"tiles": layout.tiles}
    return {"design": design | tiles, "skin_mm": list(layout.skin.size_mm)}


def with_geometry(kind: Any) -> Any:
    """Replace key `layout` in the settings of simulated boards by the geometry of the layout that it names."""
    if not isinstance(kind, Mapping) or "layout" not in kind:
        return kind
    of_layout = geometry(str(kind["layout"]))
    if twice := sorted(kind.keys() & of_layout.keys()):
        raise ParamsError(f"{', '.join(twice)} cannot be set together with layout. Change or remove one of them.")
    return {key: value for key, value in kind.items() if key != "layout"} | of_layout


def skin_design(material: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nominal skin: section `skin` of nominal.yaml, which describes its material, on the paper's board.

    Polarity, thickness, tip and magnetisation are those of the paper's layout. The magnetisation there is relative to
    that of the filler, so that the skin's saturation is the product of both.
    """
    layout = read_yaml(file_of(PAPER))
    skin = layout["skin"]
    return {
        **material,
        "saturation_T": material["saturation_T"] * skin["magnetisation"],
        "tip_radius_mm": layout["tip_radius_mm"],
        **{key: skin[key] for key in SKIN if key != "magnetisation"},
    }
