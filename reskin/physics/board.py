"""The circuit board under a skin: its design, and boards that are drawn at random from the design.

The module also contains the spreads, which are the standard deviations between boards and between skins. The random
generator of each board is seeded by the name of the board. If a simulation is extended by one board, the other boards
therefore stay the same.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator
from scipy.constants import micro, milli
from scipy.spatial.transform import Rotation

from reskin.config import Strict
from reskin.display import one_line
from reskin.seeds import rng_for

CHIPS_MAX_N = 64
Share = Annotated[float, Field(ge=0, le=0.5)]


class Tiles(Strict):
    """Settings of several boards that lie side by side under one large skin.

    The boards form a rectangular grid, whose centre is at the centre of the skin.
    """

    columns_n: Annotated[int, Field(ge=1, le=CHIPS_MAX_N)]  # number of boards along x
    rows_n: Annotated[int, Field(ge=1, le=CHIPS_MAX_N)]  # number of boards along y
    pitch_mm: Annotated[float, Field(gt=0, le=500)]  # distance between the centres of adjacent boards

    @property
    def centres_mm(self) -> list[tuple[float, float]]:
        """x and y of the centre of each board, relative to the skin's centre; the boards are listed row by row."""
        x_mm, y_mm = (self.pitch_mm * (np.arange(n) - (n - 1) / 2) for n in (self.columns_n, self.rows_n))
        return [(float(x), float(y)) for y in y_mm for x in x_mm]


