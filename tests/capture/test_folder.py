import hashlib

import pytest

from pipeline.capture.header import write_capture
from tests.capture.headers import make_header


def test_a_capture_vouches_for_its_files(tmp_path):
    (tmp_path / "source.csv").write_bytes(b"copied")
    header = write_capture(tmp_path / "c0", make_header(), {"a.bin": b"bytes", "b.csv": tmp_path / "source.csv"})
    assert header.files == {
        name: hashlib.sha256(text).hexdigest() for name, text in (("a.bin", b"bytes"), ("b.csv", b"copied"))
    }
    assert (tmp_path / "c0/b.csv").read_bytes() == b"copied"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c0", "source.csv"]


def test_a_source_that_is_missing_leaves_no_folder(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_capture(tmp_path / "c0", make_header(), {"a.bin": b"bytes", "b.csv": tmp_path / "none.csv"})
    assert list(tmp_path.iterdir()) == []
