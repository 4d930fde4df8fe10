"""Tests that a row which is missing in one of the two files of layout `ini` is detected, and that complete files raise
no alarm.

After the missing row, each field would be paired with the label of a neighbouring row.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.readers import ini
from reskin.recordings.readers.alignment import find_change
from reskin.seeds import rng_for
from tests.recordings.headers import DEFAULT_POLICY, make_header
from tests.sizes import size

PUBLIC = ("artillery_AFG_board2_50_screw", "artillery_AFG_board1_50")
AT_END_ROWS_N = 100  # A missing row that is nearer to the start or the end than this may remain undetected.
# The reported row number may be wrong by this much. In 60 cases of public recordings, it is wrong by at most 5.
ROW_OFF_MAX = 15
LATE_N = 1


def synthetic_recording(seed: int = 0, passes_n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Return synthetic fields and labels, as recorded with a printer and a force gauge.

    |dB| is 70 uT, and the noise is 25 uT. The no-load field drifts, and the fields are one row late.
    """
    rng = rng_for(seed, "lateness")
    places_mm = np.stack(np.meshgrid(np.arange(2, 19, 4.0), np.arange(2, 19, 4.0)), axis=-1).reshape(-1, 2)
    # Each place has this number of rows. The first row is without contact, and the depth increases in the following
    # rows.
    presses_n = rng.integers(3, 8, len(places_mm))
    of_place = np.repeat(np.arange(len(places_mm)), presses_n)
    step = np.concatenate([np.arange(n) for n in presses_n])
    force_N = np.where(step == 0, 0.0, 0.4 * step)
    label = np.column_stack([places_mm[of_place], force_N])
    label[force_N == 0, :2] = 10  # The recorder writes this place in rows without contact.
    one_pass_uT = rng.normal(0, 18, (len(places_mm), 15))[of_place] * np.sqrt(force_N)[:, None]
    label, b_uT = (np.tile(one, (passes_n, 1))[: 100 * passes_n] for one in (label, one_pass_uT))
    drift_uT = np.linspace(0, 60, len(label))[:, None]
    b_uT = np.roll(b_uT, LATE_N, axis=0) + drift_uT + rng.normal(0, 25 / np.sqrt(15), b_uT.shape)
    return b_uT, label


def without_row(values: np.ndarray, row: int) -> np.ndarray:
    """Delete a row. The last row is repeated, so that the number of rows stays the same."""
    return np.concatenate([np.delete(values, row, axis=0), values[-1:]])


def change_of(b_uT: np.ndarray, label: np.ndarray):
    return find_change(b_uT, label, label[:, 2] > 0.02, np.ones(len(label), bool))


@settings(max_examples=25)
@given(st.integers(AT_END_ROWS_N, 1200 - AT_END_ROWS_N), st.booleans(), st.integers(0, 5))
def test_missing_row_is_found_in_the_file_of_readings_and_in_that_of_labels(row, in_fields, seed):
    b_uT, label = synthetic_recording(seed)
    assert len(label) == 1200
    change = change_of(without_row(b_uT, row), label) if in_fields else change_of(b_uT, without_row(label, row))
    assert change is not None
    assert change.after - change.before == (-1 if in_fields else 1)
    assert abs(change.row - row) <= ROW_OFF_MAX


@settings(max_examples=25)
@given(st.integers(0, 100), st.integers(1, 12), st.integers(0, 3))
def test_complete_recording_raises_no_alarm(seed, passes_n, further_late_n):
    b_uT, label = synthetic_recording(seed, passes_n)
    assert change_of(np.roll(b_uT, further_late_n, axis=0), label) is None


def test_no_alarm_is_raised_if_fields_or_forces_do_not_depend_on_the_press():
    b_uT, label = synthetic_recording()
    assert change_of(np.zeros_like(b_uT), label) is None
    assert change_of(rng_for(0, "noise").normal(0, 5, b_uT.shape), label) is None
    no_contact = label * [1, 1, 0]
    assert change_of(b_uT, no_contact) is None
    same_force = np.column_stack([label[:, :2], np.ones(len(label))])
    assert change_of(b_uT, same_force) is None


def test_ini_recording_with_a_missing_row_is_refused(tmp_path):
    b_uT, label = synthetic_recording()
    chips = np.concatenate([without_row(b_uT, 700).reshape(-1, 5, 3), np.full((1200, 5, 1), 25.0)], axis=2)
    # The reader checks that values are multiples of the step of a chip.
    chips[..., :3] = np.round(chips[..., :3] / [0.15, 0.15, 0.242]) * [0.15, 0.15, 0.242] + [600, -900, 1452]
    np.savetxt(tmp_path / ini.READINGS, chips.reshape(1200, -1), fmt="%.3f")
    np.savetxt(tmp_path / ini.TRUTHS, label, fmt="%.3f")
    with pytest.raises(CaptureError) as caught:
        ini.read(tmp_path, make_header(layout="ini", chips_n=5), DEFAULT_POLICY)
    message = str(caught.value)
    found = re.search(r"by 1 rows before about row (\d+), by 0 from there on. 1 row of readings seem", message)
    assert found is not None
    assert abs(int(found[1]) - 701) <= ROW_OFF_MAX


@pytest.mark.parametrize("name", PUBLIC)
def test_public_recordings_raise_no_alarm_unless_a_row_is_deleted(shared_data: Path, name):
    folder = shared_data / "ini"
    label = np.loadtxt(folder / f"truths_{name}.txt")
    values = np.loadtxt(folder / f"b20_{name}.txt").reshape(len(label), -1, 4)
    b_uT = values[..., :3].reshape(len(label), -1)
    assert len(label) == 23_300
    assert change_of(b_uT, label) is None
    for row in size((150, 1_000, 5_000, 11_650, 18_165, 23_200), (150, 23_200)):
        for changed in ((without_row(b_uT, row), label), (b_uT, without_row(label, row))):
            change = change_of(*changed)
            assert change is not None
            assert abs(change.row - row) <= ROW_OFF_MAX
