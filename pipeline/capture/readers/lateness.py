"""Find where the lateness between two files that are joined row by row changes within a recording.

A recorder that loses a row in one of two files pairs every later field with its neighbour's label, and both files may
keep their length. Layout `ini` is the only one that joins files by row number alone: `table`, `lab` and `eflash7` have
one file, `eflesh` compares the times of each row, and byte streams are joined with their labels by time.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

LAGS = np.arange(-2, 6)  # rows that fields may come after their labels
ROWS_MIN_N = 300  # a shorter recording does not say enough
BLOCK_ROWS_N = 500  # over which the field's slow drift is removed
ROUNDS_N = 4
OUTLIER = 4.0  # times the median distance: more counts as much
# A change is reported if it explains as much as this many misaligned rows. Over the two public recordings and windows
# of them the largest value without a change is 12; a row lost 100 rows before the end gives 40 or more.
EVIDENCE_ROWS_MIN_N = 30
CONTRAST_MIN = 0.3  # of what a misaligned row costs, over its standard deviation: noise alone reaches 0.17 in 300 rows


class Change(NamedTuple):
    """From label row `row` (counted from 0) on, fields come `after` rows late, before it `before` rows."""

    row: int
    before: int
    after: int


def find_change(
    b_uT: Float64[np.ndarray, "f ch"], label: Float64[np.ndarray, "f 3"], contact: Bool[np.ndarray, " f"],
    sound: Bool[np.ndarray, " f"],
) -> Change | None:  # fmt: skip
    """Return where the lateness changes; None if one lateness explains all rows as well.

    Every place has its own line of field against force, fitted to all rows as they are aligned so far. Rows are then
    split into two parts with a lateness each so that fields lie nearest to these lines, and the lines are fitted again.
    `label` is x and y in mm and force in N; rows that are not `sound` say nothing.
    """
    if len(label) < ROWS_MIN_N or not contact.any():
        return None
    field_uT, force_N = _without_drift(b_uT), label[:, 2]
    place = np.unique(np.where(contact[:, None], label[:, :2], np.inf), axis=0, return_inverse=True)[1].ravel()
    row, lag = np.arange(len(label)), _best_lag(field_uT, sound, force_N, place)
    for _ in range(ROUNDS_N):
        distance = _distances(field_uT, sound, _fit_lines(field_uT, sound, force_N, place, lag))
        before_i, after_i, at = _split(distance)
        lag = np.where(row < at, LAGS[before_i], LAGS[after_i])
    gain = distance.sum(axis=1).min() - distance[before_i, :at].sum() - distance[after_i, at:].sum()
    apart = distance[after_i] - distance[before_i]
    misaligned = float(np.where(row < at, apart, -apart).mean())  # what a row costs that has the other lateness
    if misaligned <= CONTRAST_MIN * apart.std() or gain < EVIDENCE_ROWS_MIN_N * misaligned:
        return None
    return Change(at, int(LAGS[before_i]), int(LAGS[after_i]))


def _without_drift(b_uT: Float64[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f ch"]:
    blocks = np.array_split(b_uT, max(1, len(b_uT) // BLOCK_ROWS_N))
    return np.concatenate([block - np.median(block, axis=0) for block in blocks])


def _best_lag(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], force_N: Float64[np.ndarray, " f"],
    place: Int64[np.ndarray, " f"],
) -> Int64[np.ndarray, " f"]:  # fmt: skip
    """Return the one lateness with which lines fit best, for every row."""
    costs = []
    for lag_i, lag in enumerate(LAGS):
        lags = np.full(len(place), lag)
        costs.append(_distances(field_uT, sound, _fit_lines(field_uT, sound, force_N, place, lags))[lag_i].sum())
    return np.full(len(place), LAGS[np.argmin(costs)])


def _fit_lines(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], force_N: Float64[np.ndarray, " f"],
    place: Int64[np.ndarray, " f"], lag: Int64[np.ndarray, " f"],
) -> Float64[np.ndarray, "f ch"]:  # fmt: skip
    """Return the field that each label row should have: per place a least-squares line of field against force."""
    at = np.arange(len(place)) + lag
    used = (at >= 0) & (at < len(place))
    used[used] &= sound[at[used]]
    at, of, force = at[used], place[used], force_N[used]
    places_n = place.max() + 1
    count = np.maximum(np.bincount(of, minlength=places_n), 1)
    mean_N = np.bincount(of, force, places_n) / count
    off_N = force - mean_N[of]
    spread = np.bincount(of, off_N**2, places_n)
    expected_uT = np.empty_like(field_uT)
    for channel, values_uT in enumerate(field_uT[at].T):
        mean_uT = np.bincount(of, values_uT, places_n) / count
        slope = np.bincount(of, off_N * values_uT, places_n) / np.where(spread > 0, spread, np.inf)
        expected_uT[:, channel] = mean_uT[place] + slope[place] * (force_N - mean_N[place])
    return expected_uT


def _distances(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], expected_uT: Float64[np.ndarray, "f ch"]
) -> Float[np.ndarray, "l f"]:
    """Return for each lateness and label row how far its field lies from the expected one; 0 where one is unknown."""
    distance = np.zeros((len(LAGS), len(field_uT)))
    row = np.arange(len(field_uT))
    known = (row + LAGS[0] >= 0) & (row + LAGS[-1] < len(row))
    known[known] &= np.all([sound[row[known] + lag] for lag in LAGS], axis=0)
    for lag, of_lag in zip(LAGS, distance, strict=True):
        of_lag[known] = np.linalg.norm(field_uT[row[known] + lag] - expected_uT[known], axis=1)
    return np.minimum(distance, OUTLIER * np.median(distance[:, known].min(axis=0))) if known.any() else distance


def _split(distance: Float[np.ndarray, "l f"]) -> tuple[int, int, int]:
    """Return two different latenesses (their indices) and the row between them with the least sum of distances."""
    lags_n = len(distance)
    before = np.concatenate([np.zeros((lags_n, 1)), np.cumsum(distance, axis=1)], axis=1)  # of the rows before each
    after = before[:, -1:] - before
    cost = before[:, None] + after  # [before after row]
    cost[range(lags_n), range(lags_n)] = np.inf
    before_i, after_i, row = np.unravel_index(np.argmin(cost), cost.shape)
    return int(before_i), int(after_i), int(row)
