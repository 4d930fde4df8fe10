"""Record a board to a capture folder for `reskin add`, together with the labels of a label source, if there is one.

During the recording, the capture is the folder `<folder>.part`, which contains the header from the start. When the
recording has ended, the folder is renamed. If the recorder is killed or the power fails, the `.part` folder remains. It
can still be added, with the data and labels that reached the disk.
"""

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from errno import ENOSPC
from pathlib import Path
from types import FrameType
from typing import Literal, NamedTuple

import numpy as np

from reskin import io
from reskin.board.other_firmware import AnyWire, is_line
from reskin.board.port import found_ports, open_port, read_waiting
from reskin.board.rates import RateMeasurement, RateMeter
from reskin.board.stream import HEAD_BYTES_N, FrameStream, no_frame
from reskin.board.wire import Frames
from reskin.errors import CaptureError
from reskin.recordings.header import (
    ARRIVALS_FILE,
    STREAM_FILE,
    Clock,
    Header,
    Rate,
    Source,
    make_header,
    seal,
    write_header,
)
from reskin.recordings.labels import LabelContext, LabelSource, LabelThread, ProbeLogWriter
from reskin.recordings.preparing import UNNAMED

PROGRESS_s = 1.0
CAPTURES = Path("captures")

# a function that is called many times a second during a recording, with the counts of `FrameStream.account`
Report = Callable[[Mapping[str, int]], None]
Watch = Callable[[Frames], object]  # a function that is called with the new frames whenever bytes have arrived
Ended = Literal["duration", "stopped", "unplugged", "silent", "no frame", "not written"]


@dataclass(frozen=True)
class PortSettings:
    """The settings of a port, and the limits at which a recording ends."""

    baud: int
    wire: AnyWire
    chips_n: int
    duration_s: float  # the recording ends after this time; math.inf means no limit
    silence_s: float  # the recording ends if the port sends nothing for this long
    no_frame_s: float  # the recording ends if no frame has arrived this long after the first byte


@dataclass(frozen=True)
class CaptureInfo:
    """What a recorder must know about a capture: the names for its header, and the source of its labels."""

    board: str = UNNAMED
    skin: str = UNNAMED
    scan: str = "not stated"  # order of the places: random, snake or other text
    labels: LabelSource | None = None
    source: Source = "recorded"  # "simulated" if the port is an emulated board that sends a simulation


@dataclass(frozen=True)
class Recording:
    """The summary of a finished recording of a port; `ended` is the reason why it ended."""

    ended: Ended
    duration_s: float
    partial_line_bytes_n: int  # number of bytes before the first whole line of text, which were not written
    account: dict[str, int]  # counts of bytes and frames, see `FrameStream.account`
    rate: RateMeasurement


class CaptureResult(NamedTuple):
    """The result of a finished recording: the summaries of its stream and of its labels."""

    stream: Recording
    labels: str  # a summary of the labels for the user
    failed: Exception | None  # the exception that ended the source of labels, if any


def record_capture(
    port: str, folder: Path, *, info: CaptureInfo, settings: PortSettings, report: Report, watch: Watch
) -> CaptureResult:
    """Record a port to a capture folder, together with labels if `info` has a source of labels.

    The recording stops when the stream of the port ends, or when the source of labels ends.
    """
    part, header = begin_capture(folder, info, wire=settings.wire, chips_n=settings.chips_n, by="reskin record")
    stop, headers, label_thread = threading.Event(), [header], None
    try:
        if info.labels is not None:
            label_thread = LabelThread(info.labels, _label_context(part, headers, stop))
        recording = record(port, part, settings=settings, stop=stop, report=report, watch=watch)
    except CaptureError as error:
        if label_thread is not None:
            label_thread.end()
        io.remove(part)  # no frame arrived, so there is nothing to keep
        # If the source of labels failed, it ended the recording, so its error is the cause.
        if label_thread is not None and label_thread.failed is not None:
            raise label_thread.failed from error
        raise
    summary, failed = (label_thread.end(), label_thread.failed) if label_thread is not None else ("", None)
    if isinstance(failed, OSError) and failed.errno == ENOSPC:
        recording = replace(recording, ended="not written")
    # If the disk is full, the header may not be writable. The .part folder is kept, and can be added as it is.
    if recording.ended != "not written":
        end_capture(folder, headers[-1], recording.rate)
    return CaptureResult(recording, summary, failed)


