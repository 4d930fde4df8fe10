"""The paper's poking protocol: a grid of 65 points, poked at one depth after the other, in several passes.

Places are in the coordinate frame of the labels: 0 to 16 mm, with the centre of the skin at (8, 8) mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

# "a 9x9 grid (excluding 4 points per corner; a total of 65 indentations)"; the paper's "16cm" is a typo for 16 mm.
SIDE_POINTS_N = 9
PITCH_MM = 2.0
BETWEEN_CORNERS = range(2, SIDE_POINTS_N - 2)  # indices of the rows and columns that cross no excluded corner
CENTRE_MM = (SIDE_POINTS_N - 1) * PITCH_MM / 2
SKIN_MM = (20.0, 20.0)  # sides of the paper's skin, from the authors' CAD


@dataclass(frozen=True)
class Protocol:
    """Commanded pokes in order of time, one array element per indentation."""

    indentation: Int32[np.ndarray, " n"]
    pass_i: Int32[np.ndarray, " n"]
    x_mm: Float64[np.ndarray, " n"]
    y_mm: Float64[np.ndarray, " n"]
    depth_mm: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.indentation)


def points_mm() -> Float64[np.ndarray, "65 2"]:
    """Return (x, y) of the grid points in snake order: row by row, every second row with decreasing x."""
    points = []
    for row_i in range(SIDE_POINTS_N):
        row = range(SIDE_POINTS_N)[:: -1 if row_i % 2 else 1]
        points += [(column_i, row_i) for column_i in row if column_i in BETWEEN_CORNERS or row_i in BETWEEN_CORNERS]
    return np.array(points) * PITCH_MM


def protocol(depths_mm: Sequence[float], passes_n: int) -> Protocol:
    """Return the pokes of the paper's protocol: in each pass, every point at the first depth, then at the next, ..."""
    xy_mm = points_mm()
    points_n, depths_n = len(xy_mm), len(depths_mm)
    pokes_n = points_n * depths_n
    return Protocol(
        indentation=np.arange(passes_n * pokes_n, dtype=np.int32),
        pass_i=np.repeat(np.arange(passes_n, dtype=np.int32), pokes_n),
        x_mm=np.tile(xy_mm[:, 0], passes_n * depths_n),
        y_mm=np.tile(xy_mm[:, 1], passes_n * depths_n),
        depth_mm=np.tile(np.repeat(np.array(depths_mm, dtype=np.float64), points_n), passes_n),
    )
