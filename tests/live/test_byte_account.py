"""Tests with random faults: every byte sent by a board is in a frame, or is counted as lost with the right reason."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pipeline.experiments.extremes.serial import decode_portions
from reskin.live.emulator import Script, encode_pieces
from reskin.seeds import rng_for
from tests.board.signals import TEXT_WIRES, WIRES, make_frames
from tests.live.faults import BYTE_FAULTS, VALUE_FAULTS, inject

# A script has 8 parts (slots) of 12 frames each, at 400 Hz. Each slot except the last one contains one fault.
SLOTS_N, SLOT_FRAMES_N, RATE_HZ = 8, 12, 400.0
NOT_FINITE_SHARE = 0.02
SEEDS_N = 200
REASONS = ("frames_n", "frame_bytes_n", "not_finite_frames_n", "skipped_not_finite_bytes_n", "skipped_resync_bytes_n",
           "skipped_truncated_bytes_n")  # fmt: skip


def draw(seed: int) -> tuple[Script, list[bytes], list[bool], np.random.Generator]:
    """Draw a random script with faults.

    Returns the script, its undamaged frames, the mask of finite frames, and the random generator.
    """
    rng = rng_for(seed, "byte account")
    wire, chips_n = str(rng.choice(WIRES)), int(rng.integers(1, 6))
    frames = make_frames(SLOTS_N * SLOT_FRAMES_N, chips_n, seed)
    faults = [str(name) for name in rng.choice([*VALUE_FAULTS, *BYTE_FAULTS, "none"], SLOTS_N - 1)]
    # Frames near damage must contain finite numbers, because the decoder counts other frames after damage as damaged.
    finite = rng.random(len(frames)) >= NOT_FINITE_SHARE
    finite |= np.repeat([name in BYTE_FAULTS for name in [*faults, "none"]], SLOT_FRAMES_N)
    script = Script("recorded", wire, frames, encode_pieces(frames, wire), np.arange(len(frames)) / RATE_HZ)
    for slot_i, name in enumerate(faults):  # Faults of chips are injected first. Faults of the wire are injected below.
        if name in VALUE_FAULTS and (name != "clock-jump" or wire == "binary-clock"):
            script = inject(script, make_fault(name, slot_i, rng))
    pieces = list(script.pieces)
    # Frames whose numbers contain the bytes of a terminator must be finite, because otherwise the decoder does not
    # recognise them.
    finite |= np.array([b"\r\n" in piece[:-2] for piece in pieces])
    for i in np.flatnonzero(~finite):
        pieces[i] = with_nan(pieces[i], wire)
    script, clean = replace(script, pieces=pieces), pieces
    for slot_i, name in enumerate(faults):
        if name in BYTE_FAULTS:
            script = inject(script, make_fault(name, slot_i, rng))
    return script, clean, finite.tolist(), rng


def make_fault(name: str, slot_i: int, rng: np.random.Generator) -> str:
    first, frames_n = rng.integers(0, SLOT_FRAMES_N // 2), rng.integers(1, SLOT_FRAMES_N // 2)
    return f"{name}@{(slot_i * SLOT_FRAMES_N + first) / RATE_HZ}+{frames_n / RATE_HZ}"


def with_nan(piece: bytes, wire: str) -> bytes:
    """Replace the last number of a frame by NaN."""
    if wire in TEXT_WIRES:
        return piece[: piece.rstrip().rindex(b"\t") + 1] + b"nan\r\n"
    return piece[:-6] + np.float32(np.nan).tobytes() + piece[-2:]


def expected_account(script: Script, clean: list[bytes], finite: list[bool]) -> Counter[str]:
    """Return the expected counts of frames and bytes.

    They are derived from the injected faults, and not from the bytes. The frame after a damaged frame is lost too,
    because the decoder cannot know where it starts, unless the damaged frame is text and still ends with a line feed.
    """
    count: Counter[str] = Counter()
    in_step = True
    for piece, whole, is_finite in zip(script.pieces, clean, finite, strict=True):
        if piece not in (b"", whole, 2 * whole):
            count["skipped_resync_bytes_n"] += len(piece)
            in_step = script.wire in TEXT_WIRES and piece.endswith(b"\n")
            continue
        for _ in range(len(piece) // len(whole)):
            if not in_step:
                count["skipped_resync_bytes_n"] += len(whole)
            else:
                count["frames_n" if is_finite else "not_finite_frames_n"] += 1
                count["frame_bytes_n" if is_finite else "skipped_not_finite_bytes_n"] += len(whole)
            in_step = True
    return count


def split_randomly(data: bytes, rng: np.random.Generator) -> list[bytes]:
    cuts = np.sort(rng.integers(0, len(data), rng.integers(0, 9))).tolist()
    return [data[first:last] for first, last in pairwise([0, *cuts, len(data)])]


def test_every_byte_is_in_a_frame_or_counted_as_lost_with_its_reason():
    total: Counter[str] = Counter()
    for seed in range(SEEDS_N):
        script, clean, finite, rng = draw(seed)
        count, data = expected_account(script, clean, finite), b"".join(script.pieces)
        if seed % 2 and finite[-1]:  # The board is unplugged while it sends the last frame.
            left_n = len(clean[-1]) - int(rng.integers(3, len(clean[-1])))
            data = data[: len(data) - len(clean[-1]) + left_n]
            count.update(frames_n=-1, frame_bytes_n=-len(clean[-1]), skipped_truncated_bytes_n=left_n)
        _, account = decode_portions(split_randomly(data, rng), script.wire, script.frames.temperature_degC.shape[1])
        assert account == {"bytes_n": len(data)} | {name: count[name] for name in REASONS}, f"seed {seed}"
        total += count
    assert all(total[name] > 100 for name in REASONS)  # Each reason for a loss of bytes must have occurred.