def _label_context(part: Path, headers: list[Header], stop: threading.Event) -> LabelContext:
    """Make the context of a source of labels.

    A first sync mark is written to the header. It states that the times of labels and of arrivals are from the same
    clock. If the source has a clock of its own, it calls `mark` to replace this mark.
    """
    # This offset is determined only once, so that times stay consistent if the system's clock is adjusted meanwhile.
    offset_s = time.time() - time.monotonic()
    writer = ProbeLogWriter(part)

    def unix_s() -> float:
        return offset_s + time.monotonic()

    def mark(stream_s: float, source_s: float) -> None:
        with writer.locked() as is_open:
            if is_open:  # after the writer was closed, the header must not be changed any more
                clock = headers[-1].clock.model_copy(update={"marks": ((stream_s, source_s),)})
                headers[-1] = headers[-1].model_copy(update={"clock": clock})
                write_header(part, headers[-1])

    now_s = unix_s()
    mark(now_s, now_s)
    return LabelContext(writer, unix_s, stop, mark)


def begin_capture(folder: Path, info: CaptureInfo, *, wire: AnyWire, chips_n: int, by: str) -> tuple[Path, Header]:
    """Create the folder `<folder>.part` and its header; return the path of this folder, and the header.

    `by` is the name of the recording program, which becomes part of the note in the header.
    """
    part = _part_of(folder)
    for path in (folder, part):
        if path.exists():
            raise CaptureError(f"{path}: the folder exists already. Choose another --out.")
    options = {"scan": info.scan} | ({"labels": info.labels.name} if info.labels is not None else {})
    header = make_header(
        f"--out {folder.name}", capture=folder.name, source=info.source, board=info.board, skin=info.skin,
        layout="native",
        wire=wire, chips_n=chips_n, options=options,
        clock=Clock(kind="arrivals", rate_hz=None, marks=()), protocol="as the probe log says",
        note=f"recorded by {by}; arrival times are unix seconds of the host",
    )  # fmt: skip
    io.make_folder(part.parent)
    part.mkdir()
    write_header(part, header)
    io.sync(part.parent)
    return part, header


def end_capture(folder: Path, header: Header, rate: RateMeasurement) -> None:
    """Complete the header of `<folder>.part` with the rate and the hashes of the files, and rename the folder."""
    measured = None
    if rate.known:
        measured = Rate.model_validate({name: getattr(rate, name) for name in Rate.model_fields})
    part = _part_of(folder)
    seal(part, header.model_copy(update={"rate": measured}))
    io.sync(*part.iterdir(), part)
    part.rename(folder)
    io.sync(folder.parent)


def _part_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.part")


def new_folder() -> Path:
    """Return the path of a new capture folder, named after the current time."""
    return CAPTURES / time.strftime("%Y%m%d-%H%M%S")


def print_progress(alarms: Callable[[], Sequence[str]]) -> Report:
    """Return a function for the argument `report` of `record_capture`.

    The function prints the frame rate, the number of lost bytes and the alarms to stderr once a second, if stderr is a
    terminal. `alarms` is a function that returns the current alarms.
    """
    start_s = last_s = time.monotonic()
    last_n = 0

    def report(account: Mapping[str, int]) -> None:
        nonlocal last_s, last_n
        now_s, frames_n = time.monotonic(), account["frames_n"]
        if now_s - last_s < PROGRESS_s or not sys.stderr.isatty():
            return
        rate_hz = (frames_n - last_n) / (now_s - last_s)
        lost_n = sum(count for name, count in account.items() if name.startswith("skipped_"))
        line = f"{now_s - start_s:.0f} s: {rate_hz:.1f} frames/s, {frames_n} frames, {lost_n} bytes lost"
        print("; ".join([line, *alarms()]), file=sys.stderr, flush=True)
        last_s, last_n = now_s, frames_n

    return report


