"""Find boards among the serial ports, and detect what each board sends.

The properties that are detected are the wire format (the format of the bytes, see `wire`), the number of chips, the
frame rate, and the LSB of the chips (the step between the field values that a chip can send).
"""

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from reskin.board import faults, rates
from reskin.board.other_firmware import AnyWire, CustomWire
from reskin.board.port import BAUD, Chunk, open_port, port_names, read_waiting
from reskin.board.rates import RateMeasurement
from reskin.board.stream import FrameStream, decode_all, describe_unknown, matching_formats
from reskin.errors import CaptureError, ParamsError
from reskin.physics.chip import CONVERSION_S, GAINS, steps_uT

# In this time, even the slowest board sends about 200 frames. This is enough to find the LSB of its chips.
LISTENING_S = 1.5
REPLUG_TIMEOUT_S = 60.0
POLL_S = 0.2
BOARDS_MAX_N = 16  # largest number of boards that are opened at the same time
# relative tolerance with which a measured LSB is compared with that of a gain; LSBs of two gains differ by 20 % or more
GAIN_TOLERANCE = 0.05


class DetectedBoard(NamedTuple):
    """The result of listening to a port: the properties of the board on it, or the reason why no board was detected."""

    port: str
    problem: str | None  # why no board was detected; None if there is a board
    wire: AnyWire = "binary"
    chips_n: int = 0
    rate_hz: float = np.nan
    lsb_uT: tuple[float, float] = (np.nan, np.nan)  # LSB along x and y, and LSB along z; each is the median over chips
    rate: RateMeasurement | None = None  # None if there is no board
    frame_bytes_n: float = np.nan  # mean length of a frame in bytes

    @property
    def gain_sel(self) -> int | None:
        """Setting GAIN_SEL of the chips, derived from their LSB; None if no value of GAIN_SEL gives this LSB."""
        for gain_sel in range(len(GAINS)):
            xy_uT, _, z_uT = steps_uT(gain_sel)
            if np.allclose(self.lsb_uT, (xy_uT, z_uT), rtol=GAIN_TOLERANCE):
                return gain_sel
        return None

    def __str__(self) -> str:
        return f"{self.port}: {self.problem or f'{self.format}, {self.rate_hz:.0f} Hz, {self.scale}'}"

    @property
    def format(self) -> str:
        return f"{self.wire}, {self.chips_n} chips"

    @property
    def scale(self) -> str:
        if np.isfinite(self.lsb_uT).all():
            gain = "of no known gain" if self.gain_sel is None else f"GAIN_SEL {self.gain_sel}"
            return f"steps {self.lsb_uT[0]:.3f} uT in x, y and {self.lsb_uT[1]:.3f} uT in z, {gain}"
        return "steps not known yet (if the readings do not change, touch the skin)"

    def describe_rate(self, conversion_time_s: float = CONVERSION_S) -> str:
        """Return a text of several lines with the measured rate, a possible explanation, and the computed limits."""
        if self.problem is not None or self.rate is None:
            return str(self)
        rate = self.rate
        limits = rates.find_limits(self.chips_n, self.frame_bytes_n, baud=BAUD, conversion_time_s=conversion_time_s)
        source = "by the board's clock" if rate.method == "clock" else "by arrival, as the format has no usable clock"
        return "\n".join([
            f"{self.port}: {self.format}, {rate.frames_n} frames of {self.frame_bytes_n:.0f} bytes",
            f"  sent     {rate.sent_hz:.1f} Hz, {source}",
            f"  arrived  {rate.arrived_hz:.1f} Hz",
            f"  repeated {rate.repeated_frames:.1%} of frames; {rate.repeated_readings:.1%} of each chip's readings",
            f"  {rates.explain(rate, limits)}.",
            "  Computed limits:",
            *(f"    {limit.hz:8.1f} Hz: {limit.cause.rstrip(',')}" for limit in limits),
        ])  # fmt: skip


def scan_ports(
    names: Sequence[str] | None = None, *, listening_s: float = LISTENING_S, wire: CustomWire | None = None
) -> list[DetectedBoard]:
    """Listen to several ports at the same time, and return what was detected on each.

    `names` are the names of the ports. By default, these are all ports of this machine. `wire` is the format of the
    boards, if it is none of those that can be detected.
    """
    names = port_names() if names is None else names
    with ThreadPoolExecutor(max(len(names), 1)) as pool:
        return list(pool.map(lambda name: detect_board(name, listening_s, wire), names))


def find_board(names: Sequence[str] | None = None, wire: CustomWire | None = None) -> DetectedBoard:
    """Return the board that is connected; raise `CaptureError` if there is none, or more than one."""
    boards = find_boards(names, wire)
    if len(boards) != 1:
        raise CaptureError(
            f"{len(boards)} boards are connected: {'; '.join(map(str, boards))}. Choose one with --port."
        )
    return boards[0]


