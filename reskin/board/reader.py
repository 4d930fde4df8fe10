"""Read a port in a thread; if the board is unplugged, reopen the port as soon as it is plugged in again."""

import threading
import time
from collections import deque
from typing import Protocol

from reskin.board.find import BAUD, Chunk
from reskin.board.port import Device, open_port, read_waiting
from reskin.errors import CaptureError

# The queue holds two minutes of data from five chips at 400 Hz. If it is longer, its oldest chunks are dropped.
QUEUE_BYTES_MAX_N = 2**22
RETRY_S = 0.5  # time between two attempts to open the port of an unplugged board
# An empty chunk in the queue. It means that the board was plugged in, so that a new stream begins.
PLUGGED_IN = b""


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
            writer = self.writer
            if writer is not None:
                try:
                    writer.write(chunk, now_s)
                except OSError as error:  # for example, the disk is full: end the recording, but continue to read
                    self.writer, self.writer_problem = None, f"cannot be written any more: {error.strerror}"
                    writer.close()
