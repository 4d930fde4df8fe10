"""An emulated board: a process that sends the bytes that a real board would send.

The bytes come from a recorded capture or from a simulation. They are sent to a pseudo-terminal or to a TCP socket,
from which other programs read them as from a serial port.
"""

import os
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from reskin import io
from reskin.board.other_firmware import CustomWire
from reskin.board.stream import decode_all
from reskin.board.wire import TEXT_WIRES, Frames, Wire, encode, record_type
from reskin.config import read_yaml
from reskin.data.grid import points_mm
from reskin.errors import CaptureError, ParamsError
from reskin.recordings.header import HEADER_FILE, LOG_FILE, NAME, NAME_RULE, STREAM_FILE, Source
from reskin.recordings.ingest import read_header, timer
from reskin.recordings.readers import sd_card
from reskin.simulation.capture import SimulatedCapture, list_captures, simulate_capture
from reskin.simulation.defaults import SHARED, nominal
from reskin.simulation.protocols import LIFTED_MM, Plan, Walk
from reskin.simulation.settings import MAIN, parse_simulation

UNKNOWN_degC = 25.0  # is sent as the temperature of boards that send none
NOMINAL_SOURCE = "nominal"
SEED = 2021  # seed of a simulation, if the scene's YAML file does not set a seed
TOUCH_PROTOCOL = "log"  # name of the protocol with touches and pauses between them, similar to a user's touches

ROBOT_PASSES_N = 2  # number of passes of an emulated robot over the 65 places of the grid
# For each press, an emulated robot moves down for MOVING_S, presses for PRESSING_S, moves up for MOVING_S, and stays
# above the skin for LIFTED_S. Before the first press, it waits for ROBOT_QUIET_S, because a reader that opens the port
# late does not receive the first frames.
LIFTED_S, MOVING_S, PRESSING_S, ROBOT_QUIET_S = 0.12, 0.02, 0.1, 4.0
ROBOT_RATE_HZ = 100.0
# An emulated robot is considered to be at rest while the force is at least this fraction of the largest force of the
# press.
AT_REST = 0.999

TICK_S = 0.1  # longest time until `play` notices that the event `stop` was set
# Sending is blocked while the reader does not read. If it was blocked for longer than this time, all later frames are
# delayed. If it was blocked for a shorter time, `play` sends the next frames faster until it has caught up.
LATE_MAX_S = 0.1
BATCH_MAX_N = 256  # largest number of overdue frames that are sent at once
HOST = "127.0.0.1"
TCP_PORT_MAX = 65535


@dataclass(frozen=True)
class Script:
    """The byte stream that an emulated board sends, and the time at which each frame is due."""

    source: Source  # whether the stream was recorded or simulated
    wire: Wire  # wire format of the bytes
    frames: Frames  # the decoded frames
    pieces: list[bytes]  # the bytes of each frame
    t_s: Float64[np.ndarray, " f"]  # time at which each piece is due, from the start of the script
    # True x_mm, y_mm and F_N in each frame, which are NaN in frames without contact. The value is None if the true
    # contacts are unknown, as for a recorded capture.
    true_contacts: Float64[np.ndarray, "f 3"] | None = None
    presses_per_pass_n: int | None = None  # number of presses in one pass of a robot; None if no robot presses the skin

    def __len__(self) -> int:
        return len(self.pieces)

    @property
    def duration_s(self) -> float:
        """Time from the start of the script until it starts again, if it is sent in a loop."""
        return float(self.t_s[-1] * len(self) / max(len(self) - 1, 1)) if len(self) else 0.0


