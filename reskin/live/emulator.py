"""An emulated board: plays a capture or a simulation into a pseudo-terminal or a TCP socket, with faults if asked."""

import os
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64

from reskin import io
from reskin.board.faults import FAILED_B_uT, FAILED_TEMPERATURE_degC, RESET_LSB_XY_uT, RESET_LSB_Z_uT
from reskin.board.stream import decode_all
from reskin.board.wire import TEXT_WIRES, Frames, encode, record_type
from reskin.config import read_yaml
from reskin.errors import CaptureError, ParamsError
from reskin.recordings.header import HEADER_FILE, LOG_FILE, STREAM_FILE, Wire
from reskin.recordings.ingest import read_header, timer
from reskin.recordings.readers import sd_card
from reskin.seeds import rng_for
from reskin.simulation.capture import record, roster
from reskin.simulation.defaults import NOMINAL, SHARED, nominal
from reskin.simulation.settings import MAIN, parse_synthesis

WALK = "log"  # the protocol that is most like a hand: touches, and pauses between them
Source = Literal["simulated", "recorded"]


@dataclass(frozen=True)
class Script:
    """Pieces of a stream, each up to the end of one frame: the bytes, the frame, and when it is sent."""

    source: Source
    wire: Wire
    frames: Frames
    pieces: list[bytes]
    t_s: Float64[np.ndarray, " f"]  # from the start
    away_s: dict[int, float] = field(default_factory=dict)  # piece: how long the board is unplugged before it

    def __len__(self) -> int:
        return len(self.pieces)

    @property
    def duration_s(self) -> float:
        """How long it lasts, the pause before the first frame comes again included."""
        return float(self.t_s[-1] * len(self) / max(len(self) - 1, 1)) if len(self) else 0.0


NOMINAL_SOURCE = "nominal"
SEED = 2021  # of a simulation that names none


def read_script(source: str) -> Script:
    """Read the folder of a capture, or simulate: `nominal`, or a YAML file with a section `simulate` (a scene)."""
    folder = Path(source)
    if (folder / HEADER_FILE).is_file():
        return read_capture(folder)
    if source == NOMINAL_SOURCE:
        settings = read_yaml(NOMINAL)
        return simulate({name: settings[name] for name in ("boards", "protocols")}, SEED, source)
    if folder.suffix == ".yaml" and folder.is_file():
        scene = read_yaml(folder)
        if not isinstance(scene, dict) or "simulate" not in scene:
            raise ParamsError(source, "the scene", "simulated", "recorded", "Give the folder of one of its captures.")
        return simulate(scene["simulate"], scene.get("seed", SEED), source)
    rule = f"the folder of a capture (with {HEADER_FILE}), {NOMINAL_SOURCE}, or the YAML file of a simulated scene"
    raise ParamsError(source, "the source", rule, "none of them", f"Try: {NOMINAL_SOURCE}")


def read_capture(folder: Path) -> Script:
    """Read what a port or an SD card left; a card's log is sent as binary frames."""
    header = read_header(folder)
    if header.layout == "sd-card":
        t_s, b_uT, temperature_degC, _ = sd_card.read_log(folder / LOG_FILE)
        return _script(header.source, b_uT, temperature_degC, t_s)
    if header.wire is None:
        remedy = "What others recorded has no bytes of a port."
        raise CaptureError(folder, "layout", "native or sd-card", header.layout, remedy)
    data = io.read_bytes(folder / STREAM_FILE)
    frames, _ = decode_all(data, header.wire, header.chips_n, str(folder / STREAM_FILE))
    t_s = timer(folder, header)(frames, 0)
    timed = np.isfinite(t_s)
    frames, t_s = frames.where(timed), t_s[timed]
    edges = np.append(0, frames.end_byte).tolist()  # bytes between two frames go with the second
    pieces = [data[first:last] for first, last in pairwise(edges)]
    return Script(header.source, header.wire, frames, pieces, t_s - t_s[0])


