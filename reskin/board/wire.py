"""Encode and decode whole frames in the wire formats of the ReSkin and AnySkin firmware.

A frame contains one reading of each chip of a board. In the binary formats, a frame is a fixed number of bytes; in the
text formats, it is a line. Frames have no header, checksum or counter. Module `stream` finds the frames in a stream of
bytes, and `faults` checks their values.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

CR, LF, TAB, MINUS, DOT, ZERO = b"\r\n\t-.0"
Wire = Literal["binary", "binary-clock", "text-xyzt", "text-txyz"]
TEXT_WIRES = ("text-xyzt", "text-txyz")
NUMBERS_PER_CHIP_N = 4  # a temperature and three components of the field
INTEGER_DIGITS_MAX_N = 10  # Arduino's print() writes "ovf" above 4294967040
NUMBER_BYTES_MAX_N = len("-4294967040.00\t")
# Frames are processed in blocks of this many frames, which fit into the processor's cache with the values computed from
# them.
BLOCK_FRAMES_N = 4096

Run = tuple[int, int]  # a run of consecutive frames: position of its first byte, and number of frames


@dataclass(frozen=True)
class Frames:
    """Decoded frames, in the order in which the board sent them.

    `end_byte` is the number of bytes from the start of the stream to the end of each frame. `device_s` is the time of
    each frame on the board's clock; it is NaN in formats without a clock.
    """

    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    device_s: Float64[np.ndarray, " f"]
    end_byte: Int64[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.end_byte)

    def where(self, rows: Bool[np.ndarray, " f"] | slice) -> "Frames":
        """Return the frames that `rows` marks."""
        return Frames(*(getattr(self, field.name)[rows] for field in fields(self)))

    def divide(self, frames_n: int) -> Iterator["Frames"]:
        """Yield the frames in parts of at most `frames_n` frames."""
        for first in range(0, len(self), frames_n):
            yield self.where(slice(first, first + frames_n))


def concatenate(parts: Sequence[Frames], chips_n: int) -> Frames:
    """Join frames in order; if there are no parts, return an object with zero frames of `chips_n` chips."""
    if not parts:
        return _allocate(0, chips_n)
    if len(parts) == 1:
        return parts[0]
    return Frames(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Frames)))


def record_type(wire: Wire, chips_n: int) -> np.dtype[np.void]:
    """Return the data type of a binary frame: T, X, Y, Z of each chip as little-endian float32, then CR LF.

    A frame of k chips has 16 k + 2 bytes. In format `binary-clock`, the frame begins with 4 more bytes, which are the
    time on the board's clock in s.
    """
    clock = [("device_s", "<f4")] if wire == "binary-clock" else []
    return np.dtype([*clock, ("txyz", "<f4", (chips_n, NUMBERS_PER_CHIP_N)), ("end", "S2")])


def line_bytes_max_n(chips_n: int) -> int:
    """Return the maximum length of a text frame."""
    return NUMBERS_PER_CHIP_N * chips_n * NUMBER_BYTES_MAX_N + len(b"\t\r\n")


def encode(frames: Frames, wire: Wire) -> bytes:
    """Encode frames as the firmware does.

    In text formats, numbers are rounded to two decimals. Only format `binary-clock` contains the time on the board's
    clock.
    """
    frames_n, chips_n = frames.temperature_degC.shape
    b_uT = frames.b_uT.reshape(frames_n, chips_n, 3)
    if wire in TEXT_WIRES:
        return _encode_lines(b_uT, frames.temperature_degC[..., None], wire)
    records = np.empty(frames_n, record_type(wire, chips_n))
    records["txyz"][..., 0] = frames.temperature_degC
    records["txyz"][..., 1:] = b_uT
    records["end"] = b"\r\n"
    if wire == "binary-clock":
        records["device_s"] = frames.device_s
    return records.tobytes()


def _encode_lines(
    b_uT: Float32[np.ndarray, "f k 3"], temperature_degC: Float32[np.ndarray, "f k 1"], wire: Wire
) -> bytes:
    chips_n = b_uT.shape[1]
    if wire == "text-xyzt":
        values, chip = np.concatenate([b_uT, temperature_degC], axis=2), "%.2f\t%.2f\t%.2f\t%.2f\t"
    else:  # AnySkin sends no tab between two chips
        values, chip = np.concatenate([temperature_degC, b_uT], axis=2), "%.2f\t%.2f\t%.2f\t%.2f"
    line = chip * chips_n + "\r\n"
    blocks = (values[first : first + BLOCK_FRAMES_N] for first in range(0, len(values), BLOCK_FRAMES_N))
    return b"".join((line * len(block) % tuple(block.ravel().tolist())).encode() for block in blocks)


def decode_runs(
    octets: UInt8[np.ndarray, " bytes"], runs: Sequence[Run], wire: Wire, chips_n: int
) -> tuple[Frames, Bool[np.ndarray, " f"]]:
    """Decode the binary frames in the given runs of `octets`.

    Returns the frames, and a mask of the frames whose values are all finite.
    """
    record = record_type(wire, chips_n)
    frames = _allocate(sum(frames_n for _, frames_n in runs), chips_n)
    finite = np.ones(len(frames), bool)
    is_b = np.arange(NUMBERS_PER_CHIP_N * chips_n) % NUMBERS_PER_CHIP_N > 0
    b_i, temperature_i = np.flatnonzero(is_b), np.flatnonzero(~is_b)
    row_i = 0
    for first_byte, frames_n in _blocks(runs, record.itemsize):
        rows, stop_byte = slice(row_i, row_i + frames_n), first_byte + frames_n * record.itemsize
        records = octets[first_byte:stop_byte].view(record)
        # Reading unaligned floats is slow, so copy the values once. Mode "clip" makes `take` write directly to `out`;
        # in the default mode, it would first write to a buffer.
        values = np.ascontiguousarray(records["txyz"]).reshape(frames_n, -1)
        values.take(b_i, axis=1, out=frames.b_uT[rows], mode="clip")
        values.take(temperature_i, axis=1, out=frames.temperature_degC[rows], mode="clip")
        frames.end_byte[rows] = np.arange(first_byte, stop_byte, record.itemsize) + record.itemsize
        if not np.isfinite(values).all():
            finite[rows] = np.isfinite(values).all(axis=1)
        if wire == "binary-clock":
            frames.device_s[rows] = records["device_s"]
            finite[rows] &= np.isfinite(records["device_s"])
        row_i += frames_n
    return frames, finite


def decode_lines(
    octets: UInt8[np.ndarray, " bytes"], line_end: Int64[np.ndarray, " lines"], wire: Wire, chips_n: int
) -> tuple[Frames, Bool[np.ndarray, " lines"]]:
    """Decode lines of text; `line_end` is the position after the LF of each line.

    Returns the frames, and a mask of the lines that are frames. Tabs between numbers may be missing. The numbers can
    still be separated, because each has exactly two decimals: `-56.7825.00` means -56.78 and 25.00.
    """
    start = np.concatenate([[0], line_end[:-1]])
    dot = np.flatnonzero(octets == DOT)
    dots_n = np.diff(np.searchsorted(dot, line_end), prepend=0)
    is_frame = dots_n == NUMBERS_PER_CHIP_N * chips_n
    dot = dot[np.repeat(is_frame, dots_n)].reshape(-1, NUMBERS_PER_CHIP_N * chips_n)
    values, well_formed = _numbers(octets, dot, start[is_frame], line_end[is_frame])
    is_frame[is_frame] = well_formed
    chip = values[well_formed].astype(np.float32).reshape(-1, chips_n, NUMBERS_PER_CHIP_N)
    temperature_i = 0 if wire == "text-txyz" else 3
    b_uT = np.delete(chip, temperature_i, axis=2).reshape(-1, 3 * chips_n)
    unknown_s = np.full(len(chip), np.nan)
    return Frames(b_uT, chip[..., temperature_i].copy(), unknown_s, line_end[is_frame]), is_frame


def _numbers(
    octets: UInt8[np.ndarray, " bytes"],
    dot: Int64[np.ndarray, "f c"],
    line_start: Int64[np.ndarray, " f"],
    line_end: Int64[np.ndarray, " f"],
) -> tuple[Float64[np.ndarray, "f c"], Bool[np.ndarray, " f"]]:
    """Read the number around each decimal point.

    Returns the numbers, and a mask of the lines that consist only of numbers and tabs.
    """
    # Subtract the code of "0" from each byte, so that digits give 0 to 9. Unsigned bytes wrap around, so all other
    # characters give values above 9. Two zeros are appended, so that two digits can be read even if a decimal point is
    # the last byte.
    digit = np.append(octets, np.zeros(2, np.uint8)) - np.uint8(ZERO)
    stop = dot + 3
    previous_stop = np.column_stack([line_start, stop[:, :-1]])  # where the previous number ends
    well_formed = (digit[dot + 1] <= 9) & (digit[dot + 2] <= 9)
    hundredths = digit[dot + 1] * np.int64(10) + digit[dot + 2]
    first, in_number, scale = dot.copy(), np.ones(dot.shape, bool), 100
    for _ in range(INTEGER_DIGITS_MAX_N):
        in_number &= (first > previous_stop) & (digit[first - 1] <= 9)
        if not in_number.any():
            break
        hundredths += np.where(in_number, digit[first - 1] * np.int64(scale), 0)
        first -= in_number
        scale *= 10
    well_formed &= first < dot
    negative = (first > previous_stop) & (octets[first - 1] == MINUS)
    gap = first - negative - previous_stop
    well_formed &= (gap == 0) | ((gap == 1) & (octets[previous_stop.clip(max=len(octets) - 1)] == TAB))
    well_formed[:, 0] &= gap[:, 0] == 0
    is_frame = well_formed.all(axis=1) & _ends_well(octets, stop[:, -1], line_end)
    return np.where(negative, -hundredths, hundredths) / 100, is_frame


def _ends_well(
    octets: UInt8[np.ndarray, " bytes"], stop: Int64[np.ndarray, " f"], line_end: Int64[np.ndarray, " f"]
) -> Bool[np.ndarray, " f"]:
    """Mark the lines that end with the last number, an optional tab, an optional CR, and LF."""
    returns = (octets[line_end - 2] == CR) & (stop <= line_end - 2)
    rest_n = line_end - 1 - returns - stop
    tab = octets[np.minimum(stop, line_end - 1)] == TAB
    return np.where(tab, rest_n == 1, rest_n == 0)


def _allocate(frames_n: int, chips_n: int) -> Frames:
    """Allocate frames with uninitialised values and an unknown (NaN) `device_s`."""
    b_uT, temperature_degC = (np.empty((frames_n, n), np.float32) for n in (3 * chips_n, chips_n))
    return Frames(b_uT, temperature_degC, np.full(frames_n, np.nan), np.empty(frames_n, np.int64))


def _blocks(runs: Sequence[Run], frame_bytes_n: int) -> Iterator[Run]:
    """Divide long runs of frames into runs of at most `BLOCK_FRAMES_N` frames."""
    for first_byte, frames_n in runs:
        for done_n in range(0, frames_n, BLOCK_FRAMES_N):
            yield first_byte + done_n * frame_bytes_n, min(BLOCK_FRAMES_N, frames_n - done_n)
