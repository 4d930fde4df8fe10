"""Where a skin is pressed: places in mm from its middle -> whether they lie on the paper's octagon, or just beyond.

Refuses to know any skin.
"""

import numpy as np
from jaxtyping import Bool, Float

MARGIN_MM = 0.4  # past the outermost place of the paper's grid
HALF_MM, CORNER_MM = 8.0, 12.0  # of that grid: |x| and |y|, |x| + |y|


def inside(place_mm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Tell which places lie on the octagon of the paper's grid, a margin around it."""
    x_mm, y_mm = np.abs(place_mm).T
    return (np.maximum(x_mm, y_mm) <= HALF_MM + MARGIN_MM) & (x_mm + y_mm <= CORNER_MM + 1.5 * MARGIN_MM)
