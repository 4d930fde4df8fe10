"""Baseline policies: rules that choose the no-load reading to subtract from each reading (paper section 4)."""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int, Int64, Shaped

# These three values were tuned on all passes of one recording (scene `eflesh`), so that recording cannot test them.
STATES_N = 10  # a reading is compared with this many latest states: five contacts and the free states between them
SIMILAR_MIN_N = 4  # a state is free of contact if it is similar to this many of the states, including itself
# Readings are similar if their distance is below this multiple of the median distance of successive no-load readings.
SIMILAR_FACTOR = 2.0


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Return the field change relative to a no-load reading (paper section 4)."""
    return b_uT - noload_uT


def rank(label: Shaped[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Number the runs of equal labels from 0, such as the indentations or passes of a capture in order of time."""
    return np.cumsum(np.concatenate([[0], label[1:] != label[:-1]])).astype(np.int64)[: len(label)]


def initial(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> Float32[np.ndarray, "f ch"]:
    """Use the first no-load reading for all rows (paper section 4: "a single no-load measurement")."""
    return np.broadcast_to(noload_uT[:1], noload_uT.shape).copy()


def regular(
    noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"], *, regular_n: int
) -> Float32[np.ndarray, "f ch"]:
    """Use a new no-load reading every `regular_n` indentations ("at regular intervals")."""
    rank_i = rank(indentation)
    _, first_i = np.unique(rank_i, return_index=True)  # the first row of each indentation
    return noload_uT[first_i[rank_i - rank_i % regular_n]]


def each(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> Float32[np.ndarray, "f ch"]:
    """Use the no-load reading that was taken before each contact."""
    return noload_uT


def free(
    b_uT: Float32[np.ndarray, "f ch"],
    noload_uT: Float32[np.ndarray, "f ch"],
    indentation: Int[np.ndarray, " f"],
    *,
    within_uT: float,
) -> Float32[np.ndarray, "f ch"]:
    """Use the latest reading that `follow_free` classifies as free of contact; at first, the first no-load reading.

    The readings are processed in the order in which a board sends them: for each indentation, its no-load reading, then
    its rows.
    """
    rank_i = rank(indentation)
    begins = np.concatenate([[True], rank_i[1:] != rank_i[:-1]])
    order = [
        part for row_i in range(len(b_uT)) for part in ([noload_uT[row_i]] if begins[row_i] else []) + [b_uT[row_i]]
    ]
    baselines_uT = list(follow_free(order, within_uT))
    order_i = np.arange(len(b_uT)) + np.cumsum(begins)  # index of each row in `order`
    return np.stack([baselines_uT[i - 1] for i in order_i])


def follow_free(readings: Iterable[np.ndarray], within_uT: float) -> Iterator[Float[np.ndarray, " ch"]]:
    """Yield the baseline after each reading, using only the readings; the first one must be free of contact.

    Consecutive similar readings, such as those of a held press, form one state, however long it lasts. A state is
    classified as free of contact if it is similar to enough of the latest states, because presses differ from each
    other. During a long contact, such as that of a sliding finger, the baseline does not change.
    """
    states: deque[np.ndarray] = deque(maxlen=STATES_N)
    baseline_uT: np.ndarray | None = None
    for reading in readings:
        if states and _distance_uT(states[-1], reading) < within_uT:
            states[-1] = reading
        else:
            states.append(reading)
        similar_n = sum(_distance_uT(state, reading) < within_uT for state in states)
        if baseline_uT is None or similar_n >= SIMILAR_MIN_N:
            baseline_uT = reading
        yield baseline_uT


def alike_within_uT(noload_uT: Float32[np.ndarray, "f ch"], indentation: Int[np.ndarray, " f"]) -> float:
    """Return the distance below which readings are similar.

    This is `SIMILAR_FACTOR` times the median distance between the no-load readings of successive indentations.
    """
    _, first_i = np.unique(rank(indentation), return_index=True)
    successive_uT = noload_uT[first_i].astype(np.float64)
    return SIMILAR_FACTOR * float(np.median([_distance_uT(a, b) for a, b in pairwise(successive_uT)]))


def _distance_uT(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))
