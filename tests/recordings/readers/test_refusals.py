"""Tests that every reader raises an error for random bytes, files without rows, and truncated lines."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.recordings.readers import READERS
from tests.recordings.readers import test_eflesh, test_ini, test_lab, test_leaphand, test_plain

WRITERS: dict[str, Callable[[Path], Path]] = {
    "table": test_plain.write,
    "lab": lambda folder: test_lab.write(folder, *test_lab.PRESSES),
    "ini": lambda folder: test_ini.write(folder, test_ini.ONE_PASS),
    "eflesh": test_eflesh.scan,
    "leaphand": test_leaphand.write,
}
TESTS = {
    "table": test_plain, "lab": test_lab, "ini": test_ini, "eflesh": test_eflesh, "leaphand": test_leaphand,
}  # fmt: skip
FILES = [(layout, name) for layout, reader in READERS.items() for name in reader.FILES]  # type: ignore[attr-defined]
WITHOUT_ROWS = [b"", b"x", b"1", b"\n", b"\x00\xff\xfe\n", test_lab.NAMES.encode(), f"{test_lab.NAMES}\n".encode()]


def refuse(folder: Path, layout: str, name: str, change: Callable[[bytes], bytes]) -> str:
    file = WRITERS[layout](folder) / name
    file.write_bytes(change(file.read_bytes()))
    return TESTS[layout].error_of(folder)


@pytest.mark.parametrize(("layout", "name"), FILES)
@pytest.mark.parametrize("content", WITHOUT_ROWS, ids=repr)
def test_file_without_rows_is_refused(tmp_path: Path, layout: str, name: str, content: bytes) -> None:
    assert name in refuse(tmp_path, layout, name, lambda _: content)


@settings(max_examples=100, deadline=None)
@given(content=st.binary(max_size=200), file=st.sampled_from(FILES))
def test_random_bytes_are_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, file: tuple[str, str]
) -> None:
    refuse(tmp_path_factory.mktemp("random"), *file, lambda _: content)


@settings(max_examples=120, deadline=None)
@given(data=st.data(), file=st.sampled_from(FILES))
def test_file_that_ends_within_a_line_is_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, file: tuple[str, str]
) -> None:
    def cut(whole: bytes) -> bytes:
        return whole[: data.draw(st.integers(0, len(whole) - 1).filter(lambda n: whole[n - 1 : n] != b"\n"))]

    refuse(tmp_path_factory.mktemp("cut"), *file, cut)
