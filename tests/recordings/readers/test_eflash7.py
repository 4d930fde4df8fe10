"""Tests of the reader of layout `eflash7`, in which places have numbers instead of coordinates."""

from pathlib import Path

import numpy as np
import pytest

from reskin.board.faults import FAILED_B_uT
from reskin.errors import CaptureError
from reskin.recordings.header import Header
from reskin.recordings.readers import eflash7
from tests.recordings.headers import DEFAULT_POLICY, make_header

CHIPS_N = 2
STEP_uT = 2.4  # The readings of the recorded chips along x and y are multiples of this step (LSB).
FIELDS = [f"mag{chip}_{axis}" for chip in range(CHIPS_N) for axis in "xyz"]
NAMES = ["timestamp", "position", "x_pos", "y_pos", "fx", "fy", "fz", "tx", *FIELDS]
NAMES_OF_TWO = ["timestamp", "fz", "ty", "pos1_x", "pos1_y", "pos2_x", "pos2_y", *FIELDS]
HEADER = make_header(layout="eflash7", chips_n=CHIPS_N, contacts_before_n=7)
# These are the fields of the rows, in steps. In order of the rows, there is no touch, a touch, no touch, and a touch
# that begins with a row of zeros (None).
LEVELS = [0, 1, 0, 1, 0, 1, 40, 80, 41, 2, 1, None, 90]
GAUGE_N = [0.1, 0.1, 0.1, 0.1, 0.1, 0.1, -0.9, -1.9, -0.9, 0.1, 0.1, -0.4, -2.4]


def rows_of(place: str, template: str) -> list[str]:
    """Return the lines of one place or pair of places.

    `template` is formatted with the place and the force fz of each row.
    """
    lines = []
    for row_i, (level, fz_N) in enumerate(zip(LEVELS, GAUGE_N, strict=True)):
        b_uT = [0.0] * len(FIELDS) if level is None else [STEP_uT * (level + 5 * i + 1) for i in range(len(FIELDS))]
        cells = [f"{100 + 0.1 * row_i:.1f}", *[word.format(place=place, fz=fz_N) for word in template.split()]]
        lines.append(",".join([*cells, *(f"{one:.2f}" for one in b_uT)]))
    return lines


ONE = rows_of("6,3,2", "{place} 0.2,0.3,{fz},0.01")
TWO = rows_of("3,1,2,3", "{fz},0.01 {place}")


def write(folder: Path, rows: list[str] = ONE, names: list[str] = NAMES) -> Path:
    (folder / eflash7.READINGS).write_text("\n".join([",".join(names), *rows]) + "\n")
    return folder


def error_of(folder: Path, header: Header = HEADER) -> str:
    with pytest.raises(CaptureError) as caught:
        eflash7.read(folder, header, DEFAULT_POLICY)
    message = str(caught.value)
    assert "\n" not in message
    assert eflash7.READINGS in message
    return message


def test_readings_begin_with_the_first_touch(tmp_path: Path) -> None:
    readings, account = eflash7.read(write(tmp_path), HEADER, DEFAULT_POLICY)
    assert readings.t_s.tolist() == [100.6, 100.7, 100.8, 100.9, 101.0, 101.2]
    np.testing.assert_allclose(readings.b_uT[:, 0], STEP_uT * np.array([41, 81, 42, 3, 2, 91]), rtol=1e-6)
    # The no-load field is the mean of the six rows before the first touch. They have 1 and 2 steps in turn.
    np.testing.assert_allclose(readings.noload_uT[:, 0], 1.5 * STEP_uT, rtol=1e-6)
    assert account["noload_rows_n"] == 6


def test_rows_of_zeros_are_dropped_and_counted(tmp_path: Path) -> None:
    _, account = eflash7.read(write(tmp_path), HEADER, DEFAULT_POLICY)
    dropped_n = sum(count for name, count in account.items() if name.startswith("dropped_"))
    assert account["dropped_zero_rows_n"] == dropped_n == 1
    assert account["rows_n"] + account["noload_rows_n"] + dropped_n == account["rows_read_n"] == len(LEVELS)


def test_row_numbers_of_faults_count_the_rows_of_the_file(tmp_path: Path) -> None:
    failed = ",".join([*ONE[-1].split(",")[:-3], *map(str, FAILED_B_uT)])
    _, account = eflash7.read(write(tmp_path, [*ONE[:-1], failed]), HEADER, DEFAULT_POLICY)
    assert account["fault_zeros_of_all_chips_first_row"] == len(ONE) - 1
    assert account["fault_failed_read_first_row"] == account["fault_failed_read_last_row"] == len(ONE)


def test_rows_of_zeros_are_counted_separately_for_one_chip_and_for_all_chips(tmp_path: Path) -> None:
    one_chip = ",".join([*ONE[-1].split(",")[:-3], "0.0", "0.0", "0.0"])
    _, account = eflash7.read(write(tmp_path, [*ONE[:-1], one_chip]), HEADER, DEFAULT_POLICY)
    assert (account["fault_zeros_of_all_chips_dropped_n"], account["fault_zeros_dropped_n"]) == (1, 1)
    assert (account["dropped_zero_rows_n"], account["dropped_failed_read_rows_n"]) == (1, 1)
    assert account["fault_zeros_first_row"] == account["fault_zeros_last_row"] == len(ONE)