def simulate(section: Mapping[str, Any], seed: int, where: str) -> Script:
    """Simulate the first skin of a section `simulate`: its walk if it has one, else its grid."""
    synthesis = parse_synthesis(section, {name: nominal(name) for name in SHARED}, f"{where}: simulate")
    protocol = WALK if WALK in synthesis.protocols else MAIN
    board, skin = roster(synthesis, protocol)[0]
    capture = record(synthesis, protocol, board=board, skin=skin, seed=seed)
    chunk_i = np.searchsorted(capture.arrived_frames_n, 1 + np.arange(len(capture.b_uT)))
    return _script("simulated", capture.b_uT, capture.temperature_degC, capture.arrived_s[chunk_i])


def encode_pieces(frames: Frames, wire: Wire) -> list[bytes]:
    """Write frames as the firmware sends them, one by one."""
    data = encode(frames, wire)
    if wire in TEXT_WIRES:
        return data.splitlines(keepends=True)
    size = record_type(wire, frames.temperature_degC.shape[1]).itemsize
    return [data[first : first + size] for first in range(0, len(data), size)]


def _script(source: Source, b_uT: np.ndarray, temperature_degC: np.ndarray, t_s: np.ndarray) -> Script:
    wire: Wire = "binary"
    unknown = np.full(len(t_s), np.nan), np.zeros(len(t_s), np.int64)
    frames = Frames(b_uT, temperature_degC, *unknown)
    return Script(source, wire, frames, encode_pieces(frames, wire), t_s - t_s[0])


START_S, DURATION_S = 3.0, 1.0  # of a fault that says neither
TORN_EVERY_N, TORN_BYTES_N = 10, 7
CRLF_TEMPERATURE_degC = 34.513275  # its float32 holds 0D 0A
FULL_SCALE_uT, WRAP_uT = 50_000.0, 2**16 * 0.15  # of the chip; of int16 at its finest step
MAGNET_uT = 400.0
HOT_degC = 150.0
CLOCK_JUMP_S = 3600.0
Fields = Float32[np.ndarray, "f k 3"]
Values = Callable[[Fields, Float[np.ndarray, "f k"], Float64[np.ndarray, " f"], int], None]


class Fault(NamedTuple):
    """A fault's name, when it begins and how long it lasts."""

    name: str
    start_s: float
    duration_s: float


def parse_fault(text: str) -> Fault:
    """Read NAME, NAME@START_S or NAME@START_S+DURATION_S.

    >>> parse("stall@2.5+1")
    Fault(name='stall', start_s=2.5, duration_s=1.0)
    """
    found = re.fullmatch(r"([a-z0-9-]+)(?:@(\d{1,6}(?:\.\d+)?)(?:\+(\d{1,6}(?:\.\d+)?))?)?", text)
    if found is None or found[1] not in FAULTS:
        rule = f"NAME[@START_S[+DURATION_S]] with one of {', '.join(FAULTS)}"
        raise ParamsError("--fault", "a fault", rule, repr(text)[:40], "Try: --fault stuck@3+1")
    return Fault(found[1], float(found[2] or START_S), float(found[3] or DURATION_S))


def inject(script: Script, fault: Fault) -> Script:
    """Let a fault happen; of values, chip 1 is hit, or the only one."""
    inside = (script.t_s >= fault.start_s) & (script.t_s < fault.start_s + fault.duration_s)
    if not inside.any():
        rule, got = f"within the {script.duration_s:.1f} s that are sent", f"{fault.start_s:g} s"
        raise ParamsError("--fault", f"the start of {fault.name}", rule, got, "Try: NAME@START_S")
    if fault.name in TIMES:
        return TIMES[fault.name](script, int(inside.argmax()), fault.duration_s)
    rows = np.flatnonzero(inside)
    if fault.name in VALUES:
        changed = _changed(script, inside, VALUES[fault.name])
    else:
        changed = PIECES[fault.name]([script.pieces[i] for i in rows], rng_for(0, "inject", fault.name))
    pieces = list(script.pieces)
    for i, piece in zip(rows, changed, strict=True):
        pieces[i] = piece
    return replace(script, pieces=pieces)


