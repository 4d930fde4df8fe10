"""Align files row by row: find changes of the lag within a recording, and number the passes over the skin."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64

LAGS = np.arange(-2, 6)  # possible lags of the fields behind their labels, in rows
ROWS_MIN_N = 300  # in a shorter recording, a change cannot be detected
BLOCK_ROWS_N = 500  # length of the blocks over which the field's slow drift is removed
ROUNDS_N = 4
OUTLIER = 4.0  # distances are clipped to this multiple of the median distance
# A change is reported if it explains as much as this many misaligned rows. In the two public recordings and in windows
# of them, the largest value without a change is 12; a row lost 100 rows before the end gives 40 or more.
EVIDENCE_ROWS_MIN_N = 30
# Minimum mean cost of a misaligned row, divided by the standard deviation of this cost. Noise alone reaches 0.17 in 300
# rows.
CONTRAST_MIN = 0.3


class Change(NamedTuple):
    """Fields lag by `before` rows in the label rows above `row` (counted from 0), and by `after` rows from it on."""

    row: int
    before: int
    after: int


def find_change(
    b_uT: Float64[np.ndarray, "f ch"], label: Float64[np.ndarray, "f 3"], contact: Bool[np.ndarray, " f"],
    sound: Bool[np.ndarray, " f"],
) -> Change | None:  # fmt: skip
    """Return where the lag changes; None if a single lag explains the rows as well.

    For each place, a line of field against force is fitted to all rows, as they are aligned so far. Then the rows are
    split into two parts with different lags such that the fields are nearest to these lines, and the lines are
    fitted again. `label` is x and y in mm and force in N; rows that are not `sound` are ignored.
    """
    if len(label) < ROWS_MIN_N or not contact.any():
        return None
    field_uT, force_N = _without_drift(b_uT), label[:, 2]
    place = np.unique(np.where(contact[:, None], label[:, :2], np.inf), axis=0, return_inverse=True)[1].ravel()
    row, lag = np.arange(len(label)), _best_lag(field_uT, sound, force_N, place)
    for _ in range(ROUNDS_N):
        distance = _distances(field_uT, sound, _fit_lines(field_uT, sound, force_N, place, lag))
        before_i, after_i, change_row = _split(distance)
        lag = np.where(row < change_row, LAGS[before_i], LAGS[after_i])
    gain = distance.sum(axis=1).min() - distance[before_i, :change_row].sum() - distance[after_i, change_row:].sum()
    extra_cost = distance[after_i] - distance[before_i]
    # Mean cost of giving a row the lag of the other part.
    misaligned = float(np.where(row < change_row, extra_cost, -extra_cost).mean())
    if misaligned <= CONTRAST_MIN * extra_cost.std() or gain < EVIDENCE_ROWS_MIN_N * misaligned:
        return None
    return Change(change_row, int(LAGS[before_i]), int(LAGS[after_i]))


def _without_drift(b_uT: Float64[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f ch"]:
    blocks = np.array_split(b_uT, max(1, len(b_uT) // BLOCK_ROWS_N))
    return np.concatenate([block - np.median(block, axis=0) for block in blocks])


def _best_lag(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], force_N: Float64[np.ndarray, " f"],
    place: Int64[np.ndarray, " f"],
) -> Int64[np.ndarray, " f"]:  # fmt: skip
    """Return for every row the single lag with which the lines fit best."""
    costs = []
    for lag_i, lag in enumerate(LAGS):
        lags = np.full(len(place), lag)
        costs.append(_distances(field_uT, sound, _fit_lines(field_uT, sound, force_N, place, lags))[lag_i].sum())
    return np.full(len(place), LAGS[np.argmin(costs)])


def _fit_lines(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], force_N: Float64[np.ndarray, " f"],
    place: Int64[np.ndarray, " f"], lag: Int64[np.ndarray, " f"],
) -> Float64[np.ndarray, "f ch"]:  # fmt: skip
    """Return the expected field of each label row, from a least-squares line of field against force at its place."""
    field_row = np.arange(len(place)) + lag
    used = (field_row >= 0) & (field_row < len(place))
    used[used] &= sound[field_row[used]]
    field_row, place_i, force = field_row[used], place[used], force_N[used]
    places_n = place.max() + 1
    count = np.maximum(np.bincount(place_i, minlength=places_n), 1)
    mean_N = np.bincount(place_i, force, places_n) / count
    off_N = force - mean_N[place_i]
    spread = np.bincount(place_i, off_N**2, places_n)
    expected_uT = np.empty_like(field_uT)
    for channel, values_uT in enumerate(field_uT[field_row].T):
        mean_uT = np.bincount(place_i, values_uT, places_n) / count
        slope = np.bincount(place_i, off_N * values_uT, places_n) / np.where(spread > 0, spread, np.inf)
        expected_uT[:, channel] = mean_uT[place] + slope[place] * (force_N - mean_N[place])
    return expected_uT


def _distances(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], expected_uT: Float64[np.ndarray, "f ch"]
) -> Float[np.ndarray, "l f"]:
    """Return for each lag and label row the distance of the field from the expected one; 0 if either is unknown."""
    distance = np.zeros((len(LAGS), len(field_uT)))
    row = np.arange(len(field_uT))
    known = (row + LAGS[0] >= 0) & (row + LAGS[-1] < len(row))
    known[known] &= np.all([sound[row[known] + lag] for lag in LAGS], axis=0)
    for lag, lag_distance in zip(LAGS, distance, strict=True):
        lag_distance[known] = np.linalg.norm(field_uT[row[known] + lag] - expected_uT[known], axis=1)
    return np.minimum(distance, OUTLIER * np.median(distance[:, known].min(axis=0))) if known.any() else distance


def _split(distance: Float[np.ndarray, "l f"]) -> tuple[int, int, int]:
    """Return the indices of two different lags, and the row of the change, with the least sum of distances."""
    lags_n = len(distance)
    before = np.concatenate([np.zeros((lags_n, 1)), np.cumsum(distance, axis=1)], axis=1)  # sums over earlier rows
    after = before[:, -1:] - before
    cost = before[:, None] + after  # [before after row]
    cost[range(lags_n), range(lags_n)] = np.inf
    before_i, after_i, row = np.unravel_index(np.argmin(cost), cost.shape)
    return int(before_i), int(after_i), int(row)


AGREEMENT_MIN = 0.95
# A shift by half the recording leaves only half the moves to compare, some of them without contact.
SEEN_TWICE_MIN = 0.25
PROBES_N = 256
PROBES_MIN_N = 8  # with fewer probes, no period is excluded
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
    """Return the periods that fit a sample of moves from the first half; testing all moves would be quadratic."""
    half_n = len(contact) // 2
    early = moves[moves[:, 1] < half_n]
    if not len(early):
        return np.arange(1, half_n + 1) if len(moves) else np.zeros(0, np.int64)
    # Multiples of the golden ratio modulo 1 are evenly spread, and not in phase with any grid.
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
    """Return the rows of the last contact at each place and of the first contact at the next place.

    A shift that stays within a dwell cannot match both.
    """
    rows = np.flatnonzero(contact)
    pairs = np.stack([rows[:-1], rows[1:]], axis=1)
    return pairs[(place_mm[pairs[:, 0]] != place_mm[pairs[:, 1]]).any(axis=1)]
