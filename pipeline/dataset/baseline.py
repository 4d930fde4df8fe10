"""The change of field: a reading less a no-load reading, and policies of which one. In: fields, in order of time.

Knows no capture and no model.
"""

import numpy as np
from jaxtyping import Float32, Int, Int64, Shaped


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Give the change of field against a no-load reading (paper section 4)."""
    return b_uT - noload_uT


def rank(label: Shaped[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Number runs of equal labels from 0: the indentations (or passes) of one capture in order of time."""
    return np.cumsum(np.concatenate([[0], label[1:] != label[:-1]])).astype(np.int64)[: len(label)]


def initial(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> Float32[np.ndarray, "f ch"]:
    """Take the no-load reading of the first indentation for all (paper section 4: "a single no-load measurement")."""
    return np.broadcast_to(noload_uT[:1], noload_uT.shape).copy()


def regular(
    noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"], *, regular_n: int
) -> Float32[np.ndarray, "f ch"]:
    """Take the last no-load reading at a rank that is a multiple of `regular_n` ("at regular intervals")."""
    rank_i = rank(indentation)
    _, first_i = np.unique(rank_i, return_index=True)  # a row of each indentation
    return noload_uT[first_i[rank_i - rank_i % regular_n]]


def each(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> Float32[np.ndarray, "f ch"]:
    """Take the no-load reading before each contact, as it was read."""
    return noload_uT
