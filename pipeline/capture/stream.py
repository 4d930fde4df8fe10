"""From a stream to frames, without I/O. In: bytes in any portions. Out: whole frames, and a count of every lost byte.

No format marks a frame's start, and CR LF may stand inside a float (34.513275 degC has it), so where frames lie is
decided from the bytes alone, never from how they were portioned. Refuses to know ports, files and clocks.
"""

import re
from collections import Counter
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from jaxtyping import Bool, Int64, UInt8

from pipeline.capture import bursts
from pipeline.capture import wire as wires
from pipeline.capture.header import Wire
from pipeline.capture.wire import LF, Frames
from pipeline.core.errors import CaptureError

BLOCK_LINES_N = 8192
CHIPS_MAX_N = 64  # as in the header
ACCOUNT = ("bytes_n", "frames_n", "frame_bytes_n", "not_finite_frames_n", "skipped_not_finite_bytes_n",
           "skipped_resync_bytes_n", "skipped_truncated_bytes_n")  # fmt: skip


@dataclass(frozen=True)
class _Scan:
    """What a scan settled: frames, counts (names of `ACCOUNT`), bytes; and whether a frame is known to begin there."""

    frames: Frames
    count: Counter[str]
    settled_n: int
    at_boundary: bool


class FrameStream:
    """Remembers the bytes that are not settled yet; returns frames as soon as they are certain.

    `bursts` says which bytes are a binary frame; a text frame is a line of exactly 4 k numbers of two decimals. A
    stream is believed to begin with a frame: a first line cut inside its first number is a frame with a wrong number.
    """

    def __init__(self, wire: Wire, chips_n: int) -> None:
        self._wire, self._chips_n = wire, chips_n
        self._scan = _scan_lines if wire in wires.TEXT_WIRES else _scan_binary
        self._rest = b""
        self._at_boundary = True
        self._closed = False
        self._count: Counter[str] = Counter()

    def feed(self, data: bytes) -> Frames:
        """Take the next bytes; give the frames that are now certain."""
        assert not self._closed, "a stream that ended takes no more bytes"
        return self._advance(data, final=False)

    def close(self) -> Frames:
        """Say that the stream has ended; give the frames that waited for more, and count what is left as lost."""
        self._closed = True
        return self._advance(b"", final=True)

    def account(self) -> dict[str, int]:
        """Count bytes and frames; once closed, `frame_bytes_n` and all `skipped_*_bytes_n` add up to `bytes_n`."""
        return {name: self._count[name] for name in ACCOUNT}

    def _advance(self, data: bytes, final: bool) -> Frames:
        buffer = self._rest + data if self._rest else data
        offset = self._count["bytes_n"] - len(self._rest)
        scan = self._scan(np.frombuffer(buffer, np.uint8), self._at_boundary, final, self._wire, self._chips_n)
        self._rest, self._at_boundary = (b"" if final else buffer[scan.settled_n :]), scan.at_boundary
        self._count.update(scan.count, bytes_n=len(data), frames_n=len(scan.frames))
        found_n = scan.count["frame_bytes_n"] + scan.count["skipped_not_finite_bytes_n"]
        self._count["skipped_resync_bytes_n"] += scan.settled_n - found_n
        self._count["skipped_truncated_bytes_n"] += len(buffer) - scan.settled_n if final else 0
        return replace(scan.frames, end_byte=scan.frames.end_byte + offset)


def decode_all(data: bytes, wire: Wire, chips_n: int, where: str) -> tuple[Frames, dict[str, int]]:
    """Decode a whole stream; raise `CaptureError` if there is not one frame in it."""
    stream = FrameStream(wire, chips_n)
    frames = wires.concatenate([part for part in (stream.feed(data), stream.close()) if len(part)], chips_n)
    if not stream.account()["frames_n"]:
        raise no_frame(where, data, wire, chips_n)
    return frames, stream.account()


