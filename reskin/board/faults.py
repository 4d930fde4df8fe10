"""Detect the faults of a board: failed reads, stuck or reset chips, values out of range, repeated or missing frames.

`FaultDetector` finds all kinds of faults in a stream of frames, which may be passed to it in parts of any length. Byte
streams, logs and live boards use it. Tables of presses use the functions below it, because rows of a table need not
follow one another in time. What happens to faulty readings is decided in `recordings.fault_policy`, and in
`live.health` for live boards.

- a reading of a chip that did not answer: `failed_reads`, `zero_reads`
- a number that lost or gained digits: `find_reading_faults` (impossible for the chip), `lone_jumps` (far from others)
- a chip that is called stuck: `StuckChips`; a channel that never changes: `ConstantChannels`
- the step, the range and the noise of a channel: `find_lsb`, `find_reading_faults`, `lone_jumps`
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from reskin.board.chips import (
    B_MAX_uT,
    RESET_LSB_XY_uT,
    RESET_LSB_Z_uT,
    STEP_MIN_uT,
    TEMPERATURE_MAX_degC,
    TEMPERATURE_MIN_degC,
)
from reskin.board.wire import Frames

# Values that the ReSkin firmware sends for a chip whose I2C read failed. They were found in AFG_flex_50, one of the
# public recordings of layout `ini`.
FAILED_B_uT = (8028.16, 5194.00, 12943.36)
FAILED_TEMPERATURE_degC = -880.49
FAILED_TOLERANCE = 0.01  # a reading counts as failed if it differs by less, because text formats round to two decimals

# If no chip answers on the bus, all bytes are 0xFF, which is -1 step on each axis. A step along z is 1.61 times as
# large as one along x and y (data sheet of the MLX90393, table 17), or equal in other chips.
STEP_MAX_uT, STEP_RATIO, STEP_RATIO_OFF = 10.0, 1.3, 0.35
EXTREME_MIN_uT = 4_000.0  # a field of this size is never exactly equal on three axes
# A value is far from the median of the readings around it if it differs by more than JUMP_MIN_uT and by more than the
# given multiple of the median change between readings. It is near if it differs by less than the other two limits.
JUMP_MIN_uT, JUMP_STEPS, JUMP_NEAR, JUMP_NEAR_STEPS = 60.0, 15.0, 0.1, 6.0
JUMP_WINDOW_N, JUMP_READINGS_MIN_N = 7, 20
RANGE_END = 0.999  # fields beyond this fraction of 2^15 steps are at the end of the range
RANGE_MARGIN = 1.05  # a field beyond 2^15 steps by this factor is impossible

# The LSB of a chip is the step between neighbouring values that the chip can send. Two LSBs are treated as different if
# they differ by more than this fraction. Those of two gains of the MLX90393 differ by 20 % or more (data sheet).
LSB_TOLERANCE = 0.1

# The values of a channel are multiples of the chip's LSB, so they lie on a grid whose step is the LSB. To find this
# step, the distinct values of a channel are sorted. The difference between two neighbouring values is called a gap. A
# grid is detected if enough gaps equal one step: at least the fraction STEP_SHARE_MIN of all gaps, and at least
# STEPS_MIN_N gaps. In the first 200 frames of 14 real recordings, 5 % or more of the gaps equal one step. If the values
# are not on a grid, only one or two gaps are close to the smallest gap, by chance.
STEP_SHARE_MIN = 0.04
STEPS_MIN_N = 4
# Gaps below 1.5 times the smallest gap are assumed to be one step each, so they must be nearly equal: their standard
# deviation, divided by their mean, must not exceed this value. This ratio is 0.02 if the LSB is 0.242 uT and the values
# are written with two decimals. It is 0.12 if the gaps are random.
STEP_SPREAD_MAX = 0.06
# A stricter choice than STEPS_MIN_N. This many equal gaps do not occur by chance, even if there are few distinct
# values, as in data without noise.
SURE_STEPS_MIN_N = 20
# A gap below this value is a rounding error of float32 arithmetic, so the two values are treated as equal.
SAME_VALUE_uT = 1e-3

# Because of noise, successive readings of a working chip differ. They are equal only if the chip is read again before
# its next conversion is finished (after 1.84 ms), or if the chip's LSB is larger than the noise. In 14 real recordings,
# at most 3 successive frames are equal. A chip is therefore stuck if at least this many successive readings are equal.
STUCK_FRAMES_MIN_N = 20
# A chip with a constant reading counts as stuck only if another chip changes in at least this fraction of the same
# frames. The fraction is not 1, because simulated data may have no noise: the readings of working chips then change
# only while the skin is pressed or released, and are constant in the other frames.
OTHERS_MOVE_MIN = 0.5

INT16_STEPS_N = 2**15
CLOCK_STEP_MAX_S = 1.0  # a longer step of the board's clock counts as a jump
MICROS_WRAP_S = 2**32 / 1e6  # Arduino's micros() counts to 2^32, and then again from 0
# Assumed: repeated frames are a fault if, in a window of 40 frames (0.1 s at 400 Hz), more than 40 % of the frames
# equal the frame before them.
REPEATED_LOOK_N, REPEATED_SHARE = 40, 0.4
# Frames are missing between two frames if the time between them, on the board's clock, exceeds the median time between
# frames by this factor.
MISSING_STEPS = 1.6
# The board is silent if no frame arrives for a time that exceeds both SILENCE_S and SILENCE_STEPS times the median time
# between frames. The second condition ensures that a low frame rate does not count as silence.
SILENCE_S = 1.0
SILENCE_STEPS = 50.0
# If the number of stray bytes before a frame exceeds the length of this many frames, the baud rate is probably wrong.
GARBAGE_FRAMES_N = 10
LONG_LINE = 1.5  # a line of text that is longer than the median length by this factor contains stray bytes

# A stream's LSB is estimated from windows of this many frames. In real recordings, this number is enough to find the
# LSB of every working chip; 200 frames may be too few.
SCALE_FRAMES_N = 400
GRID_ROWS_N = 1000  # the LSB of a table is estimated from blocks of about this many rows


def failed_reads(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"]
) -> Bool[np.ndarray, "f k"]:
    """Mark the readings that firmware sends for a chip whose I2C read failed.

    There are three kinds: the field `FAILED_B_uT` and the temperature `FAILED_TEMPERATURE_degC` of the ReSkin firmware
    (if the temperature is unknown, only the field is compared); bytes 0xFF in place of an answer, which are -1 step on
    all axes; and the same extreme value on all axes.
    """
    chips = _by_chip(b_uT)
    same_b = np.abs(chips - FAILED_B_uT) <= FAILED_TOLERANCE
    same_temperature = np.abs(temperature_degC - FAILED_TEMPERATURE_degC) <= FAILED_TOLERANCE
    of_firmware = same_b.all(axis=2) & (same_temperature | np.isnan(temperature_degC))
    x_uT, y_uT, z_uT = np.moveaxis(chips, 2, 0)
    equal = np.abs(x_uT - y_uT) <= FAILED_TOLERANCE
    with np.errstate(invalid="ignore", divide="ignore"):
        steeper = z_uT / x_uT
    no_answer = equal & (x_uT < 0) & (x_uT >= -STEP_MAX_uT) & (np.abs(steeper - STEP_RATIO) <= STEP_RATIO_OFF)
    extreme = equal & (np.abs(x_uT - z_uT) <= FAILED_TOLERANCE) & (np.abs(x_uT) >= EXTREME_MIN_uT)
    return np.asarray(of_firmware | no_answer | extreme)


def lone_jumps(b_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, " f"]:
    """Mark the readings of a stream or a log that are far from the median of the readings around them.

    Such readings come from lines whose digits were cut. In a single reading, any channels may be far from their median,
    because no press is that short. In up to `JUMP_WINDOW_N // 2` successive readings, exactly one channel of a board of
    several chips may be, because a press changes several channels. In both cases, the reading must be further off than
    the readings around it change, because a channel may be far off its median while a press begins or ends.

    Two doors do not use this: rows of a table may be single readings of different presses, and the estimate of a live
    board cannot wait for the next readings.
    """
    jumps = np.zeros(len(b_uT), bool)
    if len(b_uT) < JUMP_READINGS_MIN_N:
        return jumps
    b_uT = b_uT.astype(np.float64)
    step_uT = np.abs(np.diff(b_uT, axis=0))
    usual_uT = np.median(step_uT, axis=0)
    far_uT = np.maximum(JUMP_MIN_uT, JUMP_STEPS * usual_uT)
    near_uT = np.maximum(JUMP_NEAR * JUMP_MIN_uT, JUMP_NEAR_STEPS * usual_uT)
    stepped = np.flatnonzero((step_uT > far_uT).any(axis=1))
    rows = np.unique(np.concatenate([stepped + i for i in range(-1, 3)])).clip(0, len(b_uT) - 1)
    around = np.arange(JUMP_WINDOW_N) - JUMP_WINDOW_N // 2
    off_uT = np.zeros_like(b_uT)
    windows = np.abs(rows[:, None] + around)  # reflected at both ends
    windows = len(b_uT) - 1 - np.abs(len(b_uT) - 1 - windows)
    off_uT[rows] = np.abs(b_uT[rows] - np.median(b_uT[windows], axis=1))
    far, off = (off_uT > far_uT).sum(axis=1), (off_uT > near_uT).sum(axis=1)
    beside = np.pad(off, 1)
    alone = (far > 0) & (beside[:-2] == 0) & (beside[2:] == 0)
    single = (far == 1) & (off == 1) & (b_uT.shape[1] > 3)
    # The second largest change of a channel in the readings around. It is large while a press begins or ends.
    changes_uT = np.zeros(len(b_uT))
    others = np.delete(windows, JUMP_WINDOW_N // 2, axis=1)
    changes_uT[rows] = np.sort(np.ptp(b_uT[others], axis=1), axis=1)[:, max(-2, -b_uT.shape[1])]
    return np.asarray((alone | single) & (off_uT.max(axis=1) > changes_uT))


def zero_reads(b_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, "f k"]:
    """Mark the readings of a chip whose three field components are exactly 0.

    In the earth's field, a chip cannot read 0 on three axes at once, so such a reading comes from memory to which no
    reading was written. Some rows of the public eFlashTeam7 recordings have zeros on all chips.
    """
    return np.asarray((_by_chip(b_uT) == 0).all(axis=2))


def find_lsb(
    b_uT: Float[np.ndarray, "f ch"], *, step_min_uT: float = STEP_MIN_uT, steps_min_n: int = STEPS_MIN_N
) -> Float[np.ndarray, "k 2"]:
    """Estimate the LSB of each chip in uT from its readings.

    The first column of the result is the LSB along x and y, and the second column is the LSB along z. A few hundred
    frames are enough. An LSB is NaN if it cannot be detected. There are three possible reasons: the settings of the
    chip change within these frames; fewer than `steps_min_n` gaps between neighbouring values equal one step; or this
    step is below `step_min_uT`.
    """
    chips = np.moveaxis(_by_chip(b_uT), 1, 0)
    steps_uT = np.array(
        [[_step([chip[:, 0], chip[:, 1]], steps_min_n), _step([chip[:, 2]], steps_min_n)] for chip in chips]
    ).reshape(-1, 2)
    return np.where(steps_uT >= step_min_uT, steps_uT, np.nan)


def reset_chips(
    lsb_uT: Float[np.ndarray, "k 2"], expected_lsb_uT: tuple[float, float] | None
) -> Bool[np.ndarray, " k"]:
    """Mark the chips that were probably reset, because their LSB is not the expected one (x and y, z).

    If `expected_lsb_uT` is None, a chip is marked if its LSB differs from the median over chips, or is that of a chip
    with its power-on settings. A chip with an unknown LSB (NaN) is not marked.
    """
    if expected_lsb_uT is not None:
        return _differs(lsb_uT, expected_lsb_uT)
    after_reset = ~_differs(lsb_uT, (RESET_LSB_XY_uT, RESET_LSB_Z_uT)) & np.isfinite(lsb_uT).all(axis=1)
    usual_xy_uT, usual_z_uT = (_median(axis[np.isfinite(axis)]) for axis in lsb_uT.T)
    return after_reset | _differs(lsb_uT, (usual_xy_uT, usual_z_uT))


class StuckChips:
    """A detector of stuck chips in a recording, which may be passed in several parts of any length.

    A reading is stuck if two conditions hold. First, at least `STUCK_FRAMES_MIN_N` successive readings of the chip are
    equal, the last of which is this reading. Second, other chips changed in at least the fraction `OTHERS_MOVE_MIN` of
    these frames. If no chip of the board changes, no chip is stuck.
    """

    def __init__(self, chips_n: int) -> None:
        self._last_uT = np.full((1, chips_n, 3), np.nan)
        self._quiet_n = np.zeros(chips_n, np.int64)  # number of frames since each chip last changed
        # number of those frames since each chip last changed in which another chip changed
        self._moved_n = np.zeros(chips_n, np.int64)

    def feed(self, b_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, "f k"]:
        """Process the next readings; return a mask of the stuck readings."""
        chips = _by_chip(b_uT)
        if not len(chips):
            return np.zeros(chips.shape[:2], bool)
        moves = (np.diff(np.concatenate([self._last_uT, chips]), axis=0) != 0).any(axis=2)
        frame_n = np.arange(1, len(chips) + 1)[:, None]
        board_changes_n = moves.any(axis=1).cumsum()[:, None]
        last_change_n = np.maximum.accumulate(np.where(moves, frame_n, 0), axis=0)
        changes_before_n = np.concatenate([[0], board_changes_n[:, 0]])[last_change_n]
        unchanged = last_change_n == 0
        quiet_n = frame_n - last_change_n + unchanged * self._quiet_n
        moved_n = board_changes_n - changes_before_n + unchanged * self._moved_n
        self._last_uT, self._quiet_n, self._moved_n = chips[-1:].astype(np.float64), quiet_n[-1], moved_n[-1]
        return (quiet_n >= STUCK_FRAMES_MIN_N - 1) & (moved_n >= OTHERS_MOVE_MIN * quiet_n)


class ConstantChannels:
    """A detector of channels that never change in a recording, although other channels of the same chip change.

    The recording may be passed in several parts of any length. A chip with three constant channels is not reported
    here, because the whole chip is then stuck (see `StuckChips`).
    """

    def __init__(self, chips_n: int) -> None:
        self._first_uT = np.full((chips_n, 3), np.nan)
        self._changed = np.zeros((chips_n, 3), bool)
        self._readings_n = 0

    def feed(self, b_uT: Float[np.ndarray, "f ch"]) -> None:
        """Process the next readings, from which the caller must have removed the failed reads."""
        chips = _by_chip(b_uT)
        if not len(chips):
            return
        if not self._readings_n:
            self._first_uT = chips[0].copy()
        self._changed |= (chips != self._first_uT).any(axis=0)
        self._readings_n += len(chips)

    def describe(self) -> list[str]:
        """Describe each constant channel, as in `Bz of chip 0 (12.5 uT)`.

        The list is empty if fewer than `STUCK_FRAMES_MIN_N` readings were processed.
        """
        if self._readings_n < STUCK_FRAMES_MIN_N:
            return []
        constant = ~self._changed & self._changed.any(axis=1, keepdims=True)
        return [
            f"B{'xyz'[axis]} of chip {chip} ({self._first_uT[chip, axis]:.6g} uT)"
            for chip, axis in np.argwhere(constant)
        ]


def repeated_frames(step_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, " f"]:
    """Mark frames that equal the frame before them, if many other frames around them do so too.

    "Many" means more than the fraction `REPEATED_SHARE` of a window of `REPEATED_LOOK_N` frames. A few repeated frames
    are normal, because the firmware may read the chips faster than they measure. `step_uT` is the change of the field
    from one frame to the next.
    """
    same = np.asarray((step_uT == 0).all(axis=1))
    if len(same) < REPEATED_LOOK_N:
        return np.zeros(len(same), bool)
    window = np.full(REPEATED_LOOK_N, 1 / REPEATED_LOOK_N)
    share, inside = (np.convolve(values, window, mode="same") for values in (same, np.ones(len(same))))
    inside[inside > 1 - 0.5 / REPEATED_LOOK_N] = 1.0  # remove rounding errors
    return np.asarray(same & (share / inside > REPEATED_SHARE))


def clock_steps(device_s: Float64[np.ndarray, " f"], last_s: float) -> Float64[np.ndarray, " f"]:
    """Return the time since the previous frame on the board's clock, which may start again from 0 after 2^32 us."""
    step_s = np.diff(device_s, prepend=last_s)
    return np.where(np.abs(step_s + MICROS_WRAP_S) < CLOCK_STEP_MAX_S, step_s + MICROS_WRAP_S, step_s)


