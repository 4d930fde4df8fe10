"""Read the port of a board: `open_port` and `read_waiting` read at once, and a `Reader` reads in a thread.

A port is either a serial port of this machine, or a network address written as `socket://host:port`.
"""

import errno
import os
import re
import select
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Protocol

import serial
from serial.serialutil import SerialBase
from serial.tools import list_ports

from reskin.errors import CaptureError

# Longest time for which one read waits for bytes. A recording checks only between two reads whether it must end, so it
# may end later by this time.
READ_TIMEOUT_s = 0.1
READ_BYTES_MAX_N = 65536
SOCKET = "socket://"
BAUD = 115200  # USB ports ignore the baud rate
# The queue holds two minutes of data from five chips at 400 Hz. If it is longer, its oldest chunks are dropped.
QUEUE_BYTES_MAX_N = 2**22
RETRY_S = 0.5  # time between two attempts to open the port of an unplugged board
# An empty chunk in the queue. It means that the board was plugged in, so that a new stream begins.
PLUGGED_IN = b""

Device = SerialBase  # an open port
Chunk = tuple[bytes, float]  # bytes that were read at once, and their time of arrival in s


def open_port(port: str, baud: int) -> Device:
    """Open a serial port, exclusively for this process, or connect to `socket://host:port`.

    This function opens the ports of boards and of force gauges. Bytes that arrived before the port was opened are
    discarded. Use `read_waiting` to read from the port, because the read timeout of a socket is set to 0.
    """
    check_name(port)
    try:
        device = serial.serial_for_url(port, baud, timeout=READ_TIMEOUT_s, exclusive=None if "://" in port else True)
    except (OSError, ValueError) as error:
        number = error.errno if isinstance(error, OSError) else None
        reason = f"{error}. {found_ports()}"
        if number == errno.ENOENT:
            reason = f"no such port. {found_ports()}"
        elif number == errno.EAGAIN:
            reason = "another program uses it (perhaps reskin live or a serial monitor). Close this program."
        elif "Could not configure port" in str(error):  # pyserial's text for devices without a baud rate
            reason = f"it is not a serial port. {found_ports()}"
        raise CaptureError(f"{port}: cannot open the port: {reason}") from None
    if not isinstance(device, serial.Serial):
        device.timeout = 0
    return device


def check_name(port: str) -> None:
    """Raise `CaptureError` for a name that cannot be a port, such as the name of a file."""
    reason = ""
    if port.startswith(SOCKET):
        if not re.fullmatch(r".+:\d{1,5}([/?].*)?", port.removeprefix(SOCKET)):
            reason = f"its port number is missing. Write {SOCKET}HOST:PORT."
    elif "://" in port:  # pyserial accepts more schemes, some of which load code
        reason = f"the only supported URL is {SOCKET}HOST:PORT."
    elif os.path.isdir(port):  # unlike `Path.is_dir`, never raises for names such as COM3
        reason = f"it is a folder. {found_ports()}"
    elif os.path.isfile(port):
        reason = "it is a file. To read a file, use reskin decode or reskin predict."
    if reason:
        raise CaptureError(f"{port}: cannot open the port: {reason}")


def read_waiting(device: Device, bytes_max_n: int = READ_BYTES_MAX_N) -> bytes:
    """Return the bytes that are waiting or arrive within `READ_TIMEOUT_s`; raise `OSError` if the board is gone."""
    if isinstance(device, serial.Serial):  # first wait for one byte, and then read all other bytes that have arrived
        first = device.read(min(1, bytes_max_n))
        waiting_n = min(device.in_waiting, READ_BYTES_MAX_N, bytes_max_n) - 1 if first else 0
        return first + device.read(waiting_n) if waiting_n > 0 else first
    # A socket does not report how many bytes have arrived, so wait until it can be read, and read once.
    ready, _, _ = select.select([device], [], [], READ_TIMEOUT_s)
    return device.read(min(READ_BYTES_MAX_N, bytes_max_n)) if ready else b""


def port_names() -> list[str]:
    """List the serial ports of this machine."""
    return sorted(port.device for port in list_ports.comports())


