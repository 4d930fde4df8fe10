"""Tests of the reader of layout `table`, which reads CSV and Parquet tables.

The tests cover quantities that are unknown, and errors that name the wrong line.
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from reskin.cli import app
from reskin.errors import CaptureError
from reskin.recordings.readers import eflesh
from reskin.recordings.readers import table as plain
from tests.recordings.headers import DEFAULT_POLICY, make_header

ROOT = Path(__file__).resolve().parents[3]
CHIPS_N = 2


def table(presses_n: int = 6, noload_n: int = 3, contact_n: int = 4, seed: int = 0) -> pd.DataFrame:
    rng, rows = np.random.default_rng(seed), []
    rest_uT = rng.normal(0, 800, 3 * CHIPS_N)
    for press in range(presses_n):
        x_mm, y_mm = 2.0 * (press % 3), 2.0 * (press // 3)
        for phase, n in (("noload", noload_n), ("contact", contact_n)):
            for _ in range(n):
                b_uT = rest_uT + (phase == "contact") * 50 * (press + 1) + rng.normal(0, 3, 3 * CHIPS_N)
                force_N = float(phase == "contact") + 0.1 * press
                fields = dict(zip(plain.columns_of(CHIPS_N)[3:9], b_uT, strict=True))
                rows.append({"phase": phase, "x_mm": x_mm, "y_mm": y_mm, "Fz_N": force_N} | fields)
    return pd.DataFrame(rows)


def write(folder: Path) -> Path:
    """Write the folder of a capture, with a table that has all columns."""
    table().to_csv(folder / plain.CSV, index=False)
    return folder


def error_of(folder: Path) -> str:
    with pytest.raises(CaptureError) as caught:
        plain.read(folder, make_header(layout="table", chips_n=CHIPS_N), DEFAULT_POLICY)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def read(folder: Path, rows: pd.DataFrame, name: str = "mine.csv"):
    folder.mkdir(exist_ok=True)
    file = folder / name
    rows.to_parquet(file) if file.suffix == ".parquet" else rows.to_csv(file, index=False)
    files = plain.collect(file)
    capture = folder / "capture"
    capture.mkdir(exist_ok=True)
    for kept, source in files.items():
        (capture / kept).write_bytes(source.read_bytes())
    return plain.read(capture, make_header(layout="table", chips_n=plain.count_chips(files)), DEFAULT_POLICY)


def test_byte_order_mark_is_ignored(tmp_path):
    without_mark, _ = read(tmp_path / "a", table())
    table().to_csv(tmp_path / "mine.csv", index=False, encoding="utf-8-sig")
    (tmp_path / "b").mkdir()
    for kept, source in plain.collect(tmp_path / "mine.csv").items():
        (tmp_path / "b" / kept).write_bytes(source.read_bytes())
    with_mark, _ = plain.read(tmp_path / "b", make_header(layout="table", chips_n=CHIPS_N), DEFAULT_POLICY)
    np.testing.assert_array_equal(with_mark.b_uT, without_mark.b_uT)


def test_rows_in_contact_have_the_mean_of_their_no_load_rows(tmp_path):
    rows = table()
    readings, account = read(tmp_path, rows)
    contact, fields = rows[rows.phase == "contact"], plain.columns_of(CHIPS_N)[3:9]
    np.testing.assert_allclose(readings.b_uT, contact[fields], rtol=1e-6)
    np.testing.assert_allclose(readings.Fz_N, contact.Fz_N, rtol=1e-6)
    for press in range(6):
        mean_uT = rows[(rows.phase == "noload")].iloc[3 * press : 3 * press + 3][fields].mean()
        np.testing.assert_allclose(readings.noload_uT[readings.indentation == press], [mean_uT] * 4, rtol=1e-5)
    assert account["rows_n"] + account["noload_rows_n"] == account["rows_read_n"] == len(rows)
    assert account["no_depth_rows_n"] == len(readings)
    assert np.isnan(readings.depth_mm).all()
    assert np.isnan(readings.temperature_degC).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 8), st.integers(1, 4), st.integers(1, 4))
def test_column_of_indentation_numbers_is_optional(tmp_path_factory, presses_n, noload_n, contact_n):
    rows = table(presses_n, noload_n, contact_n)
    numbered = rows.assign(indentation=np.repeat(np.arange(presses_n), noload_n + contact_n) + 7)
    without, with_numbers = (read(tmp_path_factory.mktemp("t"), part)[0] for part in (rows, numbered))
    assert without.indentation.tolist() == with_numbers.indentation.tolist()
    assert without.reading_i.tolist() == list(range(contact_n)) * presses_n


def test_quantities_of_empty_columns_are_unknown(tmp_path):
    rows = table().reindex(columns=plain.columns_of(CHIPS_N))
    readings, account = read(tmp_path, rows)
    assert np.isnan(readings.depth_mm).all()
    assert np.isfinite(readings.Fz_N).all()
    assert account["ignored_columns_n"] == 0


def test_no_load_rows_may_have_indentation_numbers_of_their_own(tmp_path):
    rows = table().assign(indentation=np.repeat(np.arange(12), [3, 4] * 6))
    readings, _ = read(tmp_path, rows)
    assert readings.indentation.tolist() == np.repeat(np.arange(6), 4).tolist()


def test_parquet_table_is_read_like_csv(tmp_path):
    one, other = read(tmp_path / "a", table())[0], read(tmp_path / "b", table(), "mine.parquet")[0]
    np.testing.assert_array_equal(one.b_uT, other.b_uT)
    np.testing.assert_array_equal(one.noload_uT, other.noload_uT)


def test_no_load_rows_may_have_empty_places(tmp_path):
    rows = table().assign(operator="me", note="")
    rows.loc[rows.phase == "noload", ["x_mm", "y_mm", "Fz_N"]] = np.nan
    readings, account = read(tmp_path, rows)
    assert account["ignored_columns_n"] == 2
    assert np.isfinite(readings.x_mm).all()


def test_depth_that_is_always_zero_is_unknown(tmp_path):
    zero_depth, account = read(tmp_path / "still", table().assign(depth_mm=0.0))
    assert np.isnan(zero_depth.depth_mm).all()
    assert account["no_depth_rows_n"] == len(zero_depth)
    moving = table()
    moving["depth_mm"] = np.where(moving.phase == "contact", 0.5 + 0.1 * moving.x_mm, 0.0)
    found, account = read(tmp_path / "moving", moving)
    assert np.isfinite(found.depth_mm).all()
    assert account["no_depth_rows_n"] == 0


def with_cell(rows: pd.DataFrame, row_i: int, column: str, value: object) -> pd.DataFrame:
    rows = rows.astype({column: object})
    rows.loc[row_i, column] = value
    return rows


MISTAKES = {
    "text instead of a number": (lambda t: with_cell(t, 9, "Bx1", "high"), "Bx1 in line 11"),
    "empty field": (lambda t: with_cell(t, 4, "By0", ""), "By0 in line 6"),
    "unknown phase": (lambda t: with_cell(t, 2, "phase", "touch"), "phase in line 4"),
    "no column of places": (lambda t: t.drop(columns="x_mm"), "x_mm"),
    "no z column of a chip": (lambda t: t.drop(columns="Bz1"), "Bz1"),
    "no row before the first touch": (lambda t: t[3:], "the press in line 2 has no"),
    "no row in contact": (lambda t: t[t.phase == "noload"], "no row has phase contact"),
    "fields in millitesla": (
        lambda t: t.assign(**{c: t[c] / 1e3 for c in plain.columns_of(CHIPS_N)[3:9]}),
        "convert the fields to uT",
    ),
    "wrong sign of forces": (lambda t: t.assign(Fz_N=-t.Fz_N), "Reverse the sign of Fz_N"),
    "misspelt column name": (lambda t: t.rename(columns={"Fz_N": "Fz"}), "'Fz'"),
    "missing force in one row": (lambda t: with_cell(t, 10, "Fz_N", ""), "Fz_N in line 12"),
    "number of an indentation used twice": (
        lambda t: t.assign(indentation=np.repeat([0, 1, 0, 2, 3, 4], 7)),
        "indentation 0 begins again in line 19",
    ),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_error_names_the_wrong_line_or_column(tmp_path, what):
    change, message = MISTAKES[what]
    with pytest.raises(CaptureError, match=re.escape(message)):
        read(tmp_path, change(table()))


def test_recording_converted_by_the_script_in_the_docs_equals_that_of_layout_eflesh(tmp_path, shared_data, monkeypatch):
    recording = shared_data / "eflesh/normal_force/20250401_014340_probe"
    script = re.search(r"```python\n(import pandas as pd.*?)```", (ROOT / "data/README.md").read_text(), re.DOTALL)
    for file in recording.glob("*.csv"):
        (tmp_path / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    exec(script[1], {})
    ours, _ = read(tmp_path, pd.read_csv("mine.csv"))
    chips_n = eflesh.count_chips(eflesh.collect(recording))
    header = make_header(layout="eflesh", chips_n=chips_n, options={"force_axis": "z"})
    theirs, _ = eflesh.read(recording, header, DEFAULT_POLICY)
    np.testing.assert_allclose(ours.b_uT, theirs.b_uT, rtol=1e-6)
    np.testing.assert_allclose(ours.noload_uT, theirs.noload_uT, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(ours.x_mm, theirs.x_mm, atol=1e-3)


def test_command_template_writes_the_header_line_of_a_table(tmp_path):
    out = tmp_path / "mine.csv"
    done = CliRunner().invoke(app, ["template", str(out), "--chips", "3"])
    assert done.exit_code == 0, done.output
    assert out.read_text().strip().split(",") == plain.columns_of(3)
    capture = tmp_path / "capture"
    capture.mkdir()
    (capture / plain.CSV).write_text(out.read_text())
    with pytest.raises(CaptureError, match="no row has phase contact"):
        plain.read(capture, make_header(layout="table", chips_n=3), DEFAULT_POLICY)


def test_passes_are_read_from_their_column_or_found_from_repeated_places(tmp_path):
    one = table(presses_n=9)
    three = pd.concat([one] * 3, ignore_index=True)
    found, account = read(tmp_path / "found", three)
    np.testing.assert_array_equal(found.pass_i, np.repeat([0, 1, 2], len(found) // 3))
    assert account["passes_n"] == 3
    given, _ = read(tmp_path / "given", three.assign(**{"pass": 7}))
    assert set(given.pass_i) == {7}
    deeper = pd.concat([one.assign(depth_mm=depth) for depth in (0.2, 0.4, 0.6)], ignore_index=True)
    other, account = read(tmp_path / "deeper", deeper)
    assert set(other.pass_i) == {0}
    assert account["passes_n"] == 1


def test_error_names_channels_that_never_change(tmp_path):
    rows = table()
    rows["Bz0"], rows["Bz1"] = 12.5, 0.0
    rows.to_csv(tmp_path / plain.CSV, index=False)
    assert "Bz of chip 0 (12.5 uT), Bz of chip 1 (0 uT) never changed in the whole recording" in error_of(tmp_path)


def test_table_of_field_changes_instead_of_fields_is_refused(tmp_path):
    rows, columns = table(presses_n=2), plain.columns_of(CHIPS_N)[3:9]
    fields_uT = rows[columns].to_numpy()
    rest = (rows["phase"] == "noload").to_numpy()
    rows[columns] = (fields_uT - fields_uT[rest].mean(axis=0)) / 5
    rows.to_csv(tmp_path / plain.CSV, index=False)
    assert "A baseline seems to have been subtracted" in error_of(tmp_path)
    rows[columns] = fields_uT / 1000
    rows.to_csv(tmp_path / plain.CSV, index=False)
    assert "convert the fields to uT" in error_of(tmp_path)


def test_error_says_that_numbers_have_decimal_commas(tmp_path):
    table().to_csv(tmp_path / plain.CSV, index=False, sep=";", decimal=",")
    assert "x_mm in line 2 must be a number" in error_of(tmp_path)
