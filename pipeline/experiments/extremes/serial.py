"""Damaged byte streams in every wire format. References are the frames and the number of bytes that were sent."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from typing import get_args

import numpy as np

from pipeline.experiments.extremes.cases import Case, World, largest
from reskin.board.stream import FrameStream
from reskin.board.wire import TEXT_WIRES, Frames, Wire, concatenate, encode
from reskin.physics.chip import steps_uT
from reskin.seeds import rng_for

FRAMES_N, CUT_I = 40, 20  # frames of a stream; index of the frame that is damaged
GARBAGE = b"\r\n\0\xff9.99\t\n" * 5
CRLF_degC = 34.513275  # temperature whose float32 bytes contain CR LF, the two bytes that end each frame
WIRES: tuple[Wire, ...] = get_args(Wire)
BINARY_WIRES = tuple(wire for wire in WIRES if wire not in TEXT_WIRES)
Damage = Callable[[Frames, Wire], Sequence[bytes]]  # returns the portions in which the damaged stream arrives


def make_frames(world: World, crlf_share: float = 0.05) -> Frames:
    """Return random frames whose fields are whole counts; some temperatures contain the bytes CR LF."""
    rng, chips_n = rng_for(world.seed, "extremes", "serial"), len(world.board.chips_m)
    gain_sel = world.simulation.chip.gain_sel
    counts = rng.integers(-20_000, 20_000, (FRAMES_N, chips_n, 3))
    b_uT = (counts * steps_uT(gain_sel)).reshape(FRAMES_N, -1).astype(np.float32)
    usual_degC = (rng.integers(2000, 4000, (FRAMES_N, chips_n)) / 100).astype(np.float32)
    temperature_degC = np.where(rng.random(usual_degC.shape) < crlf_share, np.float32(CRLF_degC), usual_degC)
    return Frames(b_uT, temperature_degC, np.arange(FRAMES_N) / 512.0, np.zeros(FRAMES_N, np.int64))


def decode_portions(portions: Sequence[bytes], wire: Wire, chips_n: int) -> tuple[Frames, dict[str, int]]:
    """Decode a stream that arrives in portions; return the frames, and the stream's counts of bytes and frames."""
    stream = FrameStream(wire, chips_n)
    decoded = [stream.feed(portion) for portion in portions]
    return concatenate([*decoded, stream.close()], chips_n), stream.account()


def round_as_sent(frames: Frames, wire: Wire) -> Frames:
    """Return the frames with the values that a stream contains, which has two decimals in text formats."""
    if wire not in TEXT_WIRES:
        return frames
    values = (frames.b_uT, frames.temperature_degC)
    b_uT, temperature_degC = (of.astype(float).round(2).astype(np.float32) for of in values)
    return replace(frames, b_uT=b_uT, temperature_degC=temperature_degC)


def records(frames: Frames) -> list[bytes]:
    """Return the values of each frame as bytes, so that frames can be compared bit for bit."""
    return [row.tobytes() for row in np.hstack([frames.temperature_degC, frames.b_uT])]


def lost_frames_n(
    portions: Sequence[bytes], frames: Frames, wire: Wire, *, false_n: int = 0, not_finite_n: int | None = 0
) -> float:
    """Return the number of sent frames that a decoder of a damaged stream does not find.

    Returns inf if there are more than `false_n` frames that were not sent, if a byte is neither in a frame nor counted
    as skipped, or if the number of frames with NaN or Inf is not `not_finite_n` (None: any number).
    """
    chips_n = frames.temperature_degC.shape[1]
    decoded, account = decode_portions(portions, wire, chips_n)
    sent, got = Counter(records(round_as_sent(frames, wire))), Counter(records(decoded))
    skipped_n = sum(n for name, n in account.items() if name.startswith("skipped_"))
    counted = account["frame_bytes_n"] + skipped_n == account["bytes_n"] == sum(map(len, portions))
    finite = not_finite_n in (None, account["not_finite_frames_n"])
    return float((sent - got).total()) if counted and finite and (got - sent).total() <= false_n else np.inf


def cut_start(frames: Frames, wire: Wire, where: float = 0.5) -> list[bytes]:
    """Return the stream without the first fraction `where` of its first frame."""
    return [encode(frames, wire)[int(where * _ends(frames, wire)[0]) :]]


