"""Alarms of a running board: faults of the data, a low frame rate, and external magnetic fields."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from reskin.board.faults import STEPS_MIN_N, FaultDetector, Faults, find_reading_faults
from reskin.board.rates import REPEATED_MAX, RepeatCounter
from reskin.board.wire import Frames, concatenate
from reskin.recordings.fault_policy import Action, FaultPolicy

BATCH_FRAMES_N = 40  # frames per check for faults that span several frames; 0.1 s for a board with five chips
REPEATS_FRAMES_N = 400  # frames per check for repeated readings of single chips, whose share is small
RATE_WINDOW_S = 1.0
SLOW_FRACTION = 0.7  # assumed: frames are missing if the frame rate is below this fraction of the usual rate
# weight of a new rate in the running mean, which is the usual rate; its time constant is 25 s at 400 Hz
USUAL_GAIN = 1e-4
ACTIVE_S = 2.0  # an alarm remains active for this long after its last occurrence
# A field change dB has an external cause if only a small fraction of |dB|^2, below this limit, is not common to all
# chips. For all presses of scenes `quick` and `lab`, this fraction is 0.45 or more.
RESIDUAL_FRACTION_MAX = 0.2
COMMON_MIN_uT = 50.0  # smallest external field that raises an alarm; about the strength of the earth's field
READINGS_REPEAT = f"over {100 * REPEATED_MAX:.0f} % of readings repeat: the board sends faster than its chips convert"
# if external fields are expected, a field that is larger than this multiple of their expected size raises an alarm
EXTERNAL_SDS = 3.0

# Default policy for live readings. Saturated readings are dropped, because a controller would use a wrong estimate.
LIVE_POLICY = FaultPolicy(
    failed_read="drop", zeros="drop", stuck="drop", too_hot="drop", saturated="drop", torn="drop", wrong_baud="drop",
    constant_channel="flag", chip_reset="flag", int16_wrap="flag", repeated="flag", dropped="flag", clock_jump="flag",
    unplug="flag",
)  # fmt: skip


@dataclass
class Alarm:
    """An alarm, with the number of affected frames or bytes, and the unix times of its first and last occurrence."""

    name: str
    count_n: int
    first_s: float
    last_s: float
    action: Action


class Health:
    """Detects faults in the frames of a running board, and stores its alarms and its frame rate."""

    def __init__(self, chips_n: int, policy: FaultPolicy = LIVE_POLICY) -> None:
        self.policy = policy
        self.alarms: dict[str, Alarm] = {}
        self.rate_hz = self._usual_hz = np.nan
        self._chips_n = chips_n
        # Fewer equal steps than in ingestion are enough for an estimate of a chip's LSB. In ingestion, a wrong estimate
        # may reject a whole capture, but here it causes only an alarm, which has no lasting effect.
        self._detector = FaultDetector(chips_n, steps_min_n=STEPS_MIN_N)
        self._batch: list[Frames] = []
        self._repeats = RepeatCounter(chips_n)
        self._frames_repeat = False  # whether whole frames were repeated since the last check of single readings
        self._stuck = False  # whether frames are dropped now, because a chip was stuck at the end of the last batch
        self._arrivals: deque[tuple[float, int]] = deque()
        self._arrived_n = 0

    def note(self, name: str, count_n: int, now_s: float, fault: str | None = None) -> None:
        """Add `count_n` occurrences to an alarm, which is created if necessary.

        The action that the alarm shows is that of the policy for `fault`, or `flag` if no fault is given.
        """
        if count_n:
            action: Action = getattr(self.policy, fault) if fault is not None else "flag"
            alarm = self.alarms.setdefault(name, Alarm(name, 0, now_s, now_s, action))
            alarm.count_n, alarm.last_s = alarm.count_n + count_n, now_s

    def active(self, now_s: float) -> list[Alarm]:
        """Return the alarms that occurred in the last `ACTIVE_S` seconds."""
        return [alarm for alarm in list(self.alarms.values()) if now_s - alarm.last_s <= ACTIVE_S]

    def feed(self, frames: Frames, now_s: float) -> Bool[np.ndarray, " f"]:
        """Check the next frames for faults; return the mask of frames that the policy does not drop.

        Faults of single readings are detected immediately. Faults that span several frames are detected once per
        `BATCH_FRAMES_N` frames.
        """
        readings = find_reading_faults(frames.b_uT, frames.temperature_degC)
        faulty = self._note_chips("failed I2C reads", readings.failed_read, now_s, "failed_read")
        faulty |= self._note_chips("zeros in place of a reading", readings.zeros, now_s, "zeros")
        faulty |= self._note_chips("temperature out of range", readings.too_hot, now_s, "too_hot")
        faulty |= self._note_chips("field at the end of the range", readings.saturated, now_s, "saturated")
        self._measure_rate(len(frames), now_s)
        self._batch.append(frames.where(~readings.faulty_rows))  # leave out failed reads, which would hide a stuck chip
        if sum(map(len, self._batch)) >= BATCH_FRAMES_N:
            batch, self._batch = concatenate(self._batch, self._chips_n), []
            self._note_batch(batch, self._detector.feed(batch, np.full(len(batch), now_s)), now_s)
        return np.asarray(~faulty & (not self._stuck))

    def feed_change(
        self,
        db_uT: Float[np.ndarray, " ch"],
        turn: Float64[np.ndarray, "k 3 3"],
        now_s: float,
        expected_uT: float = 0.0,
    ) -> None:
        """Raise an alarm if all chips measure nearly the same field change.

        In this case, the cause is an external field or a rotation of the board, and not a press.

        `turn` rotates the axes of each chip to those of the board. External fields of size `expected_uT` are expected
        and raise no alarm.
        """
        b_uT = np.einsum("kij,kj->ki", turn, db_uT.reshape(-1, 3).astype(np.float64))
        common_uT = b_uT.mean(axis=0)
        residual = ((b_uT - common_uT) ** 2).sum() / max((b_uT**2).sum(), 1e-9)
        least_uT = max(COMMON_MIN_uT, EXTERNAL_SDS * expected_uT)
        external = len(b_uT) > 1 and residual < RESIDUAL_FRACTION_MAX and np.linalg.norm(common_uT) > least_uT
        self.note("external field: a magnet or iron is near, or the board was rotated", int(external), now_s)

    def _note_batch(self, batch: Frames, faults: Faults, now_s: float) -> None:
        stuck = self._note_chips("stuck", faults.stuck, now_s, "stuck")
        self._stuck = bool(stuck[-1])
        self.note("frames repeat", int(faults.repeated.sum()), now_s, "repeated")
        self._note_repeats(batch, faults, now_s)
        self._note_chips("int16 overflow", faults.int16_wrap, now_s, "int16_wrap")
        self.note("the board's clock jumps", int(faults.clock_jump.sum()), now_s, "clock_jump")
        for window in faults.scale:
            reset = np.repeat(window.unusual[None], len(window.t_s), axis=0)
            self._note_chips("resolution differs from the other chips: reset", reset, now_s, "chip_reset")

    def _note_repeats(self, batch: Frames, faults: Faults, now_s: float) -> None:
        """Raise an alarm if single chips repeat their previous reading; repeated whole frames have another alarm."""
        self._repeats.feed(batch.b_uT)
        self._frames_repeat |= bool(faults.repeated.any())
        if self._repeats.frames_n >= REPEATS_FRAMES_N:
            share = self._repeats.readings
            if share > REPEATED_MAX and not self._frames_repeat:
                self.note(READINGS_REPEAT, round(share * self._repeats.frames_n), now_s, "repeated")
            self._repeats.restart()
            self._frames_repeat = False

    def _note_chips(self, name: str, mask: Bool[np.ndarray, "f k"], now_s: float, fault: str) -> Bool[np.ndarray, " f"]:
        """Add a fault to the alarm of each affected chip; return the mask of the frames that the policy drops."""
        for chip_i in np.flatnonzero(mask.any(axis=0)):
            self.note(f"chip {chip_i}: {name}", int(mask[:, chip_i].sum()), now_s, fault)
        return np.asarray(mask.any(axis=1)) & (getattr(self.policy, fault) != "flag")

    def _measure_rate(self, frames_n: int, now_s: float) -> None:
        """Measure the frame rate over one second, and raise an alarm if it is low.

        Frames have no numbers, so only a low rate shows that frames are missing.
        """
        self._arrivals.append((now_s, frames_n))
        self._arrived_n += frames_n
        while now_s - self._arrivals[0][0] > RATE_WINDOW_S:
            self._arrived_n -= self._arrivals.popleft()[1]
        first_s, first_n = self._arrivals[0]
        span_s = now_s - first_s
        if span_s < RATE_WINDOW_S / 2:
            return
        self.rate_hz = (self._arrived_n - first_n) / span_s
        usual_hz = self.rate_hz if np.isnan(self._usual_hz) else self._usual_hz
        self._usual_hz = usual_hz + USUAL_GAIN * (self.rate_hz - usual_hz)
        slow = self.rate_hz < SLOW_FRACTION * self._usual_hz
        self.note("slower than before: frames are missing", int(slow), now_s, "dropped")
