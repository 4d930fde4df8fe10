"""The poking protocol of the paper: a robot pokes the skin at the 65 points of a grid, at several depths.

All points are poked at one depth, then all points at the next depth, and so on. Places are in the coordinates of the
labels: x and y are from 0 to 16 mm, and the centre of the skin is at (8, 8) mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32

# The paper describes "a 9x9 grid (excluding 4 points per corner; a total of 65 indentations)". Its "16cm" must be a
# typing error for 16 mm.
SIDE_POINTS_N = 9
PITCH_MM = 2.0
BETWEEN_CORNERS = range(2, SIDE_POINTS_N - 2)  # indices of the rows and columns in which no point is excluded
CENTRE_MM = (SIDE_POINTS_N - 1) * PITCH_MM / 2
SKIN_MM = (20.0, 20.0)  # lengths of the sides of the paper's skin, from the CAD files of its authors


@dataclass(frozen=True)
class Protocol:
    """The pokes that a robot is commanded to make, in order of time. Each array has one element per indentation.

    `pass_i` is the number of the pass, in which all points are poked at all depths.
    """

    indentation: Int32[np.ndarray, " n"]
    pass_i: Int32[np.ndarray, " n"]
    x_mm: Float64[np.ndarray, " n"]
    y_mm: Float64[np.ndarray, " n"]
    depth_mm: Float64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.indentation)


def points_mm() -> Float64[np.ndarray, "65 2"]:
    """Return x and y of the grid points in mm, in the order in which they are poked.

    The points are ordered row by row. x increases in row 0, decreases in row 1, increases in row 2, and so on.
    """
    points = []
    for row_i in range(SIDE_POINTS_N):
        columns = range(SIDE_POINTS_N) if row_i in BETWEEN_CORNERS else BETWEEN_CORNERS
        points += [(column_i, row_i) for column_i in columns[:: -1 if row_i % 2 else 1]]
    return np.array(points) * PITCH_MM


def protocol(depths_mm: Sequence[float], passes_n: int) -> Protocol:
    """Return all pokes of the protocol in order of time.

    There are `passes_n` passes. In each pass, all points are poked at the first depth, then all points at the second
    depth, and so on.
    """
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