def merge_frames(frames: Frames, wire: Wire, *, whole_frame: bool) -> list[bytes]:
    """Return the stream without the end of a frame and the beginning of the next; together, a whole frame or more."""
    data, ends = encode(frames, wire), _ends(frames, wire)
    begin, middle, end = ends[CUT_I - 1], (ends[CUT_I - 1] + ends[CUT_I]) // 2, ends[CUT_I]
    rest = ends[CUT_I + 1] - (end - middle) if whole_frame else end + 3 * (middle - begin) // 2
    return [data[:middle] + data[rest:]]


def insert_garbage(frames: Frames, wire: Wire) -> list[bytes]:
    data, ends = encode(frames, wire), _ends(frames, wire)
    middle = (ends[CUT_I - 1] + ends[CUT_I]) // 2
    return [data[:middle], GARBAGE, data[middle:]]


def in_portions(frames: Frames, wire: Wire) -> list[bytes]:
    data = encode(frames, wire)
    return [data[i : i + 7] for i in range(0, len(data), 7)]


def not_finite(frames: Frames, wire: Wire) -> list[bytes]:
    """Return the stream with NaN in one frame, and Inf in another."""
    if wire in TEXT_WIRES:
        lines = encode(frames, wire).splitlines(keepends=True)
        for i, word in ((10, b"nan"), (30, b"inf")):
            lines[i] = word + lines[i][lines[i].index(b".") + 3 :]
        return [b"".join(lines)]
    b_uT, temperature_degC = frames.b_uT.copy(), frames.temperature_degC.copy()
    b_uT[10, 2], temperature_degC[30, 0] = np.nan, np.inf
    return [encode(replace(frames, b_uT=b_uT, temperature_degC=temperature_degC), wire)]


def _ends(frames: Frames, wire: Wire) -> list[int]:
    """Return the number of bytes up to the end of each frame; text frames are lines, binary frames are equally long."""
    data = encode(frames, wire)
    if wire in TEXT_WIRES:
        return list(accumulate(map(len, data.splitlines(keepends=True))))
    return [len(data) * (i + 1) // len(frames) for i in range(len(frames))]


def _lost(
    damage: Damage, wires: Sequence[Wire] = WIRES, crlf_share: float = 0.05, **allowed: int
) -> Callable[[World], float]:
    """Return a function that computes the largest number of lost frames in any wire format."""

    def measure(world: World) -> float:
        frames = make_frames(world, crlf_share)
        return largest(*(lost_frames_n(damage(frames, wire), frames, wire, **allowed) for wire in wires))

    return measure


_COUNTED = "every byte is in a frame or counted as skipped, and no false frame"
_frames = partial(Case, "serial", unit="frames")
CASES: tuple[Case, ...] = (
    _frames("begins_mid_frame", "a stream begins in the middle of a frame", _COUNTED, _lost(cut_start), 1.0,
            "Only this frame is lost."),
    _frames("begins_mid_frame_crlf", "the same, and every temperature contains the bytes CR LF", _COUNTED,
            _lost(cut_start, BINARY_WIRES, 1.0), 1.0, "Only this frame is lost."),
    _frames("truncated", "the last frame is truncated", _COUNTED, _lost(lambda f, wire: [encode(f, wire)[:-5]]), 1.0,
            "Only this frame is lost."),
    _frames("merged", "two frames are merged", _COUNTED, _lost(partial(merge_frames, whole_frame=False)), 2.0,
            "Only these two are lost."),
    _frames("merged_whole", "two frames are merged, with as many bytes missing as a frame has",
            "at most one false frame", _lost(partial(merge_frames, whole_frame=True), false_n=1), 2.0,
            "No format has a checksum or a counter, so that the false frame cannot be detected."),
    _frames("garbage", "unrelated bytes are inserted into a frame", _COUNTED, _lost(insert_garbage), 2.0,
            "The frame and its neighbour can be lost."),
    _frames("portions", "a stream arrives in portions of seven bytes", _COUNTED,
            _lost(in_portions), 0.0, "Nothing is damaged."),
    _frames("not_finite", "NaN in one frame, Inf in another", "both are counted as not finite",
            _lost(not_finite, not_finite_n=2), 2.0, "These two are lost."),
)  # fmt: skip
