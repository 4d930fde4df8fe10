"""Find rows that are missing in a recording, and number the passes over the skin.

In some recordings, fields and labels (places and forces) are in two files, and the fields lag behind the labels by a
number of rows. If a row is missing in one of the files, the lag changes within the recording. `find_change` finds such
a change. A pass is one visit to all places of a recording. `find_passes` finds the pass of each row.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64

from reskin.seeds import rng_for

LAGS = np.arange(-2, 6)  # possible lags of the fields behind their labels, in rows
ROWS_MIN_N = 300  # in a shorter recording, a change of the lag cannot be detected
BLOCK_ROWS_N = 500  # to remove slow drift, the median field of each block of about this many rows is subtracted
ROUNDS_N = 4  # number of iterations in which `find_change` fits the lines and splits the rows
OUTLIER = 4.0  # distances between fields and lines are clipped to this multiple of the median distance
# `find_change` fits a line of field against force for each place. The cost of a misaligned row is the mean increase of
# the distance between field and line if a row is assigned to a wrong lag. If the lag changes within the recording, two
# lags give a smaller sum of distances than a single lag. The change is reported if this reduction is at least the cost
# of this many misaligned rows. In the two public recordings and in parts of them, the reduction is the cost of at most
# 12 rows if the lag does not change. It is the cost of 40 or more rows if a row is lost 100 rows before the end.
EVIDENCE_ROWS_MIN_N = 30
# The cost of a misaligned row, divided by the standard deviation of the cost over rows, must exceed this value. In
# recordings of 300 rows, noise alone gives a ratio of up to 0.17.
CONTRAST_MIN = 0.3


class Change(NamedTuple):
    """A change of the lag of the fields behind the labels.

    The lag is `before` rows in the rows of labels before `row`, and `after` rows from `row` on. Rows are counted from
    0.
    """

    row: int
    before: int
    after: int


def find_change(
    b_uT: Float64[np.ndarray, "f ch"], label: Float64[np.ndarray, "f 3"], contact: Bool[np.ndarray, " f"],
    sound: Bool[np.ndarray, " f"],
) -> Change | None:  # fmt: skip
    """Return the change of the lag; None if a single lag explains the rows about as well.

    The lags are estimated iteratively. With the current estimate, a line of field against force is fitted for each
    place. Then the rows are split into two parts with different lags, such that the fields are as near as possible to
    these lines. Both steps are repeated. The columns of `label` are x in mm, y in mm and force in N. Rows of `b_uT`
    for which `sound` is False are ignored.
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
    # Mean cost of a misaligned row: the increase of its distance if it has the lag of the other part.
    misaligned = float(np.where(row < change_row, extra_cost, -extra_cost).mean())
    if misaligned <= CONTRAST_MIN * extra_cost.std() or gain < EVIDENCE_ROWS_MIN_N * misaligned:
        return None
    return Change(change_row, int(LAGS[before_i]), int(LAGS[after_i]))


