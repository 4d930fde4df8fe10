"""The change of field: a reading less a no-load reading, and policies of which one. In: fields, in order of time.

Knows no capture and no model.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int, Int64, Shaped

# These three were chosen on one recording (scene eflesh), with all its passes in view: another one tests them.
STATES_N = 10  # of the skin's last states, free and touched in turn: five touches
ALIKE_N = 4  # that a state has to resemble, itself included, to be taken as free
SAME = 2.0  # medians of how far no-load readings of a calibration lie apart, within which two readings are alike


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


def free(
    b_uT: Float32[np.ndarray, "f ch"],
    noload_uT: Float32[np.ndarray, "f ch"],
    indentation: Int[np.ndarray, " f"],
    *,
    within_uT: float,
) -> Float32[np.ndarray, "f ch"]:
    """Take the first no-load reading, then whatever `follow_free` judges free of contact; nobody says when that was.

    What a board sends is, for each indentation, its no-load reading and then its rows.
    """
    rank_i = rank(indentation)
    begins = np.concatenate([[True], rank_i[1:] != rank_i[:-1]])
    order = [
        part for row_i in range(len(b_uT)) for part in ([noload_uT[row_i]] if begins[row_i] else []) + [b_uT[row_i]]
    ]
    zeros = list(follow_free(order, within_uT))
    ahead = np.arange(len(b_uT)) + np.cumsum(begins)  # its place among what was sent: a row is judged after it answered
    return np.stack([zeros[place - 1] for place in ahead])


def follow_free(readings: Iterable[np.ndarray], within_uT: float) -> Iterator[Float[np.ndarray, " ch"]]:
    """Give after each reading the no-load reading in force, from fields alone, the first being one.

    Readings that are alike in turn are one state, however long it lasts: a press that is held is one. A state that
    resembles enough of the last ones is free of contact, for presses differ from each other. What never lets go, as a
    finger that slides on, leaves the old reading in force.
    """
    states: deque[np.ndarray] = deque(maxlen=STATES_N)
    zero: np.ndarray | None = None
    for reading in readings:
        if states and _apart_uT(states[-1], reading) < within_uT:
            states[-1] = reading
        else:
            states.append(reading)
        alike_n = sum(_apart_uT(state, reading) < within_uT for state in states)
        if zero is None or alike_n >= ALIKE_N:
            zero = reading
        yield zero


def alike_within_uT(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> float:
    """Give how near two readings of an untouched skin lie: `SAME` medians of a calibration's, from touch to touch."""
    _, first_i = np.unique(rank(indentation), return_index=True)
    rest_uT = noload_uT[first_i].astype(np.float64)
    return SAME * float(np.median([_apart_uT(a, b) for a, b in pairwise(rest_uT)]))


def _apart_uT(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))
