"""Baselines: no-load readings (readings without contact), which are subtracted from readings."""

import numpy as np
from jaxtyping import Float32, Int64, Shaped


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Return the field change relative to a no-load reading (paper section 4)."""
    return b_uT - noload_uT


def rank(label: Shaped[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Number the runs of equal labels, and return the number of its run for each row.

    A run consists of successive rows with the same label. Runs are numbered from 0. `label` is, for example, the
    indentation or the pass of each row of a capture, in order of time.
    """
    return np.cumsum(np.concatenate([[0], label[1:] != label[:-1]])).astype(np.int64)[: len(label)]
