"""Tests of the reader of layout `eflesh`, in which a recording is a folder of three tables.

The recording is either a scan, which becomes presses, or was made with a force gauge, and becomes strokes (down and
up).
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.header import Header
from reskin.recordings.readers import eflesh
from tests.recordings.headers import DEFAULT_POLICY, make_header

CHIPS_N = 2
GRID = [(274.0, -115.0), (274.0, -114.000061), (275.0, -115.0), (275.0, -113.999992)]
HEADER = make_header(layout="eflesh", chips_n=CHIPS_N)
GAUGED = make_header(layout="eflesh", chips_n=CHIPS_N, options={"force_axis": "z"})
START_s = 1742155052.5


def lines_of(rows: list[list[float]]) -> str:
    return "".join(",".join(repr(float(value)) for value in row) + "\n" for row in rows)


def write(folder: Path, places: list[list[float]], noload_uT: list[float]) -> Path:
    """Write a recording, whose row i is at `places[i]` (x, y, z and, if known, grams).

    In row i, the field change of channel c is 500 + i + 10 c uT.
    """
    raw = [[500.0 + i + 10.0 * c for c in range(3 * CHIPS_N)] for i in range(len(places))]
    changes = [[float(np.float32(b - base)) for b in row] for row, base in zip(raw, noload_uT, strict=True)]
    time_s = [START_s + 4.25 * i for i in range(len(places))]
    (folder / eflesh.SENSOR).write_text(lines_of([[t, *row] for t, row in zip(time_s, raw, strict=True)]))
    (folder / eflesh.CHANGES).write_text(lines_of([[t, *row] for t, row in zip(time_s, changes, strict=True)]))
    (folder / eflesh.STATES).write_text(lines_of([[t + 0.002, *row] for t, row in zip(time_s, places, strict=True)]))
    return folder


def scan(folder: Path, passes_n: int = 3) -> Path:
    places = [[x, y, 142.0 + i / 4] for i, (x, y) in enumerate(GRID)] * passes_n
    return write(folder, places, [300.0 + i for i in range(len(places))])


def strokes(folder: Path, strokes_n: int = 3) -> Path:
    """Return strokes at one place.

    Each stroke follows a new baseline, and goes down and up in five rows. In the rows at the top, the gauge has no new
    weight.
    """
    stroke = [(288.0, -1.0), (284.0, 100.0), (280.0, 1000.0), (284.0, 150.0), (288.0, -1.0)]
    places = [[315.0, -100.0, z, weight] for z, weight in stroke] * strokes_n
    return write(folder, places, [450.0 + i // len(stroke) for i in range(len(places))])


def error_of(folder: Path, header: Header = HEADER) -> str:
    with pytest.raises(CaptureError) as caught:
        eflesh.read(folder, header, DEFAULT_POLICY)
    message = str(caught.value)
    assert "\n" not in message
    return message


def edit(path: Path, line_n: int, column_i: int, cell: str) -> None:
    lines = [line.split(",") for line in path.read_text().splitlines()]
    lines[line_n - 1][column_i] = cell
    path.write_text("".join(",".join(line) + "\n" for line in lines))


def test_coordinates_of_places_are_relative_to_the_corner_of_the_scan(tmp_path: Path) -> None:
    readings, _ = eflesh.read(scan(tmp_path), HEADER, DEFAULT_POLICY)
    assert readings.x_mm[:4].tolist() == [0, 0, 1, 1]
    assert readings.y_mm[:4].tolist() == [0, 1, 0, 1]


def test_depth_is_measured_from_the_highest_position_of_the_tip(tmp_path: Path) -> None:
    readings, _ = eflesh.read(scan(tmp_path), HEADER, DEFAULT_POLICY)
    assert readings.depth_mm[:4].tolist() == [0.75, 0.5, 0.25, 0]


def test_noload_field_is_the_baseline_that_the_recorder_subtracted(tmp_path: Path) -> None:
    readings, _ = eflesh.read(scan(tmp_path), HEADER, DEFAULT_POLICY)
    np.testing.assert_array_equal(readings.b_uT[5], 505 + 10 * np.arange(6))
    # The numbers 300 + i and the differences are exact in single precision.
    np.testing.assert_array_equal(readings.noload_uT[5], np.full(6, 305))


def test_new_pass_begins_where_places_repeat(tmp_path: Path) -> None:
    readings, account = eflesh.read(scan(tmp_path, passes_n=3), HEADER, DEFAULT_POLICY)
    assert readings.pass_i.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert account["passes_n"] == 3
    assert readings.n_contacts.tolist() == list(range(12))
    assert np.isnan(readings.Fz_N).all()


def test_new_stroke_begins_at_a_new_baseline(tmp_path: Path) -> None:
    readings, account = eflesh.read(strokes(tmp_path), GAUGED, DEFAULT_POLICY)
    assert readings.pass_i.tolist() == [0] * 5 + [1] * 5 + [2] * 5
    assert account["passes_n"] == 3
    assert readings.n_contacts.tolist() == readings.pass_i.tolist()


def test_weights_in_grams_are_converted_to_newtons(tmp_path: Path) -> None:
    readings, account = eflesh.read(strokes(tmp_path, strokes_n=1), GAUGED, DEFAULT_POLICY)
    expected = np.float32([np.nan, 0.980665, 9.80665, 1.4709975, np.nan])
    # The tolerance is that of single precision, which has seven digits.
    np.testing.assert_allclose(readings.Fz_N, expected, rtol=1e-6)
    assert account["no_new_force_rows_n"] == 2
    assert account["force_sign_unknown_rows_n"] == 0
    assert np.isnan(readings.Fx_N).all()
    assert np.isnan(readings.Fy_N).all()


@pytest.mark.parametrize("axis", ["x", "y"])
def test_axis_of_the_force_gauge_is_read_from_the_header(tmp_path: Path, axis: str) -> None:
    readings, account = eflesh.read(
        strokes(tmp_path), GAUGED.model_copy(update={"options": {"force_axis": axis}}), DEFAULT_POLICY
    )
    felt = np.isfinite(getattr(readings, f"F{axis}_N"))
    assert account["force_sign_unknown_rows_n"] == felt.sum() > 0
    assert np.isnan(readings.Fz_N).all()
    # Strokes along x or y have no depth.
    assert np.isnan(readings.depth_mm).all()


@pytest.mark.parametrize("options", [{}, {"force_axis": "up"}])
def test_weights_are_refused_if_the_header_has_no_axis(tmp_path: Path, options: dict[str, str]) -> None:
    header = GAUGED.model_copy(update={"options": options})
    assert "option force_axis must be x, y or z" in error_of(strokes(tmp_path), header)


@settings(max_examples=20, deadline=None)
@given(passes_n=st.integers(1, 6))
def test_every_row_becomes_a_reading(tmp_path_factory: pytest.TempPathFactory, passes_n: int) -> None:
    readings, account = eflesh.read(scan(tmp_path_factory.mktemp("eflesh"), passes_n), HEADER, DEFAULT_POLICY)
    assert account["rows_n"] == account["rows_read_n"] == len(readings) == 4 * passes_n
    assert account["noload_rows_n"] == 0
    assert (np.diff(readings.t_s) > 0).all()


def test_three_files_of_a_recording_are_found(tmp_path: Path) -> None:
    files = eflesh.collect(scan(tmp_path))
    assert sorted(files) == sorted(eflesh.FILES)
    assert eflesh.count_chips(files) == CHIPS_N


@pytest.mark.parametrize("name", eflesh.FILES)
def test_missing_file_is_reported(tmp_path: Path, name: str) -> None:
    (scan(tmp_path) / name).unlink()
    with pytest.raises(CaptureError, match=f"does not contain {name}"):
        eflesh.collect(tmp_path)


@pytest.mark.parametrize("name", eflesh.FILES)
@pytest.mark.parametrize("cell", ["nan", "-inf", "", "1,5", "x"])
def test_error_names_the_line_of_a_cell_that_is_not_a_number(tmp_path: Path, name: str, cell: str) -> None:
    edit(scan(tmp_path) / name, 3, 2, cell)
    message = error_of(tmp_path)
    assert name in message
    assert "line 3" in message


@pytest.mark.parametrize("name", eflesh.FILES)
def test_tables_with_different_numbers_of_rows_are_refused(tmp_path: Path, name: str) -> None:
    path = scan(tmp_path) / name
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    message = error_of(tmp_path)
    assert f"11 in {name}" in message
    assert "12 in" in message


@pytest.mark.parametrize(
    ("name", "cell", "expected"),
    [
        (eflesh.CHANGES, f"{START_s + 8.6}", "line 3: the time differs by 0.100 s"),
        (eflesh.STATES, f"{START_s + 8.6}", "line 3: the time differs by 0.100 s from the time in sensor.csv"),
    ],
)
def test_clocks_that_disagree_are_refused(tmp_path: Path, name: str, cell: str, expected: str) -> None:
    edit(scan(tmp_path) / name, 3, 0, cell)
    assert expected in error_of(tmp_path)


def test_clock_that_runs_backwards_is_refused(tmp_path: Path) -> None:
    scan(tmp_path)
    for name in eflesh.FILES:
        edit(tmp_path / name, 3, 0, f"{START_s}")
    assert "time does not increase in line 3" in error_of(tmp_path)


def test_file_with_another_number_of_chips_than_its_header_is_refused(tmp_path: Path) -> None:
    message = error_of(scan(tmp_path), HEADER.model_copy(update={"chips_n": 5}))
    assert "columns instead of 16" in message
    assert "the file has 7 columns" in message


def test_implausible_weight_is_refused(tmp_path: Path) -> None:
    edit(strokes(tmp_path) / eflesh.STATES, 3, 4, "20000")
    assert "in line 3" in error_of(tmp_path, GAUGED)


def rescale(path: Path, columns: slice, factor: float) -> None:
    rows = np.array([[float(cell) for cell in line.split(",")] for line in path.read_text().splitlines()])
    rows[:, columns] *= factor
    path.write_text(lines_of(rows.tolist()))


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_places_in_metres_or_micrometres_are_refused(tmp_path: Path, factor: float) -> None:
    folder = write(tmp_path, [[5.0 * i, 0.0, 142.0] for i in range(4)], [300.0] * 4)
    eflesh.read(folder, HEADER, DEFAULT_POLICY)
    rescale(folder / eflesh.STATES, slice(1, 4), factor)
    assert "states.csv: places must be all equal, or spread over a range of 1 to 200 mm" in error_of(folder)


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_stroke_in_metres_or_micrometres_is_refused(tmp_path: Path, factor: float) -> None:
    rescale(strokes(tmp_path) / eflesh.STATES, slice(3, 4), factor)
    assert "states.csv: the greatest depth must be 0.05 to 100 mm" in error_of(tmp_path, GAUGED)


def test_weights_in_kilograms_are_refused(tmp_path: Path) -> None:
    folder = strokes(tmp_path)
    states = np.array(
        [[float(cell) for cell in row.split(",")] for row in (folder / eflesh.STATES).read_text().split()]
    )
    states[:, 4] = np.where(states[:, 4] == -1, -1, states[:, 4] / 1000)
    (folder / eflesh.STATES).write_text(lines_of(states.tolist()))
    assert (
        "force must be at least 0.05 N in one or more rows with contact; got 0.00981 N at most. If the unit is kg"
        in error_of(folder, GAUGED)
    )


@pytest.mark.parametrize("factor", [1e-2, 1e-3, 1e-6])
def test_fields_in_other_units_are_refused(tmp_path: Path, factor: float) -> None:
    scan(tmp_path)
    for name in (eflesh.SENSOR, eflesh.CHANGES):
        rescale(tmp_path / name, slice(1, None), factor)
    assert "convert the fields to uT" in error_of(tmp_path)


def test_scan_at_constant_height_has_no_depth(tmp_path):
    places = [[x, y, 142.0] for x, y in GRID] * 3
    readings, account = eflesh.read(
        write(tmp_path, places, [300.0 + i for i in range(len(places))]), HEADER, DEFAULT_POLICY
    )
    assert np.isnan(readings.depth_mm).all()
    assert account["no_depth_rows_n"] == len(readings) == len(places)


def test_scan_at_nearly_constant_height_has_no_depth(tmp_path):
    z_mm = np.linspace(143.0, 143.0177, 3 * len(GRID))
    places = [[x, y, z] for (x, y), z in zip(GRID * 3, z_mm, strict=True)]
    readings, account = eflesh.read(
        write(tmp_path, places, [300.0 + i for i in range(len(places))]), HEADER, DEFAULT_POLICY
    )
    assert np.isnan(readings.depth_mm).all()
    assert account["no_depth_rows_n"] == len(places)