def _changed(script: Script, inside: np.ndarray, change: Values) -> list[bytes]:
    frames = script.frames.where(inside)
    chip_i = min(1, frames.temperature_degC.shape[1] - 1)
    change(frames.b_uT.reshape(len(frames), -1, 3), frames.temperature_degC, frames.device_s, chip_i)
    return encode_pieces(frames, script.wire)


def _fail_read(b_uT: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[:, chip_i], temperature_degC[:, chip_i] = FAILED_B_uT, FAILED_TEMPERATURE_degC


def _read_nothing(b_uT: Fields, temperature_degC: np.ndarray, _: np.ndarray, _chip: int) -> None:
    b_uT[:], temperature_degC[:] = 0.0, 0.0


def _reset(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    step_uT = np.array([RESET_LSB_XY_uT, RESET_LSB_XY_uT, RESET_LSB_Z_uT])
    b_uT[:, chip_i] = np.rint(b_uT[:, chip_i] / step_uT) * step_uT


def _stick(b_uT: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[:, chip_i], temperature_degC[:, chip_i] = b_uT[0, chip_i], temperature_degC[0, chip_i]


def _saturate(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[:, chip_i] = FULL_SCALE_uT * np.sign(b_uT[:, chip_i])


def _wrap(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    b_uT[::2, chip_i, 2] -= WRAP_uT * np.sign(b_uT[::2, chip_i, 2])


def _magnetise(b_uT: Fields, _temperature: np.ndarray, _: np.ndarray, _chip: int) -> None:
    b_uT[:, :, 2] += MAGNET_uT  # chips are turned about z, which is the same for all


def _heat(_field: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    temperature_degC[:, chip_i] = HOT_degC


def _hold_crlf(_field: Fields, temperature_degC: np.ndarray, _: np.ndarray, chip_i: int) -> None:
    temperature_degC[:, chip_i] = CRLF_TEMPERATURE_degC


def _jump(_field: Fields, _temperature: np.ndarray, device_s: np.ndarray, _chip: int) -> None:
    if np.isnan(device_s).all():
        raise ParamsError("--fault", "clock-jump", "put where frames have a clock", "none", "Take binary-clock.")
    device_s += CLOCK_JUMP_S


def _stall(script: Script, first: int, duration_s: float) -> Script:
    return replace(script, t_s=script.t_s + duration_s * (np.arange(len(script)) >= first))


def _unplug(script: Script, first: int, duration_s: float) -> Script:
    return replace(_stall(script, first, duration_s), away_s=script.away_s | {first: duration_s})


VALUES: Mapping[str, Values] = {
    "failed-read": _fail_read, "zeros": _read_nothing, "chip-reset": _reset, "stuck": _stick, "saturated": _saturate,
    "int16-wrap": _wrap, "magnet": _magnetise, "too-hot": _heat, "crlf": _hold_crlf, "clock-jump": _jump,
}  # fmt: skip
PIECES: Mapping[str, Callable[[list[bytes], np.random.Generator], list[bytes]]] = {
    "repeated": lambda pieces, _: [2 * piece for piece in pieces],
    "dropped": lambda pieces, _: [piece if i % 2 else b"" for i, piece in enumerate(pieces)],
    "torn": lambda pieces, _: [p[:-TORN_BYTES_N] if i % TORN_EVERY_N == 0 else p for i, p in enumerate(pieces)],
    "wrong-baud": lambda pieces, rng: [rng.bytes(len(piece)) for piece in pieces],
}
TIMES: Mapping[str, Callable[[Script, int, float], Script]] = {"stall": _stall, "unplug": _unplug}
FAULTS = (*VALUES, *PIECES, *TIMES)


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
