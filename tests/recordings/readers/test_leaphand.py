"""Tests of the reader of layout `leaphand`, which contains recordings of a moving hand without contact.

The hand has several pads. Joint positions are recorded with the fields.
"""

from pathlib import Path

import numpy as np
import pytest

from reskin.board.faults import FAILED_B_uT
from reskin.errors import CaptureError
from reskin.recordings.header import Header
from reskin.recordings.readers import leaphand
from reskin.seeds import rng_for
from tests.recordings.headers import DEFAULT_POLICY, make_header

PADS_N, ROWS_N = 2, 12
STEP_uT = 0.6
HEADER = make_header(layout="leaphand", options={"pad": "2"}, contacts_before_n=7)


def numbers(rows_n: int = ROWS_N, pads_n: int = PADS_N) -> np.ndarray:
    """Return rows of a hand.

    In the first row, the hand is in another pose. Then it rests for five rows, and after these it moves.
    """
    steps = rng_for(0, "leaphand").integers(-20, 20, (rows_n, leaphand.CHANNELS_N * pads_n))
    joints = np.tile(2000 + 100 * np.arange(leaphand.JOINTS_N * pads_n), (rows_n, 1))
    joints[0] -= 300
    joints[6:, 1] += 60 * np.arange(1, rows_n - 5)
    return np.hstack([STEP_uT * steps, joints])


def write(folder: Path, rows: np.ndarray | None = None) -> Path:
    np.savetxt(folder / leaphand.READINGS, numbers() if rows is None else rows)
    return folder


def error_of(folder: Path, header: Header = HEADER) -> str:
    with pytest.raises(CaptureError) as caught:
        leaphand.read(folder, header, DEFAULT_POLICY)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_rows_after_the_hand_has_rested_become_readings_without_contact(tmp_path):
    rows = numbers()
    readings, account = leaphand.read(write(tmp_path, rows), HEADER, DEFAULT_POLICY)
    own_uT = rows[:, leaphand.CHANNELS_N : 2 * leaphand.CHANNELS_N]
    # The relative tolerance is that of single precision.
    np.testing.assert_allclose(readings.b_uT, own_uT[6:], rtol=1e-6)
    np.testing.assert_allclose(readings.noload_uT, np.tile(own_uT[1:6].mean(axis=0), (6, 1)), rtol=1e-5, atol=1e-5)
    assert readings.reading_i.tolist() == [0, 1, 2, 3, 4, 5]
    assert set(readings.Fz_N) == {0}
    assert np.isnan([readings.x_mm, readings.y_mm, readings.depth_mm, readings.t_s]).all()
    assert set(readings.n_contacts) == {7}
    assert account["noload_rows_n"] == 5
    assert account["dropped_before_noload_rows_n"] == 1
    assert account["ignored_pads_n"] == 1


def test_motion_contains_the_joint_positions_of_the_readings(tmp_path):
    rows = numbers()
    motion = leaphand.read_motion(write(tmp_path, rows), HEADER, DEFAULT_POLICY)
    np.testing.assert_array_equal(motion.joint_counts, rows[6:, PADS_N * leaphand.CHANNELS_N :])
    np.testing.assert_allclose(motion.noload_uT, rows[1:6, leaphand.CHANNELS_N : 2 * leaphand.CHANNELS_N])


@pytest.mark.parametrize("row_i", [0, 3, 8])
def test_rows_with_failed_reads_are_counted(tmp_path, row_i):
    rows = numbers()
    rows[row_i, leaphand.CHANNELS_N : leaphand.CHANNELS_N + 3] = FAILED_B_uT
    readings, account = leaphand.read(write(tmp_path, rows), HEADER, DEFAULT_POLICY)
    dropped_n = sum(count for name, count in account.items() if name.startswith("dropped_"))
    assert account["rows_n"] + account["noload_rows_n"] + dropped_n == account["rows_read_n"] == ROWS_N
    assert account["dropped_failed_read_rows_n"] == 1
    motion = leaphand.read_motion(tmp_path, HEADER, DEFAULT_POLICY)
    assert len(motion.joint_counts) == len(readings) == account["rows_n"]
    assert len(motion.noload_uT) == account["noload_rows_n"]


def with_joints(change: object, row_i: int = 4) -> np.ndarray:
    rows = numbers()
    rows[row_i, -1] = change
    return rows


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (numbers()[:, :-1], "the number of columns must be 15 fields and 4 joint positions .*; got 37"),
        (np.hstack([numbers(pads_n=4), numbers(pads_n=1)]), "the number of columns .*; got 95"),
        (with_joints(1.57), "joint 8 in line 5.* must be whole numbers from 0 to 4095; got 1.57"),
        (with_joints(4096), "joint 8 in line 5.* got 4096"),
        (numbers()[:6], "no 5 successive rows, followed by others, in which every joint stays within 50 counts"),
        (numbers() * np.r_[np.full(30, 1e5), np.ones(8)], "field must be below the full scale"),
    ],
)  # fmt: skip
def test_invalid_rows_of_a_hand_are_refused(tmp_path, rows, expected):
    with pytest.raises(CaptureError, match=f"{leaphand.READINGS}: {expected}"):
        leaphand.read(write(tmp_path, rows), HEADER, DEFAULT_POLICY)


@pytest.mark.parametrize(("options", "got"), [({}, "none"), ({"pad": "0"}, "0"), ({"pad": "3"}, "3")])
def test_pad_that_is_not_in_the_file_is_refused(tmp_path, options, got):
    header = make_header(layout="leaphand", options=options)
    assert f"option pad must be 1 to 2, the number of pads in the file; got {got}" in error_of(write(tmp_path), header)


def test_folder_instead_of_a_file_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="not a file"):
        leaphand.collect(tmp_path)
    write(tmp_path)
    assert leaphand.count_chips(leaphand.collect(tmp_path / leaphand.READINGS)) == leaphand.CHIPS_N
