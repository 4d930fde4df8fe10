"""What is wrong with a board while it runs. In: frames and when they came. Out: alarms by name, frames to believe.

An alarm counts, says when it began and was last seen, and what was decided for its fault. Refuses to know models,
and to mend anything.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from reskin.board import faults
from reskin.board import faults as limits
from reskin.board.wire import Frames, concatenate
from reskin.recordings.fault_policy import Decision, Decisions

LOOK_FRAMES_N = 40  # a tenth of a second of five chips: how late what needs several frames is seen
SCALE_FRAMES_N = 400  # in which each sound chip's step shows
RATE_WINDOW_S = 1.0
SLOW_SHARE = 0.7  # assumed, of the usual rate: frames are missing
USUAL_GAIN = 1e-4  # by which the usual rate follows, each time frames come: half a minute of 400 Hz
ACTIVE_S = 2.0  # an alarm stays on for so long after it was last seen
ALIKE_SHARE_MAX = 0.2  # of |dB|^2 that chips do not share; 0.45 or more in all pokes of scenes quick and lab
ALIKE_MIN_uT = 50.0  # about the earth's field

# What a controller is given must be believed at once: a reading beyond the chip's range has no place and force.
LIVE = Decisions(
    failed_read="drop", zeros="drop", stuck="drop", too_hot="drop", saturated="drop", torn="drop", wrong_baud="drop",
    constant_channel="flag", chip_reset="flag", int16_wrap="flag", repeated="flag", dropped="flag", clock_jump="flag",
    unplug="flag",
)  # fmt: skip


@dataclass
class Alarm:
    """How often something was seen, in frames or bytes, and when, in unix seconds."""

    name: str
    count_n: int
    first_s: float
    last_s: float
    decision: Decision


class Health:
    """Remembers what has been wrong since the board was plugged in; as much as it has chips and names of faults."""

    def __init__(self, chips_n: int, decisions: Decisions = LIVE) -> None:
        self.decisions = decisions
        self._distrusted = False  # a chip is stuck, and this is not to be let pass
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

    def note(self, name: str, count_n: int, now_s: float, fault: str | None = None) -> None:
        """Count something under its name; for a fault something was decided, all else is told and no more."""
        if count_n:
            decision: Decision = getattr(self.decisions, fault) if fault is not None else "flag"
            alarm = self.alarms.setdefault(name, Alarm(name, 0, now_s, now_s, decision))
            alarm.count_n, alarm.last_s = alarm.count_n + count_n, now_s

    def active(self, now_s: float) -> list[Alarm]:
        return [alarm for alarm in list(self.alarms.values()) if now_s - alarm.last_s <= ACTIVE_S]

    def feed(self, frames: Frames, now_s: float) -> Bool[np.ndarray, " f"]:
        """Look at the next frames; mark those to believe: hit by no fault but such as are flagged."""
        failed = np.asarray(faults.failed_reads(frames.b_uT, frames.temperature_degC))
        zero = faults.zero_reads(frames.b_uT)
        hot, full = limits.too_hot(frames.temperature_degC) & ~failed, limits.saturated(frames.b_uT) & ~failed
        untrue = self._note_chips("failed I2C reads", failed, now_s, "failed_read")
        untrue |= self._note_chips("zeros in place of a reading", zero, now_s, "zeros")
        untrue |= self._note_chips("temperature out of range", hot, now_s, "too_hot")
        untrue |= self._note_chips("field at the end of the range", full, now_s, "saturated")
        self._measure_rate(len(frames), now_s)
        self._held.append(frames.where(~(failed | zero | hot | full).any(axis=1)))
        if sum(map(len, self._held)) >= LOOK_FRAMES_N:
            self._look(concatenate(self._held, self._chips_n), now_s)
            self._held = []
        return np.asarray(~untrue & (not self._distrusted))

    def feed_change(self, db_uT: Float[np.ndarray, " ch"], turn: Float64[np.ndarray, "k 3 3"], now_s: float) -> None:
        """Look at a change of field: one that all chips share comes from a magnet, or of a board that turned."""
        b_uT = np.einsum("kij,kj->ki", turn, db_uT.reshape(-1, 3).astype(np.float64))
        shared_uT = b_uT.mean(axis=0)
        apart = ((b_uT - shared_uT) ** 2).sum() / max((b_uT**2).sum(), 1e-9)
        alike = len(b_uT) > 1 and apart < ALIKE_SHARE_MAX and np.linalg.norm(shared_uT) > ALIKE_MIN_uT
        self.note("field from outside: a magnet or iron near, or the board was turned", int(alike), now_s)

    def _look(self, frames: Frames, now_s: float) -> None:
        """Look for what only several frames show."""
        stuck = self._stuck.feed(frames.b_uT)
        untrue = self._note_chips("stuck", stuck, now_s, "stuck")
        self._distrusted = bool(len(untrue) and untrue[-1])
        b_uT = frames.b_uT if self._last is None else np.concatenate([self._last.b_uT, frames.b_uT])
        device_s = frames.device_s if self._last is None else np.concatenate([self._last.device_s, frames.device_s])
        step_uT = np.diff(b_uT, axis=0)
        repeated_n = int((step_uT == 0).all(axis=1).sum())
        repeats = repeated_n > limits.REPEATED_SHARE * len(step_uT)
        self.note("frames repeat", repeated_n if repeats else 0, now_s, "repeated")
        self._note_chips("past int16", limits.wrapped(step_uT, self._lsb_uT), now_s, "int16_wrap")
        self.note("the board's clock jumps", int(limits.clock_jumps(np.diff(device_s)).sum()), now_s, "clock_jump")
        self._last = frames.where(np.arange(len(frames)) == len(frames) - 1)
        self._since_scale.append(frames.b_uT)
        if sum(map(len, self._since_scale)) >= SCALE_FRAMES_N:
            self._lsb_uT = faults.find_lsb(np.concatenate(self._since_scale))
            odd = faults.odd_scales(self._lsb_uT, None)
            marks = np.repeat(odd[None], SCALE_FRAMES_N, 0)
            self._note_chips("another step than the others: reset", marks, now_s, "chip_reset")
            self._since_scale = []

    def _note_chips(
        self, what: str, marks: Bool[np.ndarray, "f k"], now_s: float, fault: str
    ) -> Bool[np.ndarray, " f"]:
        """Count a fault of chips; mark the frames not to be believed for it."""
        if marks.any():
            for chip_i in np.flatnonzero(marks.any(axis=0)):
                self.note(f"chip {chip_i}: {what}", int(marks[:, chip_i].sum()), now_s, fault)
        return np.asarray(marks.any(axis=1)) & (getattr(self.decisions, fault) != "flag")

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
        slow = self.rate_hz < SLOW_SHARE * self._usual_hz
        self.note("slower than it was: frames are missing", int(slow), now_s, "dropped")
