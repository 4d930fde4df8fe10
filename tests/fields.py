"""Fields of a made-up skin with five chips, for tests that need no physics."""

import numpy as np

CHIPS_MM = np.array([[0.0, 0.0], [-7.0, 0.0], [0.0, -7.0], [7.0, 0.0], [0.0, 7.0]])
WIDE_MM = 5.0


def fields_uT(place_mm: np.ndarray, force_N: np.ndarray) -> np.ndarray:
    """Return field changes in 15 channels, which are largest near each chip; x and y point away from the chip."""
    offset = (place_mm[:, None] - CHIPS_MM) / WIDE_MM
    size = 400 * force_N[:, None] ** 0.7 * np.exp(-(offset**2).sum(axis=2) / 2)
    return np.stack([size * offset[..., 0], size * offset[..., 1], size], axis=2).reshape(len(place_mm), -1)
