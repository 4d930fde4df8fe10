"""Presses of a recorded board: mean field changes and noise; agreement with a simulation, growth and memory."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from reskin.errors import SchemaError
from reskin.schema import AXES_PER_CHIP_N, Readings

# Degree of the polynomial for drift. On scene lab, degree 8 gives a memory that is a tenth smaller, and degree 12 half
# of it, because the polynomial fits the memory.
DRIFT_DEGREE = 4
SERIES_MIN_N = 20  # least number of presses in a capture, to estimate the memory
SPREAD_MIN = 0.2  # least range of log F at a place, to estimate the growth


@dataclass(frozen=True)
class RecordedPresses:
    """Presses of one skin on its board, each the mean of its readings; fields in the chips' axes.

    group_i: index of the group, which is a capture or, if depths are known, one depth of a capture.
    """

    board: str
    groups: tuple[str, ...]
    group_i: Int[np.ndarray, " n"]
    capture_i: Int[np.ndarray, " n"]
    place_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    db_uT: Float[np.ndarray, "n k 3"]
    noload_uT: Float[np.ndarray, "n k 3"]
    noise_uT: Float[np.ndarray, "3"]  # standard deviation of a reading about the mean of its press, by axis
    excluded_n: int  # presses without a known place or a force above 0 N

    def __len__(self) -> int:
        return len(self.force_N)


def pool(captures: Sequence[Readings]) -> RecordedPresses:
    """Pool the presses of all captures of one skin on one board, in order."""
    parts = [_means(one) for one in captures]
    capture_i = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    groups, group_i = np.unique(np.concatenate([part[0] for part in parts]), return_inverse=True)
    place_mm, force_N, db_uT, noload_uT, var_uT2 = (
        np.concatenate([part[i] for part in parts]).astype(float) for i in range(1, 6)
    )
    known = np.isfinite(place_mm).all(axis=1) & (force_N > 0)
    if not known.any():
        what = f"board {captures[0].board} has no press with a known place and force"
        raise SchemaError(f"experiment compare: {what}. Record both, or remove the experiment from the scene's.")
    return RecordedPresses(
        board=captures[0].board, groups=tuple(groups.tolist()), group_i=group_i.ravel()[known],
        capture_i=capture_i[known],
        place_mm=place_mm[known], force_N=force_N[known], db_uT=db_uT[known], noload_uT=noload_uT[known],
        noise_uT=np.sqrt(np.nanmean(var_uT2, axis=(0, 1))), excluded_n=int((~known).sum()),
    )  # fmt: skip


def _means(one: Readings) -> tuple[np.ndarray, ...]:
    """Return for each press: group, place, force, field change, no-load field, variance of a reading."""
    _, first, press_i, counts = np.unique(one.indentation, return_index=True, return_inverse=True, return_counts=True)
    chips = (len(first), one.chips_n, AXES_PER_CHIP_N)

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.zeros((len(first), *values.shape[1:]))
        np.add.at(total, press_i.ravel(), values)
        return total / counts.reshape(-1, *[1] * (values.ndim - 1))

    b_uT, noload_uT = one.b_uT.astype(float), one.noload_uT[first].astype(float)
    mean_uT = mean(b_uT)
    with np.errstate(divide="ignore", invalid="ignore"):  # a single reading has no variance
        var_uT2 = mean((b_uT - mean_uT[press_i.ravel()]) ** 2) * (counts / (counts - 1))[:, None]
    depths_mm = one.depth_mm[first]
    group = [one.capture + (f" {mm:g} mm" if np.isfinite(mm) else "") for mm in depths_mm]
    place_mm = np.stack([one.x_mm[first], one.y_mm[first]], axis=1)
    fields = [values.reshape(chips) for values in (mean_uT - noload_uT, noload_uT, var_uT2)]
    return np.array(group), place_mm, mean(one.Fz_N.astype(float)), *fields


def lengths_uT(db_uT: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, " n"]:
    """Return |dB| over all channels."""
    return np.linalg.norm(db_uT.reshape(len(db_uT), -1), axis=1)


def cosines(one_uT: Float[np.ndarray, "n k 3"], other_uT: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, " n"]:
    """Return for each press the cosine between two field changes over all channels."""
    return (one_uT * other_uT).sum(axis=(1, 2)) / (lengths_uT(one_uT) * lengths_uT(other_uT))


def explained(simulated_uT: Float[np.ndarray, "n k 3"], recorded_uT: Float[np.ndarray, "n k 3"]) -> np.ndarray:
    """Return for each press the explained part of the recorded change: 1 - |sim - rec|^2 / |rec|^2."""
    return 1 - (lengths_uT(simulated_uT - recorded_uT) / lengths_uT(recorded_uT)) ** 2


def growth(presses: RecordedPresses, db_uT: Float[np.ndarray, "n k 3"]) -> float | None:
    """Return the median over places of d log|dB| / d log F; None if the force does not vary at any place."""
    log_F, log_uT = np.log(presses.force_N), np.log(lengths_uT(db_uT))
    slopes = []
    for place in np.unique(presses.place_mm.round(2), axis=0):
        here: Bool[np.ndarray, " n"] = (np.abs(presses.place_mm - place) < 0.01).all(axis=1)
        x, y = log_F[here] - log_F[here].mean(), log_uT[here] - log_uT[here].mean()
        if np.ptp(x) > SPREAD_MIN:
            slopes.append(float(x @ y / (x @ x)))
    return float(np.median(slopes)) if slopes else None


def memory(
    presses: RecordedPresses, db_uT: Float[np.ndarray, "n k 3"], noload_uT: Float[np.ndarray, "n k 3"]
) -> float | None:
    """Return the part of a press's field change that remains in the next no-load reading, as the mean over captures.

    Least squares with the field change of the following press and a polynomial for drift as further regressors. None if
    all captures are too short.
    """
    found = []
    for capture_i in np.unique(presses.capture_i):
        own = np.flatnonzero(presses.capture_i == capture_i)
        rest = noload_uT[own].reshape(len(own), -1)
        if len(own) < SERIES_MIN_N or (np.diff(rest, axis=0) == 0).all(axis=1).any():
            continue  # no-load readings were not taken before each press
        drift = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(own) - 1), DRIFT_DEGREE)
        db = db_uT[own].reshape(len(own), -1)
        left = [part - drift @ np.linalg.lstsq(drift, part)[0] for part in (rest[1:], db[:-1], db[1:])]
        found.append(np.linalg.lstsq(np.stack([left[1].ravel(), left[2].ravel()], axis=1), left[0].ravel())[0][0])
    return float(np.mean(found)) if found else None