def found_ports() -> str:
    """Return a sentence that lists the ports of this machine, for error messages."""
    names = port_names()
    return (
        f"Ports found: {', '.join(names)}."
        if names
        else "No serial port was found. Check that the board is plugged in."
    )


class ChunkWriter(Protocol):
    """An object that writes chunks of bytes to a recording, such as a `CaptureWriter`."""

    def write(self, chunk: bytes, unix_s: float) -> object: ...

    def close(self) -> None: ...


class Reader:
    """A reader of a port, which reads in a thread and queues the chunks of bytes with their times of arrival.

    `missed_bytes_n` counts the bytes that were dropped because the queue was full. If a port cannot be opened or read,
    `problem` is the reason. If a recording cannot be written, `writer_problem` is the reason.
    """

    def __init__(self, port: str, baud: int = BAUD) -> None:
        self.port, self.baud = port, baud
        self.plugged_in, self.was_plugged_in, self.problem = False, False, ""
        self.missed_bytes_n = self.waiting_bytes_n = 0
        self.taken_s = 0.0  # when `take` was last called, in unix seconds
        self.writer: ChunkWriter | None = None
        self.writer_problem = ""
        # Unix time minus monotonic time. This offset is determined only once, so that the times of arrival stay
        # consistent if the system's clock is adjusted while the port is read.
        self._clock_s = time.time() - time.monotonic()
        self._chunks: deque[Chunk] = deque()
        self._arrived = threading.Condition()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"reader of {port}", daemon=True)

    def start(self, *, must_exist: bool) -> None:
        """Begin to read in the thread.

        With `must_exist`, the port is opened before the thread starts, and `CaptureError` is raised if this fails.
        """
        self._device = open_port(self.port, self.baud) if must_exist else None
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.write_to(None)

    def unix_s(self) -> float:
        """Return the current unix time, which never goes backwards."""
        return self._clock_s + time.monotonic()

    def take(self, wait_s: float) -> list[Chunk]:
        """Remove all chunks from the queue and return them; if there are none, first wait for one, at most `wait_s`."""
        with self._arrived:
            self._arrived.wait_for(lambda: bool(self._chunks), wait_s)
            chunks = list(self._chunks)
            self._chunks.clear()
            self.waiting_bytes_n = 0
            self.taken_s = self.unix_s()
        return chunks

    def write_to(self, writer: ChunkWriter | None) -> None:
        """Close the current recording, if there is one, and write all later chunks to `writer`.

        If `writer` is None, later chunks are not written.
        """
        with self._arrived:
            previous, self.writer, self.writer_problem = self.writer, writer, ""
        if previous is not None:
            previous.close()

    def _read(self) -> None:
        device: Device | None = self._device
        while not self._stop.is_set():
            try:
                device = device or self._plug_in()
                self.plugged_in = self.was_plugged_in = True
                if chunk := read_waiting(device):
                    self._queue_chunk(chunk)
            except (OSError, CaptureError) as error:
                self.plugged_in, self.problem = False, str(error)
                if device is not None:
                    device.close()
                    device = None
                self._stop.wait(RETRY_S)
        if device is not None:
            device.close()

    def _plug_in(self) -> Device:
        device = open_port(self.port, self.baud)
        self._queue_chunk(PLUGGED_IN)
        return device

    def _queue_chunk(self, chunk: bytes) -> None:
        with self._arrived:
            # The time is read while the lock is held. Therefore, any chunk that `take` has not returned yet has a time
            # after `taken_s`, when `take` was last called.
            now_s = self.unix_s()
            self._chunks.append((chunk, now_s))
            self.waiting_bytes_n += len(chunk)
            while self.waiting_bytes_n > QUEUE_BYTES_MAX_N:
                oldest_n = len(self._chunks.popleft()[0])
                self.waiting_bytes_n -= oldest_n
                self.missed_bytes_n += oldest_n
            self._arrived.notify()
            failed = None
            try:
                if self.writer is not None:
                    self.writer.write(chunk, now_s)
            except OSError as error:  # for example, the disk is full: end the recording, but continue to read
                failed, self.writer = self.writer, None
                self.writer_problem = f"cannot be written any more: {error.strerror}"
        if failed is not None:
            with suppress(OSError):  # otherwise, the board would seem to be unplugged
                failed.close()