def clock_resolution_s(device_s: Float64[np.ndarray, " f"]) -> float:
    """Return the resolution of the board's clock, whose times in s are sent as float32: 4 ms after 9 h."""
    return float(np.spacing(np.float32(np.abs(device_s).max())))


def clock_jumps(device_step_s: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Mark frames at which the board's clock went backwards, or forwards by more than `CLOCK_STEP_MAX_S`.

    `device_step_s` is the time since the previous frame according to the board's clock.
    """
    return np.asarray((device_step_s < 0) | (device_step_s > CLOCK_STEP_MAX_S))


def missing_frames(device_step_s: Float[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Estimate the number of missing frames before each frame, from the times of the board's clock.

    `device_step_s` is the time since the previous frame according to this clock. If the board sends no times (NaN), all
    counts are 0.
    """
    usual_s = np.median(device_step_s) if len(device_step_s) else np.nan
    if not usual_s > 0:
        return np.zeros(len(device_step_s), np.int64)
    late = (device_step_s > MISSING_STEPS * usual_s) & ~clock_jumps(device_step_s)
    return np.where(late, np.rint(device_step_s / usual_s) - 1, 0).astype(np.int64)


def _step(axes_uT: list[Float[np.ndarray, " f"]], steps_min_n: int) -> float:
    """Return the step of the grid on which the values of all given axes lie; NaN if no grid is detected."""
    gaps_uT = np.concatenate([np.diff(np.unique(axis[np.isfinite(axis)])) for axis in axes_uT])
    gaps_uT = gaps_uT[gaps_uT > SAME_VALUE_uT]
    if not len(gaps_uT):
        return np.nan
    one_step_uT = gaps_uT[gaps_uT < 1.5 * gaps_uT.min()]
    are_equal = one_step_uT.std() <= STEP_SPREAD_MAX * one_step_uT.mean()
    is_grid = are_equal and len(one_step_uT) >= max(steps_min_n, STEP_SHARE_MIN * len(gaps_uT))
    return float(one_step_uT.mean()) if is_grid else np.nan


def _median(known: Float[np.ndarray, " k"]) -> float:
    return float(np.median(known)) if len(known) else np.nan


def _differs(lsb_uT: Float[np.ndarray, "k 2"], expected_uT: tuple[float, float]) -> Bool[np.ndarray, " k"]:
    """Mark the chips whose LSB differs from the expected one; an unknown LSB (NaN) is not marked."""
    return np.any(np.abs(lsb_uT / expected_uT - 1) > LSB_TOLERANCE, axis=1)


def _by_chip(b_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, "f k 3"]:
    return b_uT.reshape(len(b_uT), b_uT.shape[1] // 3, 3)


class ReadingFaults(NamedTuple):
    """The faults of a set of frames that can be detected from a single reading.

    Each field is a mask with one row per frame and one column per chip.
    """

    failed_read: Bool[np.ndarray, "f k"]
    zeros: Bool[np.ndarray, "f k"]
    too_hot: Bool[np.ndarray, "f k"]
    saturated: Bool[np.ndarray, "f k"]

    @property
    def failed_rows(self) -> Bool[np.ndarray, " f"]:
        """Mask of the frames in which the reading of at least one chip failed."""
        return np.asarray((self.failed_read | self.zeros).any(axis=1))

    @property
    def faulty_rows(self) -> Bool[np.ndarray, " f"]:
        """Mask of the frames in which any chip has any of these faults."""
        return np.asarray((self.failed_read | self.zeros | self.too_hot | self.saturated).any(axis=1))


def find_reading_faults(
    b_uT: Float[np.ndarray, "f ch"],
    temperature_degC: Float[np.ndarray, "f k"],
    lsb_uT: Float[np.ndarray, "k 2"] | None = None,
) -> ReadingFaults:
    """Mark the faults that can be detected from a single reading, and from the LSB of each chip if it is known.

    A field that needs more than 16 bits is impossible; such numbers come from torn lines of text. A field at the end of
    the range of 16 bits, or of the chip, is saturated. Unknown temperatures and LSBs (NaN) mark nothing.
    """
    size_uT = np.abs(_by_chip(b_uT))
    failed, saturated = failed_reads(b_uT, temperature_degC), (size_uT > B_MAX_uT).any(axis=2)
    if lsb_uT is not None:
        full_scale_uT = INT16_STEPS_N * lsb_uT[:, [0, 0, 1]]
        failed |= (size_uT > RANGE_MARGIN * full_scale_uT).any(axis=2)
        saturated |= (size_uT > RANGE_END * full_scale_uT).any(axis=2)
    too_hot = (temperature_degC < TEMPERATURE_MIN_degC) | (temperature_degC > TEMPERATURE_MAX_degC)
    return ReadingFaults(failed, zero_reads(b_uT), too_hot & ~failed, saturated & ~failed)


class ScaleWindow(NamedTuple):
    """The LSB of each chip, estimated from `SCALE_FRAMES_N` successive frames.

    `first_frame` is the number of the first of these frames. Numbers start at 1, and frames with failed reads have no
    number. `t_s` contains the times of all frames of the window. `unusual` marks the chips that `reset_chips` marks.
    `changed` marks the chips whose LSB differs from the first LSB that was found for the same chip.
    """

    first_frame: int
    t_s: Float64[np.ndarray, " w"]
    lsb_uT: Float[np.ndarray, "k 2"]
    expected_lsb_uT: tuple[float, float] | None
    unusual: Bool[np.ndarray, " k"]
    changed: Bool[np.ndarray, " k"]


class Faults(NamedTuple):
    """The faults in those frames that were passed to one call of `FaultDetector.feed`.

    Most fields are masks or counts with one value per frame, or with one value per frame and chip.
    """

    readings: ReadingFaults
    stuck: Bool[np.ndarray, "f k"]
    int16_wrap: Bool[np.ndarray, "f k"]
    repeated: Bool[np.ndarray, " f"]
    clock_jump: Bool[np.ndarray, " f"]
    unplug: Bool[np.ndarray, " f"]
    # number of frames that are missing before each frame, according to the board's clock
    missing_frames_n: Int[np.ndarray, " f"]
    # Number of stray bytes before each frame. If there are so many that the baud rate is probably wrong, they are
    # counted in garbage_bytes_n; otherwise, they are counted in torn_bytes_n.
    torn_bytes_n: Int[np.ndarray, " f"]
    garbage_bytes_n: Int[np.ndarray, " f"]
    scale: tuple[ScaleWindow, ...]  # the windows whose last frame is among these frames


class FaultDetector:
    """A detector of all kinds of faults in a stream of frames, which may be passed in several parts of any length.

    The detector is used for recordings and for live boards. Between two calls of `feed`, it stores fewer than
    `SCALE_FRAMES_N` frames.

    Parameters
    ----------
    chips_n : number of chips.
    frame_bytes_n : length of a binary frame in bytes; None for text frames, whose lengths vary.
    expected_lsb_uT : LSB along x and y, and LSB along z; None if they are unknown.
    steps_min_n : a chip's LSB is estimated only if at least this many gaps between neighbouring values are equal; see
        `find_lsb`.
    lsb_uT : LSB of each chip, if it is known before the first frame.
    """

    def __init__(
        self,
        chips_n: int,
        *,
        frame_bytes_n: int | None = None,
        expected_lsb_uT: tuple[float, float] | None = None,
        steps_min_n: int = SURE_STEPS_MIN_N,
        lsb_uT: Float[np.ndarray, "k 2"] | None = None,
    ) -> None:
        self._expected_lsb_uT, self._steps_min_n = expected_lsb_uT, steps_min_n
        self._frame_bytes_n = frame_bytes_n
        self._stuck, self._constant = StuckChips(chips_n), ConstantChannels(chips_n)
        self._window_uT, self._window_s = np.zeros((0, 3 * chips_n), np.float32), np.zeros(0)
        self._windowed_n = 0  # number of frames in complete windows so far
        self._lsb_uT = np.full((chips_n, 2), np.nan) if lsb_uT is None else lsb_uT  # NaN until known
        self._last_b_uT: Float[np.ndarray, "1 ch"] | None = None  # field of the last frame without a faulty reading
        # the last frame's time of arrival, its time on the board's clock, and its last byte's position in the stream
        self._last: tuple[float, float, int] | None = None

    def of_readings(self, frames: Frames) -> ReadingFaults:
        """Mark the faults of single readings, with the LSB of the chips as far as it is known."""
        return find_reading_faults(frames.b_uT, frames.temperature_degC, self._lsb_uT)

    def feed(self, frames: Frames, t_s: Float64[np.ndarray, " f"]) -> Faults:
        """Process the next frames and their times in s; return their faults."""
        b_uT, chips_n = frames.b_uT, frames.temperature_degC.shape[1]
        readings = self.of_readings(frames)
        if self._frame_bytes_n is None:  # bytes that are lost inside a binary frame shift all others, so it is no frame
            whole = np.flatnonzero(~readings.failed_rows)
            readings.failed_read[whole[lone_jumps(b_uT[whole])]] = True
        temperatures = np.isfinite(frames.temperature_degC)  # a board may send none
        complete = temperatures.all(axis=1) | ~temperatures.any(axis=1)
        read = np.isfinite(b_uT).all(axis=1) & complete & ~readings.failed_rows
        sound = ~readings.faulty_rows
        scale = self._find_scale(b_uT[read], t_s[read])
        stuck, int16_wrap = np.zeros((2, len(frames), chips_n), bool)
        repeated = np.zeros(len(frames), bool)
        stuck[read] = self._stuck.feed(b_uT[read])
        stuck[~sound] = False
        if sound.any():
            # The first frame of the stream has no frame before it. It is compared with a field that differs by 1 uT, so
            # that it does not count as a repeated frame.
            last_uT = b_uT[sound][:1] + 1 if self._last_b_uT is None else self._last_b_uT
            step_uT = np.diff(b_uT[sound], axis=0, prepend=last_uT)
            self._last_b_uT = b_uT[sound][-1:]
            # The field jumps by more than 2^15 LSB if the firmware stores it as an int16 that overflows.
            wrapped = np.abs(_by_chip(step_uT)) > INT16_STEPS_N * self._lsb_uT[:, [0, 0, 1]]
            int16_wrap[sound] = wrapped.any(axis=2)
            repeated[sound] = repeated_frames(step_uT)
        self._constant.feed(b_uT[sound])
        return Faults(readings, stuck, int16_wrap, repeated, *self._find_gaps(frames, t_s), scale)

    def constant_channels(self) -> list[str]:
        """List the channels that have never changed so far; see `ConstantChannels`."""
        return self._constant.describe()

    def _find_scale(self, b_uT: Float[np.ndarray, "f ch"], t_s: Float64[np.ndarray, " f"]) -> tuple[ScaleWindow, ...]:
        """Estimate the LSB of each chip in every window that the next frames complete."""
        pending_uT, pending_s = np.concatenate([self._window_uT, b_uT]), np.concatenate([self._window_s, t_s])
        windows = []
        complete_n = len(pending_uT) // SCALE_FRAMES_N * SCALE_FRAMES_N
        for first in range(0, complete_n, SCALE_FRAMES_N):
            rows = slice(first, first + SCALE_FRAMES_N)
            lsb_uT = find_lsb(pending_uT[rows], steps_min_n=self._steps_min_n)
            changed = np.any(np.abs(lsb_uT / self._lsb_uT - 1) > LSB_TOLERANCE, axis=1)
            unusual = reset_chips(lsb_uT, self._expected_lsb_uT)
            first_frame = self._windowed_n + 1
            windows.append(ScaleWindow(first_frame, pending_s[rows], lsb_uT, self._expected_lsb_uT, unusual, changed))
            self._windowed_n += SCALE_FRAMES_N
            self._lsb_uT = np.where(np.isnan(self._lsb_uT), lsb_uT, self._lsb_uT)
        self._window_uT, self._window_s = pending_uT[complete_n:].copy(), pending_s[complete_n:].copy()
        return tuple(windows)

    def _find_gaps(
        self, frames: Frames, t_s: Float64[np.ndarray, " f"]
    ) -> tuple[
        Bool[np.ndarray, " f"], Bool[np.ndarray, " f"], Int[np.ndarray, " f"], Int[np.ndarray, " f"],
        Int[np.ndarray, " f"],
    ]:  # fmt: skip
        """Find the faults between each frame and the frame before it, from their times and positions in the stream.

        Returns the fields `clock_jump`, `unplug`, `missing_frames_n`, `torn_bytes_n` and `garbage_bytes_n` of `Faults`.
        """
        if not len(frames):
            return *np.zeros((2, 0), bool), *np.zeros((3, 0), np.int64)
        last_s, last_device_s, last_byte = self._last or (float(t_s[0]), float(frames.device_s[0]), 0)
        self._last = float(t_s[-1]), float(frames.device_s[-1]), int(frames.end_byte[-1])
        device_step_s, step_s = clock_steps(frames.device_s, last_device_s), np.diff(t_s, prepend=last_s)
        # Between two frames, the rounded time may be wrong by the resolution.
        counts_frames = clock_resolution_s(frames.device_s) < (MISSING_STEPS - 1) / 3 * np.median(device_step_s)
        usual_s = np.median(step_s[np.isfinite(step_s)]) if np.isfinite(step_s).any() else np.inf
        length_n = np.diff(frames.end_byte, prepend=last_byte)
        usual_n = self._frame_bytes_n or int(np.median(length_n))
        lost_n = length_n - usual_n
        if self._frame_bytes_n is None:  # the lengths of lines vary
            lost_n = np.where(length_n > LONG_LINE * usual_n, lost_n, 0)
        garbage = lost_n > GARBAGE_FRAMES_N * usual_n
        return (
            clock_jumps(device_step_s),
            np.asarray(step_s > max(SILENCE_S, SILENCE_STEPS * usual_s)),
            missing_frames(device_step_s) if counts_frames else np.zeros(len(device_step_s), np.int64),
            np.where(garbage, 0, lost_n),
            np.where(garbage, lost_n, 0),
        )
