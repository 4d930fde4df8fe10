"""A log without labels becomes contacts, places and forces (section 6: dog shoe, glove). In: readings. Out: estimates.

The no-load reading is the quiet start of the log itself. Truth, where a simulator kept it, is only scored. Refuses to
know files, and which network answers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from reskin.errors import CaptureError
from reskin.metrics import score

WINDOW_S = 0.1  # assumed: windows whose means are compared with the start's
QUIET_MIN_S = 0.5  # assumed: a shorter start gives no no-load reading to rely on
WANDER_SDS = 4.0  # of a window's mean, any channel: by chance in 1 of 1,000 windows of 15 channels
START_WINDOWS_N = 2  # the first windows, from which the noise is taken
CONTACT_SDS = 6.0  # times the noise of one channel beyond what the quiet start's |dB| usually is
POINTS_MAX_N = 1500  # of a drawn series

Answers = Callable[[Float32[np.ndarray, "f ch"]], Float32[np.ndarray, "f 3"]]


@dataclass(frozen=True)
class Estimates:
    """What a log says, row by row; places and forces mean something in contact only."""

    t_s: Float64[np.ndarray, " f"]
    answers: Float64[np.ndarray, "m f 3"]  # x_mm, y_mm, F_N of each network
    contact: Bool[np.ndarray, " f"]
    quiet_n: int
    noise_uT: float


def estimate(
    t_s: Float64[np.ndarray, " f"], b_uT: Float32[np.ndarray, "f ch"], networks: Sequence[Answers], *, where: str
) -> Estimates:
    """Find the quiet start, take it off, and let the networks answer for every reading."""
    return estimate_after(quiet_start(t_s, b_uT, where=where), t_s, b_uT, networks)


def estimate_after(
    quiet_n: int, t_s: Float64[np.ndarray, " f"], b_uT: Float32[np.ndarray, "f ch"], networks: Sequence[Answers]
) -> Estimates:
    """Take off the mean of a quiet start of so many readings, and let the networks answer for every reading."""
    noload_uT = b_uT[:quiet_n].mean(axis=0, dtype=np.float64)
    db_uT = (b_uT - noload_uT).astype(np.float32)
    noise_uT = float(np.sqrt((db_uT[:quiet_n].astype(np.float64) ** 2).mean()))
    length_uT = np.linalg.norm(db_uT, axis=1)
    contact = length_uT > np.median(length_uT[:quiet_n]) + CONTACT_SDS * noise_uT
    answers = np.stack([network(db_uT) for network in networks]).astype(np.float64)
    return Estimates(t_s, answers, contact, quiet_n, noise_uT)


def quiet_start(t_s: Float64[np.ndarray, " f"], b_uT: Float32[np.ndarray, "f ch"], *, where: str) -> int:
    """Count the readings of the longest start without contact.

    The start is cut into windows of 0.1 s; it lasts as long as every channel's mean over a window stays within 4
    standard errors of the first two windows' mean, their own error included. Shorter than 0.5 s is refused.
    """
    window_n = max(round(WINDOW_S / step_s(t_s)), 2)
    windows_n = len(b_uT) // window_n
    start_n = START_WINDOWS_N * window_n
    if windows_n > START_WINDOWS_N:
        first_uT = b_uT[:start_n].astype(np.float64)
        means_uT = b_uT[: windows_n * window_n].reshape(windows_n, window_n, -1).mean(axis=1, dtype=np.float64)
        # Differences of neighbours, so that a contact that begins at once does not pass for noise.
        sd_uT = np.diff(first_uT, axis=0).std(axis=0) / np.sqrt(2)
        error_uT = sd_uT * np.sqrt(1 / window_n + 1 / start_n)
        wandered = (np.abs(means_uT - first_uT.mean(axis=0)) > WANDER_SDS * error_uT).any(axis=1)
        quiet_n = window_n * (int(wandered.argmax()) if wandered.any() else windows_n)
    else:
        quiet_n = 0
    if quiet_n * step_s(t_s) < QUIET_MIN_S:
        got = f"{quiet_n * step_s(t_s):.2g} s"
        remedy = "Log the skin untouched for a second first."
        raise CaptureError(where, "the start without contact", f"{QUIET_MIN_S:g} s or more", got, remedy)
    return quiet_n


def step_s(t_s: Float64[np.ndarray, " f"]) -> float:
    """Give the usual time from one reading to the next."""
    return float(np.median(np.diff(t_s)))


def contacts_n(contact: Bool[np.ndarray, " f"]) -> int:
    """Count the runs of readings in contact; a single reading is noise, and a single one off it parts nothing."""
    padded = np.concatenate([[False], contact, [False]])
    closed = padded | (np.roll(padded, 1) & np.roll(padded, -1))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], closed, [False]]).astype(int)))
    return int((np.diff(edges)[::2] > 1).sum())


def describe(of: Estimates) -> dict[str, Any]:
    """Say how long the log is, and what is in it; the largest force is the mean of the networks' largest ones."""
    return {
        "rate_hz": 1 / step_s(of.t_s),
        "duration_s": float(of.t_s[-1] - of.t_s[0] + step_s(of.t_s)),
        "readings_n": len(of.t_s),
        "quiet_start_s": of.quiet_n * step_s(of.t_s),
        "noise_uT": of.noise_uT,
        "contact_readings_n": int(of.contact.sum()),
        "contacts_n": contacts_n(of.contact),
    } | ({"force_max_N": float(of.answers[:, of.contact, 2].max(axis=1).mean())} if of.contact.any() else {})


