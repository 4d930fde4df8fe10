"""A capture becomes readings, whatever its layout. In: a folder with `header.json`. Out: readings, an account.

A native capture (`stream.bin`, `arrivals.csv`, `probe.csv`) is read in bounded memory, every byte accounted for.
Refuses to know how to decode, to time or to join, and what is done with readings.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from pipeline.capture import arrivals, probe, wire
from pipeline.capture.arrivals import Arrivals
from pipeline.capture.decisions import Decisions
from pipeline.capture.header import (
    ARRIVALS_FILE,
    HEADER_FILE,
    PROBE_FILE,
    STREAM_FILE,
    Header,
    Wire,
    check_same_capture,
    parse,
)
from pipeline.capture.probe import ProbeLog
from pipeline.capture.readers import READERS
from pipeline.capture.readers.chips import Watch
from pipeline.capture.readers.table import check_log
from pipeline.capture.stream import FrameStream, no_frame
from pipeline.capture.wire import Frames
from pipeline.core import io
from pipeline.core.errors import CaptureError
from pipeline.core.schema import Readings
from pipeline.dataset.clocks import ClockMap, from_contacts, from_marks
from pipeline.dataset.indentations import TimedFrames, join

BLOCK_BYTES_N = 2**22
# A whole that is counted, and the prefix and suffix of counts of its lost parts.
LOSSES = (
    ("bytes_n", "skipped_", "_bytes_n"),
    ("frames_n", "dropped_", "_frames_n"),
    ("rows_read_n", "dropped_", "_rows_n"),
    ("logged_indentations_n", "dropped_", "_indentations_n"),
)
# Frames between dwells, and those of a dwell without its counterpart, are expected; so are rows of zeros where a
# recorder asks faster than chips answer, of which its reader allows so many.
NO_LOSS = (
    "dropped_between_dwells_frames_n",
    "dropped_no_noload_frames_n",
    "dropped_no_contact_frames_n",
    "dropped_zero_rows_n",
)

Timer = Callable[[Frames, int], Float64[np.ndarray, "_"]]  # frames, and how many came before -> stream time of each


class Opened(NamedTuple):
    """A capture being read; `account` is complete when `blocks` is exhausted."""

    header: Header
    blocks: Iterable[Readings]
    account: Mapping[str, int]


def open_capture(folder: Path, decisions: Decisions) -> Opened:
    """Check a capture's header and files, and begin to read it; `decisions` say what becomes of faults."""
    header = read_header(folder)
    check_same_capture(header, folder.name)
    for name, digest in header.files.items():
        if not (folder / name).is_file():
            raise CaptureError(folder / name, "the file", "there, as the header says", "nothing", "Add it again.")
        if io.sha256(folder / name) != digest:
            rule, remedy = "unchanged since it was added", "Remove it and add it again."
            raise CaptureError(folder / name, "the file", rule, "another hash", remedy)
    if header.layout == "native":
        return Opened(header, *read_native(folder, header, decisions))
    if header.layout not in READERS:
        remedy = "An SD card's log has no labels to learn from; try: reskin predict."
        raise CaptureError(folder, "layout", f"native or one of {sorted(READERS)}", header.layout, remedy)
    readings, account = READERS[header.layout].read(folder, header, decisions)
    return Opened(header, [readings], account)


def read_header(folder: Path) -> Header:
    file = folder / HEADER_FILE
    if not file.is_file():
        raise CaptureError(file, "a capture", f"a folder with {HEADER_FILE}", "none", "Is it another --layout?")
    return parse(file.read_text(encoding="utf-8", errors="replace"), str(file))


def check_losses(account: Mapping[str, int], limit: float, where: str) -> None:
    """Raise if a capture lost more than the fraction `limit` of its bytes, frames, rows or indentations."""
    for whole, prefix, suffix in LOSSES:
        lost = [key for key in account if key.startswith(prefix) and key.endswith(suffix) and key not in NO_LOSS]
        lost_n = sum(account[key] for key in lost)
        if lost_n > limit * account.get(whole, 0):
            reasons = ", ".join(f"{account[key]} {key.removesuffix('_n')}" for key in lost if account[key])
            rule = f"at most {limit:.0%} of {account[whole]}"
            remedy = "Mend the recording, or raise lost_fraction_max in params.yaml."
            raise CaptureError(where, f"lost {whole.removesuffix('_n')}", rule, reasons, remedy)


