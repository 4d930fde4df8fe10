"""Split a stream of bytes into frames; every byte is part of a frame or is counted as lost.

None of the wire formats marks the start of a frame. The bytes CR LF mark its end, but they may also occur within a
binary number; the float32 of 34.513275 degC contains them. The result depends only on the bytes, and not on how they
were divided into calls of `FrameStream.feed`. This module does no input or output.
"""

import re
from collections import Counter
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from reskin.board import wire as wires
from reskin.board.chips import B_PLAUSIBLE_uT, TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC
from reskin.board.other_firmware import AnyWire, CustomWire
from reskin.board.wire import BLOCK_FRAMES_N, CR, LF, Frames, Run, Wire
from reskin.errors import CaptureError

BLOCK_LINES_N = 8192
CHIPS_MAX_N = 64  # the same limit as in the header of a capture
# Names of the counts that `FrameStream.account` returns.
ACCOUNT = ("bytes_n", "frames_n", "frame_bytes_n", "not_finite_frames_n", "skipped_not_finite_bytes_n",
           "skipped_resync_bytes_n", "skipped_truncated_bytes_n")  # fmt: skip

# The smallest plausible value; module `chips` has the other limits of plausible values. The limits are used only if the
# bytes can be divided into frames in several ways, because CR LF occurs at several possible positions. A frame with
# values outside the limits is not dropped, because the values that the firmware sends for a failed read are outside too
# (see `faults`).
VALUE_MIN = 1e-3  # in uT or degC; a value that is smaller but not 0 is implausible, because it is below the LSB

HEAD_BYTES_N = 16384  # the format is found from this number of bytes
EXPLAINED_MIN = 0.8  # share of the bytes that the frames of a format must contain, so that it is accepted
PLAUSIBLE_MIN = 0.3  # share of the chips' readings that must be plausible in a binary format: some chips may be broken
PRINTABLE = bytes([9, 10, 13, *range(32, 127)])
ENDS_MAX = 1.5  # largest number of CR LF per frame in a binary format; more of them end other frames
TEXT_SHARE_MIN = 0.98  # at least this share of the bytes of readable text is printable
PERIOD_MAX_N, PERIOD_GAIN_MIN = 1100, 0.04  # longest period of unknown frames, and by how much it must stand out

SEARCH_FRAMES_N = 64  # the search for the next frame looks at the bytes of this many frames at once


@dataclass(frozen=True)
class _Scan:
    """The result of scanning a buffer of bytes for frames."""

    frames: Frames
    count: Counter[str]  # keys of `ACCOUNT`
    # number of settled bytes: those at the start of the buffer that need not be scanned again when more bytes arrive
    settled_n: int
    at_boundary: bool  # whether the next frame is known to begin directly after the settled bytes


class FrameStream:
    """An incremental decoder of a stream of bytes.

    Each frame is returned as soon as it is certain which bytes belong to it. Until then, these bytes are stored. See
    `_find_runs` for the rules by which binary frames are found. A text frame of k chips is a line of exactly 4 k
    numbers with two decimals. The first byte of a stream is assumed to be the start of a frame. Therefore, if a text
    stream begins in the middle of a frame's first number, this number is decoded wrongly.
    """

    def __init__(self, wire: AnyWire, chips_n: int) -> None:
        self._wire, self._chips_n = wire, chips_n
        self._rest = b""
        self._at_boundary = True
        self._closed = False
        self._count: Counter[str] = Counter()

    def feed(self, data: bytes) -> Frames:
        """Process the next bytes; return the frames that have become certain."""
        assert not self._closed, "the stream is closed"
        return self._advance(data, final=False)

    def close(self) -> Frames:
        """End the stream; return the frames that were not yet certain, and count the remaining bytes as lost."""
        self._closed = True
        return self._advance(b"", final=True)

    def account(self) -> dict[str, int]:
        """Return the counts of bytes and frames so far.

        After the stream was closed, `bytes_n` is the sum of `frame_bytes_n` and all `skipped_*_bytes_n`.
        """
        return {name: self._count[name] for name in ACCOUNT}

    def _advance(self, data: bytes, final: bool) -> Frames:
        """Scan the undecided bytes and `data` for frames; if `final`, no more bytes follow."""
        buffer = self._rest + data if self._rest else data
        offset = self._count["bytes_n"] - len(self._rest)
        scan = _scan(np.frombuffer(buffer, np.uint8), self._at_boundary, final, self._wire, self._chips_n)
        self._rest, self._at_boundary = (b"" if final else buffer[scan.settled_n :]), scan.at_boundary
        self._count.update(scan.count, bytes_n=len(data), frames_n=len(scan.frames))
        accounted_n = scan.count["frame_bytes_n"] + scan.count["skipped_not_finite_bytes_n"]
        self._count["skipped_resync_bytes_n"] += scan.settled_n - accounted_n
        self._count["skipped_truncated_bytes_n"] += len(buffer) - scan.settled_n if final else 0
        return replace(scan.frames, end_byte=scan.frames.end_byte + offset)


