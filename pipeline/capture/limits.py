"""What a sound board does not send, frame by frame. In: readings, times, places of bytes. Out: masks of frames.

Beside `faults`, which knows what broken chips send. Refuses to decide what becomes of a frame (`decisions`).
"""

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from pipeline.capture.stream import TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC

B_MAX_uT = 49_000.0  # an MLX90393 measures up to 50 mT (data sheet)
INT16_STEPS_N = 2**15
CLOCK_STEP_MAX_S = 1.0
REPEATED_LOOK_N, REPEATED_SHARE = 40, 0.4  # assumed: so many of so many frames, which is a tenth of a second at 400 Hz
MISSING_STEPS = 1.6  # of the usual step of the board's clock
SILENCE_S = 1.0
SILENCE_STEPS = 50.0  # of the usual time between two frames: a slow log is not silent
GARBAGE_FRAMES_N = 10  # so many frames' bytes in a row that are none are no torn frame
LONG_LINE = 1.5  # of the usual length of a line of text


def too_hot(temperature_degC: Float[np.ndarray, "f k"]) -> Bool[np.ndarray, "f k"]:
    """Mark temperatures out of the chip's range; unknown ones are not."""
    return (temperature_degC < TEMPERATURE_MIN_degC) | (temperature_degC > TEMPERATURE_MAX_degC)


def saturated(b_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, "f k"]:
    """Mark the readings of a chip that are at the end of its range."""
    return np.asarray((np.abs(b_uT) > B_MAX_uT).reshape(len(b_uT), b_uT.shape[1] // 3, 3).any(axis=2))


def wrapped(step_uT: Float[np.ndarray, "f ch"], lsb_uT: Float[np.ndarray, "k 2"]) -> Bool[np.ndarray, "f k"]:
    """Mark steps from frame to frame that int16 does not hold; of a chip whose LSB is not known, none."""
    wrap_uT = INT16_STEPS_N * lsb_uT[:, [0, 0, 1]]
    return np.asarray((np.abs(step_uT.reshape(len(step_uT), -1, 3)) > wrap_uT).any(axis=2))


def repeated(step_uT: Float[np.ndarray, "f ch"]) -> Bool[np.ndarray, " f"]:
    """Mark frames that are the one before again, where that is many: a loop may outrun the chips now and then."""
    same = np.asarray((step_uT == 0).all(axis=1))
    if len(same) < REPEATED_LOOK_N:
        return np.zeros(len(same), bool)
    share = np.convolve(same, np.full(REPEATED_LOOK_N, 1 / REPEATED_LOOK_N), mode="same")
    return np.asarray(same & (share > REPEATED_SHARE))


def clock_jumps(device_step_s: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Mark steps of the board's clock that no loop takes."""
    return np.asarray((device_step_s < 0) | (device_step_s > CLOCK_STEP_MAX_S))


def missing(device_step_s: Float[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Count the frames that are missing before each, by the board's clock; without one nothing tells."""
    usual_s = np.median(device_step_s) if len(device_step_s) else np.nan
    if not usual_s > 0:
        return np.zeros(len(device_step_s), np.int64)
    late = (device_step_s > MISSING_STEPS * usual_s) & ~clock_jumps(device_step_s)
    return np.where(late, np.rint(device_step_s / usual_s) - 1, 0).astype(np.int64)


def silences(step_s: Float64[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Mark frames before which nothing came for a second or more: unplugged, or stalled."""
    usual_s = np.median(step_s[np.isfinite(step_s)]) if np.isfinite(step_s).any() else np.inf
    return np.asarray(step_s > max(SILENCE_S, SILENCE_STEPS * usual_s))


def lost_before(end_byte: Int[np.ndarray, " f"], first_byte: int, frame_bytes_n: int | None) -> Int[np.ndarray, " f"]:
    """Count the bytes before each frame that are none; without a frame's length (text) the usual line tells."""
    length_n = np.diff(end_byte, prepend=first_byte)
    if frame_bytes_n is not None:
        return length_n - frame_bytes_n
    usual_n = int(np.median(length_n)) if len(length_n) else 0
    return np.where(length_n > LONG_LINE * usual_n, length_n - usual_n, 0)
