"""Measure a board's frame rate and its repeated readings, and explain what limits the rate.

`RateMeter` measures the rate. `find_limits` computes the highest rates that are possible with the conversion time of
the chips, the I2C bus, the baud rate and USB. `explain` compares the measured rate with these limits, and returns one
sentence for the user. If the measured rate agrees with a limit, this does not prove that the limit is the cause.
Therefore, the sentence says that the limit "would explain" the rate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from reskin.board.faults import SILENCE_S, clock_jumps, find_reading_faults, missing_frames
from reskin.board.wire import Frames
from reskin.physics.chip import CONVERSION_S, DIG_FILT_MAX, OSR_MAX, conversion_s

# A reading is repeated if it equals the chip's previous reading. Repeated readings are reported if they are more than
# this fraction of all readings. In 30 public recordings of real boards, the fraction is at most 0.024: successive
# readings are sometimes equal by chance, if the LSB of the chip is large.
REPEATED_MAX = 0.05
# If more than this fraction of the readings is repeated, the board sends the same reading again and again.
ALL_REPEATED = 0.99
FRAMES_MIN_N = 20  # with fewer frames, the rate is unknown
# The median time between frames on the board's clock is computed from more than this many frames at once.
CLOCK_FRAMES_N = 400
# A board sends the time of its clock as a float32 in s. The longer the board runs, the coarser is the resolution of
# this number; after some hours, it is too coarse to measure the time between two frames. The clock is used only if the
# resolution, divided by the median time between two frames, is at most this value.
CLOCK_STEP_RESOLUTION_MAX = 0.1

# Number of bits that are transferred on the I2C bus for one chip. Each byte takes 9 bits, including the acknowledge
# bit. There are 3 more bits in each command: one for the start, one for the repeated start, and one for the stop. Each
# command takes 4 bytes: the address, the command, the address again, and the status.
START_BITS_N = 9 * 4 + 3  # command SM, which starts a single conversion
READ_BITS_N = 9 * (4 + 8) + 3  # command RM, which reads the measurement: 8 more bytes for T, X, Y and Z
# bit rates of the I2C bus: Arduino's default, the rate in the ReSkin and AnySkin firmware, and the chip's maximum
I2C_HZ = (100e3, 400e3, 1e6)
LIBRARY_WAIT_S = 10e-3  # Adafruit's library waits this long in `readData`, in addition to the conversion time
UART_BITS_PER_BYTE_N = 10  # start bit, 8 data bits, stop bit
USB_BYTES_PER_S = 19 * 64 * 1000  # full speed: at most 19 bulk packets of 64 bytes in 1 ms (USB 2.0, table 5-9)

ERROR = 0.03  # assumed: relative error of a measured rate
# Assumed: a limit may also be the cause of a lower rate, because the board's program takes time too. The rate must be
# at least this fraction of the limit.
NEAR = 0.8

Method = Literal["arrivals", "clock"]


@dataclass(frozen=True)
class RateMeasurement:
    """The measured frame rate of a board.

    Parameters
    ----------
    frames_n : number of frames that arrived
    arrived_hz : frames per second that arrived; NaN if unknown
    sent_hz : frames per second that the board sent
    method : how `sent_hz` was measured: from the times of the board's clock ("clock") or, if the board has no usable
        clock, from the times of arrival ("arrivals")
    repeated_frames : fraction of the frames in which the fields of all chips equal those of the previous frame
    repeated_readings : fraction of a chip's readings that equal the chip's previous reading. This is the median over
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
        """Number of readings of a chip per second that do not repeat the previous reading."""
        return self.arrived_hz * (1 - self.repeated_readings)


