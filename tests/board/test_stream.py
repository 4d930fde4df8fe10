"""Tests of the stream decoder: results do not depend on chunks, and every byte is in a frame or counted as skipped."""

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.experiments.extremes.serial import cut_start, decode_portions, lost_frames_n, records
from reskin import io
from reskin.board import stream
from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import Frames, encode, line_bytes_max_n, record_type
from reskin.errors import CaptureError
from reskin.recordings.decode import decode_file
from tests.board.signals import BINARY_WIRES, TEXT_WIRES, WIRES, CRLF_TEMPERATURE_degC, frames_strategy, make_frames

EVERY_WIRE = st.sampled_from(WIRES)
FIELDS = ("b_uT", "temperature_degC", "device_s", "end_byte")


def chips_of(frames: Frames) -> int:
    return frames.temperature_degC.shape[1]


def check_account(account: dict[str, int], data: bytes) -> None:
    skipped_n = sum(n for name, n in account.items() if name.startswith("skipped_"))
    assert account["frame_bytes_n"] + skipped_n == account["bytes_n"] == len(data)


def check_damage(frames, wire, chunks, *, lost_n, false_n):
    assert lost_frames_n(chunks, frames, wire, false_n=false_n, not_finite_n=None) <= lost_n


def check_equal(frames: Frames, others: Frames) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(frames, name), getattr(others, name))


def split_bytes(data: bytes, sizes: list[int]) -> list[bytes]:
    return [data[first:last] for first, last in pairwise([0, *np.cumsum(sizes).tolist(), None])]


# Undamaged streams ----------------------------------------------------------------------------------------------


@given(frames_strategy(), EVERY_WIRE, st.lists(st.integers(0, 200), max_size=8))
def test_encoded_frames_are_decoded_in_chunks_of_any_size(frames, wire, sizes):
    data = encode(frames, wire)
    decoded, account = decode_portions(split_bytes(data, sizes), wire, chips_of(frames))
    decimals = 2 if wire in TEXT_WIRES else 10
    np.testing.assert_array_equal(decoded.b_uT, frames.b_uT.astype(float).round(decimals).astype(np.float32))
    assert account["frames_n"] == len(frames)
    assert account["frame_bytes_n"] == len(data)
    check_account(account, data)


