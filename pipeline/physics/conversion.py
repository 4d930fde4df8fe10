"""When a chip took the reading that a frame brings. In: frames' times, the chips' conversion time. Out: how old it is.

Each chip converts on its own, over and over; a frame brings the last finished conversion, so two chips of one frame are
not simultaneous, and frames repeat when they outrun the chip (FACTS 2). Refuses to know fields.
"""

import numpy as np
from jaxtyping import Float, Int

CONVERSION_S = 1.84e-3  # MLX90393 at OSR 0, DIG_FILT 2 (data sheet)


def last_conversions(
    frame_s: Float[np.ndarray, " f"], phase_s: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "f k"], Int[np.ndarray, "f k"]]:
    """Give the age in s of each chip's reading, and the first frame (index) that brought the same one."""
    conversion = np.floor((frame_s[:, None] - phase_s) / CONVERSION_S)
    age_s = frame_s[:, None] - phase_s - conversion * CONVERSION_S
    fresh = np.ones(conversion.shape, bool)
    fresh[1:] = conversion[1:] != conversion[:-1]
    here = np.arange(len(frame_s))[:, None]
    return age_s, np.maximum.accumulate(np.where(fresh, here, 0), axis=0)


def seen_at(
    value: Float[np.ndarray, "f k a"], age_s: Float[np.ndarray, "f k"], rate_hz: float
) -> Float[np.ndarray, "f k a"]:
    """Give what each chip saw `age_s` before its frame, on a straight line between frames at a constant rate."""
    frames_n, chips_n = age_s.shape
    place = np.maximum(np.arange(frames_n)[:, None] - age_s * rate_hz, 0.0)
    before = np.minimum(place.astype(np.intp), max(frames_n - 2, 0))
    after = np.minimum(before + 1, frames_n - 1)
    share = (place - before)[:, :, None]
    chip = np.arange(chips_n)
    return (1 - share) * value[before, chip] + share * value[after, chip]
