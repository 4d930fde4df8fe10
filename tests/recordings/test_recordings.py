"""Tests that the public recordings contain what data/README.md describes.

Each recording is copied into the folder of a capture as `reskin add` does, and read by the reader of its layout.
"""

import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from reskin.errors import CaptureError
from reskin.recordings.header import Header
from reskin.recordings.readers import eflesh, ini, lab
from reskin.recordings.tables import TableFile
from reskin.schema import Readings
from tests.recordings.headers import DEFAULT_POLICY, make_header

SPATIAL = "eflesh/spatial_resolution/20250316_155729_probe"
NORMAL = "eflesh/normal_force/20250401_014340_probe"
SHEAR = "eflesh/shear_force/20250416_200533_probe"
SCREW = "ini/b20_artillery_AFG_board2_50_screw.txt"


def ingest(reader: ModuleType, recording: Path, folder: Path, **changed: object) -> tuple[Readings, dict[str, int]]:
    """Copy a recording into a capture as `reskin add` does; return its readings and the counts of dropped rows."""
    files = reader.collect(recording)
    for name, source in files.items():
        shutil.copyfile(source, folder / name)
    header = make_header(layout=reader.__name__.rpartition(".")[2], chips_n=reader.count_chips(files), **changed)
    return read_checked(reader, folder, header)


def read_checked(reader: ModuleType, folder: Path, header: Header) -> tuple[Readings, dict[str, int]]:
    readings, account = reader.read(folder, header, DEFAULT_POLICY)
    lost_n = sum(count for name, count in account.items() if name.startswith("dropped_"))
    assert account["rows_n"] + lost_n + account["noload_rows_n"] == account["rows_read_n"]
    assert account["rows_n"] == len(readings)
    assert np.isfinite(readings.b_uT).all()
    assert np.isfinite(readings.noload_uT).all()
    return readings, account


LAB = [f"board{board}_depth{depth}" for board in (1, 2) for depth in (1, 2, 3)]


@pytest.mark.parametrize("name", LAB)
def test_lab_file_has_65_presses_of_100_readings(shared_data: Path, tmp_path: Path, name: str) -> None:
    readings, account = ingest(lab, shared_data / "lab" / f"{name}.csv", tmp_path)
    assert account["rows_read_n"] == 65 * 110
    assert account["noload_rows_n"] == 65 * 10
    assert account["ignored_columns_n"] == 0
    assert np.bincount(readings.indentation).tolist() == [100] * 65
    places = {(float(x), float(y)) for x, y in zip(readings.x_mm, readings.y_mm, strict=True)}
    assert len(places) == 65
    assert {min(places), max(places)} <= {(float(x), float(y)) for x in (0, 16) for y in range(17)}
    assert 0.6 < readings.Fz_N.min()
    assert readings.Fz_N.max() < 9.6


def test_forces_of_lab_recordings_reach_ten_newtons(shared_data: Path, tmp_path: Path) -> None:
    soft, _ = ingest(lab, shared_data / "lab/board1_depth1.csv", tmp_path)
    hard, _ = ingest(lab, shared_data / "lab/board2_depth3.csv", tmp_path)
    assert 0.6 < soft.Fz_N.min() < 0.7
    assert 9.4 < hard.Fz_N.max() < 9.6


@pytest.mark.parametrize("name", LAB)
def test_lab_tip_pushes_the_skin_along_x(shared_data: Path, tmp_path: Path, name: str) -> None:
    # The tip pushes the skin along x while it presses. Experiment compare, which uses only the fields, finds that the
    # skin moves by 48 um along the +x axis of the labels.
    readings, _ = ingest(lab, shared_data / "lab" / f"{name}.csv", tmp_path)
    assert 0.08 < readings.Fx_N.mean() < 0.6


@pytest.mark.parametrize("name", LAB)
def test_noise_of_lab_recordings_equals_that_of_the_data_sheet(shared_data: Path, name: str) -> None:
    # The noise is the deviation from the mean of each press. With 65 x 9 degrees of freedom per channel, its standard
    # error is 3 %.
    columns = [f"B{axis}{chip}" for chip in range(5) for axis in "xyz"]
    table = TableFile(shared_data / "lab" / f"{name}.csv", name).read(columns, ["phase"]).to_pandas()
    b_uT = table.loc[table.phase == "noload", columns].to_numpy().reshape(65, 10, 15)
    sd_uT = np.sqrt(b_uT.var(axis=1, ddof=1).mean(axis=0)).reshape(5, 3)
    # In all recordings, the noise is 3.0 to 3.3 uT (x, y) and 4.4 to 5.0 uT (z). Single channels deviate by the
    # standard error of 3 %.
    assert ((sd_uT[:, :2] > 2.9) & (sd_uT[:, :2] < 3.5)).all()
    assert ((sd_uT[:, 2] > 4.3) & (sd_uT[:, 2] < 5.3)).all()


def test_fields_of_lab_skins_are_a_few_millitesla(shared_data: Path, tmp_path: Path) -> None:
    noload = [ingest(lab, shared_data / "lab" / f"{name}.csv", tmp_path)[0].noload_uT for name in LAB]
    strength_uT = np.linalg.norm(np.concatenate(noload).reshape(-1, 5, 3), axis=2)
    assert 3600 < strength_uT.max() < 3800


