"""Reference methods for adaptation: fit an affine map from the inputs of one skin to the inputs of another.

Two methods need no labels: one matches the mean and the standard deviation of each channel, the other matches the
covariance of the channels (CORAL). Direct standardisation needs readings of both skins at the same places.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CORAL_RIDGE = 1.0  # added to each variance of standardised inputs (Sun, Feng & Saenko, AAAI 2016)
SD_MIN = 1e-6  # lower limit of standard deviations, which avoids a division by zero for constant channels
# Candidates for the argument `ridge` of `direct`, in units of (mean square of a channel) * (number of pairs).
RIDGES = tuple(10.0 ** np.arange(-4, 2.1, 0.5))
Inputs = Float[np.ndarray, "n c"]


@dataclass(frozen=True)
class Map:
    """The affine map (inputs - before) @ matrix + after."""

    before: Float[np.ndarray, " c"]
    matrix: Float[np.ndarray, "c c"]
    after: Float[np.ndarray, " c"]

    def __call__(self, inputs: Inputs) -> Inputs:
        """Map inputs of the source skin to inputs of the target skin."""
        return (inputs - self.before) @ self.matrix + self.after


def match_channels(source: Float[np.ndarray, "n c"], target: Float[np.ndarray, "m c"]) -> Map:
    """Fit the map that gives each channel of the source skin the mean and the standard deviation of the target skin."""
    return Map(source.mean(axis=0), np.diag(_sd(target) / _sd(source)), target.mean(axis=0))


def coral(source: Float[np.ndarray, "n c"], target: Float[np.ndarray, "m c"], ridge: float = CORAL_RIDGE) -> Map:
    """Fit the map that gives inputs of the source skin the covariance and the mean of the target skin (CORAL).

    Let C_source and C_target be the covariances of both skins' inputs in units of the standard deviations of `source`,
    with `ridge` times the identity added to each. In these units, the matrix of the map is C_source^-1/2 C_target^1/2.
    """
    scale = _sd(source)
    covariances = [np.cov(side / scale, rowvar=False) + ridge * np.eye(source.shape[1]) for side in (source, target)]
    matrix = _power(covariances[0], -0.5) @ _power(covariances[1], 0.5)
    return Map(source.mean(axis=0), matrix / scale[:, None] * scale, target.mean(axis=0))


def direct(source: Float[np.ndarray, "p c"], target: Float[np.ndarray, "p c"], ridge: float) -> Map:
    """Fit a linear map to p pairs of inputs at the same places (direct standardisation, Wang & Kowalski 1991).

    The map is the identity plus a ridge regression of the difference between the two inputs of a pair. It therefore
    leaves inputs unchanged in directions without data. The map has no constant term, because the field change without
    contact is zero for any skin.
    """
    origin = np.zeros(source.shape[1])
    gain = np.linalg.solve(source.T @ source + _penalty(source, ridge), source.T @ (target - source))
    return Map(origin, np.eye(source.shape[1]) + gain, origin)


def choose_ridge(source: Float[np.ndarray, "p c"], target: Float[np.ndarray, "p c"]) -> float:
    """Choose the ridge of `direct` by leave-one-out cross-validation over the pairs."""

    def error(ridge: float) -> float:
        leverage = source @ np.linalg.solve(source.T @ source + _penalty(source, ridge), source.T)
        residual = (target - source) - leverage @ (target - source)
        return float(((residual / (1 - np.diag(leverage))[:, None]) ** 2).sum())

    return min(RIDGES, key=error)


def _penalty(source: Float[np.ndarray, "p c"], ridge: float) -> Float[np.ndarray, "c c"]:
    return ridge * (source**2).sum() / source.shape[1] * np.eye(source.shape[1])


def _sd(inputs: Inputs) -> Float[np.ndarray, " c"]:
    return np.maximum(inputs.std(axis=0, ddof=1), SD_MIN)


def _power(symmetric: Float[np.ndarray, "c c"], exponent: float) -> Float[np.ndarray, "c c"]:
    values, vectors = np.linalg.eigh(symmetric)
    return vectors * values**exponent @ vectors.T
