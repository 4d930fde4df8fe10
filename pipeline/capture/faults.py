"""What a broken sensor sends in place of a field. In: readings. Out: masks of readings, or flags of chips.

The faults are those of real recordings: reads that failed on the bus, chips that lost their settings, chips that
stopped. Refuses to mend or drop anything, and to know bytes.
"""

import numpy as np
from jaxtyping import Bool, Float, Int64

# What the ReSkin firmware sends for a chip whose I2C read failed; seen in INI's recording AFG_flex_50.
FAILED_B_uT = (8028.16, 5194.00, 12943.36)
FAILED_TEMPERATURE_degC = -880.49
FAILED_TOLERANCE = 0.01  # text wires round to two decimals

# The grid of a chip back at its power-on settings; seen in INI's recordings AFG_test_new_board15 and piezo.
RESET_LSB_XY_uT = 0.98
RESET_LSB_Z_uT = 1.58
LSB_TOLERANCE = 0.1  # gains of the MLX90393 are a fifth or more apart (data sheet, table 17)

# A grid shows when neighbouring values often lie one step apart: 5 % or more of all gaps in the first 200 frames of 14
# real recordings are one step. Values without a grid have one smallest gap, and by chance one or two close to it.
STEP_SHARE_MIN = 0.04
STEPS_MIN_N = 4
STEP_MIN_uT = 0.1  # no setting of the MLX90393 has a finer LSB than 0.150 uT (data sheet, table 17)
SAME_VALUE_uT = 1e-3  # float32 arithmetic may write one value in two ways

# Noise moves a chip that works; it repeats itself only when it is read again before its next conversion is done
# (1.84 ms), or where its LSB is coarse: for at most 3 frames in 14 real recordings.
STUCK_FRAMES_MIN_N = 20


def failed_reads(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"]
) -> Bool[np.ndarray, "f k"]:
    """Mark the readings of a chip whose I2C read failed; a recording without temperatures has NaN there."""
    same_b = np.abs(_by_chip(b_uT) - FAILED_B_uT) <= FAILED_TOLERANCE
    same_temperature = np.abs(temperature_degC - FAILED_TEMPERATURE_degC) <= FAILED_TOLERANCE
    return same_b.all(axis=2) & (same_temperature | np.isnan(temperature_degC))


def find_lsb(b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "k 2"]:
    """Estimate the step between a chip's values, in uT, along x and y and along z; NaN where no grid shows.

    A few hundred frames show it; a chip whose settings change among them shows none.
    """
    chips = np.moveaxis(_by_chip(b_uT), 1, 0)
    return np.array([[_step([chip[:, 0], chip[:, 1]]), _step([chip[:, 2]])] for chip in chips]).reshape(-1, 2)


def reset_chips(b_uT: Float[np.ndarray, "f ch"], expected_lsb_uT: tuple[float, float] | None) -> Bool[np.ndarray, " k"]:
    """Flag the chips whose grid is not the expected one (x and y, z).

    Without an expectation: those whose grid differs from that of most chips, or is the one of a chip after a reset. A
    chip that shows no grid is not flagged.
    """
    lsb_uT = find_lsb(b_uT)
    if expected_lsb_uT is not None:
        return _not_on_grid(lsb_uT, expected_lsb_uT)
    after_reset = ~_not_on_grid(lsb_uT, (RESET_LSB_XY_uT, RESET_LSB_Z_uT)) & np.isfinite(lsb_uT).all(axis=1)
    usual_xy_uT, usual_z_uT = (_median(axis[np.isfinite(axis)]) for axis in lsb_uT.T)
    return after_reset | _not_on_grid(lsb_uT, (usual_xy_uT, usual_z_uT))


def stuck_chips(b_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, "f k"]:
    """Mark the readings of a chip that stays the same for `STUCK_FRAMES_MIN_N` frames while another chip moves."""
    chips = _by_chip(b_uT)
    stuck = np.zeros(chips.shape[:2], bool)
    if len(chips) < STUCK_FRAMES_MIN_N:
        return stuck
    moves = (np.diff(chips, axis=0) != 0).any(axis=2)
    moves_before_n = np.concatenate([np.zeros((1, 1), np.int64), moves.sum(axis=1, keepdims=True).cumsum(axis=0)])[:, 0]
    for chip_i in range(chips.shape[1]):
        first, last = _quiet_runs(moves[:, chip_i])
        others_move = moves_before_n[last] > moves_before_n[first]  # within the run this chip has no move of its own
        for start, stop in zip(first[others_move], last[others_move] + 1, strict=True):
            stuck[start:stop, chip_i] = True
    return stuck


def _quiet_runs(moves: Bool[np.ndarray, " g"]) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
    """Give first and last frame of every long run without a move; `moves[i]` is the one from frame i to i + 1."""
    edges = np.concatenate([[0], np.flatnonzero(moves) + 1, [len(moves) + 1]])
    long = np.diff(edges) >= STUCK_FRAMES_MIN_N
    return edges[:-1][long], edges[1:][long] - 1


def _step(axes_uT: list[Float[np.ndarray, " f"]]) -> float:
    """Find the step of the grid on which all values of some axes lie."""
    gaps_uT = np.concatenate([np.diff(np.unique(axis[np.isfinite(axis)])) for axis in axes_uT])
    gaps_uT = gaps_uT[gaps_uT > SAME_VALUE_uT]
    if not len(gaps_uT):
        return np.nan
    single = gaps_uT[gaps_uT < 1.5 * gaps_uT.min()]
    shows = len(single) >= max(STEPS_MIN_N, STEP_SHARE_MIN * len(gaps_uT)) and single.mean() >= STEP_MIN_uT
    return float(single.mean()) if shows else np.nan


def _median(known: Float[np.ndarray, " k"]) -> float:
    return float(np.median(known)) if len(known) else np.nan


def _not_on_grid(lsb_uT: Float[np.ndarray, "k 2"], grid_uT: tuple[float, float]) -> Bool[np.ndarray, " k"]:
    return np.any(np.abs(lsb_uT / grid_uT - 1) > LSB_TOLERANCE, axis=1)


def _by_chip(b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f k 3"]:
    return b_uT.reshape(len(b_uT), b_uT.shape[1] // 3, 3)
