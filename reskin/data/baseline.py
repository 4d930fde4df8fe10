"""Baselines: no-load readings (readings without contact), which are subtracted from readings."""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int, Int64, Shaped

# The following three values were tuned on all passes of the recording of scene `eflesh`. This recording can therefore
# not be used to test them.
# Number of latest states with which `follow_free` compares a reading. Usually, five of them are contacts and five are
# not. A state consists of consecutive similar readings.
STATES_N = 10
# A state is classified as free of contact if it is similar to at least this number of the latest states. The state
# itself is counted.
SIMILAR_MIN_N = 4
# Two readings are similar if their distance is below this factor times the median distance between the no-load readings
# of successive indentations.
SIMILAR_FACTOR = 2.0


def subtract(b_uT: Float32[np.ndarray, "f ch"], noload_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
    """Return the field change relative to a no-load reading (paper section 4)."""
    return b_uT - noload_uT


def rank(label: Shaped[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Number the runs of equal labels, and return the number of its run for each row.

    A run consists of successive rows with the same label. Runs are numbered from 0. `label` is, for example, the
    indentation or the pass of each row of a capture, in order of time.
    """
    return np.cumsum(np.concatenate([[0], label[1:] != label[:-1]])).astype(np.int64)[: len(label)]


def free(
    b_uT: Float32[np.ndarray, "f ch"],
    noload_uT: Float32[np.ndarray, "f ch"],
    indentation: Int[np.ndarray, " f"],
    *,
    within_uT: float,
) -> Float32[np.ndarray, "f ch"]:
    """Return the baseline of each row: the latest earlier reading that `follow_free` classifies as free of contact.

    The first baseline is the first no-load reading. The readings are processed in the order in which a board sends
    them: for each indentation, first the no-load reading, then the rows in contact. `follow_free` treats two readings
    as similar if their distance is below `within_uT`.
    """
    rank_i = rank(indentation)
    is_first_row = np.concatenate([[True], rank_i[1:] != rank_i[:-1]])  # whether a row is the first of its indentation
    readings_uT: list[np.ndarray] = []
    for row_i in range(len(b_uT)):
        readings_uT += [noload_uT[row_i], b_uT[row_i]] if is_first_row[row_i] else [b_uT[row_i]]
    baselines_uT = list(follow_free(readings_uT, within_uT))
    reading_i = np.arange(len(b_uT)) + np.cumsum(is_first_row)  # index of each row in `readings_uT`
    return np.stack([baselines_uT[i - 1] for i in reading_i])


def follow_free(readings: Iterable[np.ndarray], within_uT: float) -> Iterator[Float[np.ndarray, " ch"]]:
    """Yield the current baseline after each reading.

    The baseline is the latest reading that was probably free of contact. This is inferred from the readings alone:
    different presses give different readings, but all readings without contact are similar. Consecutive similar
    readings, such as those of a press that is held, form one state, however long it lasts. A state is classified as
    free of contact if it is similar to at least `SIMILAR_MIN_N` of the latest `STATES_N` states. During a long contact,
    such as that of a sliding finger, the baseline does not change. The first reading must be free of contact.
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
    """Return the distance in uT below which `follow_free` treats two readings as similar.

    This is `SIMILAR_FACTOR` times the median distance between the no-load readings of successive indentations.
    """
    _, first_i = np.unique(rank(indentation), return_index=True)
    successive_uT = noload_uT[first_i].astype(np.float64)
    return SIMILAR_FACTOR * float(np.median([_distance_uT(a, b) for a, b in pairwise(successive_uT)]))


def _distance_uT(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of two readings, which is the root mean square of their difference over the channels."""
    return float(np.sqrt(np.mean((a - b) ** 2)))
