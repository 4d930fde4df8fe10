"""Tests that encoded frames have the firmware's byte layout, and that decoding returns the encoded values."""

import re
import struct

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from reskin.board import wire as wires
from reskin.board.wire import decode_lines, decode_runs, encode, record_type
from tests.board import signals
from tests.board.signals import BINARY_WIRES, frames_of, frames_strategy, make_frames


def lines_of(text: bytes, wire: str, chips_n: int):
    octets = np.frombuffer(text, np.uint8)
    return decode_lines(octets, np.flatnonzero(octets == 10) + 1, wire, chips_n)


def one_frame(chips_n: int):
    """Return a frame. Chip 0 reads 1.25, -2.5, 56.78 uT and 25 degC; each further chip reads 3 more."""
    b_uT = np.array([[1.25, -2.5, 56.78]]) + 3 * np.arange(chips_n)[:, None]
    return frames_of(b_uT.reshape(1, -1), 25.0 + 3 * np.arange(chips_n)[None])


@pytest.mark.parametrize(("chips_n", "bytes_n"), [(1, 18), (5, 82), (40, 642)])
def test_binary_frame_has_the_size_of_the_firmwares_frames(chips_n, bytes_n):
    assert record_type("binary", chips_n).itemsize == bytes_n
    assert record_type("binary-clock", chips_n).itemsize == bytes_n + 4


def test_binary_frame_has_the_bytes_of_the_firmware():
    values = (25.0, 1.25, -2.5, 56.78, 28.0, 4.25, 0.5, 59.78)
    assert encode(one_frame(2), "binary") == struct.pack("<8f", *values) + b"\r\n"


def test_binary_frame_with_a_clock_starts_with_its_seconds():
    frames = make_frames(3, 5, 0)
    data = encode(frames, "binary-clock")
    assert [struct.unpack_from("<f", data, 86 * i)[0] for i in range(3)] == frames.device_s.tolist()
    assert data[86 + 4 : 2 * 86] == encode(frames, "binary")[82 : 2 * 82]


def test_text_line_equals_that_of_the_reskin_firmware():
    assert encode(one_frame(2), "text-xyzt") == b"1.25\t-2.50\t56.78\t25.00\t4.25\t0.50\t59.78\t28.00\t\r\n"


def test_text_line_of_the_anyskin_firmware_has_no_tab_between_chips():
    assert encode(one_frame(2), "text-txyz") == b"25.00\t1.25\t-2.50\t56.7828.00\t4.25\t0.50\t59.78\r\n"


def test_values_that_no_tab_separates_are_split_after_two_decimals():
    frames, is_frame = lines_of(b"24.00\t1.00\t2.00\t-56.7825.00\t-3.00-4.000.05\n", "text-txyz", 2)
    assert is_frame.tolist() == [True]
    assert frames.temperature_degC.tolist() == [[24.0, 25.0]]
    assert frames.b_uT[0].tolist() == [1.0, 2.0, np.float32(-56.78), -3.0, -4.0, np.float32(0.05)]


def test_synthetic_signals_contain_the_bytes_of_the_terminator():
    for value in (signals.CRLF_TEMPERATURE_degC, *signals.CRLF_B_uT):
        assert b"\r\n" in struct.pack("<f", value)


@given(frames_strategy(), st.sampled_from(BINARY_WIRES))
def test_encoded_binary_frames_are_decoded_unchanged(frames, wire):
    data, chips_n = encode(frames, wire), frames.temperature_degC.shape[1]
    length_n = record_type(wire, chips_n).itemsize
    decoded, _ = decode_runs(np.frombuffer(data, np.uint8), [(0, len(frames))], wire, chips_n)
    for i in range(len(frames)):
        numbers = struct.unpack_from(f"<{4 * chips_n}f", data, (i + 1) * length_n - 16 * chips_n - 2)
        assert decoded.temperature_degC[i].tolist() == list(numbers[::4])
        assert decoded.b_uT[i].tolist() == [value for n, value in enumerate(numbers) if n % 4]
    np.testing.assert_array_equal(decoded.b_uT, frames.b_uT)
    np.testing.assert_array_equal(decoded.device_s, frames.device_s if wire == "binary-clock" else np.nan)
    assert decoded.end_byte.tolist() == [(i + 1) * length_n for i in range(len(frames))]


def test_frames_of_several_blocks_are_decoded_unchanged():
    frames = make_frames(2 * wires.BLOCK_FRAMES_N + 5, 2, 0)
    for wire in BINARY_WIRES:
        decoded, _ = decode_runs(np.frombuffer(encode(frames, wire), np.uint8), [(0, len(frames))], wire, 2)
        np.testing.assert_array_equal(decoded.b_uT, frames.b_uT)


LINE = re.compile(rb"(?:-?\d{1,10}\.\d\d\t?){4}\t?\r?\n")
FRAGMENTS = (b"1.25", b"-0.07", b"12345.67", b"\t", b"\r", b"\n", b"-", b".", b"7", b"nan", b"1.2", b"\xff")


@given(st.lists(st.lists(st.sampled_from(FRAGMENTS), max_size=12).map(b"".join), max_size=6))
@example([b"1.25\t2.25\t3.25\t4.25", b"1.251.251.251.25\t\r", b"\t1.251.251.251.25", b"1.25.1.25", b"1.25\t\t1.25"])
def test_only_well_formed_lines_are_frames(fragments):
    lines = [line.replace(b"\n", b"") + b"\n" for line in fragments]
    frames, is_frame = lines_of(b"".join(lines), "text-xyzt", 1)
    good = [line for line in lines if LINE.fullmatch(line) and not line.endswith((b"\t\t\n", b"\t\t\r\n"))]
    assert is_frame.tolist() == [line in good for line in lines]
    numbers = [[float(number) for number in re.findall(rb"-?\d+\.\d\d", line)] for line in good]
    expected = np.array(numbers, np.float32).reshape(-1, 4)
    np.testing.assert_array_equal(frames.b_uT, expected[:, :3])
    np.testing.assert_array_equal(frames.temperature_degC, expected[:, 3:])
