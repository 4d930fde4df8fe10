"""The layout of a board for which a universal model is made: its chips, its skin, the tip and the area of presses.

A user writes a layout as a YAML file. The file `reskin/layouts/reskin.yaml` is an example, which explains each key.
"""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from reskin.config import Strict, parse, read_yaml
from reskin.errors import did_you_mean
from reskin.layouts import PAPER, ChipPlace, Coordinate, file_of
from reskin.physics import slide
from reskin.physics.board import CHIPS_MAX_N
from reskin.physics.magnet import Polarity, Quadrature
from reskin.physics.skin import SkinDesign
from reskin.simulation.defaults import NOMINAL as NOMINAL_FILE
from reskin.simulation.defaults import filler
from reskin.universal.law import COARSE, RULE, Area, Law, Length, Setup
from reskin.universal.population import NOMINAL, NOMINAL_SPREADS, THICKNESSES, TIPS, Forces

CHIPS_APART_MM = 0.5  # smallest distance between the centres of two chips, which is less than the width of a chip
EDGE_MM = 0.5  # smallest distance from the area of presses to the edge of the skin
# Side of the paper's skin. For larger skins, the cells of the quadrature rule are larger in proportion.
SIDE_MM = 20.0


class SkinStack(Strict):
    """The nominal skin of a board. The model is trained on skins that differ from it at random."""

    size_mm: tuple[Length, Length]
    thickness_mm: Annotated[float, Field(gt=0, le=20)]
    polarity: Polarity
    flipped: bool  # whether the polarity of all magnets is reversed
    # Magnetisation relative to that of the filler in nominal.yaml, which has a saturation of 0.123 T.
    magnetisation: Annotated[float, Field(gt=0, le=100)]
    modulus_MPa: Annotated[float, Field(gt=0, le=100)]


