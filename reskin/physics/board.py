"""The circuit board: its design, random boards, and the spreads between boards and between skins.

Each board is drawn with a random generator that is seeded by the board's name. Therefore, adding board 8 does not
change board 7.
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
    """Several boards under one skin, on a rectangular grid that is centred at the skin's centre."""

    columns_n: Annotated[int, Field(ge=1, le=CHIPS_MAX_N)]  # number of boards along x
    rows_n: Annotated[int, Field(ge=1, le=CHIPS_MAX_N)]  # number of boards along y
    pitch_mm: Annotated[float, Field(gt=0, le=500)]

    @property
    def centres_mm(self) -> list[tuple[float, float]]:
        """x and y of the centre of each board, relative to the skin's centre, row by row."""
        x_mm, y_mm = (self.pitch_mm * (np.arange(n) - (n - 1) / 2) for n in (self.columns_n, self.rows_n))
        return [(float(x), float(y)) for y in y_mm for x in x_mm]


class BoardDesign(Strict):
    """Positions of the chips relative to the centre of the board, and the rotation of each chip about z.

    The rotations in the scenes were determined from recordings (tests/recordings/test_lab_frames.py), because there is
    no board layout file. If `tiles` is set, several boards of this design are under one skin, and chips are numbered
    board by board.
    """

    chips_xy_mm: Annotated[tuple[tuple[float, float], ...], Field(min_length=1, max_length=CHIPS_MAX_N)]
    chips_turn_deg: tuple[float, ...]
    # distance from the chips' sensing plane to the skin, such as 1.1 mm for rigid boards and 0.6 mm for flexible boards
    gap_mm: Annotated[float, Field(gt=0, le=10)]
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
        """x and y of the chips of all boards, relative to the centre of the skin."""
        boards_mm = [(0.0, 0.0)] if self.tiles is None else self.tiles.centres_mm
        return [(x + chip_x, y + chip_y) for x, y in boards_mm for chip_x, chip_y in self.chips_xy_mm]

    @property
    def turns_deg(self) -> list[float]:
        """Rotation about z of each chip in `places_mm`."""
        return [*self.chips_turn_deg] * (len(self.places_mm) // len(self.chips_xy_mm))


class Spreads(Strict):
    """Standard deviations between boards and between skins.

    Positive quantities such as gaps, gains and thicknesses are multiplied by exp(sd * normal), so that they stay
    positive. All other quantities are normally distributed around the design value.
    """

    board_gap: Share  # relative sd of the gap between skin and chips
    board_uneven: Share  # relative sd of the gap at the outermost chips, due to tilt and bow of the base
    chip_gain: Share
    chip_cross_axis: Share
    chip_tilt_deg: Annotated[float, Field(ge=0, le=10)]
    chip_offset_uT: Annotated[float, Field(ge=0, le=5000)]
    skin_amplitude: Share  # relative sd of the magnetisation of whole skins
    skin_filler: Share  # relative sd of the local variation of the magnetisation
    # correlation of the local variation over a distance r: exp(-r^2 / 2 length^2)
    skin_filler_length_mm: Annotated[float, Field(gt=0, le=50)]
    skin_thickness: Share
    skin_modulus: Share
    skin_seat_mm: Annotated[float, Field(ge=0, le=2)]  # sd of the skin's lateral offset along each axis
    skin_rotation_deg: Annotated[float, Field(ge=0, le=10)]  # sd of the skin's rotation about z
    skin_depth_zero_mm: Annotated[float, Field(ge=0, le=0.2)]  # sd of (true depth - commanded depth)


@dataclass(frozen=True)
class Board:
    """One board, in a frame with z = 0 at the base of the skin. A chip reads sensitivity @ turn^T @ B + offset."""

    name: str
    chips_m: Float[np.ndarray, "k 3"]
    turn: Float[np.ndarray, "k 3 3"]  # the columns are the chip's axes in the board's frame
    sensitivity: Float[np.ndarray, "k 3 3"]
    offset_T: Float[np.ndarray, "k 3"]

    __repr__ = one_line


def draw_board(design: BoardDesign, spreads: Spreads, *, seed: int, name: str) -> Board:
    """Draw a board with a random generator that is seeded by `seed` and `name`.

    Tiled boards have the same gap, because they are assumed to be held down by the same skin.
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
    # Return the relative height error of each chip due to tilt and bow of the board, to be scaled by `board_uneven`.
    # The sum has three terms: tilt along x, tilt along y, and bow. At the outermost chips, each term is about a
    # standard normal number. The skin is assumed to be flat.
    places_mm = np.array(design.chips_xy_mm)
    away_mm = np.hypot(*places_mm.T)
    share = places_mm / max(away_mm.max(), 1e-12)
    uneven = np.column_stack([share, (share**2).sum(axis=1)]) @ rng.standard_normal(3)
    return np.tile(uneven, len(design.places_mm) // len(places_mm))
