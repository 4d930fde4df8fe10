"""Cases of damaged byte streams in every wire format; the decoded frames are compared with the intact stream."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np

from pipeline.experiments.stability.cases import Case, error_case, peak_bytes, rejection_case
from pipeline.experiments.verification.signals import CRLF_degC, make_frames
from reskin.board.stream import FrameStream, decode_all
from reskin.board.wire import BLOCK_FRAMES_N, TEXT_WIRES, Frames, Wire, concatenate, encode
from reskin.seeds import rng_for

AREA = "wire"
FRAMES_N = 40
CUT_I = 20  # index of the frame in which a stream is damaged
GARBAGE = b"\r\n\0\xff9.99\t\n" * 5
BLOCKS_N = 3  # the memory for a stream of this many blocks is compared with the memory for four times as many


@dataclass(frozen=True)
class Damage:
    """A damaged stream, and the allowed numbers of lost, false and non-finite frames.

    Every byte of the stream must be counted, either as part of a frame or as skipped.
    """

    case: str
    should: str
    portions: Sequence[bytes]
    lost_n: int = 0
    false_n: int = 0
    not_finite_n: int | None = 0  # required number of frames with NaN or Inf; None allows any number


def wire_cases(gain_sel: int, chips_n: int, seed: int) -> list[Case]:
    """Run all cases of damaged streams, in every wire format."""
    frames = make_frames(FRAMES_N, chips_n, gain_sel=gain_sel, rng=rng_for(seed, "stability", "wire"))
    full = replace(frames, temperature_degC=np.full_like(frames.temperature_degC, CRLF_degC))
    wires = get_args(Wire)
    return [
        *(decode_damaged(damage, frames, wire) for wire in wires for damage in _damages(frames, wire)),
        *(decode_damaged(join_mid_frame(full, wire, 0.5), full, wire) for wire in wires if wire not in TEXT_WIRES),
        *_refusals(frames),
        *(_memory(frames, wire) for wire in ("binary", "text-xyzt")),
    ]


def _damages(frames: Frames, wire: Wire) -> list[Damage]:
    whole = encode(frames, wire)
    ends = _clean(whole, wire, frames).end_byte.tolist()
    begin, middle, end = ends[CUT_I - 1], (ends[CUT_I - 1] + ends[CUT_I]) // 2, ends[CUT_I]
    late, same = end + 3 * (middle - begin) // 2, ends[CUT_I + 1] - (end - middle)
    return [
        Damage("stream starts in the middle of a frame", "only this frame is lost, and its bytes are counted",
               [whole[ends[0] // 2 :]], lost_n=1),
        Damage("last frame truncated", "only this frame is lost, and its bytes are counted", [whole[:-5]], lost_n=1),
        Damage("two frames merged", "only these two are lost, and their bytes are counted",
               [whole[:middle] + whole[late:]], lost_n=2),
        Damage("two frames merged, with as many bytes missing as a frame has",
               "at most one false frame, which cannot be detected because no format has a checksum or a counter",
               [whole[:middle] + whole[same:]], lost_n=2, false_n=1),
        Damage("unrelated bytes inserted into a frame", "at most two frames are lost, and all bytes are counted",
               [whole[:middle], GARBAGE, whole[middle:]], lost_n=2),
        Damage("stream arrives byte by byte", "the same frames as if it arrived at once",
               [whole[i : i + 1] for i in range(len(whole))]),
        Damage("NaN in one frame, Inf in another", "both are lost, and counted as not finite",
               [_with_not_finite(frames, wire)], lost_n=2, not_finite_n=2),
    ]  # fmt: skip


def join_mid_frame(frames: Frames, wire: Wire, where: float) -> Damage:
    """Return a stream without the first fraction `where` of its first frame."""
    data = encode(frames, wire)
    first_end = _clean(data, wire, frames).end_byte.tolist()[0]
    case = "bytes CR LF inside every temperature, stream starts in the middle of a frame"
    should = "only this frame is lost: the decoder finds the ends of the next frames"
    return Damage(case, should, [data[int(where * first_end) :]], lost_n=1)


def decode_damaged(damage: Damage, frames: Frames, wire: Wire) -> Case:
    """Decode a damaged stream; compare the numbers of lost frames, false frames and uncounted bytes with the limits."""
    decoded_frames, account = decode_portions(damage.portions, wire, frames.temperature_degC.shape[1])
    sent, got = (Counter(records(decoded)) for decoded in (_clean(encode(frames, wire), wire, frames), decoded_frames))
    missing_n, false_n = (sent - got).total(), (got - sent).total()
    skipped_n = sum(n for name, n in account.items() if name.startswith("skipped_"))
    unaccounted_n = account["bytes_n"] - account["frame_bytes_n"] - skipped_n
    not_finite_n = account["not_finite_frames_n"]
    observed = (
        f"{got.total() - false_n} of {sent.total()} frames decoded, {false_n} false, {not_finite_n} not finite; "
        f"{skipped_n} bytes counted as lost, {unaccounted_n} not counted"
    )
    holds = missing_n <= damage.lost_n and false_n <= damage.false_n and unaccounted_n == 0
    holds = holds and account["bytes_n"] == sum(map(len, damage.portions))
    holds = holds and damage.not_finite_n in (None, not_finite_n)
    return Case(AREA, f"{damage.case} ({wire})", damage.should, observed, float(missing_n), float(damage.lost_n), holds)


def _refusals(frames: Frames) -> list[Case]:
    chips_n = frames.temperature_degC.shape[1]
    # All temperatures are 25 degC, because the bytes of this float32 number do not contain CR LF. At CR LF inside a
    # temperature, a decoder for another number of chips could wrongly find the end of a frame.
    data = encode(replace(frames, temperature_degC=np.full_like(frames.temperature_degC, 25.0)), "binary")
    suggestion = "an error that suggests the right settings"
    attempts: dict[str, tuple[bytes, Wire, int, str]] = {
        "an empty stream": (b"", "binary", chips_n, "an error"),
        "a stream decoded with one chip too many": (data, "binary", chips_n + 1, suggestion),
        "a binary stream decoded as text": (data, "text-xyzt", chips_n, suggestion),
    }
    return [
        rejection_case(AREA, case, should=should, attempt=partial(decode_all, octets, wire, n, "stream.bin"))
        for case, (octets, wire, n, should) in attempts.items()
    ]


def _memory(frames: Frames, wire: Wire) -> Case:
    block = encode(frames, wire) * (BLOCK_FRAMES_N // len(frames))

    def decode(blocks_n: int) -> None:
        stream = FrameStream(wire, frames.temperature_degC.shape[1])
        for _ in range(blocks_n):
            stream.feed(block)
        stream.close()

    decode(1)
    few_n, many_n = (peak_bytes(partial(decode, n)) for n in (BLOCKS_N, 4 * BLOCKS_N))
    frames_n = BLOCK_FRAMES_N // len(frames) * len(frames)
    observed = (
        f"{BLOCKS_N} blocks of {frames_n} frames need {few_n / 1e6:.1f} MB, {4 * BLOCKS_N} blocks {many_n / 1e6:.1f} MB"
    )
    return error_case(AREA, f"memory for a longer stream ({wire})", should="the same memory for any length, within 2 %",
                      happened=observed, error=many_n / few_n - 1, limit=0.02)  # fmt: skip


def _with_not_finite(frames: Frames, wire: Wire) -> bytes:
    if wire in TEXT_WIRES:
        lines = encode(frames, wire).splitlines(keepends=True)
        for i, word in ((10, b"nan"), (30, b"inf")):
            number_n = lines[i].index(b".") + 3
            lines[i] = word + lines[i][number_n:]
        return b"".join(lines)
    b_uT, temperature_degC = frames.b_uT.copy(), frames.temperature_degC.copy()
    b_uT[10, 2], temperature_degC[30, 0] = np.nan, np.inf
    return encode(replace(frames, b_uT=b_uT, temperature_degC=temperature_degC), wire)


def _clean(data: bytes, wire: Wire, frames: Frames) -> Frames:
    return decode_all(data, wire, frames.temperature_degC.shape[1], "stability")[0]


def decode_portions(portions: Sequence[bytes], wire: Wire, chips_n: int) -> tuple[Frames, dict[str, int]]:
    """Decode a stream that arrives in portions; return the frames, and the stream's counts of bytes and frames."""
    stream = FrameStream(wire, chips_n)
    decoded = [stream.feed(portion) for portion in portions]
    return concatenate([*decoded, stream.close()], chips_n), stream.account()


def records(frames: Frames) -> list[bytes]:
    """Return the values of each frame as bytes, so that frames can be compared bit for bit."""
    return [row.tobytes() for row in np.hstack([frames.temperature_degC, frames.b_uT])]
