"""Tests of the reader of layout `lab`, which turns a CSV file into presses."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.header import Header
from reskin.recordings.readers import lab
from tests.recordings.headers import DEFAULT_POLICY, make_header

CHIPS_N = 2
NAMES = "indent,phase,x_mm,y_mm,T0,Bx0,By0,Bz0,T1,Bx1,By1,Bz1,Fx,Fy,Fz"
HEADER = make_header(layout="lab", chips_n=CHIPS_N, contacts_before_n=7)


def row(indent: int, phase: str, b_uT: float, *, place: str = "4,6", force: str = "0.1,-0.2,-3.5") -> str:
    """Return one line of the CSV file. The field of channel c is b_uT + 10 c."""
    c = [f"{b_uT + 10 * i:.4f}" for i in range(3 * CHIPS_N)]
    return f"{indent},{phase},{place},21.5,{','.join(c[:3])},22.5,{','.join(c[3:])},{force}"


PRESSES = [
    row(0, "noload", 100.0, force="0,0,0"),
    row(0, "noload", 104.0, force="0,0,0"),
    row(0, "contact", 160.0),
    row(0, "contact", 161.0),
    row(0, "contact", 162.0),
    row(1, "noload", 90.0, place="8,10", force="0,0,0"),
    row(1, "contact", 50.0, place="8,10", force="0,0,-0.5"),
]


def write(folder: Path, *rows: str, names: str = NAMES) -> Path:
    (folder / lab.READINGS).write_text("\n".join([names, *rows]) + "\n")
    return folder


def error_of(folder: Path, header: Header = HEADER) -> str:
    with pytest.raises(CaptureError) as caught:
        lab.read(folder, header, DEFAULT_POLICY)
    message = str(caught.value)
    assert "\n" not in message
    assert lab.READINGS in message
    return message


def test_press_with_a_single_no_load_row_is_read(tmp_path: Path) -> None:
    press_i, b_uT = lab.read_noload(write(tmp_path, *PRESSES), HEADER, DEFAULT_POLICY)
    assert press_i.tolist() == [0, 0, 1]
    assert b_uT[:, 0].tolist() == [100, 104, 90]
    readings, _ = lab.read(tmp_path, HEADER, DEFAULT_POLICY)
    np.testing.assert_allclose(readings.noload_uT[0], b_uT[press_i == 0].mean(axis=0))


def test_rows_in_contact_become_readings(tmp_path: Path) -> None:
    readings, _ = lab.read(write(tmp_path, *PRESSES), HEADER, DEFAULT_POLICY)
    assert readings.indentation.tolist() == [0, 0, 0, 1]
    assert readings.reading_i.tolist() == [0, 1, 2, 0]
    assert readings.b_uT[:, 0].tolist() == [160, 161, 162, 50]
    assert readings.b_uT[3].tolist() == [50, 60, 70, 80, 90, 100]
    assert readings.x_mm.tolist() == [4, 4, 4, 8]
    assert readings.y_mm.tolist() == [6, 6, 6, 10]
    assert readings.temperature_degC[0].tolist() == [21.5, 22.5]
    assert readings.n_contacts.tolist() == [7, 7, 7, 8]


def test_noload_field_is_the_mean_of_the_no_load_rows_of_the_same_press(tmp_path: Path) -> None:
    readings, _ = lab.read(write(tmp_path, *PRESSES), HEADER, DEFAULT_POLICY)
    assert readings.noload_uT[:, 0].tolist() == [102, 102, 102, 90]
    assert readings.noload_uT[0].tolist() == [102, 112, 122, 132, 142, 152]


def test_forces_are_converted_from_the_axes_of_the_gauge_to_those_of_the_skin(tmp_path: Path) -> None:
    readings, _ = lab.read(write(tmp_path, *PRESSES), HEADER, DEFAULT_POLICY)
    np.testing.assert_array_equal(readings.Fz_N, np.float32([3.5, 3.5, 3.5, 0.5]))
    np.testing.assert_array_equal(readings.Fx_N[:3], np.float32([-0.1] * 3))
    np.testing.assert_array_equal(readings.Fy_N[:3], np.float32([0.2] * 3))


def test_quantities_without_a_column_are_nan(tmp_path: Path) -> None:
    readings, _ = lab.read(write(tmp_path, *PRESSES), HEADER, DEFAULT_POLICY)
    assert np.isnan(readings.depth_mm).all()
    assert np.isnan(readings.t_s).all()


@settings(max_examples=20, deadline=None)
@given(counts=st.lists(st.tuples(st.integers(1, 4), st.integers(1, 5)), min_size=1, max_size=6))
def test_every_row_is_a_reading_or_a_no_load_row(
    tmp_path_factory: pytest.TempPathFactory, counts: list[tuple[int, int]]
) -> None:
    rows = []
    for indent, (noload_n, contact_n) in enumerate(counts):
        rows += [row(indent, "noload", 100.0)] * noload_n + [row(indent, "contact", 150.0)] * contact_n
    readings, account = lab.read(write(tmp_path_factory.mktemp("lab"), *rows), HEADER, DEFAULT_POLICY)
    assert account["rows_read_n"] == len(rows)
    assert account["rows_n"] == len(readings) == sum(contact_n for _, contact_n in counts)
    assert account["noload_rows_n"] == sum(noload_n for noload_n, _ in counts)


def test_row_with_failed_read_is_dropped(tmp_path: Path) -> None:
    rows = list(PRESSES)
    for row_i in (1, 3):
        rows[row_i] = (
            rows[row_i].split(",22.5,")[0].rsplit(",", 4)[0]
            + ",-880.49,8028.16,5194.00,12943.36,22.5,130,140,150,0,0,-3"
        )
    readings, account = lab.read(write(tmp_path, *rows), HEADER, DEFAULT_POLICY)
    assert account["dropped_failed_read_rows_n"] == 2
    assert (account["rows_n"], account["noload_rows_n"], account["rows_read_n"]) == (3, 2, 7)
    assert readings.b_uT[:, 0].tolist() == [160, 162, 50]
    # The no-load row with a failed read is not part of the mean.
    assert readings.noload_uT[:, 0].tolist() == [100, 100, 90]


def test_columns_of_the_file_may_be_in_any_order(tmp_path: Path) -> None:
    names = NAMES.split(",")
    order = np.roll(np.arange(len(names)), 4)
    reordered = [",".join(np.array(line.split(","))[order]) for line in PRESSES]
    (tmp_path / "reordered").mkdir()
    original, _ = lab.read(write(tmp_path, *PRESSES), HEADER, DEFAULT_POLICY)
    folder = write(tmp_path / "reordered", *reordered, names=",".join(np.array(names)[order]))
    np.testing.assert_array_equal(lab.read(folder, HEADER, DEFAULT_POLICY)[0].b_uT, original.b_uT)


def test_unknown_columns_are_ignored_and_counted(tmp_path: Path) -> None:
    _, account = lab.read(
        write(tmp_path, *[f"{line},1" for line in PRESSES], names=f"{NAMES},Mz"), HEADER, DEFAULT_POLICY
    )
    assert account["ignored_columns_n"] == 1


def test_recording_is_copied_under_the_name_that_the_reader_expects(tmp_path: Path) -> None:
    recording = tmp_path / "board1_depth1.csv"
    recording.write_text(f"{NAMES}\n{PRESSES[0]}\n")
    files = lab.collect(recording)
    assert files == {lab.READINGS: recording}
    assert lab.count_chips(files) == CHIPS_N
    with pytest.raises(CaptureError, match="not a file"):
        lab.collect(tmp_path)


@pytest.mark.parametrize(
    ("line_n", "broken", "expected"),
    [
        (4, row(0, "contact", 160.0).replace("160.0000", "nan"), "Bx0 in line 4"),
        (4, row(0, "contact", 160.0).replace("160.0000", "inf"), "Bx0 in line 4"),
        (4, row(0, "contact", 160.0).replace("160.0000", "1e30"), "Bx0 in line 4"),
        (4, row(0, "contact", 160.0).replace("160.0000", ""), "Bx0 in line 4"),
        (4, row(0, "contact", 160.0).replace("160.0000", "16O.0"), "Bx0 in line 4"),
        (4, row(0, "touch", 160.0), "phase in line 4"),
        (4, row(0, "contact", 160.0) + ",3", "line 4 has 16 columns"),
        (4, row(0, "contact", 160.0)[:20], "line 4 has 6 columns"),
        (4, row(0, "contact", 160.0, place="5,6"), "the place changes within an indent, in line 4"),
        (4, row(0, "contact", 160.0, force="0,0,-356"), "in line 4. If the unit of the file is g"),
        (4, row(0, "contact", 4e5), "in line 4"),
        (6, row(2, "contact", 90.0), "the indent from line 6 on has no fault-free noload row"),
        (8, row(0, "noload", 90.0), "indentation 0 begins again in line 8"),
    ],
)
def test_error_names_the_line_that_cannot_be_read(tmp_path: Path, line_n: int, broken: str, expected: str) -> None:
    rows = list(PRESSES)
    rows[line_n - 2] = broken
    assert expected in error_of(write(tmp_path, *rows))


@pytest.mark.parametrize("missing", ["indent", "phase", "x_mm", "T0", "By1", "Fz"])
def test_error_names_the_missing_column(tmp_path: Path, missing: str) -> None:
    column = NAMES.split(",").index(missing)
    lines = [",".join(cell for i, cell in enumerate(line.split(",")) if i != column) for line in [NAMES, *PRESSES]]
    assert f"no column '{missing}'" in error_of(write(tmp_path, *lines[1:], names=lines[0]))


def test_duplicate_column_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path, *[f"{line},1" for line in PRESSES], names=f"{NAMES},Fz")
    assert "two columns have the name Fz" in error_of(folder)


def test_fields_in_millitesla_are_refused(tmp_path: Path) -> None:
    rows = [row(0, "noload", -20.0), row(0, "contact", -21.0)]
    tiny = [",".join(str(float(c) / 1e3) if "." in c and "0000" in c else c for c in r.split(",")) for r in rows]
    assert "convert the fields to uT" in error_of(write(tmp_path, *tiny))


def scale_column(column: str, factor: float) -> list[str]:
    """Return the lines of PRESSES, with all columns of one kind (B, place or F) multiplied by `factor`."""
    names = NAMES.split(",")
    chosen = {i for i, name in enumerate(names) if name.startswith(column) or name.endswith(column)}
    return [
        ",".join(f"{factor * float(cell)!r}" if i in chosen else cell for i, cell in enumerate(line.split(",")))
        for line in PRESSES
    ]


@pytest.mark.parametrize(
    ("column", "factor", "expected"),
    [
        ("B", 1e-2, "convert the fields to uT"),
        ("B", 1e-6, "convert the fields to uT"),
        ("B", 1e4, "below the full scale"),
        ("_mm", 1e-3, "places must be all equal, or spread over a range of 1 to 200 mm; got a range of 0.004. If"),
        ("_mm", 1e3, "got a range of 4000. If the unit of the file is m or um"),
        ("F", 102.0, "force must be below 100 N; got 357 in line 4. If the unit"),
        ("F", 1e3, "convert the forces to N"),
        ("F", 1e-3, "force must be at least 0.05 N in one or more rows with contact; got 0.0035 N at most. If"),
        ("Fz", -1.0, "Fz_N in contact must be positive; got -3.5 N. Reverse the sign"),
    ],
)
def test_other_units_and_signs_are_refused(tmp_path: Path, column: str, factor: float, expected: str) -> None:
    assert expected in error_of(write(tmp_path, *scale_column(column, factor)))


def test_real_recording_converted_to_gauss_is_refused(tmp_path: Path, shared_data: Path) -> None:
    lines = (shared_data / "lab" / "board1_depth1.csv").read_text().splitlines()[:1101]
    names = lines[0].split(",")
    rows = [
        ",".join(
            f"{float(cell) / 100:.6f}" if name.startswith("B") else cell for name, cell in zip(names, row, strict=True)
        )
        for row in (line.split(",") for line in lines[1:])
    ]
    message = error_of(write(tmp_path, *rows, names=lines[0]), make_header(layout="lab", chips_n=5))
    assert "convert the fields to uT" in message


def test_file_with_another_number_of_chips_than_its_header_is_refused(tmp_path: Path) -> None:
    message = error_of(write(tmp_path, *PRESSES), HEADER.model_copy(update={"chips_n": 5}))
    assert "2 chips, but the header says 5" in message


def test_recording_without_contact_is_refused(tmp_path: Path) -> None:
    assert "no row has phase contact" in error_of(write(tmp_path, PRESSES[0]))
