"""Real recordings at work: what was broken is named as the recordings show it, and a sound board raises no alarm."""

import numpy as np
import pytest

from reskin.board.wire import Frames
from reskin.live.health import Health

RATE_HZ = 100.0
RESET, FAILED = "another step than the others: reset", "failed I2C reads"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("b20_artillery_AFG_board2_50_screw.txt", []),
        ("norm_b20_artillery_AFG_board2_50_screw.txt", []),
        ("faults/b20_artillery_AFG_flex_50.head400.txt", [f"chip {i}: {FAILED}" for i in range(5)]),
        ("faults/b20_artillery_AFG_test_new_board15.head400.txt", [f"chip 3: {RESET}"]),
        ("faults/b20_artillery_piezo.head400.txt", [f"chip {i}: {RESET}" for i in range(5)]),
    ],
)
def test_a_recordings_faults_are_told_and_nothing_else(shared_data, name, told):
    chips = np.loadtxt(shared_data / "ini" / name, dtype=np.float32).reshape(-1, 5, 4)
    b_uT, temperature_degC = chips[..., :3].reshape(len(chips), -1), chips[..., 3]
    health = Health(5)
    for first in range(0, len(chips), 5):
        rows = slice(first, first + 5)
        unknown = np.full(len(b_uT[rows]), np.nan), np.zeros(len(b_uT[rows]), np.int64)
        health.feed(Frames(b_uT[rows], temperature_degC[rows], *unknown), first / RATE_HZ)
    assert sorted(health.alarms) == told
