"""The change of field: a reading less the no-load reading that belongs to it. Knows no capture and no model."""

import numpy as np
from jaxtyping import Float32


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Give the change of field against a no-load reading (paper section 4)."""
    return b_uT - noload_uT
