"""From a serial port to a capture's stream. In: a port, a folder. Out: `stream.bin`, `arrivals.csv`, how it ended.

Bytes are written as they come, before anything looks at them, so a killed recorder loses none that it had read.
Refuses to know headers, where captures are kept, and what a frame holds.
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
from typing import BinaryIO, Literal, TextIO

import serial
from serial.tools import list_ports

from pipeline.capture.header import ARRIVALS_FILE, STREAM_FILE, Wire
from pipeline.capture.stream import FrameStream, no_frame
from pipeline.capture.wire import TEXT_WIRES
from pipeline.core.errors import CaptureError

READ_TIMEOUT_s = 0.1  # how late a stop, a silence or the end of the duration may be noticed
HEAD_BYTES_N = 16384  # the first bytes are kept to say what fits, should no frame come

Report = Callable[[Mapping[str, int]], None]  # called with the account many times a second
Ended = Literal["duration", "bytes", "stopped", "unplugged", "silent", "no frame"]


@dataclass(frozen=True)
class PortSettings:
    """How to listen, and for how long; `math.inf` seconds and no `bytes_max_n` go on until stopped."""

    baud: int
    wire: Wire
    chips_n: int
    duration_s: float
    bytes_max_n: int | None
    silence_s: float  # a port that sends nothing for so long has ended
    no_frame_s: float  # a port that sends has so long to send its first frame


@dataclass(frozen=True)
class Recording:
    """What was recorded and how it ended; `account` counts the frames and losses that a `FrameStream` saw."""

    ended: Ended
    duration_s: float
    partial_line_bytes_n: int  # bytes before the first whole line, not written
    account: dict[str, int]


def record(
    port: str, folder: Path, *, settings: PortSettings, stop: threading.Event, report: Report = lambda account: None
) -> Recording:
    """Write what a port sends until `stop` is set, Ctrl-C, SIGTERM, unplugging, or the settings say so.

    Raises `CaptureError` if the port does not open or not one frame comes. A port that falls silent after its first
    frame ends the recording: what came is kept.
    """
    with (
        _open(port, settings.baud) as device,
        _stopping_on_signals(stop),
        (folder / STREAM_FILE).open("xb") as stream,
        (folder / ARRIVALS_FILE).open("x", buffering=1, encoding="ascii", newline="\n") as arrivals,
    ):
        recorder = _Recorder(port, settings, stream, arrivals)
        ended = recorder.listen(device, stop, report)
    return recorder.finish(ended)


class _Recorder:
    """Remembers what has come since the port was opened."""

    def __init__(self, port: str, settings: PortSettings, stream: BinaryIO, arrivals: TextIO) -> None:
        self._port, self._settings = port, settings
        self._stream, self._arrivals = stream, arrivals
        self._frames = FrameStream(settings.wire, settings.chips_n)
        self._head = b""
        self._bytes_n = self._partial_line_bytes_n = 0
        self._in_partial_line = settings.wire in TEXT_WIRES
        self._start_s = self._last_byte_s = time.monotonic()
        self._first_byte_s = math.inf
        # The system's clock may be set while we record, and arrival times must not fall.
        self._unix_s = time.time() - self._start_s
        self._arrivals.write("byte_end,t_s\n")
        self._note_arrival()

    def listen(self, device: serial.Serial, stop: threading.Event, report: Report) -> Ended:
        """Read until there is a reason to end."""
        while not (ended := self._reason_to_end(stop)):
            report(self._frames.account())
            try:
                # What waits, or else one byte: then the read sleeps until it comes.
                chunk = device.read(max(1, min(device.in_waiting, self._room_n())))
            except OSError:  # pyserial's errors are OSErrors too
                return "unplugged"
            if chunk:
                self._keep(chunk)
        return ended

    def finish(self, ended: Ended) -> Recording:
        """Say what came; raise if there is no frame in it."""
        self._frames.close()
        account = self._frames.account()
        duration_s = time.monotonic() - self._start_s
        if not self._head:
            got, remedy = f"none in {duration_s:.1f} s", f"Is the board running, and this its port? {_found_ports()}"
            raise CaptureError(self._port, "bytes", "coming in", got, remedy)
        if not account["frames_n"]:
            raise no_frame(self._port, self._head, self._settings.wire, self._settings.chips_n)
        return Recording(ended, duration_s, self._partial_line_bytes_n, account)

    def _reason_to_end(self, stop: threading.Event) -> Ended | None:
        settings, now_s = self._settings, time.monotonic()
        frames_n = self._frames.account()["frames_n"]
        reasons: dict[Ended, bool] = {
            "stopped": stop.is_set(),
            "duration": now_s - self._start_s >= settings.duration_s,
            "bytes": not self._room_n(),
            "silent": now_s - self._last_byte_s > settings.silence_s,
            "no frame": not frames_n and now_s - self._first_byte_s > settings.no_frame_s,
        }
        return next((ended for ended, is_so in reasons.items() if is_so), None)

    def _room_n(self) -> int:
        bytes_max_n = self._settings.bytes_max_n
        return sys.maxsize if bytes_max_n is None else bytes_max_n - self._bytes_n

    def _keep(self, chunk: bytes) -> None:
        """Write a chunk first, then when it came, so that no arrival speaks of bytes that are not there."""
        self._last_byte_s = time.monotonic()
        self._first_byte_s = min(self._first_byte_s, self._last_byte_s)
        self._head = (self._head + chunk)[:HEAD_BYTES_N]
        if self._in_partial_line:  # of a number cut at its start, nobody could tell
            partial, newline, rest = chunk.partition(b"\n")
            self._partial_line_bytes_n += len(partial + newline)
            self._in_partial_line, chunk = not newline, rest
        if chunk:
            self._stream.write(chunk)
            self._stream.flush()
            self._bytes_n += len(chunk)
            self._note_arrival()
            self._frames.feed(chunk)

    def _note_arrival(self) -> None:
        self._arrivals.write(f"{self._bytes_n},{self._unix_s + self._last_byte_s:.6f}\n")


def _open(port: str, baud: int) -> serial.Serial:
    try:
        return serial.Serial(port, baud, timeout=READ_TIMEOUT_s, exclusive=True)
    except (OSError, ValueError) as error:
        raise CaptureError(port, "the port", "one that opens", error, _found_ports()) from None


def _found_ports() -> str:
    names = [found.device for found in list_ports.comports()]
    return f"Ports found: {', '.join(names)}." if names else "No serial port was found: is the board plugged in?"


@contextmanager
def _stopping_on_signals(stop: threading.Event) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM set `stop`; only the main thread can, and may."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
