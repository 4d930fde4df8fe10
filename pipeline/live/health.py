"""What is wrong with a board while it runs. In: frames and when they came. Out: alarms by name, frames to believe.

An alarm counts, and says when it began and was last seen. Refuses to know models, and to mend anything.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from pipeline.capture import faults
from pipeline.capture.stream import TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC
from pipeline.capture.wire import Frames, concatenate

B_MAX_uT = 49_000.0  # an MLX90393 measures up to 50 mT (data sheet)
LOOK_FRAMES_N = 40  # a tenth of a second of five chips: how late what needs several frames is seen
SCALE_FRAMES_N = 400  # in which each sound chip's step shows
REPEATED_SHARE = 0.4  # assumed, of frames that are the one before again
RATE_WINDOW_S = 1.0
SLOW_SHARE = 0.7  # assumed, of the usual rate: frames are missing
USUAL_GAIN = 1e-4  # by which the usual rate follows, each time frames come: half a minute of 400 Hz
CLOCK_STEP_MAX_S = 1.0
ACTIVE_S = 2.0  # an alarm stays on for so long after it was last seen
ALIKE_SHARE_MAX = 0.2  # of |dB|^2 that chips do not share; 0.45 or more in all pokes of scenes quick and lab
ALIKE_MIN_uT = 50.0  # about the earth's field


@dataclass
class Alarm:
    """How often something was seen, in frames or bytes, and when, in unix seconds."""

    name: str
    count_n: int
    first_s: float
    last_s: float


class Health:
    """Remembers what has been wrong since the board was plugged in; as much as it has chips and names of faults."""

    def __init__(self, chips_n: int) -> None:
        self.alarms: dict[str, Alarm] = {}
        self.rate_hz = self._usual_hz = np.nan
        self._chips_n = chips_n
        self._stuck = faults.StuckChips(chips_n)
        self._held: list[Frames] = []
        self._since_scale: list[np.ndarray] = []
        self._lsb_uT = np.full((chips_n, 2), np.nan)
        self._last: Frames | None = None
        self._came: deque[tuple[float, int]] = deque()
        self._came_n = 0

    def note(self, name: str, count_n: int, now_s: float) -> None:
        """Count something under its name."""
        if count_n:
            alarm = self.alarms.setdefault(name, Alarm(name, 0, now_s, now_s))
            alarm.count_n, alarm.last_s = alarm.count_n + count_n, now_s

    def active(self, now_s: float) -> list[Alarm]:
        return [alarm for alarm in list(self.alarms.values()) if now_s - alarm.last_s <= ACTIVE_S]

    def feed(self, frames: Frames, now_s: float) -> Bool[np.ndarray, " f"]:
        """Look at the next frames; mark those whose every chip was read and gives what a chip can."""
        failed = np.asarray(faults.failed_reads(frames.b_uT, frames.temperature_degC))
        zero = faults.zero_reads(frames.b_uT)
        warm = (frames.temperature_degC >= TEMPERATURE_MIN_degC) & (frames.temperature_degC <= TEMPERATURE_MAX_degC)
        beyond = (np.abs(frames.b_uT) > B_MAX_uT).reshape(len(frames), -1, 3).any(axis=2)
        self._note_chips("failed I2C reads", failed, now_s)
        self._note_chips("zeros in place of a reading", zero, now_s)
        self._note_chips("temperature out of range", np.asarray(~warm & ~failed), now_s)
        self._note_chips("field at the end of the range", beyond & ~failed, now_s)
        self._measure_rate(len(frames), now_s)
        sound = ~(failed | zero | ~warm | beyond).any(axis=1)
        self._held.append(frames.where(sound))
        if sum(map(len, self._held)) >= LOOK_FRAMES_N:
            self._look(concatenate(self._held, self._chips_n), now_s)
            self._held = []
        return sound

    def feed_change(self, db_uT: Float[np.ndarray, " ch"], turn: Float64[np.ndarray, "k 3 3"], now_s: float) -> None:
        """Look at a change of field: one that all chips share comes from a magnet, or of a board that turned."""
        b_uT = np.einsum("kij,kj->ki", turn, db_uT.reshape(-1, 3).astype(np.float64))
        shared_uT = b_uT.mean(axis=0)
        apart = ((b_uT - shared_uT) ** 2).sum() / max((b_uT**2).sum(), 1e-9)
        alike = len(b_uT) > 1 and apart < ALIKE_SHARE_MAX and np.linalg.norm(shared_uT) > ALIKE_MIN_uT
        self.note("field from outside: a magnet or iron near, or the board was turned", int(alike), now_s)

    def _look(self, frames: Frames, now_s: float) -> None:
        """Look for what only several frames show."""
        self._note_chips("stuck", self._stuck.feed(frames.b_uT), now_s)
        b_uT = frames.b_uT if self._last is None else np.concatenate([self._last.b_uT, frames.b_uT])
        device_s = frames.device_s if self._last is None else np.concatenate([self._last.device_s, frames.device_s])
        step_uT = np.diff(b_uT, axis=0)
        repeated_n = int((step_uT == 0).all(axis=1).sum())
        self.note("frames repeat", repeated_n if repeated_n > REPEATED_SHARE * len(step_uT) else 0, now_s)
        wrap_uT = 2**15 * self._lsb_uT[:, [0, 0, 1]]  # NaN, which nothing exceeds, until the step is known
        wrapped = np.abs(step_uT.reshape(len(step_uT), -1, 3)) > wrap_uT
        self._note_chips("past int16", np.asarray(wrapped.any(axis=2)), now_s)
        steps_s = np.diff(device_s)
        self.note("the board's clock jumps", int(((steps_s < 0) | (steps_s > CLOCK_STEP_MAX_S)).sum()), now_s)
        self._last = frames.where(np.arange(len(frames)) == len(frames) - 1)
        self._since_scale.append(frames.b_uT)
        if sum(map(len, self._since_scale)) >= SCALE_FRAMES_N:
            self._lsb_uT = faults.find_lsb(np.concatenate(self._since_scale))
            odd = faults.odd_scales(self._lsb_uT, None)
            self._note_chips("another step than the others: reset", np.repeat(odd[None], SCALE_FRAMES_N, 0), now_s)
            self._since_scale = []

    def _note_chips(self, what: str, marks: Bool[np.ndarray, "f k"], now_s: float) -> None:
        if marks.any():
            for chip_i in np.flatnonzero(marks.any(axis=0)):
                self.note(f"chip {chip_i}: {what}", int(marks[:, chip_i].sum()), now_s)

    def _measure_rate(self, frames_n: int, now_s: float) -> None:
        """Count frames over a second; less than usual means that some do not come, which no format tells."""
        came = self._came
        came.append((now_s, frames_n))
        self._came_n += frames_n
        while now_s - came[0][0] > RATE_WINDOW_S:
            self._came_n -= came.popleft()[1]
        span_s = now_s - came[0][0]
        if span_s < RATE_WINDOW_S / 2:
            return
        self.rate_hz = (self._came_n - came[0][1]) / span_s
        usual_hz = self.rate_hz if np.isnan(self._usual_hz) else self._usual_hz
        self._usual_hz = usual_hz + USUAL_GAIN * (self.rate_hz - usual_hz)
        self.note("slower than it was: frames are missing", int(self.rate_hz < SLOW_SHARE * self._usual_hz), now_s)