def _without_drift(b_uT: Float64[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f ch"]:
    """Subtract the median field of each block of about `BLOCK_ROWS_N` rows."""
    blocks = np.array_split(b_uT, max(1, len(b_uT) // BLOCK_ROWS_N))
    return np.concatenate([block - np.median(block, axis=0) for block in blocks])


def _best_lag(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], force_N: Float64[np.ndarray, " f"],
    place: Int64[np.ndarray, " f"],
) -> Int64[np.ndarray, " f"]:  # fmt: skip
    """Find the single lag that fits all rows best; return an array with this lag for each row."""
    costs = []
    for lag_i, lag in enumerate(LAGS):
        lags = np.full(len(place), lag)
        costs.append(_distances(field_uT, sound, _fit_lines(field_uT, sound, force_N, place, lags))[lag_i].sum())
    return np.full(len(place), LAGS[np.argmin(costs)])


def _fit_lines(
    field_uT: Float64[np.ndarray, "f ch"], sound: Bool[np.ndarray, " f"], force_N: Float64[np.ndarray, " f"],
    place: Int64[np.ndarray, " f"], lag: Int64[np.ndarray, " f"],
) -> Float64[np.ndarray, "f ch"]:  # fmt: skip
    """Return the field that is expected for each row of labels.

    For each place, a line of field against force is fitted by least squares, with the given lag of each row. The
    expected field is the value of this line at the row's force.
    """
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
    """Return the distance in uT between the measured and the expected field, for each lag and each row of labels.

    The distances of a row are 0 if the field is unknown for one of the lags.
    """
    distance = np.zeros((len(LAGS), len(field_uT)))
    row = np.arange(len(field_uT))
    known = (row + LAGS[0] >= 0) & (row + LAGS[-1] < len(row))
    known[known] &= np.all([sound[row[known] + lag] for lag in LAGS], axis=0)
    for lag, lag_distance in zip(LAGS, distance, strict=True):
        lag_distance[known] = np.linalg.norm(field_uT[row[known] + lag] - expected_uT[known], axis=1)
    return np.minimum(distance, OUTLIER * np.median(distance[:, known].min(axis=0))) if known.any() else distance


def _split(distance: Float[np.ndarray, "l f"]) -> tuple[int, int, int]:
    """Find the two different lags, and the row of the change between them, for which the sum of distances is smallest.

    Returns the indices of the lags before and after the change in `LAGS`, and the row of the change.
    """
    lags_n = len(distance)
    before = np.concatenate([np.zeros((lags_n, 1)), np.cumsum(distance, axis=1)], axis=1)  # sums over earlier rows
    after = before[:, -1:] - before
    cost = before[:, None] + after  # [before after row]
    cost[range(lags_n), range(lags_n)] = np.inf
    before_i, after_i, row = np.unravel_index(np.argmin(cost), cost.shape)
    return int(before_i), int(after_i), int(row)


# The period is the number of rows of a pass. To find it, moves are compared. A move is a change of place from one
# contact to the next: the last row before the change, and the first row in contact after it. A move can be compared if
# both rows that are one period later are in contact too. A period is accepted if, for at least this fraction of the
# compared moves, the places one period later are the same.
AGREEMENT_MIN = 0.95
# At least this fraction of all moves must be comparable. The fraction is far below 1 for two reasons. If the period is
# half of the recording, only half of the moves have rows one period later. Some of these rows may be without contact.
COMPARED_MIN = 0.25
# Most periods are excluded quickly with a sample of this many moves. If fewer than PROBES_MIN_N moves of the sample can
# be compared for a period, the sample does not exclude this period.
PROBES_N = 256
PROBES_MIN_N = 8


def find_passes(place_mm: Float[np.ndarray, "f 2"], contact: Bool[np.ndarray, " f"]) -> Int32[np.ndarray, " f"]:
    """Return the number of the pass to which each row belongs; passes are numbered from 0.

    A new pass begins when the sequence of places repeats. If the sequence does not repeat, all rows are in pass 0. The
    places of rows without contact are ignored. The last pass may be incomplete.
    """
    rows_n = len(place_mm)
    moves = _find_moves(place_mm, contact)
    for period_n in _likely_periods(place_mm, contact, moves):
        compared = moves[moves[:, 1] < rows_n - period_n]
        compared = compared[contact[compared + period_n].all(axis=1)]
        if len(compared) and len(compared) >= COMPARED_MIN * len(moves):
            same = (place_mm[compared] == place_mm[compared + period_n]).all(axis=(1, 2))
            if same.mean() >= AGREEMENT_MIN:
                return (np.arange(rows_n) // period_n).astype(np.int32)
    return np.zeros(rows_n, np.int32)


def _likely_periods(
    place_mm: Float[np.ndarray, "f 2"], contact: Bool[np.ndarray, " f"], moves: Int64[np.ndarray, "moves 2"]
) -> Int64[np.ndarray, " p"]:
    """Return the periods, in rows, that fit a sample of the moves in the first half of the recording.

    Only a sample is tested, because the time to test all moves for all periods would grow quadratically with the length
    of the recording.
    """
    half_n = len(contact) // 2
    early = moves[moves[:, 1] < half_n]
    if not len(early):
        return np.arange(1, half_n + 1) if len(moves) else np.zeros(0, np.int64)
    # The sample is random, because equally spaced moves on a grid of places could all be at the same few places.
    probes = rng_for(0, "moves").permutation(early)[:PROBES_N]
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
    """Return the moves: pairs of the last row in contact at a place and the first row in contact at the next place.

    Moves are compared instead of single rows, because several successive rows have the same place. If a period is wrong
    by less than the duration of such a dwell, it may still match one of the two places of a move, but not both.
    """
    rows = np.flatnonzero(contact)
    pairs = np.stack([rows[:-1], rows[1:]], axis=1)
    return pairs[(place_mm[pairs[:, 0]] != place_mm[pairs[:, 1]]).any(axis=1)]