def no_frame(where: str, data: bytes, wire: Wire, chips_n: int) -> CaptureError:
    """Make the error for a stream without a frame, from its bytes or the first of them; say what fits them instead."""
    rule, got = f"frames of {chips_n} chips in wire format {wire}", f"no frame found in {len(data)} bytes"
    hint = " or ".join(f"{fit} with {k} chips" for fit, k in fitting(data))
    remedy = "Wrong baud rate, chip count or wire format?" + (f" It fits {hint}." if hint else "")
    if not data:
        remedy = "Is the board running and sending?"
    return CaptureError(where, "the stream", rule, got, remedy)


def fitting(data: bytes) -> list[tuple[Wire, int]]:
    """List the formats, of the fewest chips that do, in which most of the first 16 KiB of `data` is frames."""
    data = data[:16384]
    for chips_n in range(1, min(CHIPS_MAX_N, len(data) // 16) + 1):  # no format has less than 16 bytes a chip
        streams = {wire: FrameStream(wire, chips_n) for wire in get_args(Wire)}
        for stream in streams.values():
            stream.feed(data)
        found = [wire for wire, stream in streams.items() if 2 * stream.account()["frame_bytes_n"] > len(data)]
        if found:
            return [(wire, chips_n) for wire in found]
    return []


def _scan_binary(
    octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, wire: Wire, chips_n: int
) -> _Scan:
    record = wires.record_type(wire, chips_n)
    runs, settled_n, at_boundary = bursts.lay_frames(octets, at_boundary, final, record)
    frames, finite = wires.decode_runs(octets, runs, wire, chips_n)
    lost_n = len(frames) - int(np.count_nonzero(finite))
    if lost_n:
        frames = frames.where(finite)
    count = Counter(
        frame_bytes_n=len(frames) * record.itemsize,
        not_finite_frames_n=lost_n,
        skipped_not_finite_bytes_n=lost_n * record.itemsize,
    )
    return _Scan(frames, count, settled_n, at_boundary)


def _scan_lines(octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, wire: Wire, chips_n: int) -> _Scan:
    """Decode whole lines; a line longer than any frame is not waited for."""
    line_end = np.flatnonzero(octets == LF) + 1
    settled_n = int(line_end[-1]) if len(line_end) else 0
    parts: list[Frames] = []
    count: Counter[str] = Counter()
    # What is left of a line that was not waited for may look like a frame, and is none.
    for first in range(0 if at_boundary else 1, len(line_end), BLOCK_LINES_N):
        base = int(line_end[first - 1]) if first else 0
        ends = line_end[first : first + BLOCK_LINES_N] - base
        block, lines_n = octets[base : base + ends[-1]], np.diff(ends, prepend=0)
        frames, is_frame = wires.decode_lines(block, ends, wire, chips_n)
        lost = _not_finite_lines(block, ends, is_frame, chips_n)
        parts.append(replace(frames, end_byte=frames.end_byte + base))
        count.update(
            frame_bytes_n=int(lines_n[is_frame].sum()),
            not_finite_frames_n=int(np.count_nonzero(lost)),
            skipped_not_finite_bytes_n=int(lines_n[lost].sum()),
        )
    at_boundary = at_boundary or settled_n > 0
    if not at_boundary or len(octets) - settled_n > wires.line_bytes_max_n(chips_n):
        settled_n, at_boundary = len(octets), False
    return _Scan(wires.concatenate(parts, chips_n), count, settled_n, at_boundary)


def _not_finite_lines(
    block: UInt8[np.ndarray, " bytes"],
    line_end: Int64[np.ndarray, " lines"],
    is_frame: Bool[np.ndarray, " lines"],
    chips_n: int,
) -> Bool[np.ndarray, " lines"]:
    """Mark the lines that would be frames, had the firmware not written nan, inf or ovf for a number."""
    line = re.compile(rb"(?:-?(?:\d{1,10}\.\d\d|nan|inf|ovf)\t?){%d}\t?\r?\n" % (wires.NUMBERS_PER_CHIP_N * chips_n))
    start = np.concatenate([[0], line_end[:-1]])
    marked = np.zeros(len(line_end), bool)
    for line_i in np.flatnonzero(~is_frame):
        marked[line_i] = line.fullmatch(block[start[line_i] : line_end[line_i]].tobytes()) is not None
    return marked