class BoardDesign(Strict):
    """Settings of the design of a board: the places and the rotations of its chips, and its distance from the skin.

    The authors of the paper did not publish a file with the layout of their board. The rotations of the chips in the
    scenes were therefore determined from recordings (tests/recordings/test_lab_frames.py).
    """

    # places of the chips, relative to the centre of the board
    chips_xy_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1, max_length=CHIPS_MAX_N)]
    chips_turn_deg: tuple[float, ...]  # rotation of each chip about z
    # distance from the chips' sensing plane to the skin
    gap_mm: Annotated[float, Field(gt=0, le=10)]
    # If set, several boards of this design are under one skin, and the chips are numbered board by board.
    tiles: Tiles | None = None

    @model_validator(mode="after")
    def _check_chips(self) -> "BoardDesign":
        if len(self.chips_xy_mm) != len(self.chips_turn_deg):
            raise ValueError("chips_turn_deg must have one rotation for each chip in chips_xy_mm")
        if len(self.places_mm) > CHIPS_MAX_N:
            raise ValueError(f"tiles must have at most {CHIPS_MAX_N} chips in total, not {len(self.places_mm)}")
        return self

    @property
    def places_mm(self) -> list[tuple[float, float]]:
        """x and y of each chip of all boards under the skin, relative to the centre of the skin."""
        boards_mm = [(0.0, 0.0)] if self.tiles is None else self.tiles.centres_mm
        return [(x + chip_x, y + chip_y) for x, y in boards_mm for chip_x, chip_y in self.chips_xy_mm]

    @property
    def turns_deg(self) -> list[float]:
        """Rotation about z of each chip, in the same order as `places_mm`."""
        return [*self.chips_turn_deg] * (len(self.places_mm) // len(self.chips_xy_mm))


class Spreads(Strict):
    """Settings of the spreads: the standard deviations of properties between boards and between skins.

    A property that must be positive, such as a gap, a gain or a thickness, is the design value times
    exp(sd * normal), where sd is the standard deviation and `normal` is a standard normal number. Every other property
    is normally distributed around its design value.
    """

    board_gap: Share  # relative sd of the gap between skin and chips
    # relative sd of the gap at the outermost chips, because the board is tilted and bent
    board_uneven: Share
    chip_gain: Share  # relative sd of the sensitivity of each axis of a chip
    chip_cross_axis: Share  # sd of the sensitivity of an axis of a chip to the field along another axis
    chip_tilt_deg: Annotated[float, Field(ge=0, le=10)]  # sd of the rotation of a chip about each axis in its plane
    chip_offset_uT: Annotated[float, Field(ge=0, le=5000)]  # sd of the reading of a chip without a field
    skin_amplitude: Share  # relative sd of the magnetisation of whole skins
    skin_filler: Share  # relative sd of the local variation of the magnetisation
    # Length in the correlation of the local variation at two places: the correlation at the distance r is
    # exp(-r^2 / 2 length^2).
    skin_filler_length_mm: Annotated[float, Field(gt=0, le=50)]
    skin_thickness: Share  # relative sd of the thickness
    skin_modulus: Share  # relative sd of Young's modulus
    skin_seat_mm: Annotated[float, Field(ge=0, le=2)]  # sd of the skin's lateral offset along each axis
    skin_rotation_deg: Annotated[float, Field(ge=0, le=10)]  # sd of the skin's rotation about z
    skin_give_um: Annotated[float, Field(ge=0, le=100)]  # sd of `give_um` of the skin's `hold` along each axis
    skin_away_um_mm: Annotated[float, Field(ge=0, le=50)]  # sd of `away_um_mm` of the skin's `hold`
    skin_depth_zero_mm: Annotated[float, Field(ge=0, le=0.2)]  # sd of (true depth - commanded depth)


@dataclass(frozen=True)
class Board:
    """One board with k chips.

    In the coordinate system of the board, z = 0 is the base of the skin. In the field B, a chip without noise reads
    sensitivity @ turn^T @ B + offset.
    """

    name: str
    chips_m: Float[np.ndarray, "k 3"]  # positions of the chips
    turn: Float[np.ndarray, "k 3 3"]  # rotation matrices, whose columns are the chip's axes in the board's frame
    sensitivity: Float[np.ndarray, "k 3 3"]  # the diagonal has the gains, and the other entries are cross-axis terms
    offset_T: Float[np.ndarray, "k 3"]

    __repr__ = one_line


def draw_board(design: BoardDesign, spreads: Spreads, *, seed: int, name: str) -> Board:
    """Draw a board at random, with a generator that is seeded by `seed` and `name`.

    If the design has `tiles`, one gap between chips and skin is drawn for all boards under the skin, because the same
    skin is assumed to hold all of them down.
    """
    rng = rng_for(seed, "board", name)
    chips_n = len(design.places_mm)
    gap_mm = design.gap_mm * np.exp(spreads.board_gap * rng.standard_normal())
    tilt_deg = spreads.chip_tilt_deg * rng.standard_normal((chips_n, 2))
    turn = Rotation.from_euler("ZYX", np.column_stack([design.turns_deg, tilt_deg]), degrees=True)
    gain = np.exp(spreads.chip_gain * rng.standard_normal((chips_n, 3)))
    cross = spreads.chip_cross_axis * rng.standard_normal((chips_n, 3, 3))
    offset_T = spreads.chip_offset_uT * micro * rng.standard_normal((chips_n, 3))
    gaps_mm = gap_mm * np.exp(spreads.board_uneven * _unevenness(design, rng))
    return Board(
        name=name,
        chips_m=np.column_stack([np.array(design.places_mm), -gaps_mm]) * milli,
        turn=turn.as_matrix(),
        sensitivity=np.where(np.eye(3, dtype=bool), gain[:, :, None], cross),
        offset_T=offset_T,
    )


def _unevenness(design: BoardDesign, rng: np.random.Generator) -> Float[np.ndarray, " k"]:
    # Return how the gap differs from chip to chip, because the board is tilted and bent while the skin is assumed to be
    # flat. Multiplied by `board_uneven`, the result is the logarithm of the ratio between the gap of a chip and the gap
    # of the board. The result is the sum of three terms: the tilt along x, the tilt along y, and the bow, which grows
    # with the square of the distance from the centre. At the outermost chips, each term is about a standard normal
    # number.
    places_mm = np.array(design.chips_xy_mm)
    away_mm = np.hypot(*places_mm.T)
    share = places_mm / max(away_mm.max(), 1e-12)
    uneven = np.column_stack([share, (share**2).sum(axis=1)]) @ rng.standard_normal(3)
    return np.tile(uneven, len(design.places_mm) // len(places_mm))
