"""Kept arrays: the same bits come back; a changed source, setting or file gives none; no rights are no fault."""

import numpy as np
import pytest

from reskin import io


@pytest.fixture
def package(tmp_path):
    io._cache_state.cache_clear()
    (tmp_path / "a.py").write_text("x = 1\n")
    return tmp_path


def files(package):
    return sorted((package / "__pycache__").glob("*"))


def test_what_was_kept_comes_back_to_the_last_bit(package):
    array = np.random.default_rng(0).normal(size=(3, 2))
    assert io.load_cached_array(package, "flow 1") is None
    io.save_cached_array(package, "flow 1", array)
    np.testing.assert_array_equal(io.load_cached_array(package, "flow 1"), array)
    assert io.load_cached_array(package, "flow 2") is None


@pytest.mark.parametrize("what", ["source", "another source", "setting"])
def test_another_state_gives_nothing_and_takes_the_place_of_the_old(package, monkeypatch, what):
    io.save_cached_array(package, "flow", np.ones(3))
    if what == "setting":
        monkeypatch.setenv("ATEN_CPU_CAPABILITY", "default")
    else:
        (package / ("a.py" if what == "source" else "b.py")).write_text("x = 2\n")
    io._cache_state.cache_clear()
    assert io.load_cached_array(package, "flow") is None
    io.save_cached_array(package, "flow", np.zeros(3))
    assert len(files(package)) == 1


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"no array"])
def test_a_file_that_is_no_array_is_computed_again(package, content):
    io.save_cached_array(package, "flow", np.ones(3))
    files(package)[0].write_bytes(content)
    assert io.load_cached_array(package, "flow") is None


def test_where_nothing_can_be_written_nothing_is_kept(package):
    (package / "__pycache__").write_text("a file in the way")
    io.save_cached_array(package, "flow", np.ones(3))
    assert io.load_cached_array(package, "flow") is None
