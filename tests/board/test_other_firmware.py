"""Tests of the formats of other firmware: no reading is delivered unless the user states the format."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin.board.find import recognise
from reskin.board.other_firmware import CustomWire, custom_wire, read_wire
from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import Frames, encode
from reskin.errors import CaptureError, ParamsError
from reskin.seeds import rng_for

CHIPS_N, FRAMES_N = 5, 120
FIELDS = tuple(f"B{axis}{chip}" for chip in range(CHIPS_N) for axis in "xyz")
RNG = rng_for(0, "custom")
B_uT = np.round((np.tile([100.0, 50.0, -800.0], CHIPS_N) + RNG.normal(0, 3, (FRAMES_N, 15))) / 0.15) * 0.15


def lines(separator: str, digits: int = 2, comma: bool = False) -> bytes:
    text = "".join(separator.join(f"{value:.{digits}f}" for value in row) + "\r\n" for row in B_uT)
    return (text.replace(".", ",") if comma else text).encode()


def labelled() -> bytes:
    names = [f"Board0Sensor{chip}{axis}" for chip in range(CHIPS_N) for axis in "XYZ"]
    rows = (",".join(f"{name}:{value:.2f}" for name, value in zip(names, row, strict=True)) for row in B_uT)
    return "".join(f"{row}\r\n" for row in rows).encode()


def records(header: bytes = b"\xaa\x55", counter: bool = True, end: bytes = b"", form: str = "<15f") -> bytes:
    parts = []
    for i, row in enumerate(B_uT):
        body = (
            header
            + bytes([i & 255] * counter)
            + struct.pack(form, *(row if "f" in form else np.rint(row * 10).astype(int)))
        )
        parts.append(body + bytes([sum(body) & 255] * bool(header)) + end)
    return b"".join(parts)


TEXT = CustomWire(kind="text", columns=FIELDS)
SYNC = CustomWire(kind="binary", columns=FIELDS, header="AA55", skipped_n=1, checksum="sum8")
CASES = {
    "commas": (lines(","), TEXT), "three decimals": (lines("\t", 3), TEXT), "tabs": (lines("\t"), TEXT),
    "labelled": (labelled(), TEXT), "semicolons and commas": (
        lines("; ", comma=True), TEXT.model_copy(update={"decimal_comma": True}),
    ),
    "header, counter, checksum": (records(), SYNC),
    "no temperature": (records(b"", False, b"\r\n"), CustomWire(kind="binary", columns=FIELDS, end="0D0A")),
    "big-endian integers": (
        records(form=">15h"), SYNC.model_copy(update={"number": "int16", "big_endian": True, "uT": 0.1}),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_no_reading_is_delivered_without_the_format_and_all_with_it(case):
    data, wire = CASES[case]
    found = recognise("port", [(data, 1.0)])
    assert found.problem is not None
    assert "--wire" in found.problem
    if wire.kind == "text" and not wire.decimal_comma:
        assert "15 numbers a line" in found.problem
    frames, account = decode_all(data, wire, CHIPS_N, "port")
    np.testing.assert_allclose(frames.b_uT, B_uT, atol=0.06)
    assert np.isnan(frames.temperature_degC).all()
    assert account["bytes_n"] == account["frame_bytes_n"] == len(data)
    board = recognise("port", [(data, 1.0)], wire)
    assert (board.problem, board.chips_n) == (None, CHIPS_N)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(CASES)), st.lists(st.integers(1, 700), max_size=20), st.binary(max_size=60))
def test_result_does_not_depend_on_how_bytes_arrive_and_every_byte_is_counted(case, cuts, junk):
    data, wire = CASES[case]
    data = data[: len(data) // 2] + junk + data[len(data) // 2 :]
    whole, account = decode_all(data, wire, CHIPS_N, "port")
    stream, parts, start = FrameStream(wire, CHIPS_N), [], 0
    for cut in [*np.cumsum(cuts).tolist(), len(data)]:
        parts.append(stream.feed(data[start:cut]))
        start = max(start, cut)
    parts.append(stream.close())
    assert sum(map(len, parts)) == len(whole) >= FRAMES_N - 2
    np.testing.assert_array_equal(np.concatenate([part.b_uT for part in parts]), whole.b_uT)
    np.testing.assert_array_equal(np.concatenate([part.end_byte for part in parts]), whole.end_byte)
    assert stream.account() == account
    lost_n = (
        account["skipped_not_finite_bytes_n"] + account["skipped_resync_bytes_n"] + account["skipped_truncated_bytes_n"]
    )
    assert account["frame_bytes_n"] + lost_n == len(data)


def test_a_wrong_checksum_drops_the_frame():
    damaged = bytearray(records())
    damaged[64 * 10 + 20] ^= 1
    frames, account = decode_all(bytes(damaged), SYNC, CHIPS_N, "port")
    assert len(frames) == FRAMES_N - 1
    assert account["skipped_resync_bytes_n"] == SYNC.frame_bytes_n


def test_several_boards_temperatures_and_times_in_a_line():
    wire = read_wire("text:t_s,Bx0,By0,Bz0,T0,-,Bx1,By1,Bz1,T1")
    frames, _ = decode_all(b"0.5 1 2 3 20 99 4 5 6 21\n1.0 1 2 3 20 99 4 5 7 21\n", wire, 2, "port")
    np.testing.assert_array_equal(frames.b_uT, [[1, 2, 3, 4, 5, 6], [1, 2, 3, 4, 5, 7]])
    np.testing.assert_array_equal(frames.temperature_degC, [[20, 21]] * 2)
    np.testing.assert_array_equal(frames.device_s, [0.5, 1.0])


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-xyzt", "text-txyz"])
def test_known_formats_are_still_detected_from_their_first_bytes(wire):
    frames = Frames(
        B_uT.astype(np.float32), np.full((FRAMES_N, CHIPS_N), 25.5, np.float32), np.arange(FRAMES_N) / 100,
        np.zeros(FRAMES_N, int),
    )  # fmt: skip
    board = recognise("port", [(encode(frames, wire)[7:], 1.0)])
    assert (board.problem, board.wire, board.chips_n) == (None, wire, CHIPS_N)


def test_formats_are_read_from_text_and_files_and_wrong_ones_are_refused(tmp_path):
    assert read_wire("binary") == "binary"
    assert custom_wire("binary") is custom_wire(None) is None
    file = tmp_path / "mine.yaml"
    file.write_text(f"kind: binary\ncolumns: [{', '.join(FIELDS)}]\nheader: AA55\nskipped_n: 1\nchecksum: sum8\n")
    assert read_wire(str(file)) == SYNC
    for text, rule in (
        ("text-xyz", "no format.*Did you mean text-xyzt"), ("text:Bx0,By0", "columns"),
        ("text:Bx0,By0,B0", "B0 is not Bx0"), ("text:Bx0,By0,Bz1,Bx1,By1", "Bz0 is missing"),
        ("text:Bx0,By0,Bz0,Bz0", "occurs twice"), (str(tmp_path / "none.yaml"), "not found"),
    ):  # fmt: skip
        with pytest.raises(ParamsError, match=rule):
            read_wire(text)
    file.write_text(f"kind: binary\ncolumns: [{', '.join(FIELDS)}]\n")
    with pytest.raises(ParamsError, match="needs a header, an end or a checksum"):
        read_wire(str(file))
    with pytest.raises(CaptureError, match="no frame found"):
        decode_all(b"1,2,3\n" * 100, TEXT, CHIPS_N, "port")
