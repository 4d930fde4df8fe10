"""Baselines by policy: which no-load reading is subtracted from each reading (paper section 4)."""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int, Int64, Shaped

# These three were chosen on all passes of one recording (scene eflesh); only another recording can test them.
STATES_N = 10  # number of last states to compare with: five touches, and the free states between them
ALIKE_N = 4  # a state is free of contact if this many states, including itself, are alike
SAME = 2.0  # readings are alike within this multiple of the median distance between no-load readings of a calibration


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Return the field change relative to a no-load reading (paper section 4)."""
    return b_uT - noload_uT


def rank(label: Shaped[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Number runs of equal labels from 0: the indentations (or passes) of one capture in order of time."""
    return np.cumsum(np.concatenate([[0], label[1:] != label[:-1]])).astype(np.int64)[: len(label)]


def initial(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> Float32[np.ndarray, "f ch"]:
    """Use the no-load reading of the first indentation for all (paper section 4: "a single no-load measurement")."""
    return np.broadcast_to(noload_uT[:1], noload_uT.shape).copy()


def regular(
    noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"], *, regular_n: int
) -> Float32[np.ndarray, "f ch"]:
    """Use a new no-load reading every `regular_n` indentations ("at regular intervals")."""
    rank_i = rank(indentation)
    _, first_i = np.unique(rank_i, return_index=True)  # a row of each indentation
    return noload_uT[first_i[rank_i - rank_i % regular_n]]


def each(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> Float32[np.ndarray, "f ch"]:
    """Use the no-load reading before each contact."""
    return noload_uT


def free(
    b_uT: Float32[np.ndarray, "f ch"],
    noload_uT: Float32[np.ndarray, "f ch"],
    indentation: Int[np.ndarray, " f"],
    *,
    within_uT: float,
) -> Float32[np.ndarray, "f ch"]:
    """Use the first no-load reading, then the last reading that `follow_free` detects as free of contact.

    The order of the readings is that of a board: for each indentation, its no-load reading, then its rows.
    """
    rank_i = rank(indentation)
    begins = np.concatenate([[True], rank_i[1:] != rank_i[:-1]])
    order = [
        part for row_i in range(len(b_uT)) for part in ([noload_uT[row_i]] if begins[row_i] else []) + [b_uT[row_i]]
    ]
    zeros = list(follow_free(order, within_uT))
    sent_i = np.arange(len(b_uT)) + np.cumsum(begins)  # index of each row in `order`
    return np.stack([zeros[i - 1] for i in sent_i])


def follow_free(readings: Iterable[np.ndarray], within_uT: float) -> Iterator[Float[np.ndarray, " ch"]]:
    """Yield the baseline after each reading, detected from the fields alone; the first reading is free of contact.

    Consecutive readings that are alike form one state, however long it lasts, such as a press that is held. A state
    that resembles enough of the last states is free of contact, because presses differ from each other. During a
    contact that does not end, such as a sliding finger, the baseline stays the same.
    """
    states: deque[np.ndarray] = deque(maxlen=STATES_N)
    zero: np.ndarray | None = None
    for reading in readings:
        if states and _distance_uT(states[-1], reading) < within_uT:
            states[-1] = reading
        else:
            states.append(reading)
        alike_n = sum(_distance_uT(state, reading) < within_uT for state in states)
        if zero is None or alike_n >= ALIKE_N:
            zero = reading
        yield zero


def alike_within_uT(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> float:
    """Return the distance within which readings are alike: `SAME` times the median between consecutive ones at rest."""
    _, first_i = np.unique(rank(indentation), return_index=True)
    rest_uT = noload_uT[first_i].astype(np.float64)
    return SAME * float(np.median([_distance_uT(a, b) for a, b in pairwise(rest_uT)]))


def _distance_uT(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))
