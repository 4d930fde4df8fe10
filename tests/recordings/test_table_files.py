"""Tests of table files: what counts as a number, and files that would fill the memory."""

import gzip
import zipfile
from contextlib import suppress

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from reskin.errors import CaptureError
from reskin.recordings import tables
from reskin.recordings.tables import TableFile


def read(file, **options):
    return TableFile(file, "here").read(["b"], ["a"], **options)


@pytest.mark.parametrize("cell", ["1_000", "٣", "0x10", "1e400", "inf", "2e12", "1.2.3", "1,5", "one", "- 1"])
def test_text_that_other_programs_do_not_take_for_a_number_is_refused_with_its_line(tmp_path, cell):
    file = tmp_path / "a.csv"
    file.write_text(f"a;b\nx;1\nx;{cell}\n")
    with pytest.raises(CaptureError, match="b in line 3 must be a number"):
        read(file)


def test_numbers_are_parsed_exactly_and_empty_cells_are_unknown(tmp_path):
    numbers = [-0.1, 1e-7, 123456.789012345678, 5e9, 0.30000000000000004, 7.0]
    cells = [*map(repr, numbers), "+.5", "5.", " 1E+3 ", "", "nan"]
    (tmp_path / "a.csv").write_text("a,b\n" + "".join(f"x,{cell}\n" for cell in cells))
    found = np.asarray(read(tmp_path / "a.csv")["b"])
    np.testing.assert_array_equal(found, [*numbers, 0.5, 5.0, 1000.0, np.nan, np.nan])


def test_large_files_are_read_in_blocks_and_name_the_line(tmp_path):
    lines = [f"x,{i}" for i in range(700_000)]
    (tmp_path / "a.csv").write_text("\n".join(["a,b", *lines]) + "\n")
    np.testing.assert_array_equal(read(tmp_path / "a.csv")["b"], np.arange(700_000))
    lines[600_000] = "x,?"
    (tmp_path / "a.csv").write_text("\n".join(["a,b", *lines]) + "\n")
    with pytest.raises(CaptureError, match="b in line 600002"):
        read(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'a,b,c\nx,1,\nx,2,"y\nx,3,z\n', "quotation mark"),
        (b"a,b\nx,1\nx\n", "line 3 has 1 columns"),
        (b"a,b\nx,1\n\xff\xfe,2\n", "cannot be read as a table"),
        (b"a,b\nx,1\nx,2", "no line break"),
        (b"a,b", "no line break"),
        (b"", "empty"),
        (b'{"a": "x", "b": ' + b"[" * 100_000 + b"\n", "cannot be read as a table"),
        (b'{"a": "x", "b": [1]}\n', "b: values of type list"),
        (b"PAR1" + bytes(50), "cannot be read as a table"),
        (b"a,b\rc\nx,1\n", "cannot be read as a table"),
        (b"PK\x03\x04" + bytes(50), "zip or Excel"),
        (b"\x1f\x8b" + bytes(50), "gzip file is damaged"),
    ],
)
def test_damaged_files_are_refused_in_one_sentence(tmp_path, content, message):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(CaptureError, match=message) as caught:
        read(tmp_path / "a.csv")
    assert "\n" not in str(caught.value)


def test_parquet_files_with_damaged_pages_raise_no_other_error(tmp_path):
    pq.write_table(pa.table({"a": ["x"] * 50, "b": np.arange(50.0)}), tmp_path / "a.parquet", compression="snappy")
    content = (tmp_path / "a.parquet").read_bytes()
    for start in range(4, 400, 40):
        (tmp_path / "a.parquet").write_bytes(content[:start] + b"\xff" * 40 + content[start + 40 :])
        with suppress(CaptureError):  # any other error would be a traceback for the user
            read(tmp_path / "a.parquet")


def test_small_files_that_expand_to_large_tables_are_refused_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "TABLE_BYTES_MAX", 1_000_000)
    rows = pa.table({"a": ["x"] * 100_000, "b": np.ones(100_000)})
    pq.write_table(rows, tmp_path / "a.parquet")
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"a,b\n" + b"x,1\n" * 300_000))
    np.savez_compressed(tmp_path / "a.npz", a=np.ones(100_000), b=np.ones(100_000))
    for file in tmp_path.iterdir():
        assert file.stat().st_size < 20_000
        with pytest.raises(CaptureError, match="GiB"):
            read(file)
    assert zipfile.is_zipfile(tmp_path / "a.npz")
