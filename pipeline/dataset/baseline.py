"""No-load policies: which no-load reading is subtracted from a reading. In: `Readings`. Out: noload_uT of each row.

A capture holds the no-load field of every indentation (`immediate`); the other policies say what would have been
known with fewer. Refuses to know what is learned from the difference.
"""

import numpy as np
from jaxtyping import Float32

from pipeline.schema import Readings


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Give the change of field against a no-load reading."""
    return b_uT - noload_uT


def immediate(readings: Readings) -> Float32[np.ndarray, "f ch"]:
    """Give the no-load reading taken just before each contact."""
    return readings.noload_uT


def initial(readings: Readings) -> Float32[np.ndarray, "f ch"]:
    """Give every row the no-load reading of the capture's first indentation."""
    first = readings.noload_uT[readings.indentation.argmin()]
    return np.broadcast_to(first, readings.noload_uT.shape).copy()


def every(readings: Readings, k: int) -> Float32[np.ndarray, "f ch"]:
    """Give every row the last no-load reading, if one is taken at each k-th indentation only (0, k, 2 k, ...)."""
    assert k >= 1, "k is checked where it is read"
    _, row_i, order_i = np.unique(readings.indentation, return_index=True, return_inverse=True)
    return readings.noload_uT[row_i[order_i // k * k]]
