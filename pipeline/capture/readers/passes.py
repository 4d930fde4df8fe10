"""How often a robot went over the skin. In: the places it pressed, in order. Out: the pass each row belongs to.

The rule: a pass is the smallest shift at which 95 % of the moves from one place to the next meet the same two places
again, for at least a quarter of all moves. Refuses to know any grid: a protocol is found, never assumed.
"""

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

AGREEMENT_MIN = 0.95
SEEN_TWICE_MIN = 0.25  # a shift of half the recording leaves half the moves to compare, of which some touch nothing
PROBES_N = 256
PROBES_MIN_N = 8  # fewer say nothing
GOLDEN = (np.sqrt(5.0) - 1) / 2


def find_passes(place_mm: Float[np.ndarray, "f 2"], contact: Bool[np.ndarray, " f"]) -> Int32[np.ndarray, " f"]:
    """Number the passes; all rows are pass 0 if the places do not repeat. Places of rows without contact are ignored.

    The last pass may be incomplete.
    """
    rows_n = len(place_mm)
    moves = _find_moves(place_mm, contact)
    for period_n in _likely_periods(place_mm, contact, moves):
        here = moves[moves[:, 1] < rows_n - period_n]
        here = here[contact[here + period_n].all(axis=1)]
        if len(here) and len(here) >= SEEN_TWICE_MIN * len(moves):
            same = (place_mm[here] == place_mm[here + period_n]).all(axis=(1, 2))
            if same.mean() >= AGREEMENT_MIN:
                return (np.arange(rows_n) // period_n).astype(np.int32)
    return np.zeros(rows_n, np.int32)


def _likely_periods(
    place_mm: Float[np.ndarray, "f 2"], contact: Bool[np.ndarray, " f"], moves: Int64[np.ndarray, "moves 2"]
) -> Int64[np.ndarray, " p"]:
    """Leave out the shifts at which most of a few moves of the first half differ: trying all on all is quadratic."""
    half_n = len(contact) // 2
    early = moves[moves[:, 1] < half_n]
    if not len(early):
        return np.arange(1, half_n + 1) if len(moves) else np.zeros(0, np.int64)
    # Steps of the golden section lie evenly, and in step with no grid.
    probes = early[np.unique((np.arange(PROBES_N) * GOLDEN % 1 * len(early)).astype(np.int64))]
    tried_n, same_n = np.zeros((2, half_n), np.int64)
    for first, second in probes:
        shifts = slice(1, half_n + 1)
        touch = contact[first:][shifts] & contact[second : second + half_n + 1][shifts]
        same_first = (place_mm[first:][shifts] == place_mm[first]).all(axis=1)
        same_second = (place_mm[second : second + half_n + 1][shifts] == place_mm[second]).all(axis=1)
        tried_n += touch
        same_n += touch & same_first & same_second
    return np.flatnonzero((tried_n < PROBES_MIN_N) | (2 * same_n >= tried_n)) + 1


def _find_moves(place_mm: Float[np.ndarray, "f 2"], contact: Bool[np.ndarray, " f"]) -> Int64[np.ndarray, "moves 2"]:
    """Rows of the last contact at one place and of the first at the next: a shift within a dwell cannot match both."""
    rows = np.flatnonzero(contact)
    pairs = np.stack([rows[:-1], rows[1:]], axis=1)
    return pairs[(place_mm[pairs[:, 0]] != place_mm[pairs[:, 1]]).any(axis=1)]
