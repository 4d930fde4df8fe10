"""Alignment of skins: inputs of one skin beside those of others -> a linear map between them, in closed form.

By channels' means and deviations, or all their covariances, which need no label; or by pairs at the same places, which
do. Refuses to know regressors, skins and folds.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CORAL_RIDGE = 1.0  # added to every variance of standardised inputs, as Sun, Feng & Saenko (AAAI 2016) do
SD_MIN = 1e-6  # a channel that is constant is moved, not stretched
RIDGES = tuple(10.0 ** np.arange(-4, 2.1, 0.5))  # of the mean square of a channel, times the number of pairs
Inputs = Float[np.ndarray, "n c"]


@dataclass(frozen=True)
class Map:
    """Inputs less `before`, times `matrix`, plus `after`."""

    before: Float[np.ndarray, " c"]
    matrix: Float[np.ndarray, "c c"]
    after: Float[np.ndarray, " c"]

    def __call__(self, inputs: Inputs) -> Inputs:
        """Move inputs of the one skin to where the other's lie."""
        return (inputs - self.before) @ self.matrix + self.after


def match_channels(of: Float[np.ndarray, "n c"], to: Float[np.ndarray, "m c"]) -> Map:
    """Give each channel the mean and the standard deviation that it has on the other skin."""
    return Map(of.mean(axis=0), np.diag(_sd(to) / _sd(of)), to.mean(axis=0))


def coral(of: Float[np.ndarray, "n c"], to: Float[np.ndarray, "m c"], ridge: float = CORAL_RIDGE) -> Map:
    """Whiten inputs and colour them with the other skin's covariance, means matched too (CORAL).

    In units of the first skin's deviations: C_of^-1/2 C_to^1/2, each C plus `ridge` times the identity.
    """
    scale = _sd(of)
    covariances = [np.cov(side / scale, rowvar=False) + ridge * np.eye(of.shape[1]) for side in (of, to)]
    matrix = _power(covariances[0], -0.5) @ _power(covariances[1], 0.5)
    return Map(of.mean(axis=0), matrix / scale[:, None] * scale, to.mean(axis=0))


def direct(of: Float[np.ndarray, "p c"], to: Float[np.ndarray, "p c"], ridge: float) -> Map:
    """Find the linear map that takes a few inputs to their pairs (direct standardisation, Wang & Kowalski 1991).

    Ridge regression of what pairs differ by, so that what no pair tells stays as it is; no constant, as no contact is
    no change on any skin.
    """
    none = np.zeros(of.shape[1])
    gain = np.linalg.solve(of.T @ of + _held(of, ridge), of.T @ (to - of))
    return Map(none, np.eye(of.shape[1]) + gain, none)


def choose_ridge(of: Float[np.ndarray, "p c"], to: Float[np.ndarray, "p c"]) -> float:
    """Choose the ridge of `direct` that errs least on pairs left out one by one: no row but the pairs is looked at."""

    def error(ridge: float) -> float:
        hat = of @ np.linalg.solve(of.T @ of + _held(of, ridge), of.T)
        off = (to - of) - hat @ (to - of)
        return float(((off / (1 - np.diag(hat))[:, None]) ** 2).sum())

    return min(RIDGES, key=error)


def _held(of: Float[np.ndarray, "p c"], ridge: float) -> Float[np.ndarray, "c c"]:
    return ridge * (of**2).sum() / of.shape[1] * np.eye(of.shape[1])


def _sd(inputs: Inputs) -> Float[np.ndarray, " c"]:
    return np.maximum(inputs.std(axis=0, ddof=1), SD_MIN)


def _power(symmetric: Float[np.ndarray, "c c"], exponent: float) -> Float[np.ndarray, "c c"]:
    values, vectors = np.linalg.eigh(symmetric)
    return vectors * values**exponent @ vectors.T