class RepeatCounter:
    """A counter of repeated frames and readings in a stream, which may be passed in several parts of any length.

    The caller must remove frames with a failed reading, because all failed readings are equal.
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
        """Fraction of the frames that repeat the previous frame."""
        return self._same_frames_n / self.frames_n if self.frames_n else 0.0

    @property
    def readings(self) -> float:
        """Fraction of a chip's readings that repeat the chip's previous reading; the lower median over chips."""
        same_n = np.sort(self._same_readings_n)
        return float(same_n[(len(same_n) - 1) // 2] / self.frames_n) if self.frames_n else 0.0

    def restart(self) -> None:
        """Set all counts to zero, but keep the last frame for comparison with the next one."""
        self.frames_n = self._same_frames_n = 0
        self._same_readings_n[:] = 0


class RateMeter:
    """A meter of the frame rate of a stream, which may be passed in several parts of any length.

    The meter needs a constant amount of memory. `start_s` is the time of arrival of the first bytes. Frames that
    arrived at this time are not counted for the rate, because they may have been waiting in the port for any time. A
    silence of a second or more, such as while the board is unplugged, does not count as time in which frames could
    arrive.
    """

    def __init__(self, chips_n: int, start_s: float) -> None:
        self._start_s = self._last_s = start_s
        self._repeats = RepeatCounter(chips_n)
        self._frames_n = self._arrived_n = 0
        self._elapsed_s = 0.0
        # times on the board's clock of the frames that `_count_sent` has not counted yet
        self._clock_s: list[Float64[np.ndarray, " f"]] = []
        self._clocked_n = 0  # number of times that were added to `_clock_s` since the last count
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
        """Count the frames that the board sent according to its clock, including those that did not arrive."""
        clock_s = np.concatenate(self._clock_s) if self._clock_s else np.zeros(0)
        self._clock_s, self._clocked_n = [clock_s[-1:]], 0
        step_s = np.diff(clock_s)
        # A frame with the same board time as the previous frame is a copy of it that arrived again, so it is not
        # counted.
        step_s = step_s[~clock_jumps(step_s) & (step_s > 0)]
        if not len(step_s) or np.spacing(np.float32(clock_s[-1])) > CLOCK_STEP_RESOLUTION_MAX * np.median(step_s):
            return
        self._sent_n += len(step_s) + int(missing_frames(step_s).sum())
        self._sent_s += float(step_s.sum())


def measure(frames: Frames, chunks: Sequence[tuple[bytes, float]]) -> RateMeasurement:
    """Measure the rate of frames that were decoded from `chunks`, which are pairs of bytes and time of arrival in s."""
    arrived_s = np.array([t_s for _, t_s in chunks])
    chunk_i = np.searchsorted(np.cumsum([len(chunk) for chunk, _ in chunks]), frames.end_byte)
    meter = RateMeter(frames.temperature_degC.shape[1], arrived_s[0])
    meter.feed(frames, arrived_s[chunk_i])
    return meter.measure()


class Limit(NamedTuple):
    """An upper limit of the frame rate that was computed from one possible cause."""

    hz: float
    cause: str


def find_limits(
    chips_n: int, frame_bytes_n: float, *, baud: int, conversion_time_s: float = CONVERSION_S
) -> list[Limit]:
    """Compute the upper limits of the frame rate from several causes, sorted from the lowest limit to the highest.

    Parameters
    ----------
    chips_n : number of chips, all of which are on one I2C bus
    frame_bytes_n : mean length of a frame in bytes
    baud : baud rate. It limits the frame rate only if the board has a USB-to-serial chip.
    conversion_time_s : time that a chip needs for one conversion; the default is the time with the paper's settings
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
    """Return a sentence on what may limit a measured rate; `limits` is the result of `find_limits`."""
    if not rate.known:
        return f"{rate.frames_n} frames are too few to measure a rate. Listen for a longer time"
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
    """Return the chip settings with which a conversion takes about `time_s`, as a text; "" if there are none."""
    found = [
        f"OSR {osr} with DIG_FILT {dig_filt}"
        for osr in range(OSR_MAX + 1)
        for dig_filt in range(DIG_FILT_MAX + 1)
        if abs(conversion_s(osr, dig_filt) / time_s - 1) <= ERROR
    ]
    return f" ({' or '.join(found)})" if found else ""
