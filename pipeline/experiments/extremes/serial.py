"""Chips in fields beyond their range, and damaged byte streams in every wire format.

References are the data sheet, recorded noise, and the frames of the intact stream.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np
from jaxtyping import Float, Float32
from scipy.constants import micro

from pipeline.experiments.extremes.cases import Case, World, max_error, relative_error
from pipeline.experiments.extremes.physics import peak_bytes
from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import BLOCK_FRAMES_N, TEXT_WIRES, Frames, Wire, concatenate, encode
from reskin.physics.board import Board
from reskin.physics.chip import ChipDesign, Overruns, read_field, read_temperature, steps_uT
from reskin.seeds import rng_for

SHEET_uT = (0.150, 0.150, 0.242)  # data sheet: field per count at gain 1 (x, y, z)
SHEET_GAINS = (5.0, 4.0, 3.0, 2.5, 2.0, 1.667, 1.333, 1.0)  # GAIN_SEL 0 to 7
# Ranges of the standard deviation of the noise in three recorded data sets (x and y, z)
RECORDED_NOISE_uT = ((3.0, 3.7), (4.5, 7.0))
STILL_FRAMES_N = 20_000
SATURATED_uT = 50e3


def quiet(gain_sel: int) -> ChipDesign:
    """Return a chip without noise."""
    return ChipDesign(gain_sel=gain_sel, noise_xy_uT=0.0, noise_z_uT=0.0, noise_temperature_degC=0.0)


def read_bare(
    b_uT: Float[np.ndarray, "f 3"], design: ChipDesign, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "f 3"], Overruns]:
    """Read fields with one chip that is not rotated, and that has a gain of one and no offset."""
    eye = np.eye(3)[None]
    board = Board("bare", np.zeros((1, 3)), eye, eye, np.zeros((1, 3)))
    return read_field((b_uT * micro)[:, None], board, design=design, rng=rng)


def conversion(b_uT: Float[np.ndarray, "f 3"], gain_sel: int) -> float:
    """Return the error of readings in counts; inf if clipped and wrapped values are not counted.

    A chip clips fields at 50 mT; a count beyond 16 bits wraps around.
    """
    read_uT, overruns = read_bare(b_uT, quiet(gain_sel), rng_for(0, "extremes", "chip"))
    counts = b_uT.clip(-SATURATED_uT, SATURATED_uT) / steps_uT(gain_sel)
    wrapped = counts - 2**16 * np.rint(counts / 2**16)
    beyond_n = (int((np.rint(counts) != np.rint(wrapped)).sum()), int((np.abs(b_uT) > SATURATED_uT).sum()))
    error = max_error(read_uT / steps_uT(gain_sel), wrapped)
    return error if beyond_n == (overruns.wrapped_n, overruns.clipped_n) else np.inf


def out_of_range_uT(seed: int) -> Float[np.ndarray, "f 3"]:
    """Return random fields up to 60 mT whose counts are not within a count of a limit."""
    b_uT = rng_for(seed, "extremes", "range").uniform(-60e3, 60e3, (2000, 3))
    counts = b_uT / steps_uT(7)
    return np.where(np.abs(np.abs(counts) % 2**16 - 2**15) < 1, 0.0, b_uT)


def noise_sd_uT(chip: ChipDesign, seed: int) -> Float[np.ndarray, "3"]:
    read_uT, _ = read_bare(np.zeros((STILL_FRAMES_N, 3)), chip, rng_for(seed, "extremes", "noise"))
    return read_uT.std(axis=0)


def noise(chip: ChipDesign, seed: int) -> float:
    design_uT = np.array([chip.noise_xy_uT, chip.noise_xy_uT, chip.noise_z_uT])
    return relative_error(noise_sd_uT(chip, seed), np.sqrt(design_uT**2 + steps_uT(chip.gain_sel) ** 2 / 12))


def beyond_recorded_noise_uT(chip: ChipDesign, seed: int) -> float:
    low_uT, high_uT = np.array([RECORDED_NOISE_uT[axis == 2] for axis in range(3)]).T
    sd_uT = noise_sd_uT(chip, seed)
    return float(np.maximum(low_uT - sd_uT, sd_uT - high_uT).clip(min=0).max())


def temperature(seed: int) -> float:
    rng = rng_for(seed, "extremes", "temperature")
    true_degC = rng.uniform(0, 60, (500, 5))
    raw = np.rint((true_degC - 25) * 45.2 + 46244)  # counts, by the inverse of the data sheet's formula
    return max_error(read_temperature(true_degC, quiet(7), rng), 25 + (raw - 46244) / 45.2)


# Byte streams -----------------------------------------------------------------------------------------------------

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


def records(frames: Frames) -> list[bytes]:
    """Return the values of each frame as bytes, so that frames can be compared bit for bit."""
    return [row.tobytes() for row in np.hstack([frames.temperature_degC, frames.b_uT])]


def lost_frames_n(
    portions: Sequence[bytes], frames: Frames, wire: Wire, *, false_n: int = 0, not_finite_n: int | None = 0
) -> float:
    """Return the number of frames of the intact stream that a decoder of a damaged stream does not find.

    Returns inf if there are more than `false_n` frames that were not sent, if a byte is neither in a frame nor counted
    as skipped, or if the number of frames with NaN or Inf is not `not_finite_n` (None: any number).
    """
    chips_n = frames.temperature_degC.shape[1]
    decoded, account = decode_portions(portions, wire, chips_n)
    sent = Counter(records(decode_all(encode(frames, wire), wire, chips_n, "extremes")[0]))
    got = Counter(records(decoded))
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
    """Return the number of bytes up to the end of each frame."""
    decoded, _ = decode_all(encode(frames, wire), wire, frames.temperature_degC.shape[1], "extremes")
    return [int(end) for end in decoded.end_byte]


def _lost(
    damage: Damage, wires: Sequence[Wire] = WIRES, crlf_share: float = 0.05, **allowed: int
) -> Callable[[World], float]:
    """Return a function that computes the largest number of lost frames in any wire format."""

    def measure(world: World) -> float:
        frames = make_frames(world, crlf_share)
        return max(lost_frames_n(damage(frames, wire), frames, wire, **allowed) for wire in wires)

    return measure


def memory_growth(world: World, wire: Wire) -> float:
    """Return the relative growth of the decoder's memory if a stream is four times as long."""
    frames = make_frames(world)
    block = encode(frames, wire) * (BLOCK_FRAMES_N // len(frames))

    def decode(blocks_n: int) -> None:
        stream = FrameStream(wire, frames.temperature_degC.shape[1])
        for _ in range(blocks_n):
            stream.feed(block)
        stream.close()

    decode(1)
    return peak_bytes(partial(decode, 8)) / peak_bytes(partial(decode, 2)) - 1


_COUNTED = "every byte is in a frame or counted as skipped, and no false frame"
_frames = partial(Case, "serial", unit="frames")
CASES: tuple[Case, ...] = (
    Case("chip", "steps", "field per count, all gains", "data sheet, 0.150 uT (x, y) and 0.242 uT (z) times the gain",
         lambda _: relative_error(np.array([steps_uT(i) for i in range(8)]), np.outer(SHEET_GAINS, SHEET_uT)), 3e-4,
         "The gains 5/3 and 4/3 are published with three decimals."),
    Case("chip", "range", "readings of fields up to 60 mT at GAIN_SEL 7, whose range is 4.9 mT (x, y) and 7.9 mT (z)",
         "clipped at 50 mT, wrapped to 16 bits; both counted", lambda w: conversion(out_of_range_uT(w.seed), 7), 0.51,
         "Readings are rounded to whole counts.", unit="counts"),
    Case("chip", "noise", "noise of a board at rest", "standard deviation in the settings, and rounding to counts",
         lambda w: noise(w.simulation.chip, w.seed), 4 / np.sqrt(2 * STILL_FRAMES_N), "Four standard errors."),
    Case("chip", "recorded_noise", "noise of a board at rest, distance from the range of recorded noise",
         "3.0-3.7 uT in x and y, 4.5-7.0 uT in z", lambda w: beyond_recorded_noise_uT(w.simulation.chip, w.seed), 0.1,
         "The recorded values have two digits.", unit="uT"),
    Case("chip", "temperature", "temperature", "25 + (raw - 46244) / 45.2, data sheet", lambda w: temperature(w.seed),
         4e-6, "Rounding errors of float32 are largest at 60 degC.", unit="degC"),
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
    *(Case("serial", f"memory_{wire}", f"memory for a stream that is four times as long ({wire})", "the same memory",
           partial(memory_growth, wire=wire), 0.02, "The total varies by a few bytes.", full=True)
      for wire in ("binary", "text-xyzt")),
)  # fmt: skip