def read_script(source: str, *, board: str | None = None, robot: bool = False) -> Script:
    """Create a script from a recorded capture or from a simulation.

    Parameters
    ----------
    source : folder of a capture, the YAML file of a scene with a section `simulate`, or `nominal`, which stands for a
        simulation with the nominal settings
    board : name of the simulated board, which is allowed only for the source `nominal`. For each name, another board
        with another skin is drawn. By default, the first board of the simulation is used.
    robot : whether a robot presses the skin at the places of the grid, which is allowed only for the source `nominal`.
        By default, the skin is touched at random places.
    """
    folder = Path(source)
    if (board is not None or robot) and source != NOMINAL_SOURCE and folder.exists():
        raise ParamsError(f"{source}: --board and --robot can only be used with source {NOMINAL_SOURCE}. Omit them.")
    if (folder / HEADER_FILE).is_file():
        return read_capture(folder)
    if source == NOMINAL_SOURCE:
        section = {name: nominal(name) for name in ("boards", "protocols")}
        return simulate(section, SEED, source, board=board, robot=robot)
    if folder.suffix == ".yaml" and folder.is_file():
        scene = read_yaml(folder)
        if not isinstance(scene, dict) or "simulate" not in scene:
            raise ParamsError(
                f"{source}: the scene is recorded, not simulated. Use the folder of one of its captures as the source."
            )
        return simulate(scene["simulate"], scene.get("seed", SEED), source)
    raise ParamsError(
        f"{source}: the source must be the folder of a capture (with {HEADER_FILE}), {NOMINAL_SOURCE}, or the YAML "
        f"file of a simulated scene. Try: {NOMINAL_SOURCE}"
    )


def read_capture(folder: Path) -> Script:
    """Create a script from a capture, which contains either a byte stream or the log of an SD card.

    The bytes of a stream are sent unchanged. The readings in a log are encoded as frames of a byte stream.
    """
    header = read_header(folder)
    if header.layout == "sd-card":
        t_s, b_uT, temperature_degC, _ = sd_card.read_log(folder / LOG_FILE)
        return _binary_script(header.source, b_uT, temperature_degC, t_s)
    if header.wire is None:
        raise CaptureError(
            f"{folder}: a capture of layout {header.layout} cannot be replayed as a serial stream. Use a capture "
            "with layout native or sd-card."
        )
    data = io.read_bytes(folder / STREAM_FILE)
    frames, _ = decode_all(data, header.wire, header.chips_n, str(folder / STREAM_FILE))
    t_s = timer(folder, header)(frames, 0)
    timed = np.isfinite(t_s)
    frames, t_s = frames.where(timed), t_s[timed]
    if isinstance(header.wire, CustomWire):  # emulated as a board that sends the paper's format
        temperature_degC = np.nan_to_num(frames.temperature_degC, nan=UNKNOWN_degC)
        return _binary_script(header.source, frames.b_uT, temperature_degC, t_s)
    edges = np.append(0, frames.end_byte).tolist()  # bytes between two frames become part of the second frame's piece
    pieces = [data[first:last] for first, last in pairwise(edges)]
    return Script(header.source, header.wire, frames, pieces, t_s - t_s[0])


class RobotPresses(Walk):
    """Protocol of the presses of an emulated robot, which presses all places of the grid in each pass.

    The order of the places is random. Like protocol `walk`, the result is one continuous recording.
    """

    def plan(self, rng: np.random.Generator, skin_mm: tuple[float, float]) -> Plan:
        """Draw the order of the places and the depth of each press.

        As in protocol `walk`, the plan is a single indentation, in which each frame is one stop.
        """
        lifted_n, moving_n, pressing_n = (round(s * self.rate_hz) for s in (LIFTED_S, MOVING_S, PRESSING_S))
        ramp = np.arange(1, moving_n + 1) / (moving_n + 1)
        share = np.concatenate([ramp, np.ones(pressing_n), ramp[::-1]])
        place_mm = np.concatenate([rng.permutation(points_mm()) for _ in range(self.steps_n)])
        depth_mm = rng.uniform(*self.depth_mm, size=len(place_mm))
        lifted_mm = np.full((len(place_mm), lifted_n), LIFTED_MM)
        frames_mm = np.hstack([depth_mm[:, None] * share, lifted_mm])
        x_mm, y_mm = place_mm.repeat(frames_mm.shape[1], axis=0).T[:, None]
        description = f"an emulated robot, {self.steps_n} passes over {len(points_mm())} places in random order"
        return Plan(
            np.zeros(1, np.int32), x_mm, y_mm, frames_mm.reshape(1, -1), np.zeros((1, 2)), description
        )  # fmt: skip


