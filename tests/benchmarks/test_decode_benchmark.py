"""Compare the time to decode whole blocks of bytes with that of loops over single frames, on the same bytes.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_decode_benchmark.py`. The loops decode only a tenth of the
frames, and their times are multiplied by ten. Each time is the smallest of three measurements. The test asserts only
that the decoded values are equal.
"""

import io
import struct
import time
import tracemalloc
from collections import namedtuple
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import encode
from tests.benchmarks import size
from tests.board.signals import make_frames

FRAMES_N = size(1_000_000, 2_000)
LOOP_FRAMES_N = size(100_000, 200)
CHIPS_N = 5
FRAME_BYTES_N = 82
PORTION_BYTES_N = 4096

Sample = namedtuple("Sample", "time_s, delay_s, values, device")


def bare_loop(data: bytes) -> list[tuple[float, ...]]:
    """Unpack frames at known positions with `struct`, without checking them and without building arrays."""
    return [struct.unpack_from("<20f", data, first) for first in range(0, len(data), FRAME_BYTES_N)]


def loop_to_arrays(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Unpack frames one by one into the arrays that a model needs; check the terminator of each frame."""
    b_uT, temperature_degC = [], []
    for first in range(0, len(data), FRAME_BYTES_N):
        frame = data[first : first + FRAME_BYTES_N]
        if frame[-2:] == b"\r\n":
            values = np.array(struct.unpack("<20f", frame[:-2]), np.float32).reshape(CHIPS_N, 4)
            b_uT.append(values[:, 1:].ravel())
            temperature_degC.append(values[:, 0])
    return np.array(b_uT), np.array(temperature_degC)


def reader_loop(data: bytes) -> list[Sample]:
    """Read each frame with the code of the sensor's public Python reader, from memory instead of a serial port."""
    port, samples = io.BytesIO(data), []
    for _ in range(len(data) // FRAME_BYTES_N):
        start_s = time.time()
        frame = port.read(FRAME_BYTES_N)
        if frame[-2:] == b"\r\n":
            values = struct.unpack("@{}fcc".format(4 * CHIPS_N), frame)[: 4 * CHIPS_N]  # noqa: UP032
            samples.append(Sample(start_s, time.time() - start_s, values, -1))
    return samples


def best_s(call: Callable[[], Any]) -> float:
    times_s = []
    for _ in range(3):
        start_s = time.perf_counter()
        call()
        times_s.append(time.perf_counter() - start_s)
    return min(times_s)


def peak_MB(call: Callable[[], Any]) -> float:
    tracemalloc.start()
    call()
    peak_bytes_n = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak_bytes_n / 1e6


def bare_copy(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Copy every value to its position in the decoded arrays without any check, to measure memory access alone."""
    frames = np.frombuffer(data, np.dtype([("chips", "<f4", (CHIPS_N, 4)), ("end", "V2")]))["chips"]
    return frames[:, :, 1:].reshape(len(frames), -1).copy(), frames[:, :, 0].copy()


def feed_in_portions(data: bytes, wire: str) -> None:
    stream = FrameStream(wire, CHIPS_N)
    for first in range(0, len(data), PORTION_BYTES_N):
        stream.feed(data[first : first + PORTION_BYTES_N])
    stream.close()


@pytest.mark.parametrize("crlf_share", [0.0, 0.01])
def test_decoding_time_of_binary_frames(crlf_share):
    frames = make_frames(FRAMES_N, CHIPS_N, 0, crlf_share=crlf_share)
    data = encode(frames, "binary")
    decoded, _ = decode_all(data, "binary", CHIPS_N, "benchmark")
    np.testing.assert_array_equal(decoded.b_uT, frames.b_uT)
    ours_s = best_s(lambda: decode_all(data, "binary", CHIPS_N, "benchmark"))
    copy_s, flat_s = best_s(lambda: bare_copy(data)), best_s(lambda: np.frombuffer(data, np.uint8).copy())
    print(f"\n{FRAMES_N} binary frames, {len(data) / 1e6:.0f} MB, {crlf_share:.0%} of values hold CR LF")
    print(f"  blocks: {ours_s:.3f} s, {FRAMES_N / ours_s:.3g} frames/s, ", end="")
    print(f"peak {peak_MB(lambda: decode_all(data, 'binary', CHIPS_N, 'benchmark')):.0f} MB in addition to the bytes")
    print(f"  blocks, fed {PORTION_BYTES_N} bytes at a time: {best_s(lambda: feed_in_portions(data, 'binary')):.3f} s")
    print(f"  copying only the values into arrays: {copy_s:.3f} s; copying the bytes unchanged: {flat_s:.3f} s")
    loop_data = data[: LOOP_FRAMES_N * FRAME_BYTES_N]
    for loop in (bare_loop, reader_loop, loop_to_arrays):
        loop_s = best_s(lambda loop=loop: loop(loop_data)) * FRAMES_N / LOOP_FRAMES_N
        print(f"  {loop.__name__}: {loop_s:.3f} s, ratio {loop_s / ours_s:.0f}")


@pytest.mark.parametrize("wire", ["text-xyzt", "text-txyz"])
def test_decoding_time_of_text_frames(wire):
    frames = make_frames(LOOP_FRAMES_N, CHIPS_N, 0)
    data = encode(frames, wire)
    decoded, _ = decode_all(data, wire, CHIPS_N, "benchmark")
    np.testing.assert_array_equal(decoded.b_uT, frames.b_uT.astype(float).round(2).astype(np.float32))
    ours_s = best_s(lambda: decode_all(data, wire, CHIPS_N, "benchmark"))
    print(f"\n{LOOP_FRAMES_N} frames of {wire}: {ours_s:.3f} s, {LOOP_FRAMES_N / ours_s:.3g} frames/s")
    if wire == "text-xyzt":  # values of the other format are not separated by white space
        loop_s = best_s(lambda: [[float(word) for word in line.split()] for line in data.decode().splitlines()])
        print(f"  a loop over lines and words: {loop_s:.3f} s, ratio {loop_s / ours_s:.1f}")