def score_contacts(of: Estimates, true: Float64[np.ndarray, "f 3"]) -> dict[str, Any]:
    """Score the readings found in contact; true rows are NaN where there is none, and count what was missed.

    Each network is scored by itself: scores are the mean over networks, and `spread` holds their standard deviation.
    """
    touched = np.isfinite(true[:, 2])
    both = of.contact & touched
    counts: dict[str, Any] = {
        "contacts_true_n": contacts_n(touched),
        "missed_readings_n": int((touched & ~of.contact).sum()),
        "false_readings_n": int((of.contact & ~touched).sum()),
        "force_true_max_N": float(np.nanmax(true[:, 2])),
    }
    if counts["missed_readings_n"]:
        counts["missed_force_max_N"] = float(true[touched & ~of.contact, 2].max())
    if not both.any():
        return counts
    scores = [score(true[both], answer[both]) for answer in of.answers]
    of_networks = {name: np.array([one[name] for one in scores]) for name in scores[0]}
    spread = {name: float(values.std(ddof=1)) for name, values in of_networks.items()} if len(scores) > 1 else {}
    return (
        counts
        | {name: float(values.mean()) for name, values in of_networks.items()}
        | ({"spread": spread} if spread else {})
    )


def truth_at(
    t_s: Float64[np.ndarray, " f"],
    start_s: Float64[np.ndarray, " d"],
    end_s: Float64[np.ndarray, " d"],
    true: Float[np.ndarray, "d 3"],
) -> Float64[np.ndarray, "f 3"]:
    """Give each reading what the dwell says that it lies in; NaN between dwells."""
    dwell_i = np.searchsorted(start_s, t_s, "right") - 1
    inside = (dwell_i >= 0) & (t_s <= end_s[dwell_i])
    return np.where(inside[:, None], true[dwell_i].astype(np.float64), np.nan)


def thin(of: Estimates, true: Float64[np.ndarray, "f 3"] | None) -> dict[str, Any]:
    """Keep at most 1,500 readings of the series, evenly, for figures; None where there is no contact.

    `estimated` is what the first network answers; of several networks, `low` and `high` are the least and most.
    """
    kept = np.unique(np.linspace(0, len(of.t_s) - 1, POINTS_MAX_N).astype(int))
    answers = np.where(of.contact[:, None], of.answers, np.nan)[:, kept]
    drawn: dict[str, Any] = {"t_s": np.round(of.t_s[kept], 3).tolist(), "estimated": _columns(answers[0])}
    if len(answers) > 1:
        drawn |= {"low": _columns(answers.min(axis=0)), "high": _columns(answers.max(axis=0))}
    return drawn if true is None else drawn | {"true": _columns(true[kept])}


def _columns(rows: Float64[np.ndarray, "f 3"]) -> dict[str, list[float | None]]:
    names = ("x_mm", "y_mm", "F_N")
    return {
        name: [None if np.isnan(value) else round(float(value), 2) for value in column]
        for name, column in zip(names, rows.T, strict=True)
    }
