import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.header import Clock, check_same_capture, parse, render, write_capture
from tests.recordings.headers import make_header


@given(st.floats(0.1, 1e5), st.lists(st.tuples(st.floats(0, 1e9), st.floats(0, 1e9)), max_size=3))
def test_header_round_trip(rate_hz, marks):
    clock = Clock(kind="rate", rate_hz=rate_hz, marks=tuple(marks))
    header = make_header(layout="native", wire="binary", clock=clock)
    assert parse(render(header), "header.json") == header


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"unit_b": "mT"}, "header.json: unit_b: Input should be 'uT'; got 'mT'"),
        ({"chips_n": 0}, "chips_n: Input should be greater than or equal to 1; got 0"),
        ({"chips_n": "5"}, "chips_n: Input should be a valid integer; got '5'"),
        ({"board": "../b"}, "board: String should match pattern"),
        ({"format": "reskin-capture/2"}, "format: Input should be 'reskin-capture/1'"),
        ({"colour": "red"}, "colour: Extra inputs are not permitted; got 'red'"),
        ({"wire": "binary"}, "wire belongs to layout 'native', and to no other"),
        ({"clock": {"kind": "rate", "rate_hz": None, "marks": []}}, "rate_hz belongs to clock kind 'rate'"),
    ],
)
def test_invalid_field_is_named(changed, message):
    fields = json.loads(render(make_header())) | changed
    with pytest.raises(CaptureError, match=message):
        parse(json.dumps(fields), "header.json")


def test_missing_field_is_an_error():
    fields = json.loads(render(make_header()))
    del fields["skin"]
    with pytest.raises(CaptureError, match="skin: Field required; got nothing"):
        parse(json.dumps(fields), "header.json")


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00", "null"])
def test_malformed_header_is_refused(text):
    with pytest.raises(CaptureError, match="header.json: header: ") as caught:
        parse(text, "header.json")
    assert "\n" not in str(caught.value)


def test_renamed_folder_is_refused():
    with pytest.raises(CaptureError, match="capture must be the folder's name 'other'; got 'a_capture'"):
        check_same_capture(make_header(), "other")


def test_capture_checks_its_files(tmp_path):
    (tmp_path / "source.csv").write_bytes(b"copied")
    header = write_capture(tmp_path / "c0", make_header(), {"a.bin": b"bytes", "b.csv": tmp_path / "source.csv"})
    assert header.files == {
        name: hashlib.sha256(text).hexdigest() for name, text in (("a.bin", b"bytes"), ("b.csv", b"copied"))
    }
    assert (tmp_path / "c0/b.csv").read_bytes() == b"copied"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c0", "source.csv"]


def test_missing_source_leaves_no_folder(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_capture(tmp_path / "c0", make_header(), {"a.bin": b"bytes", "b.csv": tmp_path / "none.csv"})
    assert list(tmp_path.iterdir()) == []
