"""Tests of the reader of layout `ini`, in which two text files become passes over a raster of places.

One file has the readings of the chips, the other one the labels. The fields can be some rows late.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.header import Firmware, Header
from reskin.recordings.readers import ini
from tests.recordings.headers import DEFAULT_POLICY, make_header

CHIPS_N = 3
LSB_XY_uT, LSB_Z_uT = 0.15, 0.242
HEADER = make_header(layout="ini", chips_n=CHIPS_N, contacts_before_n=7)

# These are the labels of one pass. It begins with two rows without contact at the corner, one of which still has the
# label of the last place. Then follow the presses. One press is too weak for the gauge.
ONE_PASS = [
    (2.0, 2.0, 0.0),
    (10.0, 10.0, 0.0),
    (2.0, 4.0, 0.08),
    (2.0, 4.0, 0.3),
    (10.0, 10.0, 0.0),
    (4.0, 2.0, 0.52),
    (10.0, 10.0, 1.5),
    (18.0, 18.0, 0.019),
]
FAILED = "8028.16 5194.0 12943.36 -880.49"


def chip_line(row_i: int, chip_i: int, lsb_xy_uT: float = LSB_XY_uT, lsb_z_uT: float = LSB_Z_uT) -> str:
    """Return the text X, Y, Z, T of a chip.

    The field of each row is one step (LSB) larger than that of the row before.
    """
    steps = 1000 + row_i + 100 * chip_i
    return f"{steps * lsb_xy_uT:.2f} {(steps + 1) * lsb_xy_uT:.2f} {(steps + 2) * lsb_z_uT:.2f} {28 + chip_i}.5"


def reading_line(row_i: int) -> str:
    return " ".join(chip_line(row_i, chip_i) for chip_i in range(CHIPS_N))


def field_uT(row_i: int) -> np.ndarray:
    numbers = np.array(reading_line(row_i).split(), float).reshape(CHIPS_N, 4)
    return numbers[:, :3].ravel()


def write(folder: Path, truths: list[tuple[float, float, float]]) -> Path:
    (folder / ini.READINGS).write_text("".join(f"{reading_line(i)}\n" for i in range(len(truths))))
    (folder / ini.TRUTHS).write_text("".join(f"{x} {y} {force}\n" for x, y, force in truths))
    return folder


def edit(path: Path, line_n: int, line: str) -> None:
    lines = path.read_text().splitlines()
    lines[line_n - 1] = line
    path.write_text("".join(f"{row}\n" for row in lines))


def error_of(folder: Path, header: Header = HEADER) -> str:
    with pytest.raises(CaptureError) as caught:
        ini.read(folder, header, DEFAULT_POLICY)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_every_row_becomes_a_press_of_its_pass(tmp_path: Path) -> None:
    readings, account = ini.read(write(tmp_path, ONE_PASS * 3), HEADER, DEFAULT_POLICY)
    assert readings.pass_i.tolist() == [0] * 8 + [1] * 8 + [2] * 8
    assert account["passes_n"] == 3
    assert readings.indentation.tolist() == list(range(24))
    np.testing.assert_array_equal(readings.b_uT[3], field_uT(3).astype(np.float32))
    assert readings.temperature_degC[0].tolist() == [28.5, 29.5, 30.5]


def test_rows_without_a_force_have_no_contact_and_no_place(tmp_path: Path) -> None:
    readings, account = ini.read(write(tmp_path, ONE_PASS), HEADER, DEFAULT_POLICY)
    assert np.isnan(readings.x_mm).tolist() == [True, True, False, False, True, False, False, True]
    assert np.isnan(readings.y_mm).tolist() == np.isnan(readings.x_mm).tolist()
    np.testing.assert_array_equal(readings.Fz_N, np.float32([0, 0, 0.08, 0.3, 0, 0.52, 1.5, 0]))
    assert (readings.x_mm[6], readings.y_mm[6]) == (10, 10)
    assert account["no_contact_rows_n"] == 4
    assert readings.n_contacts.tolist() == [7, 7, 7, 8, 9, 9, 10, 11]


def test_noload_field_is_the_mean_of_the_first_rows_of_each_pass(tmp_path: Path) -> None:
    readings, account = ini.read(write(tmp_path, ONE_PASS * 2), HEADER, DEFAULT_POLICY)
    for pass_i in (0, 1):
        corner_uT = (field_uT(8 * pass_i) + field_uT(8 * pass_i + 1)) / 2
        expected = np.tile(corner_uT, (8, 1)).astype(np.float32)
        np.testing.assert_array_equal(readings.noload_uT[readings.pass_i == pass_i], expected)
    assert account["corner_rows_n"] == 4


def test_recording_in_which_no_place_repeats_is_one_pass(tmp_path: Path) -> None:
    _, account = ini.read(write(tmp_path, ONE_PASS), HEADER, DEFAULT_POLICY)
    assert account["passes_n"] == 1


def test_quantities_that_the_layout_does_not_contain_are_nan(tmp_path: Path) -> None:
    readings, _ = ini.read(write(tmp_path, ONE_PASS), HEADER, DEFAULT_POLICY)
    for name in ("depth_mm", "Fx_N", "Fy_N", "t_s"):
        assert np.isnan(getattr(readings, name)).all()


def test_pass_that_begins_in_contact_is_refused(tmp_path: Path) -> None:
    message = error_of(write(tmp_path, ONE_PASS[2:6] * 3))
    assert "truths.txt line 1: this pass does not begin with a fault-free row" in message


def test_row_with_a_failed_read_is_dropped(tmp_path: Path) -> None:
    write(tmp_path, ONE_PASS * 2)
    edit(tmp_path / ini.READINGS, 2, f"{chip_line(1, 0)} {FAILED} {chip_line(1, 2)}")
    edit(tmp_path / ini.READINGS, 4, f"{FAILED} {FAILED} {FAILED}")
    readings, account = ini.read(tmp_path, HEADER, DEFAULT_POLICY)
    assert account["dropped_failed_read_rows_n"] == 2
    assert readings.indentation.tolist() == [0, 2, *range(4, 16)]
    # The corner row with a failed read is not part of the mean of the no-load rows.
    np.testing.assert_array_equal(readings.noload_uT[0], field_uT(0).astype(np.float32))


@settings(max_examples=20, deadline=None)
@given(passes_n=st.integers(1, 4), failed=st.sets(st.integers(2, 7)))
def test_every_row_is_returned_or_counted_as_noload_or_dropped(
    tmp_path_factory: pytest.TempPathFactory, passes_n: int, failed: set[int]
) -> None:
    folder = write(tmp_path_factory.mktemp("ini"), ONE_PASS * passes_n)
    for row_i in failed:
        edit(folder / ini.READINGS, row_i + 1, f"{FAILED} {chip_line(row_i, 1)} {chip_line(row_i, 2)}")
    readings, account = ini.read(folder, HEADER, DEFAULT_POLICY)
    assert account["rows_n"] == len(readings) == 8 * passes_n - len(failed)
    dropped_n = account["dropped_failed_read_rows_n"]
    assert account["rows_n"] + account["noload_rows_n"] + dropped_n == account["rows_read_n"] == 8 * passes_n


def header_with_lateness(rows_late: str) -> Header:
    return HEADER.model_copy(update={"options": {"rows_late": rows_late}})


def write_late(folder: Path, truths: list[tuple[float, float, float]], late_n: int) -> Path:
    """Write a recording whose fields grow with the force.

    The fields are `late_n` rows late, which means that the field in a row belongs to the label of an earlier row.
    """
    write(folder, truths)
    force = [truths[max(i - late_n, 0)][2] for i in range(len(truths))]
    lines = []
    for row_i, force_N in enumerate(force):
        steps = [1000 + row_i % 7 + round(500 * force_N) + 100 * axis for axis in range(3)]
        chip = f"{steps[0] * 0.15:.2f} {steps[1] * 0.15:.2f} {steps[2] * 0.242:.2f} 28.5"
        lines.append(" ".join([chip] * CHIPS_N) + "\n")
    (folder / ini.READINGS).write_text("".join(lines))
    return folder


@settings(max_examples=10, deadline=None)
@given(late_n=st.integers(0, 5))
def test_number_of_rows_by_which_fields_are_late_is_reported(
    tmp_path_factory: pytest.TempPathFactory, late_n: int
) -> None:
    folder = write_late(tmp_path_factory.mktemp("ini"), ONE_PASS * 5, late_n)
    for declared in ("0", str(late_n)):
        _, account = ini.read(folder, header_with_lateness(declared), DEFAULT_POLICY)
        assert account["best_rows_late_n"] == late_n
        assert account["rows_late_n"] == int(declared)


@pytest.mark.parametrize("late_n", [0, 1, 4])
@pytest.mark.parametrize(("passes_n", "is_long"), [(13, True), (5, False)])  # The recordings have 104 and 40 rows.
def test_lateness_is_corrected_if_the_recording_is_long_enough(tmp_path, late_n, passes_n, is_long):
    _, account = ini.read(write_late(tmp_path, ONE_PASS * passes_n, late_n), HEADER, DEFAULT_POLICY)
    assert account["best_rows_late_n"] == late_n
    assert account["rows_late_n"] == account["dropped_no_partner_rows_n"] == (late_n if is_long else 0)


@settings(max_examples=12, deadline=None)
@given(late_n=st.integers(0, 5), failed=st.sets(st.integers(10, 20), max_size=1))
def test_late_fields_are_paired_with_the_labels_to_which_they_belong(
    tmp_path_factory: pytest.TempPathFactory, late_n: int, failed: set[int]
) -> None:
    folder = write(tmp_path_factory.mktemp("ini"), ONE_PASS * 3)
    for row_i in failed:
        edit(folder / ini.READINGS, row_i + 1, f"{FAILED} {chip_line(row_i, 1)} {chip_line(row_i, 2)}")
    readings, account = ini.read(folder, header_with_lateness(str(late_n)), DEFAULT_POLICY)
    truths_i = [i for i in range(24 - late_n) if i + late_n not in failed]
    assert readings.indentation.tolist() == truths_i
    np.testing.assert_array_equal(
        readings.Fz_N,
        np.float32([max(ONE_PASS[i % 8][2], 0.02) for i in truths_i])
        * (np.array([ONE_PASS[i % 8][2] for i in truths_i]) >= 0.02),
    )
    np.testing.assert_array_equal(readings.b_uT, np.float32([field_uT(i + late_n) for i in truths_i]))
    assert readings.pass_i.tolist() == [i // 8 for i in truths_i]
    corner_uT = (field_uT(late_n) + field_uT(1 + late_n)) / 2
    np.testing.assert_array_equal(readings.noload_uT[0], corner_uT.astype(np.float32))
    assert account["dropped_no_partner_rows_n"] == late_n
    dropped_n = sum(n for key, n in account.items() if key.startswith("dropped_"))
    assert account["rows_n"] + account["noload_rows_n"] + dropped_n == account["rows_read_n"] == 24


@pytest.mark.parametrize("rows_late", ["6", "-1", "one", ""])
def test_invalid_option_rows_late_is_refused(tmp_path: Path, rows_late: str) -> None:
    assert "option rows_late must be 0 to 5" in error_of(write(tmp_path, ONE_PASS), header_with_lateness(rows_late))


def test_recording_shorter_than_its_lateness_is_refused(tmp_path: Path) -> None:
    assert "the recording has 4 rows, but option rows_late is 5" in error_of(
        write(tmp_path, ONE_PASS[:4]), header_with_lateness("5")
    )


def test_fields_of_a_public_recording_are_one_row_late(tmp_path: Path, shared_data: Path) -> None:
    for name, source in (
        (ini.READINGS, "b20_artillery_AFG_board2_50_screw.txt"),
        (ini.TRUTHS, "truths_artillery_AFG_board2_50_screw.txt"),
    ):
        (tmp_path / name).write_bytes((shared_data / "ini" / source).read_bytes())
    _, account = ini.read(tmp_path, make_header(layout="ini"), DEFAULT_POLICY)
    assert account["best_rows_late_n"] == account["rows_late_n"] == 1
    assert account["passes_n"] == 50
    assert account["rows_n"] + account["dropped_no_partner_rows_n"] == account["rows_read_n"] == 23300


@pytest.mark.parametrize(
    ("columns", "factor", "expected"),
    [
        (slice(0, 2), 1e-3, "places must be all equal, or spread over a range of 1 to 200 mm; got a range of 0.016"),
        (slice(0, 2), 1e3, "convert the places to mm"),
        (slice(2, 3), 0.01, "force must be at least 0.05 N in one or more rows with contact; got 0.015 N at most"),
        (slice(2, 3), 1e3, "convert the forces to N"),
    ],
)
def test_labels_in_other_units_are_refused(tmp_path: Path, columns: slice, factor: float, expected: str) -> None:
    truths = np.array(ONE_PASS)
    truths[:, columns] *= factor
    truths[:, 2] = np.where(factor == 1e-3, np.array(ONE_PASS)[:, 2], truths[:, 2])
    message = error_of(write(tmp_path, [tuple(row) for row in truths.tolist()]))
    assert expected in message
    assert ini.TRUTHS in message


def test_pass_whose_first_rows_have_a_stuck_chip_is_refused(tmp_path: Path) -> None:
    write(tmp_path, ONE_PASS * 8)
    for row_i in range(20, 64):
        edit(tmp_path / ini.READINGS, row_i + 1, f"{chip_line(row_i, 0)} {chip_line(20, 1)} {chip_line(row_i, 2)}")
    # A chip counts as stuck from the 20th equal reading on. In the last passes, all corner rows have a stuck chip, so
    # there is no no-load field.
    assert "truths.txt line 41: this pass does not begin with a fault-free row" in error_of(tmp_path)


def test_recording_in_which_all_reads_failed_is_refused(tmp_path: Path) -> None:
    write(tmp_path, ONE_PASS)
    (tmp_path / ini.READINGS).write_text(f"{FAILED} {FAILED} {FAILED}\n" * len(ONE_PASS))
    assert "failed" in error_of(tmp_path)


def recording_with_resets(folder: Path, reset: set[int], rows: range, passes_n: int = 3) -> Path:
    """Write passes in which some chips lose their settings.

    In the given rows, the chips `reset` read with the settings that they have after power-on.
    """
    write(folder, ONE_PASS * passes_n)
    lines = []
    for row_i in range(len(ONE_PASS) * passes_n):
        lsb = {
            chip_i: (0.98, 1.58) if chip_i in reset and row_i in rows else (0.15, 0.242) for chip_i in range(CHIPS_N)
        }
        lines.append(" ".join(chip_line(row_i, chip_i, *lsb[chip_i]) for chip_i in range(CHIPS_N)) + "\n")
    (folder / ini.READINGS).write_text("".join(lines))
    return folder


def test_error_names_a_chip_that_has_power_on_settings(tmp_path: Path) -> None:
    message = error_of(recording_with_resets(tmp_path, {1}, range(24)))
    assert "chip 1 must be the LSB of the other chips" in message
    assert "0.98 uT in x, y and 1.58 uT in z" in message


def test_recording_in_which_all_chips_have_power_on_settings_is_refused(tmp_path: Path) -> None:
    message = error_of(recording_with_resets(tmp_path, {0, 1, 2}, range(24)))
    assert "chip 0, 1, 2 must" in message
    assert "0.98 uT in x, y and 1.58 uT in z" in message


def test_error_names_a_chip_that_loses_its_settings_during_the_recording(tmp_path: Path) -> None:
    # There are 2400 rows, which the reader checks in two blocks.
    message = error_of(recording_with_resets(tmp_path, {1}, range(1200, 2400), passes_n=300))
    assert "from row 1201: the LSB of chip 1 must" in message


def test_steps_that_differ_from_the_settings_in_the_header_are_refused(tmp_path: Path) -> None:
    firmware = Firmware(gain_sel=6, lsb_xy_uT=0.2, lsb_z_uT=0.3227)
    message = error_of(write(tmp_path, ONE_PASS * 3), HEADER.model_copy(update={"firmware": firmware}))
    assert "must be (0.2, 0.3227) uT; got 0.15 uT in x, y" in message


@pytest.mark.parametrize("name", ["b20_stand.txt", "stand.txt"])
def test_file_of_labels_is_found_by_its_name(tmp_path: Path, name: str) -> None:
    recording, truths = tmp_path / name, tmp_path / "truths_stand.txt"
    recording.write_text(f"{reading_line(0)}\n")
    with pytest.raises(CaptureError, match=r"no .*truths_stand\.txt"):
        ini.collect(recording)
    truths.write_text("2 2 0\n")
    files = ini.collect(recording)
    assert files == {ini.READINGS: recording, ini.TRUTHS: truths}
    assert ini.count_chips(files) == CHIPS_N
    with pytest.raises(CaptureError, match="instead of truths_"):
        ini.collect(truths)


@pytest.mark.parametrize("cell", ["nan", "-inf", "1e30", "1,5", "x"])
@pytest.mark.parametrize("name", ini.FILES)
def test_error_names_the_line_of_a_cell_that_is_not_a_number(tmp_path: Path, name: str, cell: str) -> None:
    path = write(tmp_path, ONE_PASS) / name
    edit(path, 3, f"{cell} {path.read_text().splitlines()[2].partition(' ')[2]}")
    message = error_of(tmp_path)
    assert f"{name}: " in message
    assert "in line 3" in message


@pytest.mark.parametrize("name", ini.FILES)
def test_error_names_the_line_of_a_missing_or_extra_cell(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, ONE_PASS) / name
    line = path.read_text().splitlines()[2]
    for broken in (f"{line} 1", line.rpartition(" ")[0]):
        edit(path, 3, broken)
        message = error_of(tmp_path)
        assert name in message
        assert "line 3 has" in message


def test_files_with_different_numbers_of_rows_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, ONE_PASS) / ini.TRUTHS
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    assert f"8 in {ini.READINGS} and 7 in {ini.TRUTHS}" in error_of(tmp_path)


def test_file_with_another_number_of_chips_than_its_header_is_refused(tmp_path: Path) -> None:
    message = error_of(write(tmp_path, ONE_PASS), HEADER.model_copy(update={"chips_n": 5}))
    assert "columns instead of 20" in message
    assert "the file has 12 columns" in message


def test_forces_in_grams_are_refused(tmp_path: Path) -> None:
    edit(write(tmp_path, ONE_PASS) / ini.TRUTHS, 4, "2.0 4.0 153.0")
    assert "in line 4. If the unit of the file is g" in error_of(tmp_path)