def simulate(
    section: Mapping[str, Any], seed: int, where: str, *, board: str | None = None, robot: bool = False
) -> Script:
    """Create a script by simulating a skin.

    If the settings contain the protocol `log`, this protocol is simulated. Otherwise, the main protocol is simulated,
    in which a grid of places is pressed.

    `section` has the settings, as in section `simulate` of a scene, and `where` names it in error messages. By default,
    the first board of the settings is used. With `robot`, the touches of protocol `log` are replaced by presses of a
    robot.
    """
    simulation = parse_simulation(section, {name: nominal(name) for name in SHARED}, f"{where}: simulate")
    protocol = TOUCH_PROTOCOL if TOUCH_PROTOCOL in simulation.protocols else MAIN
    if robot:
        touches = simulation.protocols[TOUCH_PROTOCOL]
        changes = {"steps_n": ROBOT_PASSES_N, "rate_hz": ROBOT_RATE_HZ, "quiet_s": ROBOT_QUIET_S}
        presses = RobotPresses(**dict(touches) | changes)
        simulation = simulation.model_copy(update={"protocols": {**simulation.protocols, TOUCH_PROTOCOL: presses}})
    first_board, skin = list_captures(simulation, protocol)[0]
    if board is not None:
        if not re.fullmatch(NAME, board):
            raise ParamsError("--board", "the name", NAME_RULE, repr(board), "Choose another name.")
        skin = f"{board}_s1"
    capture = simulate_capture(simulation, protocol, board=board or first_board, skin=skin, seed=seed)
    chunk_i = np.searchsorted(capture.arrived_frames_n, 1 + np.arange(len(capture.b_uT)))
    script = _binary_script("simulated", capture.b_uT, capture.temperature_degC, capture.arrived_s[chunk_i])
    script = replace(script, true_contacts=true_contacts_of(capture))
    if robot:
        # The frames are due one by one instead of in chunks, so that each row of the robot's log has its own time.
        even_s = np.arange(len(script)) / ROBOT_RATE_HZ
        script = replace(script, t_s=even_s, presses_per_pass_n=len(points_mm()))
    return script


def true_contacts_of(capture: SimulatedCapture) -> Float64[np.ndarray, "f 3"] | None:
    """Return the true x_mm, y_mm and F_N in each frame; the values are NaN in frames without contact.

    The true contacts are taken from the probe log of the capture, which has one dwell per frame in contact and no
    errors in protocols of kind `walk`, such as `log`. In all other protocols, the probe log contains the errors of the
    simulated robot. The result is then None.
    """
    if capture.card_rate_hz is None:
        return None
    log, rate_hz = capture.probe, capture.card_rate_hz
    true = np.full((len(capture.b_uT), 3), np.nan)
    # Frame i is at the time (i + 1) / rate, and its dwell begins half a frame earlier, at (i + 0.5) / rate.
    frame_i = np.rint(log.t_start_s[log.contact] * rate_hz - 0.5).astype(int)
    true[frame_i] = np.column_stack([log.x_mm, log.y_mm, log.Fz_N])[log.contact]
    return true


def _binary_script(source: Source, b_uT: np.ndarray, temperature_degC: np.ndarray, t_s: np.ndarray) -> Script:
    frames = Frames(b_uT, temperature_degC, np.full(len(t_s), np.nan), np.zeros(len(t_s), np.int64))
    return Script(source, "binary", frames, encode_pieces(frames, "binary"), t_s - t_s[0])


def encode_pieces(frames: Frames, wire: Wire) -> list[bytes]:
    """Encode frames in one of the firmware's wire formats; return the bytes of each frame."""
    data = encode(frames, wire)
    if wire in TEXT_WIRES:
        return data.splitlines(keepends=True)
    size = record_type(wire, frames.temperature_degC.shape[1]).itemsize
    return [data[first : first + size] for first in range(0, len(data), size)]