@given(st.integers(1, 5), st.binary(max_size=400))
def test_frames_that_contain_any_finite_numbers_are_decoded_unchanged(chips_n, payload):
    values = np.frombuffer(payload[: len(payload) // (16 * chips_n) * 16 * chips_n], "<f4").reshape(-1, 4 * chips_n)
    values = np.where(np.isfinite(values), values, np.float32(0))
    data = b"".join(struct.pack(f"<{4 * chips_n}f", *row) + b"\r\n" for row in values)
    frames, _ = decode_portions([data], "binary", chips_n)
    np.testing.assert_array_equal(frames.temperature_degC, values[:, ::4])


@pytest.mark.parametrize("wire", WIRES)
def test_decoding_byte_by_byte_gives_the_same_frames_as_decoding_all_bytes_at_once(wire):
    data = b"\x07rubbish" + encode(make_frames(6, 5, 1, crlf_share=0.3), wire)[5:-3]
    data = data[:200] + data[205:]
    whole, account = decode_portions([data], wire, 5)
    single, single_account = decode_portions([data[i : i + 1] for i in range(len(data))], wire, 5)
    assert len(whole) >= 3
    check_equal(whole, single)
    assert account == single_account


@pytest.mark.parametrize("wire", WIRES)
def test_frame_is_returned_when_its_last_byte_has_arrived(wire):
    frames = make_frames(4, 5, 2)
    frame_stream, data = FrameStream(wire, 5), encode(frames, wire)
    arrivals = [i + 1 for i in range(len(data)) for _ in range(len(frame_stream.feed(data[i : i + 1])))]
    whole, _ = decode_portions([data], wire, 5)
    assert arrivals == whole.end_byte.tolist()


@given(st.binary(max_size=600), EVERY_WIRE, st.integers(1, 3), st.lists(st.integers(0, 50), max_size=8))
def test_decoding_of_random_bytes_does_not_depend_on_the_chunks(data, wire, chips_n, sizes):
    whole, account = decode_portions([data], wire, chips_n)
    chunks, chunks_account = decode_portions(split_bytes(data, sizes), wire, chips_n)
    check_equal(whole, chunks)
    assert account == chunks_account
    check_account(account, data)


FRAGMENTS = (b"\r\n", b"\r", b"\n", b"\r\n" * 9, b"\0" * 16, b"\0" * 7, b"B", b"\xff\x7f")


@settings(max_examples=150)
@given(st.lists(st.sampled_from(FRAGMENTS)).map(b"".join), st.integers(1, 2), st.lists(st.integers(1, 30), max_size=8))
def test_decoding_of_bytes_with_many_terminators_does_not_depend_on_the_chunks(data, chips_n, sizes):
    whole, account = decode_portions([data], "binary", chips_n)
    chunks, chunks_account = decode_portions(split_bytes(data, sizes), "binary", chips_n)
    check_equal(whole, chunks)
    assert account == chunks_account
    check_account(account, data)


# Damaged streams: `lost_frames_n` also checks false frames and counted bytes ----------------------------------


@settings(max_examples=150)
@given(frames_strategy(min_frames_n=6), st.sampled_from(BINARY_WIRES), st.floats(0, 1), st.floats(0, 1))
def test_at_most_two_frames_are_lost_if_bytes_are_missing(frames, wire, where, missing_share):
    data = encode(frames, wire)
    missing_n = 1 + int(missing_share * (record_type(wire, chips_of(frames)).itemsize - 2))
    first = int(where * (len(data) - missing_n))
    # The decoder mistakes the remains of two damaged frames for a frame only if the numbers of a frame contain CR LF,
    # and this is one frame length before the end of the remains.
    false_n = int(data.count(b"\r\n") > len(frames))
    check_damage(frames, wire, [data[:first], data[first + missing_n :]], lost_n=2, false_n=false_n)


@settings(max_examples=150)
@given(frames_strategy(min_frames_n=6), st.sampled_from(BINARY_WIRES), st.floats(0, 1), st.binary(max_size=300))
def test_at_most_two_frames_are_lost_if_bytes_are_inserted(frames, wire, where, noise):
    data = encode(frames, wire)
    first = int(where * len(data))
    check_damage(frames, wire, [data[:first], noise, data[first:]], lost_n=2, false_n=len(noise))


@given(frames_strategy(min_frames_n=4), st.sampled_from(TEXT_WIRES), st.floats(0, 1), st.integers(1, 40))
def test_only_the_lines_that_contained_missing_bytes_of_text_are_lost(frames, wire, where, missing_n):
    data = encode(frames, wire)
    first = int(where * max(len(data) - missing_n, 0))
    damaged = data[:first] + data[first + missing_n :]
    touched_n = data[: first + missing_n].count(b"\n") - data[:first].count(b"\n") + 1
    check_damage(frames, wire, [damaged], lost_n=touched_n, false_n=len(frames))


@given(frames_strategy(min_frames_n=4), st.sampled_from(BINARY_WIRES), st.floats(0, 1))
def test_only_one_frame_is_lost_if_a_stream_starts_within_a_frame(frames, wire, where):
    length_n = record_type(wire, chips_of(frames)).itemsize
    # The cut is not between CR and LF. Otherwise, the next frame would be lost too.
    joined_n = 1 + int(where * (length_n - 3))
    assert lost_frames_n(cut_start(frames, wire, (joined_n + 0.5) / length_n), frames, wire) <= 1


def test_frames_whose_temperature_contains_the_terminator_are_decoded():
    frames = make_frames(50, 5, 3)
    frames.temperature_degC[:] = CRLF_TEMPERATURE_degC
    for n in range(1, 81):
        assert lost_frames_n(cut_start(frames, "binary", n / 82), frames, "binary") <= 1


def test_remains_of_two_damaged_frames_are_not_taken_for_a_frame():
    frames = make_frames(6, 1, 3)
    frames.temperature_degC[2], frames.b_uT[2, 0] = CRLF_TEMPERATURE_degC, 100.0
    data = encode(frames, "binary")
    # Of frames 2 and 3, 8 and 13 bytes remain. After the CR LF in the temperature, they are as long as a frame.
    kept, _ = decode_portions([data[: 2 * 18 + 8] + data[3 * 18 + 5 :]], "binary", 1)
    assert records(kept) == [record for i, record in enumerate(records(frames)) if i not in (2, 3)]


@pytest.mark.parametrize("wire", BINARY_WIRES)
def test_frames_with_failed_reads_are_decoded(wire):
    frames = make_frames(20, 5, 4)
    frames.b_uT[:], frames.temperature_degC[:] = np.tile([8028.16, 5194.00, 12943.36], 5), -880.49
    kept, account = decode_portions([encode(frames, wire)[30:]], wire, 5)
    assert len(kept) == 19
    assert account["frames_n"] == 19


def test_skipped_bytes_are_counted_by_reason():
    frames = make_frames(10, 5, 5)
    frames.b_uT[3, 2], frames.temperature_degC[6, 0] = np.nan, np.inf
    data = b"junk\r\n" + encode(frames, "binary")[:-20]
    _, account = decode_portions([data], "binary", 5)
    assert account == {
        "bytes_n": len(data), "frames_n": 7, "frame_bytes_n": 7 * 82,
        "not_finite_frames_n": 2, "skipped_not_finite_bytes_n": 2 * 82,
        "skipped_resync_bytes_n": 6, "skipped_truncated_bytes_n": 62,
    }  # fmt: skip


def test_frame_with_an_infinite_clock_is_counted_as_not_finite():
    frames = make_frames(3, 2, 6)
    frames.device_s[1] = np.inf
    assert decode_portions([encode(frames, "binary-clock")], "binary-clock", 2)[1]["not_finite_frames_n"] == 1


@pytest.mark.parametrize("word", ["nan", "inf", "-inf", "ovf"])
@pytest.mark.parametrize("wire", TEXT_WIRES)
def test_text_frame_with_nan_or_inf_is_counted_as_not_finite(wire, word):
    line = encode(make_frames(1, 2, 7), wire)
    damaged = word.encode() + line[line.index(b"\t") :]
    _, account = decode_portions([line + damaged + line], wire, 2)
    assert account["frames_n"] == 2
    assert account["not_finite_frames_n"] == 1
    assert account["skipped_not_finite_bytes_n"] == len(damaged)


@pytest.mark.parametrize("chunk_n", [1, 7, 10**6])
def test_line_without_an_end_is_skipped(chunk_n):
    line = encode(make_frames(1, 1, 8), "text-xyzt")
    data = line + b"9" * 3 * line_bytes_max_n(1) + line + line
    kept, account = decode_portions([data[i : i + chunk_n] for i in range(0, len(data), chunk_n)], "text-xyzt", 1)
    assert len(kept) == 2
    check_account(account, data)


def test_rest_of_a_line_without_an_end_is_not_a_frame():
    line = encode(make_frames(1, 1, 8), "text-xyzt")
    kept, account = decode_portions([line + b"9" * 2 * line_bytes_max_n(1), line, line], "text-xyzt", 1)
    assert kept.end_byte.tolist() == [len(line), account["bytes_n"]]


def test_end_bytes_of_text_frames_are_right_in_several_blocks(monkeypatch):
    data = encode(make_frames(10, 2, 8), "text-xyzt")
    monkeypatch.setattr(stream, "BLOCK_LINES_N", 3)
    kept, _ = decode_portions([data[:20], data[20:]], "text-xyzt", 2)
    assert kept.end_byte.tolist() == np.cumsum([len(line) for line in data.splitlines(keepends=True)]).tolist()


def test_long_stream_with_many_damaged_frames_is_decoded():
    frames = make_frames(3 * stream.BLOCK_FRAMES_N, 5, 9, crlf_share=0.01)
    data = encode(frames, "binary")
    data = b"".join(data[i + 7 : i + 82 * 100] for i in range(0, len(data), 82 * 100))
    kept, account = decode_portions([data], "binary", 5)
    assert len(kept) == len(frames) - -(-len(frames) // 100)
    assert account["frames_n"] == len(kept)


# Errors ---------------------------------------------------------------------------------------------------------


# Fewer examples than usual, because an error is slow: all wire formats are tried.
@settings(max_examples=25, deadline=None)
@given(st.binary(max_size=2000), EVERY_WIRE, st.integers(1, 6))
def test_random_bytes_are_decoded_or_raise_a_capture_error(data, wire, chips_n):
    try:
        frames, _ = decode_all(data, wire, chips_n, "random")
        assert len(frames)
    except CaptureError:
        pass


@pytest.mark.parametrize("wire", WIRES)
def test_empty_stream_is_refused(wire):
    with pytest.raises(CaptureError, match="empty.bin: no frame found in 0 bytes"):
        decode_all(b"", wire, 5, "empty.bin")


def test_error_suggests_the_wire_format_that_fits():
    data = encode(make_frames(20, 4, 10), "binary")
    with pytest.raises(
        CaptureError,
        match="Check the baud rate, the number of chips and the wire format. The bytes fit binary with 4 chips",
    ):
        decode_all(data, "binary", 5, "a.bin")


def test_error_has_no_suggestion_if_no_wire_format_fits():
    with pytest.raises(CaptureError, match="in 1 bytes, .*The bytes are no known frames. Check the baud rate."):
        decode_all(b"\0", "binary", 5, "a.bin")


def test_decoded_file_is_a_table_with_units(tmp_path):
    frames = make_frames(4, 2, seed=0)
    (tmp_path / "dump.bin").write_bytes(encode(frames, "binary"))
    account = decode_file(tmp_path / "dump.bin", tmp_path / "frames.parquet", "binary", 2)
    table = io.read_table(tmp_path / "frames.parquet")
    assert account["frames_n"] == len(table) == 4
    np.testing.assert_array_equal(table["by1_uT"].to_numpy(), frames.b_uT[:, 4])
    np.testing.assert_array_equal(table["temperature1_degC"].to_numpy(), frames.temperature_degC[:, 1])
    assert table.schema.field("bz0_uT").metadata[b"unit"] == b"uT"
    assert table["end_byte"].to_pylist() == [34, 68, 102, 136]


def test_dumped_stream_without_frames_is_refused(tmp_path):
    (tmp_path / "dump.bin").write_bytes(b"abc")
    with pytest.raises(CaptureError, match="no frame found in 3 bytes"):
        decode_file(tmp_path / "dump.bin", tmp_path / "frames.parquet", "binary", 2)
    assert not (tmp_path / "frames.parquet").exists()