def test_ini_recording_has_fifty_passes(shared_data: Path, tmp_path: Path) -> None:
    readings, account = ingest(ini, shared_data / SCREW, tmp_path)
    assert account["rows_read_n"] == 23_300
    assert account["rows_n"] == 23_299  # The fields are one row late, so one row of labels has no row of fields.
    assert account["passes_n"] == 50
    assert np.bincount(readings.pass_i).tolist() == [466] * 49 + [465]
    touching = np.isfinite(readings.x_mm)
    assert set(readings.x_mm[touching]) == set(readings.y_mm[touching]) == set(range(2, 19, 2))
    assert account["no_contact_rows_n"] == 1665 == (~touching).sum()
    assert (readings.Fz_N[~touching] == 0).all()
    assert readings.Fz_N[touching].min() >= np.float32(0.02)
    assert readings.Fz_N.max() == np.float32(4.1)


def test_centre_of_the_ini_grid_is_one_of_its_places(shared_data: Path, tmp_path: Path) -> None:
    readings, _ = ingest(ini, shared_data / SCREW, tmp_path)
    centre = (readings.x_mm == 10) & (readings.y_mm == 10)
    assert centre.sum() == 6 * 50
    assert (readings.Fz_N[centre] > 0).all()


def test_fields_of_ini_recordings_are_one_row_late(shared_data: Path, tmp_path: Path) -> None:
    # This is a known fault of these recordings: the field in a row belongs to the force in the previous row.
    readings, _ = ingest(ini, shared_data / SCREW, tmp_path, options={"rows_late": "0"})
    change_uT = np.linalg.norm(readings.b_uT - readings.noload_uT, axis=1)
    same_row = np.corrcoef(readings.Fz_N[:-1], change_uT[:-1])[0, 1]
    row_before = np.corrcoef(readings.Fz_N[:-1], change_uT[1:])[0, 1]
    assert row_before > same_row + 0.1


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("AFG_flex_50", "failed"),
        ("AFG_test_new_board15", "chip 3"),
        ("piezo", "0.98"),
    ],
)
def test_incomplete_ini_recordings_are_refused(shared_data: Path, tmp_path: Path, name: str, expected: str) -> None:
    with pytest.raises(CaptureError, match=expected) as caught:
        ingest(ini, shared_data / "ini/faults" / f"b20_artillery_{name}.head400.txt", tmp_path)
    assert "\n" not in str(caught.value)


def test_eflesh_scan_has_five_passes_over_31_by_31_places(shared_data: Path, tmp_path: Path) -> None:
    readings, account = ingest(eflesh, shared_data / SPATIAL, tmp_path)
    assert account["rows_n"] == 4805
    assert np.bincount(readings.pass_i).tolist() == [961] * 5
    assert set(readings.x_mm) == set(readings.y_mm) == set(range(31))
    assert readings.depth_mm.min() == 0
    assert 3.9 < readings.depth_mm.max() < 4.1
    assert np.isnan(readings.Fz_N).all()
    assert len(np.unique(readings.noload_uT, axis=0)) == 4805


@pytest.mark.parametrize("name", [NORMAL, "eflesh/normal_force/20250401_015037_probe"])
def test_eflesh_gauge_recorded_ten_strokes(shared_data: Path, tmp_path: Path, name: str) -> None:
    readings, account = ingest(eflesh, shared_data / name, tmp_path, options={"force_axis": "z"})
    assert account["rows_n"] == 3600
    assert account["no_new_force_rows_n"] == 1740 == np.isnan(readings.Fz_N).sum()
    assert 0.48 < account["no_new_force_rows_n"] / account["rows_n"] < 0.49
    assert set(readings.x_mm) == set(readings.y_mm) == {0.0}
    assert 11.9 < readings.depth_mm.max() < 12.1
    # The readings of the gauge are 3.3 and 3.5 kg at the greatest depth.
    assert 32 < np.nanmax(readings.Fz_N) < 34.5


@pytest.mark.parametrize("name", [NORMAL, SHEAR])
def test_each_pass_of_the_eflesh_gauge_is_one_stroke(shared_data: Path, tmp_path: Path, name: str) -> None:
    # Passes are found from new baselines. The z coordinate of the robot, which the reader does not use for this
    # purpose, gives the same passes.
    readings, account = ingest(eflesh, shared_data / name, tmp_path, options={"force_axis": "z"})
    assert account["passes_n"] == 10
    for pass_i in range(10):
        depth_mm = readings.depth_mm[readings.pass_i == pass_i]
        half_mm = readings.depth_mm.max() / 2
        crossings = np.diff((depth_mm > half_mm).astype(int))
        assert crossings[crossings != 0].tolist() == [1, -1]


def test_eflesh_shear_recording_has_ten_chips(shared_data: Path, tmp_path: Path) -> None:
    readings, _ = ingest(eflesh, shared_data / SHEAR, tmp_path, options={"force_axis": "x"})
    assert readings.chips_n == 10
    assert len(readings) == 7200
    assert np.isnan(readings.Fz_N).all()
    assert 17 < np.nanmax(readings.Fx_N) < 18.5