def decode_all(data: bytes, wire: AnyWire, chips_n: int, where: str) -> tuple[Frames, dict[str, int]]:
    """Decode a whole stream; raise `CaptureError` if it contains no frame."""
    stream = FrameStream(wire, chips_n)
    frames = wires.concatenate([part for part in (stream.feed(data), stream.close()) if len(part)], chips_n)
    if not stream.account()["frames_n"]:
        raise no_frame(where, data, wire, chips_n)
    return frames, stream.account()


def no_frame(where: str, data: bytes, wire: AnyWire, chips_n: int, bytes_n: int | None = None) -> CaptureError:
    """Return the error for a stream of `bytes_n` bytes (by default, those of `data`) without frames.

    The message suggests those formats in which `data`, the first bytes of the stream, can be decoded. If there is none,
    it describes the bytes.
    """
    if not data:
        remedy = "Check that the board is running and sends data."
    elif formats := matching_formats(data):
        hint = " or ".join(f"{fit} with {k} chips" for fit, k in formats)
        remedy = f"Check the baud rate, the number of chips and the wire format. The bytes fit {hint}."
    else:
        remedy = f"The bytes are {describe_unknown(data)}"
    found = f"no frame found in {bytes_n or len(data)} bytes, read as {chips_n} chips in wire format {wire}"
    return CaptureError(f"{where}: {found}. {remedy}")


