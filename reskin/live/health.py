"""Alarms of a running board.

An alarm is raised if the data have a fault, if the frame rate is low, or if an external magnetic field is detected.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from reskin.board.faults import STEPS_MIN_N, FaultDetector, Faults
from reskin.board.rates import REPEATED_MAX, RepeatCounter
from reskin.board.wire import Frames, concatenate
from reskin.recordings.fault_policy import Action, FaultPolicy

# Number of frames in one check for faults that are visible only in several frames. For a board with five chips, these
# frames take 0.1 s.
BATCH_FRAMES_N = 40
# Number of frames in one check for repeated readings of single chips. This number is larger, because only a small
# fraction of the readings may be repeated.
REPEATS_FRAMES_N = 400
RATE_WINDOW_S = 1.0  # the frame rate is measured over this time
# Frames are considered to be missing if the frame rate is below this fraction of the usual rate. The value is assumed.
SLOW_FRACTION = 0.7
# The usual rate is a running mean of the measured rates, in which a new rate has this weight. At 400 Hz, the time
# constant of the running mean is 25 s.
USUAL_GAIN = 1e-4
ACTIVE_S = 2.0  # an alarm remains active for this time after its last occurrence
# A press changes the field differently at each chip, whereas an external field is nearly the same at all chips. A field
# change dB is attributed to an external field if the part of |dB|^2 that is not common to all chips is below this
# fraction. For all presses of scenes `quick` and `lab`, the fraction is 0.45 or more.
RESIDUAL_FRACTION_MAX = 0.2
# Smallest external field that raises an alarm. It is about as strong as the earth's field.
COMMON_MIN_uT = 50.0
RESET = "resolution differs from the other chips: the chip was probably reset"
READINGS_REPEAT = f"over {100 * REPEATED_MAX:.0f} % of readings repeat: the board sends faster than its chips convert"
# If external fields are expected, only a field that is larger than this multiple of their expected size raises an
# alarm.
EXTERNAL_SDS = 3.0

# What is done with faulty frames by default: "drop" means that they get no estimate, and "flag" means that they only
# raise an alarm. Frames with saturated readings are dropped, because their estimates would be wrong and a robot's
# controller might use them.
LIVE_POLICY = FaultPolicy(
    failed_read="drop", zeros="drop", stuck="drop", too_hot="drop", saturated="drop", torn="drop", wrong_baud="drop",
    constant_channel="flag", chip_reset="flag", int16_wrap="flag", repeated="flag", dropped="flag", clock_jump="flag",
    unplug="flag",
)  # fmt: skip


@dataclass
class Alarm:
    """An alarm of a board, which may have occurred several times."""

    name: str
    count_n: int  # number of affected frames or bytes
    first_s: float  # unix time of the first occurrence
    last_s: float  # unix time of the last occurrence
    action: Action  # what is done with the affected frames


class Health:
    """The health of a running board: detects faults in its frames, stores its alarms, and measures its frame rate."""

    def __init__(self, chips_n: int, policy: FaultPolicy = LIVE_POLICY) -> None:
        self.policy = policy
        self.alarms: dict[str, Alarm] = {}
        self.rate_hz = self._usual_hz = np.nan
        self._chips_n = chips_n
        # The detector estimates a chip's resolution from equal steps between readings. Here it needs fewer equal steps
        # than in the ingestion of a capture. In ingestion, a wrong estimate may cause a whole capture to be rejected,
        # but here it causes only an alarm, which has no lasting effect.
        self._detector = FaultDetector(chips_n, steps_min_n=STEPS_MIN_N)
        self._batch: list[Frames] = []
        self._repeats = RepeatCounter(chips_n)
        # Readings of single chips are checked for repetitions from time to time. This flag says whether any whole frame
        # was repeated since the last of these checks.
        self._frames_repeat = False
        # Whether a chip was stuck at the end of the last batch. If so, all frames are dropped until the next batch.
        self._stuck = False
        self._arrivals: deque[tuple[float, int]] = deque()
        self._arrived_n = 0

    def note(self, name: str, count_n: int, now_s: float, fault: str | None = None) -> None:
        """Add `count_n` affected frames or bytes to the alarm with this name. Create the alarm if it does not exist.

        The alarm also displays an action, which is the action of the policy for `fault`. If no fault is given, the
        action is `flag`.
        """
        if count_n:
            action: Action = getattr(self.policy, fault) if fault is not None else "flag"
            alarm = self.alarms.setdefault(name, Alarm(name, 0, now_s, now_s, action))
            alarm.count_n, alarm.last_s = alarm.count_n + count_n, now_s

    def active(self, now_s: float) -> list[Alarm]:
        """Return the alarms that occurred in the last `ACTIVE_S` seconds."""
        return [alarm for alarm in list(self.alarms.values()) if now_s - alarm.last_s <= ACTIVE_S]

    def feed(self, frames: Frames, now_s: float) -> Bool[np.ndarray, " f"]:
        """Check the next frames for faults; return for each frame whether it may be used.

        A frame may be used unless it has a fault for which the policy is to drop the frame. Faults that are visible in
        a single reading are detected immediately. Faults that are visible only in several frames are detected once per
        `BATCH_FRAMES_N` frames.
        """
        readings = self._detector.of_readings(frames)
        faulty = self._note_chips("failed I2C reads", readings.failed_read, now_s, "failed_read")
        faulty |= self._note_chips("zeros in place of a reading", readings.zeros, now_s, "zeros")
        faulty |= self._note_chips("temperature out of range", readings.too_hot, now_s, "too_hot")
        faulty |= self._note_chips("field at the end of the range", readings.saturated, now_s, "saturated")
        self._measure_rate(len(frames), now_s)
        # Frames with failed reads are left out of the batch, because they would hide that a chip is stuck.
        self._batch.append(frames.where(~readings.faulty_rows))
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

        Such a field change is not caused by a press, but by an external field or by a rotation of the board.

        Parameters
        ----------
        db_uT : the latest field change
        turn : rotation matrix of each chip, from the axes of the chip to the axes of the board
        now_s : unix time of the field change
        expected_uT : size of external fields that are expected and raise no alarm
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
            self._note_chips(RESET, reset, now_s, "chip_reset")

    def _note_repeats(self, batch: Frames, faults: Faults, now_s: float) -> None:
        """Raise an alarm if single chips repeat their previous reading.

        If whole frames are repeated, this alarm is not raised, because there is another alarm for repeated frames.
        """
        self._repeats.feed(batch.b_uT)
        self._frames_repeat |= bool(faults.repeated.any())
        if self._repeats.frames_n >= REPEATS_FRAMES_N:
            share = self._repeats.readings
            if share > REPEATED_MAX and not self._frames_repeat:
                self.note(READINGS_REPEAT, round(share * self._repeats.frames_n), now_s, "repeated")
            self._repeats.restart()
            self._frames_repeat = False

    def _note_chips(self, name: str, mask: Bool[np.ndarray, "f k"], now_s: float, fault: str) -> Bool[np.ndarray, " f"]:
        """Raise an alarm for each chip that has a fault; return for each frame whether the policy is to drop it.

        `mask` states whether each chip has the fault in each frame.
        """
        for chip_i in np.flatnonzero(mask.any(axis=0)):
            self.note(f"chip {chip_i}: {name}", int(mask[:, chip_i].sum()), now_s, fault)
        return np.asarray(mask.any(axis=1)) & (getattr(self.policy, fault) != "flag")

    def _measure_rate(self, frames_n: int, now_s: float) -> None:
        """Measure the frame rate over one second, and raise an alarm if it is low.

        Frames are not numbered. Therefore, only a low rate can show that frames are missing.
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