class Terminal:
    """A pseudo-terminal, which a reader opens like a serial port.

    When the board is plugged in again, the operating system may choose another name for the pseudo-terminal. A symbolic
    link to the pseudo-terminal, if requested, keeps its name.
    """

    def __init__(self, link: Path | None = None) -> None:
        if not hasattr(os, "openpty"):
            raise ParamsError("--port: this operating system has no pseudo-terminals. Try: --port tcp")
        if link is not None and link.exists() and not link.is_symlink():
            raise ParamsError(f"--port: {link} is an existing file, not a link. Choose another name.")
        self._link = link
        self._open_ends: tuple[int, ...] = ()
        self.opened = False  # whether a reader has opened the port; `play` sets this to False again
        self.plug_in()

    def plug_in(self) -> None:
        """Create the pseudo-terminal and the link."""
        import fcntl
        import termios
        import tty  # these modules do not exist on Windows

        if self._link is not None and self._link.is_symlink() and self._link.exists():
            raise ParamsError(
                f"--port: {self._link} links to {os.readlink(self._link)}, which is in use, perhaps by another "
                "`reskin emulate`. Stop that process, remove the link, or choose another name."
            )
        self._open_ends = self._far, self._near = os.openpty()
        tty.setraw(self._near)
        # When a reader opens the pseudo-terminal, the reader discards all data in the buffer of the pseudo-terminal. In
        # packet mode, this process is informed when data are discarded, and so notices that the port was opened.
        fcntl.ioctl(self._far, termios.TIOCPKT, struct.pack("i", 1))
        self._flushed = termios.TIOCPKT_FLUSHREAD
        os.set_blocking(self._far, False)
        self.name = os.ttyname(self._near)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.name)
            self.name = str(self._link)

    def unplug(self) -> None:
        """Remove the pseudo-terminal and the link."""
        if self._link is not None and self._open_ends:
            # Remove the link before the pseudo-terminal is closed. Once it is closed, another emulator may create a
            # link with the same name, which must not be removed.
            self._link.unlink(missing_ok=True)
        for descriptor in self._open_ends:
            os.close(descriptor)
        self._open_ends = ()

    def send(self, data: bytes, stop: threading.Event) -> int:
        """Send bytes as fast as the reader accepts them, until `stop` is set; return the number of bytes sent."""
        sent_n = 0
        while sent_n < len(data) and not stop.is_set():
            readable, writable, _ = select.select([self._far], [self._far], [], TICK_S)
            with suppress(BlockingIOError):
                # The first byte is the packet status. The other bytes are data from the reader, which are ignored.
                if readable:
                    self.opened |= bool(os.read(self._far, 4096)[0] & self._flushed)
                if writable:
                    sent_n += os.write(self._far, data[sent_n:])
        return sent_n


class TcpServer:
    """A TCP server on this machine that serves one reader at a time, at `socket://127.0.0.1:PORT`."""

    def __init__(self, number: int = 0) -> None:
        self._number, self.opened = number, False
        self.plug_in()

    def plug_in(self) -> None:
        try:
            self._server = socket.create_server((HOST, self._number))
        except OSError as error:
            raise ParamsError(f"--port: TCP port {self._number}: {error.strerror}. Try: --port tcp") from None
        self._server.settimeout(TICK_S)
        self._number = self._server.getsockname()[1]
        self.name = f"socket://{HOST}:{self._number}"
        self._client: socket.socket | None = None

    def unplug(self) -> None:
        for connection in (self._client, self._server):
            if connection is not None:
                connection.close()

    def send(self, data: bytes, stop: threading.Event) -> int:
        sent_n = 0
        while sent_n < len(data) and not stop.is_set():
            try:
                if self._client is None:
                    self._client = self._server.accept()[0]
                    self.opened = True
                    self._client.settimeout(TICK_S)
                sent_n += self._client.send(data[sent_n:])
            except TimeoutError:
                continue
            except OSError:  # the reader has disconnected: wait for another reader
                if self._client is not None:
                    self._client.close()
                self._client = None
        return sent_n


