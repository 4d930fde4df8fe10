"""Measure a board's frame rate and its repeated readings, and explain what limits the rate.

`RateMeter` measures the rate. `find_limits` computes the maximum rates that conversion time, I2C bus, baud rate and USB
allow.
`explain` compares the measured rate with these limits in one sentence. Agreement with a limit does not prove that this
limit is the cause, so the sentence says "would explain".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from reskin.board.faults import SILENCE_S, clock_jumps, find_reading_faults, missing_frames
from reskin.board.wire import Frames
from reskin.physics.chip import CONVERSION_S, DIG_FILT_MAX, OSR_MAX, conversion_s

# Repeated readings are reported if their share is above this value. In 30 public recordings of real boards, the share
# is at most 0.024, because successive values of a chip with a coarse LSB are sometimes equal by chance.
REPEATED_MAX = 0.05
ALL_REPEATED = 0.99  # above this share, the board sends the same reading again and again
FRAMES_MIN_N = 20  # with fewer frames, the rate is unknown
CLOCK_FRAMES_N = 400  # the usual step of the board's clock is determined from this many frames
# A board sends the time of its clock as a float32 in s. After some hours, the resolution of a float32 is too coarse for
# the time between two frames.
CLOCK_STEP_RESOLUTION_MAX = 0.1  # largest ratio of this resolution to the time between two frames

# Bits on the I2C bus for one chip: 9 per byte, including the acknowledge bit, and one for each start, repeated start
# and stop. Each command takes 4 bytes: address, command, address again, and status. Command RM (read the measurement)
# takes 8 more bytes, for T, X, Y and Z.
START_BITS_N = 9 * 4 + 3  # command SM: start a single conversion
READ_BITS_N = 9 * (4 + 8) + 3
I2C_HZ = (100e3, 400e3, 1e6)  # Arduino's default, the rate in the ReSkin and AnySkin firmware, and the chip's maximum
LIBRARY_WAIT_S = 10e-3  # Adafruit's library waits this long in `readData`, in addition to the conversion
UART_BITS_PER_BYTE_N = 10  # start bit, 8 data bits, stop bit
USB_BYTES_PER_S = 19 * 64 * 1000  # full speed: at most 19 bulk packets of 64 bytes in 1 ms (USB 2.0, table 5-9)

ERROR = 0.03  # assumed: relative error of a measured rate
# assumed: a limit also explains rates down to this fraction of the limit, because the board's program takes time too
NEAR = 0.8

Method = Literal["arrivals", "clock"]


@dataclass(frozen=True)
class RateMeasurement:
    """The measured rate of a board.

    Parameters
    ----------
    frames_n : number of frames
    arrived_hz : frames per second that arrived; NaN if unknown
    sent_hz : frames per second that the board sent
    method : how `sent_hz` was measured: by the board's clock, or by arrivals if there is no usable clock
    repeated_frames : share of frames whose fields equal those of the previous frame
    repeated_readings : share of a chip's readings that equal the chip's previous reading. This is the median over
        chips, so that a single stuck chip has no effect.
    """

    frames_n: int
    arrived_hz: float
    sent_hz: float
    method: Method
    repeated_frames: float
    repeated_readings: float

    @property
    def known(self) -> bool:
        """Whether there were enough frames for a rate."""
        return self.frames_n >= FRAMES_MIN_N and np.isfinite(self.arrived_hz)

    @property
    def new_hz(self) -> float:
        """New readings of a chip per second."""
        return self.arrived_hz * (1 - self.repeated_readings)


class RepeatCounter:
    """Count repeated frames and readings in a stream that arrives in portions of any length.

    Frames with a failed reading are left out, because all failed readings are equal.
    """

    def __init__(self, chips_n: int) -> None:
        self.frames_n = 0
        self._last_uT: Float[np.ndarray, "1 ch"] = np.full((1, 3 * chips_n), np.nan)
        self._same_frames_n = 0
        self._same_readings_n: Int64[np.ndarray, " k"] = np.zeros(chips_n, np.int64)

    def feed(self, b_uT: Float[np.ndarray, "f ch"]) -> None:
        """Process the next frames."""
        if not len(b_uT):
            return
        before_uT = np.concatenate([self._last_uT, b_uT[:-1]])
        same: Bool[np.ndarray, "f k"] = (b_uT == before_uT).reshape(len(b_uT), -1, 3).all(axis=2)
        self._last_uT = b_uT[-1:].copy()
        self.frames_n += len(b_uT)
        self._same_frames_n += int(same.all(axis=1).sum())
        self._same_readings_n += same.sum(axis=0)

    @property
    def frames(self) -> float:
        """Share of frames that repeat the previous frame."""
        return self._same_frames_n / self.frames_n if self.frames_n else 0.0

    @property
    def readings(self) -> float:
        """Share of a chip's readings that repeat its previous reading: the lower median over chips."""
        same_n = np.sort(self._same_readings_n)
        return float(same_n[(len(same_n) - 1) // 2] / self.frames_n) if self.frames_n else 0.0

    def restart(self) -> None:
        """Set all counts to zero, but keep the last frame for comparison with the next one."""
        self.frames_n = self._same_frames_n = 0
        self._same_readings_n[:] = 0


class RateMeter:
    """Measure the rate of frames that arrive in portions of any length, with constant memory.

    `start_s` is the time of arrival of the first bytes. Frames that arrived at this time may have been waiting in the
    port, so they are not counted for the rate. A silence of a second or more is not counted either.
    """

    def __init__(self, chips_n: int, start_s: float) -> None:
        self._start_s = self._last_s = start_s
        self._repeats = RepeatCounter(chips_n)
        self._frames_n = self._arrived_n = 0
        self._elapsed_s = 0.0
        # times of the board's clock for frames that are not counted yet
        self._clock_s: list[Float64[np.ndarray, " f"]] = []
        self._clocked_n = 0  # number of times in `_clock_s`
        self._sent_n = 0.0
        self._sent_s = 0.0

    def feed(self, frames: Frames, arrived_s: Float64[np.ndarray, " f"]) -> None:
        """Process the next frames and their times of arrival."""
        if not len(frames):
            return
        readings = find_reading_faults(frames.b_uT, frames.temperature_degC)
        self._repeats.feed(frames.b_uT[~readings.failed_rows])
        self._frames_n += len(frames)
        step_s = np.diff(arrived_s, prepend=self._last_s)
        counts = (arrived_s > self._start_s) & (step_s < SILENCE_S)
        self._arrived_n += int(counts.sum())
        self._elapsed_s += float(step_s[counts].sum())
        self._last_s = float(arrived_s[-1])
        if np.isfinite(frames.device_s).all():
            self._clock_s.append(frames.device_s)
            self._clocked_n += len(frames)
        if self._clocked_n > CLOCK_FRAMES_N:
            self._count_sent()

    def measure(self) -> RateMeasurement:
        """Return the measurement of the frames so far."""
        self._count_sent()
        arrived_hz = self._arrived_n / self._elapsed_s if self._elapsed_s > 0 else np.nan
        method: Method = "clock" if self._sent_s > 0 else "arrivals"
        sent_hz = self._sent_n / self._sent_s if method == "clock" else arrived_hz
        return RateMeasurement(
            self._frames_n, arrived_hz, sent_hz, method, self._repeats.frames, self._repeats.readings
        )

    def _count_sent(self) -> None:
        """Count the frames that the board sent according to its clock, including missing ones."""
        clock_s = np.concatenate(self._clock_s) if self._clock_s else np.zeros(0)
        self._clock_s, self._clocked_n = [clock_s[-1:]], 0
        step_s = np.diff(clock_s)
        # If a frame has the same time as the previous frame, this frame was sent once but arrived twice.
        step_s = step_s[~clock_jumps(step_s) & (step_s > 0)]
        if not len(step_s) or np.spacing(np.float32(clock_s[-1])) > CLOCK_STEP_RESOLUTION_MAX * np.median(step_s):
            return
        self._sent_n += len(step_s) + int(missing_frames(step_s).sum())
        self._sent_s += float(step_s.sum())


def measure(frames: Frames, chunks: Sequence[tuple[bytes, float]]) -> RateMeasurement:
    """Measure the rate of frames that were decoded from chunks of bytes, each with its time of arrival in s."""
    arrived_s = np.array([t_s for _, t_s in chunks])
    chunk_i = np.searchsorted(np.cumsum([len(chunk) for chunk, _ in chunks]), frames.end_byte)
    meter = RateMeter(frames.temperature_degC.shape[1], arrived_s[0])
    meter.feed(frames, arrived_s[chunk_i])
    return meter.measure()


class Limit(NamedTuple):
    """A computed upper limit of the frame rate, and its cause."""

    hz: float
    cause: str


def find_limits(
    chips_n: int, frame_bytes_n: float, *, baud: int, conversion_time_s: float = CONVERSION_S
) -> list[Limit]:
    """Compute upper limits of the frame rate, lowest first.

    Parameters
    ----------
    chips_n : number of chips, all on one I2C bus
    frame_bytes_n : mean length of a frame
    baud : baud rate, which limits a board with a USB-to-serial chip
    conversion_time_s : time of one conversion; the default is that of the paper's settings
    """
    chips = f"{chips_n} chips" if chips_n > 1 else "1 chip"
    in_turn = f"{chips} read one after the other" if chips_n > 1 else "1 chip started and read"
    conversion = f"{1e3 * conversion_time_s:.3g} ms"
    wait = f"{1e3 * (conversion_time_s + LIBRARY_WAIT_S):.3g} ms"
    limits = [
        Limit(1 / conversion_time_s, f"chips that convert on their own, {conversion} a reading,"),
        Limit(baud / (UART_BITS_PER_BYTE_N * frame_bytes_n), f"{frame_bytes_n:.0f} bytes a frame at {baud} baud"),
        Limit(USB_BYTES_PER_S / frame_bytes_n, f"{frame_bytes_n:.0f} bytes a frame over full-speed USB"),
    ]
    both_n = START_BITS_N + READ_BITS_N
    for i2c_hz in I2C_HZ:
        read_s, both_s = READ_BITS_N / i2c_hz, both_n / i2c_hz
        bus = f"bits of I2C at {i2c_hz / 1e3:g} kHz"
        if chips_n > 1:
            together_hz = 1 / (conversion_time_s + chips_n * both_s)
            cause = f"{chips} started together and then read, {conversion} and {chips_n} x {both_n} {bus},"
            limits.append(Limit(together_hz, cause))
        limits += [
            Limit(1 / (chips_n * read_s), f"{chips} with {READ_BITS_N} {bus} each"),
            Limit(
                1 / (chips_n * (conversion_time_s + both_s)),
                f"{in_turn}, {conversion} and {both_n} {bus} each,",
            ),
            Limit(
                1 / (chips_n * (conversion_time_s + LIBRARY_WAIT_S + both_s)),
                f"{in_turn} by Adafruit's library, {wait} and {both_n} {bus} each,",
            ),
        ]
    return sorted(limits)


def explain(rate: RateMeasurement, limits: Sequence[Limit]) -> str:
    """Explain in one sentence what limits a measured rate; `limits` are from `find_limits`."""
    if not rate.known:
        return f"{rate.frames_n} frames are too few to measure a rate: listen longer"
    arrive = f"{_hz(rate.arrived_hz)} arrive"
    if rate.method == "clock":
        arrive += f" of {_hz(rate.sent_hz)} that the board sends by its own clock"
    if rate.arrived_hz > (1 + ERROR) * rate.sent_hz:
        return f"{arrive}: the same frames arrive more than once"
    if rate.repeated_readings > ALL_REPEATED:
        return f"{arrive}, but all repeat the same reading: unplug the board and plug it in again"
    if rate.repeated_readings > REPEATED_MAX:
        return (
            f"{arrive}, but {100 * rate.repeated_readings:.0f} % of a chip's readings repeat the one before: the board "
            f"sends faster than its chips convert, at {_hz(rate.new_hz)}; conversions of {1e3 / rate.new_hz:.3g} ms"
            f"{_settings_with(1 / rate.new_hz)} would explain it"
        )
    if rate.arrived_hz < (1 - ERROR) * rate.sent_hz:
        lost = 100 * (1 - rate.arrived_hz / rate.sent_hz)
        return f"{arrive}: {lost:.0f} % of the frames are lost between the board's clock and this program"
    possible = [limit for limit in limits if NEAR * limit.hz <= rate.arrived_hz <= (1 + ERROR) * limit.hz]
    if not possible:
        return f"{arrive}; no computed limit is near it, but a pause in the board's program would explain it"
    limit = min(possible, key=lambda limit: abs(limit.hz - rate.arrived_hz))
    return f"{arrive}; {limit.cause} allow {_hz(limit.hz)}, which would explain it"


def _hz(rate_hz: float) -> str:
    return f"{rate_hz:.1f} Hz" if rate_hz < 100 else f"{rate_hz:.0f} Hz"


def _settings_with(time_s: float) -> str:
    """Name the chip settings with which a conversion takes about `time_s`; "" if there are none."""
    found = [
        f"OSR {osr} with DIG_FILT {dig_filt}"
        for osr in range(OSR_MAX + 1)
        for dig_filt in range(DIG_FILT_MAX + 1)
        if abs(conversion_s(osr, dig_filt) / time_s - 1) <= ERROR
    ]
    return f" ({' or '.join(found)})" if found else ""
