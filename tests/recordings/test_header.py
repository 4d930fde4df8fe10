"""Tests of the headers of captures, and of opening a capture with the reader of its layout."""

import hashlib
import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.header import NAME, Clock, Rate, parse, render, write_capture
from reskin.recordings.ingest import check_losses, open_capture, read_header
from reskin.recordings.readers import READERS, lab
from tests.recordings.headers import DEFAULT_POLICY, make_header
from tests.recordings.readers.test_lab import NAMES, PRESSES


@given(st.floats(0.1, 1e5), st.lists(st.tuples(st.floats(0, 1e9), st.floats(0, 1e9)), max_size=3))
def test_written_header_is_read_unchanged(rate_hz, marks):
    clock = Clock(kind="rate", rate_hz=rate_hz, marks=tuple(marks))
    header = make_header(layout="native", wire="binary", clock=clock)
    assert parse(render(header), "header.json") == header


def test_frame_rate_in_a_header_is_optional():
    """Headers of old captures have no frame rate, because it was not measured. They are read, and written unchanged."""
    before = render(make_header())
    assert "rate" not in json.loads(before)
    assert parse(before, "header.json").rate is None
    rate = Rate(sent_hz=400.0, method="clock", arrived_hz=398.5, repeated_frames=0.0, repeated_readings=0.25)
    header = make_header(rate=rate)
    assert parse(render(header), "header.json").rate == rate


@pytest.mark.parametrize("name", ["b", "9", "Z_-", "x" * 64])
def test_names_of_up_to_64_letters_digits_and_dashes_are_valid(name):
    assert re.fullmatch(NAME, name)


@pytest.mark.parametrize("name", ["", "_b", "-b", "x" * 65, "b 1", "b.1", "../b", "b\n", "b\u00e4"])
def test_longer_names_and_names_with_other_characters_are_invalid(name):
    assert not re.fullmatch(NAME, name)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {
                "rate": {
                    "sent_hz": 400.0,
                    "method": "clock",
                    "arrived_hz": 400.0,
                    "repeated_frames": 1.5,
                    "repeated_readings": 0.0,
                }
            },
            "rate.repeated_frames: Input should be less than or equal to 1; got 1.5",
        ),
        ({"unit_b": "mT"}, "header.json: unit_b: Input should be 'uT'; got 'mT'"),
        ({"chips_n": 0}, "chips_n: Input should be greater than or equal to 1; got 0"),
        ({"chips_n": "5"}, "chips_n: Input should be a valid integer; got '5'"),
        ({"board": "../b"}, "board: String should match pattern"),
        ({"format": "reskin-capture/2"}, "format: Input should be 'reskin-capture/1'"),
        ({"colour": "red"}, "colour: Extra inputs are not permitted; got 'red'"),
        ({"wire": "binary"}, "wire must be given for layout 'native', and only for it"),
        ({"clock": {"kind": "rate", "rate_hz": None, "marks": []}}, "rate_hz must be given for clock kind 'rate'"),
        (
            {"clock": {"kind": "recording", "rate_hz": None, "marks": [[0.0, np.nan]]}},
            "clock.marks.0.1: Input should be a finite number",
        ),
    ],
)
def test_error_names_the_invalid_field(changed, message):
    fields = json.loads(render(make_header())) | changed
    with pytest.raises(CaptureError, match=message):
        parse(json.dumps(fields), "header.json")


def test_missing_field_is_reported():
    fields = json.loads(render(make_header()))
    del fields["skin"]
    with pytest.raises(CaptureError, match="skin: Field required; got nothing"):
        parse(json.dumps(fields), "header.json")


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00", "null"])
def test_malformed_header_is_refused(text):
    with pytest.raises(CaptureError, match="header.json: header: ") as caught:
        parse(text, "header.json")
    assert "\n" not in str(caught.value)


def test_capture_in_a_renamed_folder_is_refused(tmp_path):
    write_capture(tmp_path / "other", make_header(), {})
    with pytest.raises(CaptureError, match="the name of the folder, 'other'; got 'a_capture'"):
        open_capture(tmp_path / "other", DEFAULT_POLICY)


def test_header_contains_checksums_of_all_files(tmp_path):
    (tmp_path / "source.csv").write_bytes(b"copied")
    header = write_capture(tmp_path / "c0", make_header(), {"a.bin": b"bytes", "b.csv": tmp_path / "source.csv"})
    assert header.files == {
        name: hashlib.sha256(text).hexdigest() for name, text in (("a.bin", b"bytes"), ("b.csv", b"copied"))
    }
    assert (tmp_path / "c0/b.csv").read_bytes() == b"copied"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c0", "source.csv"]


def test_capture_of_a_missing_file_leaves_no_folder(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_capture(tmp_path / "c0", make_header(), {"a.bin": b"bytes", "b.csv": tmp_path / "none.csv"})
    assert list(tmp_path.iterdir()) == []


def capture(folder):
    text = "\n".join([NAMES, *PRESSES]) + "\n"
    write_capture(folder, make_header(capture=folder.name, chips_n=2), {lab.READINGS: text.encode()})
    return folder


def test_capture_opens_with_the_reader_of_its_layout(tmp_path):
    header, blocks, account = open_capture(capture(tmp_path / "c0"), DEFAULT_POLICY)
    assert header.layout in READERS
    assert sum(map(len, blocks)) == account["rows_n"] == 4


def test_capture_whose_file_was_changed_is_refused(tmp_path):
    folder = capture(tmp_path / "c0")
    with (folder / lab.READINGS).open("a") as stream:
        stream.write("\n")
    with pytest.raises(CaptureError, match="has changed since it was added"):
        open_capture(folder, DEFAULT_POLICY)
    (folder / lab.READINGS).unlink()
    with pytest.raises(CaptureError, match="file not found, although the header lists this file"):
        open_capture(folder, DEFAULT_POLICY)


def test_folder_without_header_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="not a capture folder: there is no header.json"):
        read_header(tmp_path)


@pytest.mark.parametrize(
    ("account", "message"),
    [
        (
            {"bytes_n": 100, "skipped_resync_bytes_n": 6},
            "more than 5% of 100 bytes are lost: 6 skipped_resync_bytes",
        ),
        ({"rows_read_n": 10, "dropped_failed_read_rows_n": 1}, "1 dropped_failed_read_rows"),
        ({"frames_n": 10, "dropped_no_time_frames_n": 9}, "9 dropped_no_time_frames"),
        ({"logged_indentations_n": 10, "dropped_no_frame_indentations_n": 9}, "9 dropped_no_frame_indentations"),
    ],
)
def test_capture_with_too_many_lost_frames_is_refused(account, message):
    with pytest.raises(CaptureError, match=message):
        check_losses(account, 0.05, "c0")


def test_capture_is_accepted_with_few_lost_bytes_and_many_frames_between_dwells():
    check_losses(
        {"bytes_n": 100, "skipped_resync_bytes_n": 5, "frames_n": 9, "dropped_between_dwells_frames_n": 8}, 0.05, "c0"
    )
