"""Time to decode whole blocks of bytes, compared with loops over single frames on the same bytes.

The loops decode a tenth of the frames, and their times are multiplied by ten. Each time is the smallest of three.
"""

import io
import struct
import time
from collections import namedtuple
from functools import partial

import numpy as np

from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import Wire, encode
from tests.board.signals import make_frames
from tools.benchmarks.common import best_s

FRAMES_N, CHIPS_N, FRAME_BYTES_N, PORTION_BYTES_N = 1_000_000, 5, 82, 4096
Sample = namedtuple("Sample", "time_s, delay_s, values, device")


def bare_loop(data: bytes) -> object:
    """Unpack frames at known positions with `struct`, without checking them and without building arrays."""
    return [struct.unpack_from("<20f", data, first) for first in range(0, len(data), FRAME_BYTES_N)]


def loop_to_arrays(data: bytes) -> object:
    """Unpack frames one by one into the arrays that a model needs; check the terminator of each frame."""
    b_uT, temperature_degC = [], []
    for first in range(0, len(data), FRAME_BYTES_N):
        frame = data[first : first + FRAME_BYTES_N]
        if frame[-2:] == b"\r\n":
            values = np.array(struct.unpack("<20f", frame[:-2]), np.float32).reshape(CHIPS_N, 4)
            b_uT.append(values[:, 1:].ravel())
            temperature_degC.append(values[:, 0])
    return np.array(b_uT), np.array(temperature_degC)


def reader_loop(data: bytes) -> object:
    """Read each frame with the code of the sensor's public Python reader, from memory instead of a serial port."""
    port, samples = io.BytesIO(data), []
    for _ in range(len(data) // FRAME_BYTES_N):
        start_s = time.time()
        frame = port.read(FRAME_BYTES_N)
        if frame[-2:] == b"\r\n":
            values = struct.unpack("@{}fcc".format(4 * CHIPS_N), frame)[: 4 * CHIPS_N]  # noqa: UP032
            samples.append(Sample(start_s, time.time() - start_s, values, -1))
    return samples


def feed_in_portions(data: bytes) -> None:
    stream = FrameStream("binary", CHIPS_N)
    for first in range(0, len(data), PORTION_BYTES_N):
        stream.feed(data[first : first + PORTION_BYTES_N])
    stream.close()


def main(frames_n: int = FRAMES_N) -> None:
    for crlf_share in (0.0, 0.01):
        frames = make_frames(frames_n, CHIPS_N, 0, crlf_share=crlf_share)
        data = encode(frames, "binary")
        np.testing.assert_array_equal(decode_all(data, "binary", CHIPS_N, "benchmark")[0].b_uT, frames.b_uT)
        blocks_s = best_s(partial(decode_all, data, "binary", CHIPS_N, "benchmark"))
        print(f"{frames_n} binary frames, {crlf_share:.0%} of values hold CR LF: {blocks_s:.3f} s in one block,")
        print(f"  {best_s(partial(feed_in_portions, data)):.3f} s fed {PORTION_BYTES_N} bytes at a time")
        loop_data = data[: frames_n // 10 * FRAME_BYTES_N]
        for loop in (bare_loop, reader_loop, loop_to_arrays):
            loop_s = 10 * best_s(partial(loop, loop_data))
            print(f"  {loop.__name__}: {loop_s:.3f} s, ratio {loop_s / blocks_s:.0f}")
    wires: tuple[Wire, ...] = ("text-xyzt", "text-txyz")
    for wire in wires:
        data = encode(make_frames(frames_n // 10, CHIPS_N, 0), wire)
        text_s = best_s(partial(decode_all, data, wire, CHIPS_N, "benchmark"))
        print(f"{frames_n // 10} frames of {wire}: {text_s:.3f} s")


if __name__ == "__main__":
    main()