def record(
    port: str,
    folder: Path,
    *,
    settings: PortSettings,
    stop: threading.Event,
    report: Report = lambda account: None,
    watch: Watch = lambda frames: None,
) -> Recording:
    """Write the bytes that a port sends, and the times at which they arrived, to a capture folder.

    The recording ends when `stop` is set, when the process receives Ctrl-C or SIGTERM, when the board is unplugged,
    when the port is silent, when the files cannot be written, or at a limit in the settings. The data that were
    received until then are kept. Raises `CaptureError` if the port cannot be opened or if no frame arrives.
    """
    with (
        open_port(port, settings.baud) as device,
        _stopping_on_signals(stop),
        CaptureWriter(folder, settings.wire, settings.chips_n) as writer,
    ):
        head, account = b"", writer.decoder.account()
        start_s = last_byte_s = time.monotonic()
        first_byte_s = math.inf
        # Unix time minus monotonic time. This offset is determined only once, so that times of arrival do not go
        # backwards if the system's clock is adjusted during the recording.
        unix_offset_s = time.time() - start_s

        def reason_to_end() -> Ended | None:
            now_s = time.monotonic()
            reasons: dict[Ended, bool] = {
                "stopped": stop.is_set(),
                "duration": now_s - start_s >= settings.duration_s,
                "silent": now_s - last_byte_s > settings.silence_s,
                "no frame": not account["frames_n"] and now_s - first_byte_s > settings.no_frame_s,
            }
            return next((ended for ended, applies in reasons.items() if applies), None)

        while not (ended := reason_to_end()):
            report(account)
            try:
                chunk = read_waiting(device)
            except OSError:  # pyserial's errors are OSErrors too
                ended = "unplugged"
                break
            if chunk:
                last_byte_s = time.monotonic()
                first_byte_s = min(first_byte_s, last_byte_s)
                head = (head + chunk)[:HEAD_BYTES_N]
                try:
                    watch(writer.write(chunk, unix_offset_s + last_byte_s))
                except OSError:
                    ended = "not written"
                    break
                account = writer.decoder.account()
    writer.decoder.close()
    account, duration_s = writer.decoder.account(), time.monotonic() - start_s
    if not head:
        remedy = f"Check that the board is running, and that this is the port of the board. {found_ports()}"
        raise CaptureError(f"{port}: no bytes arrived in {duration_s:.1f} s. {remedy}")
    if not account["frames_n"]:
        raise no_frame(port, head, settings.wire, settings.chips_n)
    return Recording(ended, duration_s, writer.partial_line_bytes_n, account, writer.rate())


class CaptureWriter:
    """A writer of the files `stream.bin` (the bytes) and `arrivals.csv` (their times of arrival) of a recording.

    For each chunk of bytes, the bytes are written first, and their time of arrival second. Therefore, if the recorder
    is killed between the two, no time refers to missing bytes. If the disk is full, a partly written chunk is removed.
    The written bytes are also decoded, to count the frames and to measure their rate.
    """

    def __init__(self, folder: Path, wire: AnyWire, chips_n: int) -> None:
        self.bytes_n = self.partial_line_bytes_n = 0
        self.decoder = FrameStream(wire, chips_n)
        self._chips_n = chips_n
        self._meter: RateMeter | None = None  # None until the first bytes arrive
        self._in_partial_line = is_line(wire)
        # The files are not buffered. Therefore, no written data is lost if the process is killed, and closing the files
        # cannot fail because of a full disk.
        self._stream = (folder / STREAM_FILE).open("xb", buffering=0)
        self._arrivals = (folder / ARRIVALS_FILE).open("xb", buffering=0)
        self._arrivals.write(b"byte_end,t_s\n")
        self._note_arrival(time.time())

    def __enter__(self) -> "CaptureWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._stream.close()
        self._arrivals.close()

    def rate(self) -> RateMeasurement:
        """Return the rate of the frames that were written so far."""
        return (self._meter or RateMeter(self._chips_n, 0.0)).measure()

    def write(self, chunk: bytes, unix_s: float) -> Frames:
        """Write a chunk; return the frames that are now complete.

        In text formats, the first line is not written, because the recording may have begun inside a number.
        """
        if self._meter is None:
            self._meter = RateMeter(self._chips_n, unix_s)
        if self._in_partial_line:
            partial, newline, rest = chunk.partition(b"\n")
            self.partial_line_bytes_n += len(partial + newline)
            self._in_partial_line, chunk = not newline, rest
        if chunk:
            io.append(self._stream, chunk)
            self.bytes_n += len(chunk)
            self._note_arrival(unix_s)
        frames = self.decoder.feed(chunk)
        self._meter.feed(frames, np.full(len(frames), unix_s))
        return frames

    def _note_arrival(self, unix_s: float) -> None:
        io.append(self._arrivals, f"{self.bytes_n},{unix_s:.6f}\n".encode())


@contextmanager
def _stopping_on_signals(stop: threading.Event) -> Iterator[None]:
    """Set `stop` if the process receives Ctrl-C or SIGTERM during the `with` block.

    Only the main thread can handle signals, so nothing is changed in other threads.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def set_stop(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, set_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
