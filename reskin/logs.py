"""Find the start without contact and the contacts in a log, and summarise the estimates of a log.

A log is a recording of the field over time. Section 6 of the paper shows logs of a dog's shoe and of a glove. A log
must begin with some time without contact, which is called the quiet start here. The mean field of the quiet start is
the no-load reading, which is subtracted from all readings of the log.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.special import ndtri

from reskin.data.contact import contact_threshold_uT, magnitudes_uT, noise_uT
from reskin.errors import CaptureError

# To find the end of the quiet start, the log is divided into windows of this length, which is an assumed value. The
# mean field of each window is compared with the mean field at the start of the log.
WINDOW_S = 0.1
QUIET_MIN_S = 0.5  # shortest quiet start whose mean field is assumed to be a reliable no-load reading
# Share of logs of pure noise that may be refused because a window seems to differ from the start. From this follows by
# how many standard errors the mean of a channel may differ, for the number of channels and of windows.
FALSE_SHARE = 0.002
FEW_READINGS = 1.5  # the limit is larger by this number divided by the square root of the number of readings
NORMAL_1SD = 0.683  # this share of normally distributed numbers is within one standard deviation
START_WINDOWS_N = 2  # number of windows that are the start of the log, from which mean and noise are estimated

# A function that is called with the noise of the readings in uT. It returns a matrix that removes external fields from
# readings, or None if they are not to be removed.
FindSuppressor = Callable[[float], Float64[np.ndarray, "ch ch"] | None]


class ContactDetector:
    """A detector of contacts in a log, from the readings `quiet_uT` of its quiet start."""

    def __init__(self, quiet_uT: Float32[np.ndarray, "q ch"], find_suppressor: FindSuppressor | None = None) -> None:
        self._noload_uT = quiet_uT.mean(axis=0, dtype=np.float64)
        db_uT = self.change_uT(quiet_uT)
        self.noise_uT = noise_uT(db_uT)
        self._suppressor = None if find_suppressor is None else find_suppressor(self.noise_uT)
        self._threshold_uT = contact_threshold_uT(db_uT, self._suppressor)

    def change_uT(self, b_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "f ch"]:
        """Return the field changes since the quiet start."""
        return (b_uT - self._noload_uT).astype(np.float32)

    def contact(self, db_uT: Float32[np.ndarray, "f ch"]) -> Bool[np.ndarray, " f"]:
        """Return whether each reading is in contact, from its field changes."""
        return np.asarray(magnitudes_uT(db_uT, self._suppressor) > self._threshold_uT)


def quiet_start(t_s: Float64[np.ndarray, " f"], b_uT: Float32[np.ndarray, "f ch"], *, where: str) -> int:
    """Return the number of readings in the quiet start of a log.

    The log is divided into windows of 0.1 s, or of two readings of slow boards. The quiet start ends before the first
    window in which the mean of any channel differs from the channel's mean over the first two windows by more than
    noise would explain.

    Raises CaptureError if the quiet start is shorter than 0.5 s.
    """
    window_n = max(round(WINDOW_S / step_s(t_s)), 2)
    windows_n = len(b_uT) // window_n
    start_n = START_WINDOWS_N * window_n
    if windows_n > START_WINDOWS_N:
        first_uT = b_uT[:start_n].astype(np.float64)
        means_uT = b_uT[: windows_n * window_n].reshape(windows_n, window_n, -1).mean(axis=1, dtype=np.float64)
        # The noise is estimated from the differences between consecutive readings of the whole log, of which presses
        # change few. If the noise is smaller than the step of a chip, most differences are 0.
        steps_uT = np.abs(np.diff(b_uT.astype(np.float64), axis=0))
        typical_uT = np.quantile(steps_uT, NORMAL_1SD, axis=0)
        usual_uT = np.where(typical_uT > 0, typical_uT, np.diff(first_uT, axis=0).std(axis=0))
        error_uT = usual_uT / np.sqrt(2) * np.sqrt(1 / window_n + 1 / start_n)
        tests_n = b_uT.shape[1] * max(round(QUIET_MIN_S / (window_n * step_s(t_s))), START_WINDOWS_N + 1)
        # A noise that is estimated from few readings may be too small.
        limit_sds = -float(ndtri(FALSE_SHARE / tests_n / 2)) * (1 + FEW_READINGS / np.sqrt(len(b_uT)))
        moved = (np.abs(means_uT - first_uT.mean(axis=0)) > limit_sds * error_uT).any(axis=1)
        quiet_n = window_n * (int(moved.argmax()) if moved.any() else windows_n)
    else:
        quiet_n = 0
    if (logged_s := len(b_uT) * step_s(t_s)) < QUIET_MIN_S:
        raise CaptureError(
            f"{where}: the log has {len(b_uT)} readings ({logged_s:.2g} s), but it must begin with at least "
            f"{QUIET_MIN_S:g} s without contact. Record a longer log."
        )
    if quiet_n * step_s(t_s) < QUIET_MIN_S:
        raise CaptureError(
            f"{where}: the start without contact lasts {quiet_n * step_s(t_s):.2g} s, less than {QUIET_MIN_S:g} s. "
            "Record again, and leave the skin untouched for the first second."
        )
    return quiet_n


def step_s(t_s: Float64[np.ndarray, " f"]) -> float:
    """Return the median time between consecutive readings, in s."""
    return float(np.median(np.diff(t_s)))


def contacts_n(contact: Bool[np.ndarray, " f"]) -> int:
    """Count the contacts in a log.

    A contact is a run of at least two consecutive readings in contact. A single reading without contact does not end a
    run.
    """
    padded = np.concatenate([[False], contact, [False]])
    closed = padded | (np.roll(padded, 1) & np.roll(padded, -1))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], closed, [False]]).astype(int)))
    return int((np.diff(edges)[::2] > 1).sum())


class LogSummary:
    """The summary of a log: duration, rate, noise, number of contacts, and the largest estimated force in contact.

    The log may be passed in parts of any length. With several models, the largest force is averaged over the models.
    """

    def __init__(self, step_s: float, quiet_n: int, noise_uT: float) -> None:
        self._step_s, self._first_s, self._last_s = step_s, np.nan, np.nan
        self._counts: dict[str, Any] = {
            "rate_hz": 1 / step_s, "duration_s": 0.0, "readings_n": 0, "quiet_start_s": quiet_n * step_s,
            "noise_uT": noise_uT, "contact_readings_n": 0, "contacts_n": 0,
        }  # fmt: skip
        self._pending = np.zeros(0, bool)
        self._force_N: list[Float64[np.ndarray, " m"]] = []  # the largest force so far by each model

    def feed(
        self, t_s: Float64[np.ndarray, " f"], contact: Bool[np.ndarray, " f"], force_N: Float[np.ndarray, "m c"]
    ) -> None:
        """Process the next readings; `force_N` has the estimated forces of those in contact."""
        if not len(t_s):
            return
        self._first_s, self._last_s = float(np.fmin(self._first_s, t_s[0])), float(t_s[-1])
        self._counts["readings_n"] += len(t_s)
        self._counts["contact_readings_n"] += int(contact.sum())
        if contact.any():
            self._force_N = [np.max([*self._force_N, force_N.max(axis=1)], axis=0)]
        # Two readings without contact end a contact. What follows the last two may go on in the next part.
        pending = np.concatenate([self._pending, contact])
        apart = np.flatnonzero(~pending[:-1] & ~pending[1:])
        ended_n = int(apart[-1]) + 1 if len(apart) else 0
        self._counts["contacts_n"] += contacts_n(pending[:ended_n])
        pending = pending[ended_n:]
        self._pending = pending if len(pending) <= 4 else np.concatenate([[True, True], pending[-2:]])

    def counts(self) -> dict[str, Any]:
        """Return the summary of all readings so far."""
        last_n = contacts_n(self._pending)
        duration_s = self._last_s - self._first_s + self._step_s
        counts = self._counts | {"duration_s": duration_s, "contacts_n": self._counts["contacts_n"] + last_n}
        return counts | ({"force_max_N": float(self._force_N[0].mean())} if self._force_N else {})