def read_native(folder: Path, header: Header, decisions: Decisions) -> tuple[Iterator[Readings], dict[str, int]]:
    """Begin to read a capture; the account is complete when the readings are exhausted.

    Without sync marks the stream is read twice, first for the clock.
    """
    stream = folder / STREAM_FILE
    if not stream.is_file():
        raise CaptureError(stream, "the file", "there", "nothing", "Copy the whole capture folder.")
    log = probe.parse(folder / PROBE_FILE, str(folder / PROBE_FILE))
    check_log(log, str(folder / PROBE_FILE))
    times_of = timer(folder, header)
    clock = _clock(folder, header, log, _timed_frames(folder, header, times_of, {}, decisions))
    account = {
        "clock_residual_us": round(1e6 * clock.residual_s),
        "clock_explained_pct": round(100 * clock.explained),
    }
    blocks = _timed_frames(folder, header, times_of, account, decisions)
    return join(blocks, log, clock, header, account), account


def _clock(folder: Path, header: Header, log: ProbeLog, blocks: Iterator[TimedFrames]) -> ClockMap:
    if header.clock.marks:
        return from_marks(np.array(header.clock.marks), str(folder))
    pairs = ((block.t_s[block.sound], block.frames.b_uT[block.sound]) for block in blocks)
    return from_contacts(pairs, log, str(folder))


def _timed_frames(
    folder: Path, header: Header, times_of: Timer, account: dict[str, int], decisions: Decisions
) -> Iterator[TimedFrames]:
    """Decode the stream block by block; the stream's own account is added when it has ended."""
    stream, watch = FrameStream(_wire(header), header.chips_n), Watch(header, str(folder / STREAM_FILE), decisions)
    frames_n = 0
    with (folder / STREAM_FILE).open("rb") as file:
        head = data = file.read(BLOCK_BYTES_N)
        while data:
            frames = stream.feed(data)
            yield _timed(frames, times_of(frames, frames_n), watch)
            frames_n += len(frames)
            data = file.read(BLOCK_BYTES_N)
    frames = stream.close()
    yield _timed(frames, times_of(frames, frames_n), watch)
    if not stream.account()["frames_n"]:
        raise no_frame(str(folder / STREAM_FILE), head, _wire(header), header.chips_n)
    watch.close()
    account.update(stream.account() | watch.ledger.account())


def _timed(frames: Frames, t_s: Float64[np.ndarray, " f"], watch: Watch) -> TimedFrames:
    found = watch.look(frames, t_s)
    return TimedFrames(frames, t_s, found.failed, found.stuck, found.beyond)


def timer(folder: Path, header: Header) -> Timer:
    """Choose how frames get a time, as the header's clock says."""
    rate_hz = header.clock.rate_hz
    if header.clock.kind == "arrivals":
        table = _arrivals(folder)
        return lambda frames, _: arrivals.times_of(frames.end_byte, table)
    if rate_hz is None:
        got = repr(header.clock.kind)
        raise CaptureError(folder, "clock.kind", "'arrivals' or 'rate' for a port's stream", got, "Mend it.")
    if header.wire in wire.TEXT_WIRES:
        return lambda frames, before_n: arrivals.constant_rate(before_n + 1.0 + np.arange(len(frames)), rate_hz)
    frame_bytes_n = wire.record_type(_wire(header), header.chips_n).itemsize
    return lambda frames, _: arrivals.constant_rate(frames.end_byte / frame_bytes_n, rate_hz)


def _arrivals(folder: Path) -> Arrivals:
    """Read the arrivals; a stream that is shorter than they say was cut off after it was recorded."""
    table = arrivals.parse(folder / ARRIVALS_FILE, str(folder / ARRIVALS_FILE))
    bytes_n, arrived_n = (folder / STREAM_FILE).stat().st_size, int(table.byte_end[-1])
    if bytes_n < arrived_n:
        rule = f"the {arrived_n} bytes long that {ARRIVALS_FILE} says"
        raise CaptureError(folder / STREAM_FILE, "the stream", rule, bytes_n, "Copy the capture again.")
    return table


def _wire(header: Header) -> Wire:
    assert header.wire is not None, "the header's own check: a native capture has a wire"
    return header.wire
