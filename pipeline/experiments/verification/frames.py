"""Laws of the bytes of frames, against Python's struct and float. In: readings of chips. Out: checks.

The binary layouts are those of the authors' reader: struct "<20fcc" for five chips.
Refuses to know losses (`stability`).
"""

import struct
from collections.abc import Callable

import numpy as np

from pipeline.experiments.verification.checks import Check
from reskin.board import wire
from reskin.board.stream import decode_all
from reskin.board.wire import Frames
from reskin.physics.chip import steps_uT
from reskin.recordings.header import Wire
from reskin.seeds import rng_for

FRAMES_N = 300
CRLF_degC = 34.513275  # its float32 holds CR LF
CRLF_SHARE = 0.05


def check_frames(gain_sel: int, chips_n: int, seed: int) -> list[Check]:
    """Check what is written and what is read, for each wire format; an error is the largest difference of any value."""
    frames = make_frames(FRAMES_N, chips_n, gain_sel=gain_sel, rng=rng_for(seed, "verification", "frames"))
    laws: dict[Wire, Callable[[Frames, Wire], list[Check]]] = {
        "binary": binary,
        "binary-clock": binary,
        "text-xyzt": text,
        "text-txyz": text,
    }
    return [check for layout, law in laws.items() for check in law(frames, layout)]


def make_frames(frames_n: int, chips_n: int, *, gain_sel: int, rng: np.random.Generator) -> Frames:
    """Make readings on the chip's grid; some temperatures hold CR LF in their bytes."""
    counts = rng.integers(-20_000, 20_000, (frames_n, chips_n, 3))
    b_uT = (counts * steps_uT(gain_sel)).reshape(frames_n, -1).astype(np.float32)
    usual_degC = (rng.integers(2000, 4000, (frames_n, chips_n)) / 100).astype(np.float32)
    held_degC = np.where(rng.random(usual_degC.shape) < CRLF_SHARE, np.float32(CRLF_degC), usual_degC)
    return Frames(b_uT, held_degC, np.arange(frames_n) / 512.0, np.zeros(frames_n, np.int64))


def binary(frames: Frames, layout: Wire) -> list[Check]:
    values, clock = _txyz(frames), "f" if layout == "binary-clock" else ""
    form = struct.Struct(f"<{clock}{values.shape[1]}fcc")
    rows = np.column_stack([frames.device_s, values]).tolist() if clock else values.tolist()
    theirs = b"".join(form.pack(*row, b"\r", b"\n") for row in rows)
    ours = wire.encode(frames, layout)
    unpacked = np.array([row[:-2] for row in form.iter_unpack(ours)])[:, len(clock) :]
    decoded, _ = decode_all(theirs, layout, frames.temperature_degC.shape[1], "verification")
    same = "bytes are bytes"
    return [
        Check(f"frames, {layout}", "what is written", f"struct {form.format!r}", _differing(ours, theirs),
              "bytes", 0.0, same),
        Check(f"frames, {layout}", "what struct reads of it", f"struct {form.format!r}, as the authors' reader",
              float(np.abs(unpacked - values).max()), "uT or degC", 0.0, same),
        Check(f"frames, {layout}", "what is read of struct's bytes, CR LF in floats included", "the values packed",
              _missed(decoded, values), "uT or degC", 0.0, same),
    ]  # fmt: skip


def text(frames: Frames, layout: Wire) -> list[Check]:
    values = _txyz(frames)
    numbers = values.reshape(len(frames), -1, 4)
    ordered = numbers if layout == "text-txyz" else np.roll(numbers, -1, axis=2)
    # AnySkin's firmware leaves the tab between two chips out.
    gap = "" if layout == "text-txyz" else "\t"
    lines = [gap.join("\t".join(f"{value:.2f}" for value in chip) for chip in row) + gap for row in ordered.tolist()]
    theirs = "".join(line + "\r\n" for line in lines).encode()
    ours = wire.encode(frames, layout)
    decoded, _ = decode_all(theirs, layout, frames.temperature_degC.shape[1], "verification")
    return [
        Check(f"frames, {layout}", "what is written", "Python's format, two decimals", _differing(ours, theirs),
              "bytes", 0.0, "bytes are bytes"),
        Check(f"frames, {layout}", "what is read", "the values printed", _missed(decoded, values), "uT or degC", 5.5e-3,
              "two decimals: half of the last, and the rounding of float32"),
    ]  # fmt: skip


def _txyz(frames: Frames) -> np.ndarray:
    b_uT = frames.b_uT.reshape(len(frames), -1, 3)
    return np.concatenate([frames.temperature_degC[:, :, None], b_uT], axis=2).reshape(len(frames), -1)


def _differing(ours: bytes, theirs: bytes) -> float:
    return float(abs(len(ours) - len(theirs)) + sum(a != b for a, b in zip(ours, theirs, strict=False)))


def _missed(decoded: Frames, values: np.ndarray) -> float:
    found = _txyz(decoded)
    return float(np.abs(found - values).max()) if found.shape == values.shape else np.inf
