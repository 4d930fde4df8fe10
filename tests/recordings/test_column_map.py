"""Tests of maps of columns: tables of other recorders become tables of layout `table`."""

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from reskin.errors import CaptureError, ParamsError
from reskin.recordings.column_map import convert, read_map
from reskin.recordings.fault_policy import STANDARD_POLICY
from reskin.recordings.header import write_capture
from reskin.recordings.preparing import CaptureNames, mapped
from reskin.recordings.readers import READERS
from reskin.seeds import rng_for

ROOT = Path(__file__).resolve().parents[2]
FIELDS = [f"B{axis}{chip}" for chip in range(2) for axis in "xyz"]
RIGHT = pd.DataFrame(
    {
        "phase": ["noload"] * 3 + ["contact"] * 3, "x_mm": [1.0, 1, 1, 2, 2, 2.5], "y_mm": [-4.0] * 6,
        "Fz_N": [0.0, 0, 0, 1, 2, 3], "t_s": np.arange(6) + 0.25,
        **dict(zip(FIELDS, rng_for(0, "fields").normal(500, 20, (6, 6)).round(2).T, strict=True)),
    }
)  # fmt: skip
MAP = """\
fields: {Bx: "mag{}_x", By: "mag{}_y", Bz: "mag{}_z", first: 1, unit: mT, signs: [1, 1, -1]}
phase: {of: pressed, contact: [1]}
decimal_comma: true
columns:
  x_mm: {of: "X [cm]", unit: cm, sign: -1}
  y_mm: {of: Y, unit: cm}
  Fz_N: {of: load, unit: g}
  t_s: {of: [sec, nsec], unit: [s, ns]}
"""
SAME = """\
fields: {Bx: "B{}x", By: "B{}y", Bz: "B{}z"}
phase: phase
columns: {x_mm: x_mm, y_mm: y_mm, Fz_N: Fz_N, t_s: t_s}
"""


def foreign():
    data = {
        "sec": range(6), "nsec": [250_000_000] * 6, "pressed": [0, 0, 0, 1, 1, 1], "X [cm]": -RIGHT.x_mm / 10,
        "Y": RIGHT.y_mm / 10, "load": RIGHT.Fz_N / 9.80665e-3, "remark": "a",
    }  # fmt: skip
    signs = {"x": 1, "y": 1, "z": -1}
    return pd.DataFrame(data | {f"mag{int(n[2]) + 1}_{n[1]}": signs[n[1]] * RIGHT[n] / 1e3 for n in FIELDS})


def converted(tmp_path, file, text):
    (tmp_path / "map.yaml").write_text(text)
    return convert(file, read_map(tmp_path / "map.yaml")).to_pandas()


