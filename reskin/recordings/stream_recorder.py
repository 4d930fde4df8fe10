"""Record the bytes that a board's port sends: write the files `stream.bin` and `arrivals.csv` of a capture.

`stream.bin` contains the bytes, and `arrivals.csv` contains the times at which they arrived.
"""

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Literal

import numpy as np

from reskin import io
from reskin.board.custom import AnyWire, is_line
from reskin.board.port import Device, found_ports, open_port, read_waiting
from reskin.board.rates import RateMeasurement, RateMeter
from reskin.board.stream import FrameStream, no_frame
from reskin.board.wire import Frames
from reskin.errors import CaptureError
from reskin.recordings.header import ARRIVALS_FILE, STREAM_FILE

# The first bytes of a stream, up to this number, are kept in memory. If they contain no frame, the error suggests wire
# formats in which they can be decoded.
HEAD_BYTES_N = 16384

# a function that is called many times a second during a recording, with the counts of `FrameStream.account`
Report = Callable[[Mapping[str, int]], None]
Watch = Callable[[Frames], object]  # a function that is called with the new frames whenever bytes have arrived
Ended = Literal["duration", "bytes", "stopped", "unplugged", "silent", "no frame", "not written"]


@dataclass(frozen=True)
class PortSettings:
    """The settings of a port, and the limits at which a recording ends."""

    baud: int
    wire: AnyWire
    chips_n: int
    duration_s: float  # the recording ends after this time; math.inf means no limit
    bytes_max_n: int | None  # the recording ends after this many bytes; None means no limit
    silence_s: float  # the recording ends if the port sends nothing for this long
    no_frame_s: float  # the recording ends if no frame has arrived this long after the first byte


@dataclass(frozen=True)
class Recording:
    """The summary of a finished recording; `ended` is the reason why it ended."""

    ended: Ended
    duration_s: float
    partial_line_bytes_n: int  # number of bytes before the first whole line of text, which were not written
    account: dict[str, int]  # counts of bytes and frames, see `FrameStream.account`
    rate: RateMeasurement


def record(
    port: str,
    folder: Path,
    *,
    settings: PortSettings,
    stop: threading.Event,
    report: Report = lambda account: None,
    watch: Watch = lambda frames: None,
) -> Recording:
    """Write the bytes that a port sends to a capture folder.

    The recording ends when `stop` is set, when the process receives Ctrl-C or SIGTERM, when the board is unplugged,
    when the port is silent, when the files cannot be written, or at a limit in the settings. The data that were
    received until then are kept. Raises `CaptureError` if the port cannot be opened or if no frame arrives.
    """
    with (
        open_port(port, settings.baud) as device,
        _stopping_on_signals(stop),
        CaptureWriter(folder, settings.wire, settings.chips_n) as writer,
    ):
        recorder = _Recorder(port, settings, writer, watch)
        ended = recorder.listen(device, stop, report)
    return recorder.finish(ended)


class CaptureWriter:
    """A writer of the files `stream.bin` and `arrivals.csv` of a recording.

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


class _Recorder:
    """A recording in progress, which reads from a port and writes to a capture."""

    def __init__(self, port: str, settings: PortSettings, writer: CaptureWriter, watch: Watch) -> None:
        self._port, self._settings, self._writer, self._watch = port, settings, writer, watch
        self._head = b""
        self._start_s = self._last_byte_s = time.monotonic()
        self._first_byte_s = math.inf
        # Unix time minus monotonic time. This offset is determined only once, so that times of arrival do not go
        # backwards if the system's clock is adjusted during the recording.
        self._unix_offset_s = time.time() - self._start_s

    def listen(self, device: Device, stop: threading.Event, report: Report) -> Ended:
        """Read chunks from the port and write them to the capture until there is a reason to end; return the reason."""
        while not (ended := self._reason_to_end(stop)):
            report(self._writer.decoder.account())
            try:
                chunk = read_waiting(device, self._bytes_left_n())
            except OSError:  # pyserial's errors are OSErrors too
                return "unplugged"
            try:
                self._write(chunk)
            except OSError:
                return "not written"
        return ended

    def finish(self, ended: Ended) -> Recording:
        """Return the finished recording; raise `CaptureError` if it has no frames."""
        self._writer.decoder.close()
        account = self._writer.decoder.account()
        duration_s = time.monotonic() - self._start_s
        if not self._head:
            remedy = f"Check that the board is running, and that this is the port of the board. {found_ports()}"
            raise CaptureError(f"{self._port}: no bytes arrived in {duration_s:.1f} s. {remedy}")
        if not account["frames_n"]:
            raise no_frame(self._port, self._head, self._settings.wire, self._settings.chips_n)
        return Recording(ended, duration_s, self._writer.partial_line_bytes_n, account, self._writer.rate())

    def _reason_to_end(self, stop: threading.Event) -> Ended | None:
        settings, now_s = self._settings, time.monotonic()
        frames_n = self._writer.decoder.account()["frames_n"]
        reasons: dict[Ended, bool] = {
            "stopped": stop.is_set(),
            "duration": now_s - self._start_s >= settings.duration_s,
            "bytes": not self._bytes_left_n(),
            "silent": now_s - self._last_byte_s > settings.silence_s,
            "no frame": not frames_n and now_s - self._first_byte_s > settings.no_frame_s,
        }
        return next((ended for ended, applies in reasons.items() if applies), None)

    def _bytes_left_n(self) -> int:
        bytes_max_n = self._settings.bytes_max_n
        return sys.maxsize if bytes_max_n is None else bytes_max_n - self._writer.bytes_n

    def _write(self, chunk: bytes) -> None:
        if not chunk:
            return
        self._last_byte_s = time.monotonic()
        self._first_byte_s = min(self._first_byte_s, self._last_byte_s)
        self._head = (self._head + chunk)[:HEAD_BYTES_N]
        self._watch(self._writer.write(chunk, self._unix_offset_s + self._last_byte_s))


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