def find_boards(names: Sequence[str] | None = None, wire: CustomWire | None = None) -> list[DetectedBoard]:
    """Return all boards that are connected; raise `CaptureError` if there are none."""
    results = scan_ports(names, wire=wire)
    boards = [board for board in results if board.problem is None]
    if not boards:
        problems = "; ".join(map(str, results)) or "no serial port found"
        raise CaptureError(
            f"no board found ({problems}). Plug in a board, or state its port with --port. Without a board, use: "
            "reskin live --emulate nominal"
        )
    return boards


def detect_board(port: str, listening_s: float = LISTENING_S, wire: CustomWire | None = None) -> DetectedBoard:
    """Listen to a port for `listening_s`, and detect the board on it."""
    chunks: list[Chunk] = []
    try:
        with open_port(port, BAUD) as device:
            end_s = time.monotonic() + listening_s
            while time.monotonic() < end_s:
                if chunk := read_waiting(device):
                    chunks.append((chunk, time.monotonic()))
    except CaptureError as error:
        return DetectedBoard(port, str(error).removeprefix(f"{port}: "))
    except OSError as error:
        return DetectedBoard(port, f"the port disappeared while it was read: {error}")
    return recognise(port, chunks, wire)


def recognise(port: str, chunks: Sequence[Chunk], wire: CustomWire | None = None) -> DetectedBoard:
    """Detect a board from the chunks of bytes that its port sent; `wire` is its format, if the user has stated it."""
    data = b"".join(chunk for chunk, _ in chunks)
    if not data:
        return DetectedBoard(port, "no bytes arrived. Check that the board is running")
    formats: Sequence[tuple[AnyWire, int]] = matching_formats(data)
    if wire is not None:
        stream = FrameStream(wire, wire.chips_n)
        stream.feed(data)
        if not stream.account()["frames_n"]:
            return DetectedBoard(port, f"no frame of the stated format in {len(data)} bytes ({wire})")
        formats = [(wire, wire.chips_n)]
    if not formats:
        return DetectedBoard(port, f"no frame in {len(data)} bytes. The bytes are {describe_unknown(data)}")
    decoded = [(*decode_all(data, form, chips_n, port), form, chips_n) for form, chips_n in formats]
    # The bytes of a text frame fit both text formats, which differ only in the order of the numbers: a chip's
    # temperature is its first number in one format, and its last number in the other. Temperatures vary less than
    # fields, so choose the format in which the decoded temperatures vary least.
    frames, account, found, chips_n = min(
        decoded, key=lambda item: float(item[0].temperature_degC.std(dtype=np.float64))
    )
    # Bytes that are not a board's may be decoded to very large numbers, whose differences overflow.
    with np.errstate(over="ignore"):
        lsb_uT = [_median(axis) for axis in faults.find_lsb(frames.b_uT).T]
    rate = rates.measure(frames, chunks)
    frame_bytes_n = account["frame_bytes_n"] / len(frames)
    return DetectedBoard(port, None, found, chips_n, rate.arrived_hz, (lsb_uT[0], lsb_uT[1]), rate, frame_bytes_n)


def _median(steps_uT: Float64[np.ndarray, " k"]) -> float:
    finite_uT = steps_uT[np.isfinite(steps_uT)]
    return float(np.median(finite_uT)) if len(finite_uT) else np.nan


def find_replugged_port(
    say: Callable[[str], None],
    *,
    names: Callable[[], Iterable[str]] = port_names,
    pause: Callable[[float], None] = time.sleep,
    timeout_s: float = REPLUG_TIMEOUT_S,
) -> str:
    """Ask the user to unplug a board and plug it in again; return the name of the port that then appears.

    The function waits up to `timeout_s` seconds until the port disappears, and again until it appears. The name of the
    port may be different afterwards. Nothing is read from the port, so any serial device is accepted, not only a board.
    If several ports appear, the first one in alphabetical order is returned.
    """
    say("Unplug the board.")
    before = set(names())
    unplugged = _wait(lambda: before - set(names()), pause, timeout_s, "disappeared")
    say(f"{', '.join(sorted(unplugged))} disappeared. Plug the board in again.")
    remaining = before - unplugged
    return min(_wait(lambda: set(names()) - remaining, pause, timeout_s, "appeared"))


def _wait(find_ports: Callable[[], set[str]], pause: Callable[[float], None], timeout_s: float, what: str) -> set[str]:
    """Call `find_ports` repeatedly until it returns ports; raise `CaptureError` if it returns none for `timeout_s`."""
    for _ in range(round(timeout_s / POLL_S)):
        if ports := find_ports():
            return ports
        pause(POLL_S)
    raise CaptureError(f"no port {what} within {timeout_s:g} s. Check that the board has a serial port.")


def check_named_once(ports: Sequence[str], where: str) -> None:
    """Raise `ParamsError` unless there are 1 to `BOARDS_MAX_N` ports, and all have different names."""
    if len(set(ports)) != len(ports) or not 0 < len(ports) <= BOARDS_MAX_N:
        rule = f"1 to {BOARDS_MAX_N}, each named once"
        raise ParamsError(where, "ports", rule, ", ".join(ports) or "none", "Name each port once.")