def check(found):
    assert set(found) == set(RIGHT)
    assert list(found.phase) == list(RIGHT.phase)
    for name in RIGHT.columns.drop("phase"):
        np.testing.assert_allclose(found[name], RIGHT[name], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_names_units_signs_and_split_times_are_converted(tmp_path, separator):
    foreign().to_csv(tmp_path / "a.csv", sep=separator, decimal=",", index=False)
    check(converted(tmp_path, tmp_path / "a.csv", MAP))


def renamed():
    return RIGHT.rename(columns={name: f"B{name[2]}{name[1]}" for name in FIELDS})


@pytest.mark.parametrize("container", ["csv", "utf-16", "gz", "parquet", "jsonl"])
def test_containers_are_read(tmp_path, container):
    file, data = tmp_path / f"a.{container}", renamed()
    match container:
        case "csv" | "utf-16":
            data.to_csv(file, index=False, encoding="utf-8" if container == "csv" else "utf-16")
        case "gz":
            file.write_bytes(gzip.compress(data.to_csv(index=False).encode()))
        case "parquet":
            data.to_parquet(file)
        case "jsonl":
            data.to_json(file, orient="records", lines=True, double_precision=15)
    check(converted(tmp_path, file, SAME))


LISTED = SAME.replace('{Bx: "B{}x", By: "B{}y", Bz: "B{}z"}', "{of: b}")


def test_lists_of_fields_and_arrays_are_read(tmp_path):
    lists = RIGHT.drop(columns=FIELDS).assign(b=list(RIGHT[FIELDS].to_numpy()))
    lists.to_parquet(tmp_path / "a.parquet")
    check(converted(tmp_path, tmp_path / "a.parquet", LISTED))
    lists.assign(T1=20.5, T2=21.5).to_parquet(tmp_path / "a.parquet")
    found = converted(tmp_path, tmp_path / "a.parquet", LISTED.replace("{of: b}", '{of: b, T: "T{}", first: 1}'))
    assert list(found.T0) == [20.5] * 6
    assert list(found.T1) == [21.5] * 6
    others = {name: RIGHT[name].to_numpy() for name in ("x_mm", "y_mm", "Fz_N", "t_s")}
    np.savez(tmp_path / "a.npz", b=RIGHT[FIELDS].to_numpy(), **others)
    check(converted(tmp_path, tmp_path / "a.npz", LISTED.replace("phase: phase", "phase: {of: Fz_N, above: 0.1}")))


def test_times_may_be_dates(tmp_path):
    data = renamed().assign(t_s=[f"2026-11-29T12:00:0{i}.5Z" for i in range(6)])
    data.to_csv(tmp_path / "a.csv", index=False)
    found = converted(tmp_path, tmp_path / "a.csv", SAME.replace("t_s: t_s", "t_s: {of: t_s, unit: iso}"))
    np.testing.assert_allclose(found.t_s, np.arange(6))


def test_date_and_time_may_be_in_two_columns_of_any_format(tmp_path):
    data = renamed().drop(columns="t_s").assign(Datum="04.03.2025", Zeit=[f"09:30:0{i},250" for i in range(6)])
    data.to_csv(tmp_path / "a.csv", index=False)
    in_map = 't_s: {of: [Datum, Zeit], format: "%d.%m.%Y %H:%M:%S,%f"}'
    np.testing.assert_allclose(
        converted(tmp_path, tmp_path / "a.csv", SAME.replace("t_s: t_s", in_map)).t_s, np.arange(6)
    )
    for wrong in (in_map.replace(",%f", ""), "t_s: {of: Datum, unit: iso}"):
        with pytest.raises(CaptureError, match=r"Write t_s as YYYY-MM-DDTHH:MM:SS, or state .* format"):
            converted(tmp_path, tmp_path / "a.csv", SAME.replace("t_s: t_s", wrong))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("Fz_N: Fz_N", 'Fz_N: {of: Fz_N, format: "%S"}'), "Fz_N: `format` is for t_s"),
        (("x_mm: x_mm", "x_mm: X"), "no column 'X'; the file has phase, x_mm"),
        (("Fz_N: Fz_N", "Fz_N: {of: Fz_N, unit: pound}"), "Fz_N: unit pound is not one of N, mN, kN, g, kg"),
        (("Fz_N: Fz_N", "Fn_N: Fz_N"), "Fn_N is not one of x_mm, y_mm"),
        (("phase: phase", "phase: {of: phase}"), "state one of `contact`, `above`"),
        (
            ("phase: phase", "phase: {of: phase, contact: [touch]}"),
            "by column phase, which has noload, contact",
        ),
        (("t_s: t_s", "t_s: {of: time, unit: iso}"), "no column 'time'"),
        (('{Bx: "B{}x", By: "B{}y", Bz: "B{}z"}', "{of: b}"), "no column 'b'"),
        (("t_s: t_s", "t_s: phase"), "phase in line 2 must be a number .*got 'noload'"),
    ],
)
def test_mistakes_in_a_map_are_named(tmp_path, change, message):
    renamed().to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises((CaptureError, ParamsError), match=message):
        converted(tmp_path, tmp_path / "a.csv", SAME.replace(*change))


@pytest.mark.parametrize(
    ("start", "what"),
    [(b"\x89HDF\r\n", "an HDF5 file"), (b"PK\x03\x04", "a zip or Excel file"), (b"\x89MCAP", "an MCAP")],
)
def test_other_containers_are_named_with_a_remedy(tmp_path, start, what):
    (tmp_path / "a.csv").write_bytes(start + bytes(100))
    with pytest.raises(CaptureError, match=f"the file is {what}.*\\. (Write|Save|Export)"):
        converted(tmp_path, tmp_path / "a.csv", SAME)


def test_map_in_the_examples_reads_the_recordings_of_eflash7(tmp_path, shared_data):
    columns = read_map(ROOT / "examples/eflash7_columns.yaml")
    for file in sorted((shared_data / "eflash7").glob("position_*.csv")):
        header, files = mapped(file, CaptureNames("flash", "pad", None), ROOT / "examples/eflash7_columns.yaml")
        folder = tmp_path / header.capture
        readings, counts = READERS["table"].read(folder, write_capture(folder, header, files), STANDARD_POLICY)
        raw = pd.read_csv(file)
        assert convert(file, columns).num_rows == counts["rows_read_n"] == len(raw)
        assert counts["dropped_failed_read_rows_n"] == (raw.filter(like="mag") == 0).all(axis=1).sum()
        np.testing.assert_allclose(readings.Fz_N.max(), -raw.fz.min(), rtol=0.02)


def test_a_column_may_tell_contact_and_be_a_number_too(tmp_path):
    data = renamed().assign(phase=[0, 0, 0, 1, 1, 1])
    data.to_csv(tmp_path / "a.csv", index=False)
    text = SAME.replace("phase: phase", "phase: {of: phase, contact: 1}").replace("t_s: t_s", "pass: phase")
    assert list(converted(tmp_path, tmp_path / "a.csv", text)["pass"]) == [0, 0, 0, 1, 1, 1]
    below = SAME.replace("phase: phase", "phase: {of: x_mm, below: 1.5}")
    assert list(converted(tmp_path, tmp_path / "a.csv", below).phase) == ["contact"] * 3 + ["noload"] * 3