EmulatedPort = Terminal | TcpServer


def make_port(kind: str) -> EmulatedPort:
    """Create an emulated port.

    The text `kind` is one of these: `pty` makes a pseudo-terminal; a path makes a pseudo-terminal and a link to it at
    this path; `tcp` makes a TCP server; `tcp:NUMBER` makes a TCP server with this port number.
    """
    name, _, number = kind.partition(":")
    if kind == "pty":
        return Terminal()
    if name == "tcp" and (number.isdecimal() or kind == "tcp"):
        if int(number or 0) > TCP_PORT_MAX:
            raise ParamsError(f"--port: {number} is not a TCP port (1 to {TCP_PORT_MAX}). Try: --port tcp")
        return TcpServer(int(number or 0))
    if Path(kind).parent.is_dir() and "/" in kind:
        return Terminal(Path(kind))
    raise ParamsError(
        f"--port: {kind} is not one of pty, tcp, tcp:PORT and ./NAME (creates a link with this name). Try: --port pty"
    )


def play(
    script: Script,
    port: EmulatedPort,
    stop: threading.Event,
    *,
    speed: float = 1.0,
    loop: bool = False,
    on_sent: Callable[[range], None] = lambda pieces: None,
) -> int:
    """Send each piece of a script to a port at its due time.

    Parameters
    ----------
    script, port : what is sent, and where
    stop : event that another thread sets to end sending
    speed : factor by which all due times are divided. With `math.inf`, the script is sent as fast as the reader reads.
    loop : whether the script starts again at its end, and whenever a reader opens the port
    on_sent : function that is called after each batch with the indices of the pieces in the batch

    Returns
    -------
    The number of bytes that were sent.
    """
    sent_n, start_s = 0, time.monotonic()
    while not stop.is_set():
        i = 0
        while i < len(script) and not stop.is_set():
            now_s, due_s = time.monotonic() - start_s, float(script.t_s[i]) / speed
            if due_s > now_s:
                stop.wait(min(due_s - now_s, TICK_S))
                continue
            blocked_s = max(now_s - due_s - LATE_MAX_S, 0.0)
            start_s += blocked_s
            overdue_n = int(np.searchsorted(script.t_s, (now_s - blocked_s) * speed, "right")) - i
            first, i = i, i + min(max(overdue_n, 1), BATCH_MAX_N)
            sent_n += port.send(b"".join(script.pieces[first:i]), stop)
            on_sent(range(first, i))
            if port.opened and loop:
                i, start_s = 0, time.monotonic()
            port.opened = False
        if not loop:
            break
        start_s += script.duration_s / speed
    return sent_n


class EmulatedBoard:
    """The emulated board at a port, and the true contact in the frame that it sent last."""

    def __init__(self, script: Script, port: EmulatedPort) -> None:
        self.port, self.source = port.name, script.source
        self._true_contacts = script.true_contacts
        self._sent_i = 0

    @property
    def has_true_contacts(self) -> bool:
        return self._true_contacts is not None

    def note_sent(self, pieces: range) -> None:
        self._sent_i = pieces[-1]

    def true_contact(self) -> tuple[float, float, float]:
        """Return the true x_mm, y_mm and F_N in the last frame that was sent.

        The values are NaN if the skin is not touched, or if the true contacts are unknown.
        """
        if self._true_contacts is None:
            return (np.nan, np.nan, np.nan)
        x_mm, y_mm, force_N = self._true_contacts[self._sent_i].tolist()
        return x_mm, y_mm, force_N


