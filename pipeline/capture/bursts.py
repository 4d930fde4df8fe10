"""Where binary frames lie. In: bytes. Out: runs of frames, and how many bytes are settled, the same for any portions.

A frame is taken at once where the one before ended (or the stream began) and CR LF closes it, unless CR LF stands in
its payload too *and* its values make no sense. Then, and after a break, the next frame is searched for: CR LF stands
before it and closes it. If several layouts fit, the one with most plausible chips in two frames wins, then the first.
Refuses to know what is remembered between portions (`stream`).
"""

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.capture.wire import BLOCK_FRAMES_N, CR, LF, Run

# An MLX90393 measures up to 50 mT (data sheet) in steps above 0.1 uT. Only where CR LF leaves two ways to lay frames do
# these limits decide: a value outside them is no reason to drop a frame (failed reads are outside, see `faults`).
TEMPERATURE_MIN_degC, TEMPERATURE_MAX_degC = -50.0, 125.0
B_MAX_uT = 6e4
VALUE_MIN = 1e-3  # what is nearer to 0, in uT or degC, is below the chip's LSB

SEARCH_FRAMES_N = 64  # a search looks at so many frames' bytes at once


def lay_frames(
    octets: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, record: np.dtype[np.void]
) -> tuple[list[Run], int, bool]:
    """Find the runs of frames; also how many bytes are settled and whether a frame is known to begin there."""
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
        skip_n, found = _search(window, at_boundary, final and reaches_end, record)
        position += skip_n
        at_boundary = found or (at_boundary and skip_n == 0)
        if found:
            runs.append((position, 1))
            position += record.itemsize
        elif reaches_end:
            break
    return [run for run in runs if run[1]], position, at_boundary


def _sure_frames_n(octets: UInt8[np.ndarray, " bytes"], record: np.dtype[np.void]) -> int:
    """Count the frames from the first byte on that need no look at what follows them."""
    sure_n, frames_n = 0, len(octets) // record.itemsize
    while sure_n < frames_n:
        block_n = min(frames_n - sure_n, BLOCK_FRAMES_N)
        block = octets[sure_n * record.itemsize : (sure_n + block_n) * record.itemsize]
        sure_in_block_n = _sure_in_block_n(block, record)
        sure_n += sure_in_block_n
        if sure_in_block_n < block_n:
            break
    return sure_n


def _sure_in_block_n(block: UInt8[np.ndarray, " bytes"], record: np.dtype[np.void]) -> int:
    rows = block.reshape(-1, record.itemsize)
    closed = (rows[:, -2] == CR) & (rows[:, -1] == LF)
    closed_n = len(rows) if closed.all() else int(closed.argmin())
    ends = _terminators(block[: closed_n * record.itemsize])
    if np.count_nonzero(ends) == closed_n:  # none but those that close a frame
        return closed_n
    inside = np.flatnonzero(ends)
    inside = inside[inside % record.itemsize != record.itemsize - 2]
    suspect_i = np.unique(inside // record.itemsize)
    sane = _plausible(block.view(record)["txyz"][suspect_i]).all(axis=1)
    return closed_n if sane.all() else int(suspect_i[sane.argmin()])


def _search(
    window: UInt8[np.ndarray, " bytes"], at_boundary: bool, final: bool, record: np.dtype[np.void]
) -> tuple[int, bool]:
    """Give the number of bytes to skip, and whether a frame begins there (else: more bytes must tell).

    If a window is searched again with more bytes, the two before the first undecided start are kept: they may close
    a frame before it.
    """
    length_n, window_n = record.itemsize, len(window)
    ended = np.zeros(window_n + 2 * length_n + 1, bool)  # a frame may have ended before this byte
    ended[0] = at_boundary
    ended[2 : window_n + 1] = _terminators(window)[: max(window_n - 1, 0)]
    fits = ended[:-length_n] & ended[length_n:]
    first = int(fits.argmax())
    if not fits[first]:
        return (window_n if final else max(window_n - length_n - 1, 0)), False
    if not final and window_n < first + 3 * length_n:  # rivals may follow
        return max(first - 2, 0), False
    starts = first + np.flatnonzero(fits[first : first + length_n])
    here_n, next_n = (
        np.array([_plausible_n(window[start:], record) if fits[start] else 0 for start in starts + shift])
        for shift in (0, length_n)
    )
    best_i = int((here_n + next_n).argmax())
    start = int(starts[best_i])
    # A frame's end behind a CR LF that ended nothing looks like a frame; the one after it is more plausible.
    is_tail = next_n[best_i] > here_n[best_i] and not (at_boundary and start == 0)
    return start + length_n * int(is_tail), True


def _terminators(octets: UInt8[np.ndarray, " bytes"]) -> Bool[np.ndarray, " pairs"]:
    """Mark the bytes that begin a CR LF."""
    return (octets[:-1] == CR) & (octets[1:] == LF)


def _plausible_n(octets: UInt8[np.ndarray, " bytes"], record: np.dtype[np.void]) -> int:
    """Count the plausible chips of the frame at the first byte."""
    return int(np.count_nonzero(_plausible(octets[: record.itemsize].view(record)["txyz"])))


def _plausible(txyz: Float32[np.ndarray, "f k 4"]) -> Bool[np.ndarray, "f k"]:
    """Mark the chips whose values a magnetometer can give."""
    temperature_degC, b_uT = txyz[..., 0], txyz[..., 1:]
    warm = (temperature_degC >= TEMPERATURE_MIN_degC) & (temperature_degC <= TEMPERATURE_MAX_degC)
    no_dust = ((txyz == 0) | (np.abs(txyz) >= VALUE_MIN)).all(axis=-1)
    return warm & no_dust & (np.abs(b_uT) <= B_MAX_uT).all(axis=-1)
