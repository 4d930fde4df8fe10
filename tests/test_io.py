from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import safetensors.numpy

from reskin import io
from reskin.errors import SchemaError
from reskin.schema import UNITS
from tests.data.tables import readings


def test_readings_written_to_a_file_are_read_unchanged(tmp_path):
    before = readings(x_mm=np.array([0, np.nan, 2, 3, 4, 5], np.float32))
    io.write_readings(tmp_path / "c0.parquet", [before], {"rows_n": 6})
    after = io.read_readings(tmp_path / "c0.parquet")
    for name in UNITS:
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
        assert getattr(after, name).dtype == getattr(before, name).dtype
    assert (after.capture, after.board, after.skin, after.source) == ("c0", "b0", "s0", "recorded")
    assert io.read_ingest_counts(tmp_path / "c0.parquet") == {"rows_n": 6}


def test_file_of_readings_states_the_units_of_columns_and_its_schema_version(tmp_path):
    io.write_readings(tmp_path / "c0.parquet", [readings()], {})
    schema = pq.read_schema(tmp_path / "c0.parquet")
    assert {field.name: field.metadata[b"unit"].decode() for field in schema if field.name in UNITS} == UNITS
    assert schema.metadata[b"reskin.schema"] == b"2"
    assert b"Force on the skin" in schema.metadata[b"reskin.force"]
    assert pq.ParquetFile(tmp_path / "c0.parquet").metadata.row_group(0).column(5).compression == "ZSTD"


def test_blocks_of_readings_are_concatenated_in_one_file(tmp_path):
    io.write_readings(tmp_path / "whole.parquet", [readings()], {})
    io.write_readings(tmp_path / "blocks.parquet", [readings(), readings()], {})
    assert len(io.read_readings(tmp_path / "blocks.parquet")) == 2 * len(io.read_readings(tmp_path / "whole.parquet"))


def test_equal_readings_are_written_as_equal_files(tmp_path):
    for name in ("one", "other"):
        io.write_readings(tmp_path / name, [readings()], {"rows_n": 6})
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()


def test_capture_without_readings_is_an_error(tmp_path):
    with pytest.raises(SchemaError, match="all readings of the capture were dropped"):
        io.write_readings(tmp_path / "c0.parquet", [], {})
    assert list(tmp_path.iterdir()) == []


def test_folder_that_cannot_be_created_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file/below", Path("/proc/nowhere")):
        with pytest.raises(SchemaError, match=f"^{folder}: cannot create this folder"):
            io.write_text(folder / "out.csv", "new")