def matching_formats(data: bytes) -> list[tuple[Wire, int]]:
    """List the formats that explain the first 16 KiB of `data`.

    A format is a pair of a wire format and a number of chips. It explains the bytes if at least the share
    `EXPLAINED_MIN` of them are frames, apart from an incomplete frame at each end. Only text formats are tried for
    readable text; the values of binary formats must be plausible, because any bytes can be read as numbers. If formats
    with different numbers of chips fit, only those with the smallest number of chips are listed.
    """
    data = data[:HEAD_BYTES_N]
    text = is_text(data)
    for chips_n in range(1, min(CHIPS_MAX_N, len(data) // 16) + 1):  # every format has 16 bytes or more per chip
        matches = []
        for wire in get_args(Wire):
            if text == (wire in wires.TEXT_WIRES):
                stream = FrameStream(wire, chips_n)
                frames, account = stream.feed(data), stream.account()
                ends_n = 2 * account["frame_bytes_n"] / max(account["frames_n"], 1)  # as long as two frames
                enough = account["frame_bytes_n"] >= EXPLAINED_MIN * (len(data) - ends_n)
                # In other formats of ends with CR LF, several of their frames may look like one of these.
                single = text or data.count(b"\r\n") <= ENDS_MAX * account["frames_n"] + 2
                if len(frames) and enough and single and (text or _are_plausible(frames)):
                    matches.append((wire, chips_n))
        if matches:
            return matches
    return []


def is_text(data: bytes) -> bool:
    """Return whether bytes are readable text: nearly all are printable ASCII characters, tabs or ends of lines."""
    return len(data) > 0 and len(data.translate(None, PRINTABLE)) <= (1 - TEXT_SHARE_MIN) * len(data)


def describe_unknown(data: bytes) -> str:
    """Describe bytes that are in no known format, and state what the user can do."""
    data = data[:HEAD_BYTES_N]
    if is_text(data):
        lines = [line.strip() for line in data.decode("ascii", "replace").splitlines()[1:-1] if line.strip()]
        line = max(lines, key=lines.count) if lines else data[:80].decode("ascii", "replace")
        numbers_n = len(re.findall(r"(?<![A-Za-z\d])[-+]?\d+(?:\.\d*)?", line))
        return (
            f"readable text, but no known format: {line[:80]!r}, {numbers_n} numbers a line. Known lines have four "
            "numbers with two decimals for each chip, separated by tabs: X Y Z T (text-xyzt) or T X Y Z (text-txyz). "
            "Describe other lines with --wire text:Bx0,By0,Bz0,... (docs/live.md, Other firmware)."
        )
    period_n = _period_n(np.frombuffer(data, np.uint8))
    repeats = f" They repeat every {period_n} bytes." if period_n else ""
    return (
        f"no known frames.{repeats} Check the baud rate. A known binary frame has the temperature and three fields of "
        "each chip as float32, and ends with CR LF; describe other frames in a file for "
        "--wire (docs/live.md, Other firmware)."
    )


def _period_n(octets: UInt8[np.ndarray, " bytes"]) -> int | None:
    """Return the length after which bytes repeat most often, if this is clearly more often than by chance."""
    longest_n = min(PERIOD_MAX_N, len(octets) // 4)
    shares = np.array([0.0, *((octets[n:] == octets[:-n]).mean() for n in range(1, longest_n + 1))])
    gain = shares - np.median(shares)
    best = int(np.argmax(gain >= 0.8 * gain.max()))  # the shortest of its multiples
    return best if best >= 4 and gain[best] > PERIOD_GAIN_MIN else None


def _are_plausible(frames: Frames) -> bool:
    """Return whether most chips have plausible values in most frames."""
    chips_n = frames.temperature_degC.shape[1]
    b_uT = frames.b_uT.reshape(len(frames), chips_n, 3)
    txyz = np.concatenate([frames.temperature_degC[..., None], b_uT], axis=2)
    return bool(_plausible(txyz).mean() >= PLAUSIBLE_MIN)


def _scan(octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, wire: AnyWire, chips_n: int) -> _Scan:
    """Find and decode the frames in a buffer of bytes, in any format."""
    if isinstance(wire, CustomWire):
        frames, count, settled_n = wire.scan(octets)
        return _Scan(frames, count, settled_n, at_boundary=True)
    scan = _scan_lines if wire in wires.TEXT_WIRES else _scan_binary
    return scan(octets, at_boundary, final, wire, chips_n)


def _scan_binary(
    octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, wire: Wire, chips_n: int
) -> _Scan:
    """Find and decode binary frames; drop and count the frames with values that are not finite."""
    record = wires.record_type(wire, chips_n)
    runs, settled_n, at_boundary = _find_runs(octets, at_boundary, final, record)
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


def _find_runs(
    octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, record: np.dtype[np.void]
) -> tuple[list[Run], int, bool]:
    """Find the runs of consecutive frames in the bytes of a buffer.

    Returns the runs, the number of settled bytes, and whether the next frame begins directly after the settled bytes
    (see `_Scan`).

    A frame is accepted directly if it begins where the previous frame ended (or at the start of the stream) and ends
    with CR LF. There is one exception: a frame that also contains CR LF among its values *and* has implausible values
    is not accepted directly. In this case, and after stray bytes, `_search` looks for the next position at which a
    frame may begin: there must be CR LF directly before this position, and at the end of the frame. If there are
    several such positions, `_search` decides by the number of chips with plausible values. It counts these chips in the
    frame at the position and in the frame after it, and chooses the position with the largest number. If several
    positions have the same number, it chooses the first.
    """
    runs: list[Run] = []
    position = 0
    while True:
        if at_boundary:
            frames_n = _sure_frames_n(octets[position:], record)
            runs.append((position, frames_n))
            position += frames_n * record.itemsize
            if len(octets) - position < record.itemsize:
                break
        window = octets[position : position + SEARCH_FRAMES_N * record.itemsize]
        reaches_end = position + len(window) == len(octets)
        skip_n, is_found = _search(window, at_boundary, final and reaches_end, record)
        position += skip_n
        at_boundary = is_found or (at_boundary and skip_n == 0)
        if is_found:
            runs.append((position, 1))
            position += record.itemsize
        elif reaches_end:
            break
    return [run for run in runs if run[1]], position, at_boundary


def _sure_frames_n(octets: UInt8[np.ndarray, " bytes"], record: np.dtype[np.void]) -> int:
    """Return how many successive frames, from the first byte on, are accepted directly (see `_find_runs`)."""
    sure_n, frames_n, block_n = 0, len(octets) // record.itemsize, 1
    while sure_n < frames_n:
        # The blocks grow, so that little is read in vain if a search begins after every frame.
        block_n = min(frames_n - sure_n, 8 * block_n, BLOCK_FRAMES_N)
        block = octets[sure_n * record.itemsize : (sure_n + block_n) * record.itemsize]
        sure_in_block_n = _sure_in_block_n(block, record)
        sure_n += sure_in_block_n
        if sure_in_block_n < block_n:
            break
    return sure_n


def _sure_in_block_n(block: UInt8[np.ndarray, " bytes"], record: np.dtype[np.void]) -> int:
    """Return the same number as `_sure_frames_n`, for a block that consists of whole frames."""
    rows = block.reshape(-1, record.itemsize)
    closed = (rows[:, -2] == CR) & (rows[:, -1] == LF)
    closed_n = len(rows) if closed.all() else int(closed.argmin())
    if not closed_n:
        return 0
    ends = _terminators(block[: closed_n * record.itemsize])
    if np.count_nonzero(ends) == closed_n:  # each CR LF is at the end of a frame
        return closed_n
    inside = np.append(ends, False).reshape(closed_n, record.itemsize)
    inside[:, -2] = False
    suspect_i = np.flatnonzero(inside.any(axis=1))
    plausible = _plausible(block.view(record)["txyz"][suspect_i]).all(axis=1)
    return closed_n if plausible.all() else int(suspect_i[plausible.argmin()])


def _search(
    window: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, record: np.dtype[np.void]
) -> tuple[int, bool]:
    """Return the number of bytes to skip, and whether a frame begins after them; if not, more bytes are needed.

    If more bytes are needed, the window is searched again together with these bytes. Therefore, the two bytes before
    the first possible start of a frame are not skipped: they may be the CR LF at the end of the frame before it.
    """
    length_n, window_n = record.itemsize, len(window)
    ended = np.zeros(window_n + 2 * length_n + 1, bool)  # whether a frame may have ended before each byte
    ended[0] = at_boundary
    ended[2 : window_n + 1] = _terminators(window)[: max(window_n - 1, 0)]
    fits = ended[:-length_n] & ended[length_n:]
    first = int(fits.argmax())
    if not fits[first]:
        return (window_n if final else max(window_n - length_n - 1, 0)), False
    if not final and window_n < first + 3 * length_n:  # other candidate positions may follow
        return max(first - 2, 0), False
    starts = first + np.flatnonzero(fits[first : first + length_n])
    candidates = np.concatenate([starts, starts + length_n])
    whole = candidates[fits[candidates]]
    plausible_n = np.zeros(len(candidates), np.int64)
    rows = sliding_window_view(window, length_n)[whole]  # a copy of the bytes of each frame that may begin here
    plausible_n[fits[candidates]] = _plausible(rows.view(record)["txyz"][:, 0]).sum(axis=1)
    here_n, next_n = np.split(plausible_n, 2)
    best_i = int((here_n + next_n).argmax())
    start = int(starts[best_i])
    # If the values of a frame contain CR LF, the bytes after this CR LF may look like the start of a frame. Such a
    # false frame has fewer plausible chips than the real frame after it, so it is skipped.
    is_tail = next_n[best_i] > here_n[best_i] and not (at_boundary and start == 0)
    return start + length_n * int(is_tail), True


def _terminators(octets: UInt8[np.ndarray, " bytes"]) -> Bool[np.ndarray, " pairs"]:
    """Mark each CR that is followed by LF."""
    return (octets[:-1] == CR) & (octets[1:] == LF)


def _plausible(txyz: Float32[np.ndarray, "f k 4"]) -> Bool[np.ndarray, "f k"]:
    """Mark the chips whose values are possible for the magnetometer."""
    temperature_degC, b_uT = txyz[..., 0], txyz[..., 1:]
    possible_temperature = (temperature_degC >= TEMPERATURE_MIN_degC) & (temperature_degC <= TEMPERATURE_MAX_degC)
    possible_value = (txyz == 0) | (np.abs(txyz) >= VALUE_MIN)
    possible_value[..., 1:] &= np.abs(b_uT) <= B_PLAUSIBLE_uT
    return possible_temperature & possible_value.all(axis=-1)


def _scan_lines(octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, wire: Wire, chips_n: int) -> _Scan:
    """Decode whole lines; skip the bytes of a line that is longer than any frame, without waiting for its end."""
    line_end = np.flatnonzero(octets == LF) + 1
    settled_n = int(line_end[-1]) if len(line_end) else 0
    parts: list[Frames] = []
    count: Counter[str] = Counter()
    # If the first byte is in the middle of a line that is longer than any frame, skip the rest of this line, because it
    # may look like a frame.
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
    """Mark the lines that would be frames if the firmware had not written nan, inf or ovf in place of a number."""
    line = re.compile(rb"(?:-?(?:\d{1,10}\.\d\d|nan|inf|ovf)\t?){%d}\t?\r?\n" % (wires.NUMBERS_PER_CHIP_N * chips_n))
    start = np.concatenate([[0], line_end[:-1]])
    marked = np.zeros(len(line_end), bool)
    for line_i in np.flatnonzero(~is_frame):
        marked[line_i] = line.fullmatch(block[start[line_i] : line_end[line_i]].tobytes()) is not None
    return marked
