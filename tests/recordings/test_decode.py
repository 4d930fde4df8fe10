"""Tests of the times of decoded frames on the board's clock."""

import numpy as np
import pytest

from reskin.recordings.decode import BoardClock

RATE_HZ = 400.0


@pytest.mark.parametrize(
    ("start_s", "coarse"),
    [(0.0, False), (71.5 * 60, False), (8 * 3600.0, True), (30 * 3600.0, True)],
    ids=["start", "micros", "8h", "30h"],
)
@pytest.mark.parametrize("parts_n", [1, 7])
def test_board_times_increase_over_the_wrap_of_micros_and_after_hours(start_s, coarse, parts_n):
    """The time in s is sent as float32; micros() starts again from 0 after 71.6 minutes, and millis() after 50 days."""
    sent_s = start_s + np.arange(4000) / RATE_HZ
    wrap_s = 2**32 / 1e6 if start_s < 2**32 / 1e6 else np.inf
    device_s = np.where(sent_s < wrap_s, sent_s, sent_s - wrap_s).astype(np.float32)
    end_byte = 86 * (1 + np.arange(4000))
    clock = BoardClock()
    t_s = np.concatenate(
        [
            clock.times_of(*part)
            for part in zip(
                np.array_split(device_s.astype(float), parts_n), np.array_split(end_byte, parts_n), strict=True
            )
        ]
    )
    assert (np.diff(t_s) > 0).all()
    assert np.abs(t_s - sent_s).max() <= np.spacing(np.float32(device_s.max())) + 1e-9
    assert (clock.account.get("coarse_clock_frames_n", 0) == 4000) == coarse