def test_old_file_is_kept_if_writing_the_new_one_fails(tmp_path):
    io.write_text(tmp_path / "a.txt", "old")
    with pytest.raises(RuntimeError), io.replacing(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert [file.read_text() for file in tmp_path.iterdir()] == ["old"]


def read_texts(folder: Path) -> dict[str, str]:
    return {file.name: file.read_text(encoding="utf-8") for file in folder.iterdir()}


def test_write_texts_replaces_all_files_of_a_folder(tmp_path):
    io.write_texts(tmp_path / "tables", {"a.md": "old", "gone.md": "old"})
    io.write_texts(tmp_path / "tables", {"a.md": "±1 µT", "b.md": ""})
    assert read_texts(tmp_path / "tables") == {"a.md": "±1 µT", "b.md": ""}
    io.write_texts(tmp_path / "tables", {})
    assert read_texts(tmp_path / "tables") == {}
    assert [path.name for path in tmp_path.iterdir()] == ["tables"]


def test_old_folder_is_kept_if_writing_one_of_its_texts_fails(tmp_path):
    io.write_texts(tmp_path / "tables", {"a.md": "old", "b.md": "old"})
    with pytest.raises(UnicodeEncodeError):
        io.write_texts(tmp_path / "tables", {"a.md": "new", "b.md": "half a pair: \ud800"})
    assert read_texts(tmp_path / "tables") == {"a.md": "old", "b.md": "old"}
    assert [path.name for path in tmp_path.iterdir()] == ["tables"]


def test_wrong_unit_is_an_error(tmp_path):
    io.write_readings(tmp_path / "c0.parquet", [readings()], {})
    table = pq.read_table(tmp_path / "c0.parquet")
    i = table.schema.get_field_index("b_uT")
    table = table.cast(table.schema.set(i, table.schema.field("b_uT").with_metadata({"unit": "mT"})))
    io.write_table(tmp_path / "c1.parquet", table)
    with pytest.raises(SchemaError, match="unit of b_uT must be 'uT'; got mT"):
        io.read_readings(tmp_path / "c1.parquet")


def test_missing_column_is_an_error(tmp_path):
    io.write_readings(tmp_path / "c0.parquet", [readings()], {})
    io.write_table(tmp_path / "c1.parquet", pq.read_table(tmp_path / "c0.parquet").drop_columns(["noload_uT"]))
    with pytest.raises(SchemaError, match="column noload_uT is missing"):
        io.read_readings(tmp_path / "c1.parquet")


def test_write_json_raises_if_a_value_is_nan(tmp_path):
    with pytest.raises(ValueError, match="Out of range float"):
        io.write_json(tmp_path / "a.json", {"x": float("nan")})
    assert list(tmp_path.iterdir()) == []


def flip_bits(file: Path, every_n: int = 1) -> Iterator[int]:
    """Flip one bit in every n-th byte of a file, one after the other.

    While a bit is flipped, the index of its byte is yielded. Then the byte is restored.
    """
    content_before = file.read_bytes()
    for i in range(0, len(content_before), every_n):
        content = bytearray(content_before)
        content[i] ^= 1 << i % 8
        file.write_bytes(content)
        yield i
    file.write_bytes(content_before)


def test_flipped_bits_of_tensors_are_detected(tmp_path):
    file, tensors = tmp_path / "m.safetensors", {"a": np.arange(6.0, dtype=np.float32), "b": np.arange(4)}
    io.write_tensors(file, tensors, {"format": "1", "trial": "x"})
    detected_n = 0
    for _ in flip_bits(file):
        try:
            found, metadata = io.read_tensors(file)
        except SchemaError as error:
            detected_n += "m.safetensors: the file" in str(error)
            continue
        assert all(np.array_equal(found[name], tensors[name]) for name in tensors)
        assert {name: metadata[name] for name in ("format", "trial")} == {"format": "1", "trial": "x"}
    # Flipped bits in the name under which the digest is stored remain undetected.
    assert detected_n > file.stat().st_size - 8


def test_flipped_bits_of_tables_are_detected(tmp_path):
    file = tmp_path / "c0.parquet"
    io.write_readings(file, [readings()], {"rows_n": 6})
    before, chunks = repr(io.read_table(file).to_pydict()), pq.read_metadata(file).row_group(0)
    # The metadata of the file start after this byte.
    end, detected_n = chunks.column(chunks.num_columns - 1).data_page_offset, 0
    for i in flip_bits(file, every_n=3):
        try:
            assert repr(io.read_table(file).to_pydict()) == before or i > end
        except SchemaError as error:
            detected_n += i <= end and "c0.parquet: the file cannot be read as a Parquet file" in str(error)
    assert detected_n > end // 6  # The other flipped bits are in headers of pages and do not affect the values.


def test_tensors_without_digest_are_refused(tmp_path):
    safetensors.numpy.save_file({"a": np.arange(3.0)}, tmp_path / "m.safetensors", {"format": "1"})
    with pytest.raises(SchemaError, match="digest"):
        io.read_tensors(tmp_path / "m.safetensors")


def test_equal_tensors_are_written_as_equal_files(tmp_path):
    metadata = {name: name for name in "cabdhgfe"}
    for seed in range(6):
        io.write_tensors(tmp_path / str(seed), {"b": np.arange(3), "a": np.ones((2, 2))}, metadata)
    assert len({file.read_bytes() for file in tmp_path.iterdir()}) == 1
    assert list(safetensors.safe_open(tmp_path / "0", framework="numpy").keys()) == ["a", "b"]


@pytest.mark.parametrize("read", [io.read_bytes, io.read_json, io.read_table, io.read_readings, io.read_tensors])
def test_missing_file_is_an_error(tmp_path, read):
    with pytest.raises(SchemaError, match="none: file not found"):
        read(tmp_path / "none")


@pytest.fixture
def package(tmp_path):
    io._cache_state.cache_clear()
    (tmp_path / "a.py").write_text("x = 1\n")
    return tmp_path


def cached_files(package):
    return sorted((package / "__pycache__").glob("*"))


def test_cached_array_is_loaded_unchanged(package):
    array = np.random.default_rng(0).normal(size=(3, 2))
    assert io.load_cached_array(package, "flow 1") is None
    io.save_cached_array(package, "flow 1", array)
    np.testing.assert_array_equal(io.load_cached_array(package, "flow 1"), array)
    assert io.load_cached_array(package, "flow 2") is None


@pytest.mark.parametrize("what", ["source", "another source", "setting"])
def test_cached_array_is_not_loaded_after_a_change_of_source_or_setting(package, monkeypatch, what):
    io.save_cached_array(package, "flow", np.ones(3))
    if what == "setting":
        monkeypatch.setenv("ATEN_CPU_CAPABILITY", "default")
    else:
        (package / ("a.py" if what == "source" else "b.py")).write_text("x = 2\n")
    io._cache_state.cache_clear()
    assert io.load_cached_array(package, "flow") is None
    io.save_cached_array(package, "flow", np.zeros(3))
    assert len(cached_files(package)) == 1


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"no array"])
def test_damaged_array_is_not_loaded(package, content):
    io.save_cached_array(package, "flow", np.ones(3))
    cached_files(package)[0].write_bytes(content)
    assert io.load_cached_array(package, "flow") is None


def test_array_is_not_cached_if_the_folder_cannot_be_written(package):
    (package / "__pycache__").write_text("a file in the way")
    io.save_cached_array(package, "flow", np.ones(3))
    assert io.load_cached_array(package, "flow") is None
