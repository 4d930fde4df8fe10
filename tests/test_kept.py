"""Tests of arrays that are cached in files in the folder of the code."""

import numpy as np
import pytest

from reskin import io


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