def test_forces_are_relative_to_the_start_and_positive_under_compression(tmp_path: Path) -> None:
    readings, account = eflash7.read(write(tmp_path), HEADER, DEFAULT_POLICY)
    # The tolerance is rounding to single precision.
    np.testing.assert_allclose(readings.Fz_N, [1, 2, 1, 0, 0, 2.5], atol=1e-6)
    np.testing.assert_allclose(readings.Fx_N, 0, atol=1e-7)
    assert account["force_sign_unknown_rows_n"] == 6


def test_new_indentation_begins_where_the_force_rises(tmp_path: Path) -> None:
    readings, _ = eflash7.read(write(tmp_path), HEADER, DEFAULT_POLICY)
    assert readings.indentation.tolist() == [0, 0, 0, 0, 0, 1]
    assert readings.n_contacts.tolist() == [7, 7, 7, 7, 7, 8]


def test_numbered_places_have_no_coordinates(tmp_path: Path) -> None:
    for rows, names, places in ((ONE, NAMES, {6}), (TWO, NAMES_OF_TWO, {3, 8})):
        readings, account = eflash7.read(write(tmp_path, rows, names), HEADER, DEFAULT_POLICY)
        assert np.isnan([readings.x_mm, readings.y_mm, readings.depth_mm]).all()
        assert {n for n in range(1, 10) if f"place_{n}_rows_n" in account} == places
        assert all(account[f"place_{n}_rows_n"] == account["rows_n"] for n in places)


def test_sideways_forces_are_unknown_if_two_places_are_touched_at_once(tmp_path: Path) -> None:
    readings, account = eflash7.read(write(tmp_path, TWO, NAMES_OF_TWO), HEADER, DEFAULT_POLICY)
    assert np.isnan(readings.Fx_N).all()
    assert readings.Fz_N.max() == np.float32(2.5)
    assert account["force_sign_unknown_rows_n"] == 0


def test_missing_and_repeated_rows_are_counted(tmp_path: Path) -> None:
    rows = [*ONE[:10], ONE[9].replace("100.9", "103.9"), *[row.replace("101.", "104.") for row in ONE[10:]]]
    _, account = eflash7.read(write(tmp_path, rows), HEADER, DEFAULT_POLICY)
    assert (account["gap_rows_n"], account["repeated_rows_n"]) == (1, 1)


def with_line_changed(line_n: int, old: str, new: str) -> list[str]:
    return [row.replace(old, new) if row_i + 2 == line_n else row for row_i, row in enumerate(ONE)]


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (with_line_changed(4, "3,2", "3,1"), "the place changes in line 4"),
        (
            [row.replace("6,3,2", "6,12.5,8") for row in ONE],
            "columns and rows of a grid, numbered from 1 to 3; got [12.5, 8.0]",
        ),
        (with_line_changed(5, "100.3", "100.1"), "timestamp does not increase in line 5"),
        (with_line_changed(8, "-0.9", "-356"), "in line 8. If the unit of the file is g"),
        (with_line_changed(8, "-0.9", "nan"), "fz in line 8"),
        (ONE[5:], "fewer than 5 rows come before the first touch"),
        (
            [ONE[11].replace("101.1", f"{90 + i}") for i in range(9)] + ONE,
            "10 of 22 rows contain only zeros, but at most 25%",
        ),
    ],
)
def test_invalid_rows_are_refused(tmp_path: Path, rows: list[str], expected: str) -> None:
    assert expected in error_of(write(tmp_path, rows))


def test_file_with_the_wrong_sign_of_forces_is_refused(tmp_path: Path) -> None:
    rows = [row.replace(",-", ",") for row in ONE]
    assert "the strongest fz must be negative" in error_of(write(tmp_path, rows))


def test_pair_of_equal_places_is_refused(tmp_path: Path) -> None:
    rows = rows_of("3,1,3,1", "{fz},0.01 {place}")
    assert "both places are the same, place 3" in error_of(write(tmp_path, rows, NAMES_OF_TWO))


def test_fields_in_millitesla_are_refused(tmp_path: Path) -> None:
    cells = ONE[0].split(",")
    fields_mT = [[1e-3 * STEP_uT * (level + 5 * i) for i in range(len(FIELDS))] for level in range(40)]
    rows = [",".join([f"{i}", *cells[1:8], *(f"{b:.5f}" for b in row)]) for i, row in enumerate(fields_mT)]
    assert "Convert the field changes to uT" in error_of(write(tmp_path, rows))


def test_recording_is_copied_under_the_name_that_the_reader_expects(tmp_path: Path) -> None:
    recording = tmp_path / "position_6.csv"
    recording.write_text(f"{','.join(NAMES)}\n{ONE[0]}\n")
    files = eflash7.collect(recording)
    assert files == {eflash7.READINGS: recording}
    assert eflash7.count_chips(files) == CHIPS_N
    with pytest.raises(CaptureError, match="one CSV file"):
        eflash7.collect(tmp_path)