class BoardLayout(Strict):
    """Everything about a board and its skin that the universal model must know before training."""

    name: Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    chips: Annotated[tuple[ChipPlace, ...], Field(min_length=1, max_length=CHIPS_MAX_N)]
    centre_mm: tuple[Coordinate, Coordinate]  # the board's centre in the coordinates of labels and estimates
    gap_mm: Annotated[float, Field(ge=0.8, le=20)]  # distance from the sensing plane of the chips to the skin
    skin: SkinStack
    tip_radius_mm: Annotated[float, Field(gt=0, le=50)]
    area: Area
    # Smallest and largest force.
    force_N: tuple[Annotated[float, Field(gt=0, le=1000)], Annotated[float, Field(gt=0, le=1000)]]
    # Standard deviations of some parameters of the law (`reskin.universal.law`) over skins. For all other parameters,
    # the values in `population.NOMINAL_SPREADS` are used.
    spreads: dict[str, Annotated[float, Field(gt=0, le=100)]]

    @model_validator(mode="after")
    def _check(self) -> "BoardLayout":
        places = [(chip.x_mm, chip.y_mm) for chip in self.chips]
        for i, place in enumerate(places):
            if place in places[:i]:
                raise ValueError(f"chips {places.index(place)} and {i} are at the same place {place} mm")
        apart_mm = [math.dist(place, other) for i, place in enumerate(places) for other in places[:i]]
        if min(apart_mm, default=CHIPS_APART_MM) < CHIPS_APART_MM:
            raise ValueError(
                f"two chips are {min(apart_mm):g} mm apart, but the smallest distance is {CHIPS_APART_MM:g} mm. State "
                "the positions of the chips in mm"
            )
        for axis, half_mm, side_mm in zip("xy", self.half_mm, self.skin.size_mm, strict=True):
            if half_mm + EDGE_MM > side_mm / 2:
                problem = f"area.half_{axis}_mm is {half_mm:g}, but half the skin's size is {side_mm / 2:g}"
                raise ValueError(f"{problem}; the area must end {EDGE_MM:g} mm or more before the edge of the skin")
        deepest_mm = slide.DEEPEST * max(THICKNESSES) * self.skin.thickness_mm
        least_mm = deepest_mm / min(TIPS)
        if self.tip_radius_mm <= least_mm:
            problem = f"tip_radius_mm is {self.tip_radius_mm:g}, but must be above {least_mm:.3g}"
            raise ValueError(
                f"{problem} for a skin with a thickness of {self.skin.thickness_mm:g} mm: use a larger tip or a "
                "thinner skin"
            )
        if not 2 * self.force_N[0] <= self.force_N[1]:
            raise ValueError(
                f"force_N is {list(self.force_N)}; the second value (the largest force) must be at least twice the "
                "first (the smallest force)"
            )
        for name in self.spreads:
            if name not in NOMINAL_SPREADS:
                known = ", ".join(NOMINAL_SPREADS)
                guess = did_you_mean(name, NOMINAL_SPREADS)
                raise ValueError(f"spreads: {name} is not a parameter of the law ({known}).{guess}")
        return self

    @property
    def channels_n(self) -> int:
        """Number of values in one reading, which has three values per chip."""
        return 3 * len(self.chips)

    @property
    def half_mm(self) -> tuple[float, float]:
        """Largest |x| and |y| of presses, relative to the board's centre."""
        return self.area.half_x_mm, self.area.half_y_mm

    @property
    def chips_mm(self) -> Float[np.ndarray, "k 2"]:
        """Positions of the chips relative to the board's centre."""
        return np.array([(chip.x_mm, chip.y_mm) for chip in self.chips])

    @property
    def turns_deg(self) -> tuple[float, ...]:
        """Rotation of each chip about z in degrees."""
        return tuple(float(chip.turn_deg) for chip in self.chips)

    @property
    def reach_mm(self) -> Float[np.ndarray, "2 2"]:
        """The edges of the skin relative to the board's centre.

        The first row contains the smallest x and y, the second row the largest x and y.
        """
        return np.array([[-0.5], [0.5]]) * self.skin.size_mm

    @property
    def forces(self) -> Forces:
        """Distribution of the forces of presses in training.

        A fifth of the presses are light: their force is at most ten times the smallest force.
        """
        least_N, largest_N = self.force_N
        between_N = min(10 * least_N, (least_N * largest_N) ** 0.5)
        return Forces(between_N, largest_N / 0.95, light_N=least_N, light_share=0.2)

    @property
    def law(self) -> Law:
        """The central law, around which the skins for training are drawn.

        This is the nominal law with the gap, the magnetisation and the modulus of this layout.
        """
        skin = self.skin
        return replace(NOMINAL, gap_mm=self.gap_mm, amplitude=skin.magnetisation, modulus_MPa=skin.modulus_MPa)

    @property
    def all_spreads(self) -> dict[str, float]:
        """Standard deviations of all parameters of the law over skins."""
        return NOMINAL_SPREADS | self.spreads

    def setup(self) -> Setup:
        """Return the setup for simulations of the nominal skin on this board."""
        skin = self.skin.model_dump(include={"thickness_mm", "polarity", "flipped"})
        changes = skin | {"tip_radius_mm": self.tip_radius_mm}
        design = parse(SkinDesign, filler() | changes, f"{NOMINAL_FILE}: skin")
        factor = max(1.0, max(self.skin.size_mm) / SIDE_MM)
        rule, coarse = (Quadrature(each.cell_m * factor, each.layers_n) for each in (RULE, COARSE))
        return Setup(
            design, self.chips_mm, self.skin.size_mm, self.skin.flipped, self.tip_radius_mm, rule, coarse, self.area
        )

    def to_board(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
        """Convert readings along the chips' axes to readings along the board's axes."""
        return b_uT @ _board_from_chips(self.turns_deg)

    def to_chips(self, b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f ch"]:
        """Convert readings along the board's axes to readings along the chips' axes."""
        return b_uT @ _board_from_chips(self.turns_deg).T


@cache
def _board_from_chips(turns_deg: tuple[float, ...]) -> Float[np.ndarray, "ch ch"]:
    of_chips = Rotation.from_euler("z", np.array(turns_deg)[:, None], degrees=True).as_matrix()
    return np.array(block_diag(*of_chips)).T


def read_layout(file: Path | str) -> BoardLayout:
    """Read a layout from a YAML file.

    `file` can also be the name of a layout that comes with the project: reskin, anyskin or eflesh.

    Raises
    ------
    ParamsError : the file is missing or is not YAML, or one of its keys is missing, is unknown or has a wrong value
    """
    path = Path(file)
    if path.suffix not in (".yaml", ".yml"):
        path = file_of(str(file))
    return as_layout(read_yaml(path), str(path))


def as_layout(value: Any, where: str) -> BoardLayout:
    """Create a layout from the content of a YAML or JSON file.

    Raises ParamsError if the content is invalid. `where` is the beginning of its message.
    """
    return parse(BoardLayout, value, where)


@cache
def paper_layout() -> BoardLayout:
    """Return the layout of the paper's board."""
    return read_layout(PAPER)
