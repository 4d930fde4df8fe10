"""A board that is not there: plays a script into a pseudo-terminal or a TCP socket, at its own rate or another.

Time stands still while nobody reads, so that what is sent is taken: bytes sent are bytes received. What is played over
and over begins again when its port is opened, as boards do that are reset by that: each reader finds the untouched
skin that the script begins with. Refuses to know what the bytes mean.
"""

import os
import select
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.core.errors import ParamsError
from pipeline.live.script import Script

TICK_S = 0.1  # how late a stop may be noticed
LATE_MAX_S = 0.1  # who was kept waiting for longer does not catch up
SENT_TOGETHER_N = 256  # frames at most, when they are overdue
HOST = "127.0.0.1"


class Terminal:
    """A pseudo-terminal; with a link it keeps its name when it is unplugged and plugged in again."""

    def __init__(self, link: Path | None = None) -> None:
        if not hasattr(os, "openpty"):
            raise ParamsError("--port", "the port", "tcp on this system", "pty", "Try: --port tcp")
        if link is not None and (link.exists() and not link.is_symlink()):
            raise ParamsError(link, "the link", "new", "a file that is there", "Choose another name.")
        self._link, self._opened = link, False
        self.plug_in()

    def plug_in(self) -> None:
        import fcntl
        import termios
        import tty  # none of them is on Windows

        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        fcntl.ioctl(self._far, termios.TIOCPKT, struct.pack("i", 1))  # say when somebody opens it, who then flushes it
        self._flushed = termios.TIOCPKT_FLUSHREAD
        os.set_blocking(self._far, False)
        self.name = os.ttyname(self._near)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.name)
            self.name = str(self._link)

    def unplug(self) -> None:
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._near)
        os.close(self._far)

    def send(self, data: bytes, stop: threading.Event) -> int:
        taken_n = 0
        while taken_n < len(data) and not stop.is_set():
            told, free, _ = select.select([self._far], [self._far], [], TICK_S)
            with suppress(BlockingIOError):
                if told:  # what a reader writes is not heard
                    self._opened |= bool(os.read(self._far, 4096)[0] & self._flushed)
                if free:
                    taken_n += os.write(self._far, data[taken_n:])
        return taken_n

    def was_opened(self) -> bool:
        """Say whether somebody has opened the port since this was last asked."""
        opened, self._opened = self._opened, False
        return opened


class Socket:
    """A TCP server on this machine, for one reader at a time: `socket://127.0.0.1:PORT`."""

    def __init__(self, number: int = 0) -> None:
        self._number, self._opened = number, False
        self.plug_in()

    def plug_in(self) -> None:
        try:
            self._server = socket.create_server((HOST, self._number))
        except OSError as error:
            raise ParamsError("--port", f"TCP port {self._number}", "free", error.strerror, "Try: --port tcp") from None
        self._server.settimeout(TICK_S)
        self._number = self._server.getsockname()[1]
        self.name = f"socket://{HOST}:{self._number}"
        self._client: socket.socket | None = None

    def unplug(self) -> None:
        for end in (self._client, self._server):
            if end is not None:
                end.close()

    def send(self, data: bytes, stop: threading.Event) -> int:
        taken_n = 0
        while taken_n < len(data) and not stop.is_set():
            try:
                if self._client is None:
                    self._client = self._server.accept()[0]
                    self._opened = True
                    self._client.settimeout(TICK_S)
                taken_n += self._client.send(data[taken_n:])
            except TimeoutError:
                continue
            except OSError:  # the reader has gone: wait for another
                if self._client is not None:
                    self._client.close()
                self._client = None
        return taken_n

    def was_opened(self) -> bool:
        """Say whether somebody has connected since this was last asked."""
        opened, self._opened = self._opened, False
        return opened


Port = Terminal | Socket


def open_far_end(port: str) -> Port:
    """Open `pty`, `tcp`, `tcp:PORT`, or a pseudo-terminal with a link at a path."""
    kind, _, number = port.partition(":")
    if port == "pty":
        return Terminal()
    if kind == "tcp" and (number.isdecimal() or port == "tcp"):
        return Socket(int(number or 0))
    if Path(port).parent.is_dir() and "/" in port:
        return Terminal(Path(port))
    raise ParamsError("--port", "the port", "pty, tcp, tcp:PORT or ./NAME of a link to be made", port, "Try: pty")


def play(script: Script, port: Port, stop: threading.Event, *, speed: float = 1.0, loop: bool = False) -> int:
    """Send a script, `speed` times as fast as it was recorded (`math.inf`: as fast as it is taken); give the bytes."""
    sent_n, start_s, comes_back = 0, time.monotonic(), False
    while not stop.is_set():
        i = 0
        while i < len(script) and not stop.is_set():
            if i in script.away_s:
                port.unplug()
                stop.wait(script.away_s[i])
                port.plug_in()
                comes_back = True  # who opens it then finds the script where it was
            now_s, due_s = time.monotonic() - start_s, float(script.t_s[i]) / speed
            if due_s > now_s:
                stop.wait(min(due_s - now_s, TICK_S))
                continue
            lost_s = max(now_s - due_s - LATE_MAX_S, 0.0)
            start_s += lost_s
            first, i = i, _next_after(script, i, (now_s - lost_s) * speed)
            sent_n += port.send(b"".join(script.pieces[first:i]), stop)
            if port.was_opened():
                if loop and not comes_back:
                    i, start_s = 0, time.monotonic()
                comes_back = False
        if not loop:
            break
        start_s += script.duration_s / speed
    return sent_n


def _next_after(script: Script, first: int, script_s: float) -> int:
    """Give the first piece that is not sent together with another one: it is not due, or comes after an unplugging."""
    last = first + 1
    end = min(len(script), first + SENT_TOGETHER_N)
    while last < end and script.t_s[last] <= script_s and last not in script.away_s:
        last += 1
    return last


@contextmanager
def playing(script: Script) -> Iterator[str]:
    """Play a script over and over beside the caller; give the name of its port."""
    port, stop = (Terminal() if hasattr(os, "openpty") else Socket()), threading.Event()
    player = threading.Thread(target=play, args=[script, port, stop], kwargs={"loop": True}, daemon=True)
    player.start()
    try:
        yield port.name
    finally:
        stop.set()
        player.join()
        port.unplug()