class RobotLog:
    """The log of an emulated robot: a CSV file to which a row is appended for each frame that was sent.

    The file has the format that a robot's program must write for `reskin record --labels`. Its columns are `unix_s`,
    `phase` (`noload`, `moving` or `contact`), `pass_i`, `x_mm`, `y_mm` and `Fz_N`.
    """

    def __init__(self, script: Script, file: Path, speed: float = 1.0) -> None:
        if script.true_contacts is None or script.presses_per_pass_n is None:
            raise ParamsError(
                f"--robot: the source contains no robot that presses the skin. Use source {NOMINAL_SOURCE}."
            )
        self._cells = _robot_cells(script.true_contacts, script.presses_per_pass_n)
        self._due_s = script.t_s / speed
        self._last_s = 0.0
        self._stream = file.open("w", encoding="utf-8", buffering=1)  # each line is written immediately
        self._stream.write("unix_s,phase,pass_i,x_mm,y_mm,Fz_N\n")

    def __call__(self, pieces: range) -> None:
        now_s = time.time()
        # Several late frames may have been sent together. Their rows have the times at which they were due, relative to
        # the last of these frames.
        for i in pieces:
            self._last_s = max(self._last_s, now_s - float(self._due_s[pieces[-1]] - self._due_s[i]))
            self._stream.write(f"{self._last_s:.6f},{self._cells[i]}\n")

    def close(self) -> None:
        self._stream.close()


def _touches(true_contacts: Float64[np.ndarray, "f 3"]) -> list[tuple[int, int]]:
    """Return the first frame of each touch, and the frame after its end."""
    edges = np.flatnonzero(np.diff(np.isfinite(true_contacts[:, 0]), prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def _robot_cells(true_contacts: Float64[np.ndarray, "f 3"], presses_per_pass_n: int) -> list[str]:
    """Return the cells that follow the time in the row of each frame: phase, pass, place and force."""
    presses, cells = _touches(true_contacts), ["noload,0,,,"] * len(true_contacts)
    for press_i, (first, end) in enumerate(presses):
        force_max_N = true_contacts[first:end, 2].max()
        for i, (x_mm, y_mm, force_N) in enumerate(true_contacts[first:end].tolist(), first):
            phase = "contact" if force_N >= AT_REST * force_max_N else "moving"
            cells[i] = f"{phase},{press_i // presses_per_pass_n},{x_mm:g},{y_mm:g},{force_N:.4f}"
        # The rows without contact after a press belong to the pass of the next press. Otherwise, the no-load dwell
        # between two passes would be split into two.
        following = presses[press_i + 1][0] if press_i + 1 < len(presses) else len(cells)
        pass_i = (press_i + 1) // presses_per_pass_n
        cells[end:following] = [f"noload,{pass_i},,,"] * (following - end)
    return cells


class TouchPrinter:
    """A function that prints the true place and the largest true force of each touch when its first frame is sent."""

    def __init__(self, script: Script, source: str, say: Callable[[str], object]) -> None:
        if script.true_contacts is None:
            remedy = "Use source nominal, or the YAML file of a simulated scene with a protocol named log."
            raise ParamsError(f"--true-places: the true places of {source} are unknown. {remedy}")
        self._texts, self._say = {}, say
        for first, end in _touches(script.true_contacts):
            x_mm, y_mm, force_N = script.true_contacts[first:end].max(axis=0)
            self._texts[first] = f"true place: x {x_mm:.1f} mm, y {y_mm:.1f} mm; largest force {force_N:.2f} N"

    def __call__(self, pieces: range) -> None:
        for i in pieces:
            if i in self._texts:
                self._say(self._texts[i])


@contextmanager
def playing(script: Script) -> Iterator[EmulatedBoard]:
    """Send a script in a loop in another thread, as long as the `with` block runs; yield the emulated board."""
    port, stop = (Terminal() if hasattr(os, "openpty") else TcpServer()), threading.Event()
    board = EmulatedBoard(script, port)
    options = {"loop": True, "on_sent": board.note_sent}
    player = threading.Thread(target=play, args=[script, port, stop], kwargs=options, daemon=True)
    player.start()
    try:
        yield board
    finally:
        stop.set()
        player.join()
        port.unplug()
