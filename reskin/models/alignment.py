"""Adapt a model to a new skin by converting the new skin's inputs, instead of changing the model.

These methods are compared with the paper's adaptation. They fit an affine map from the inputs of one skin (the source)
to the inputs of another skin (the target). Two methods need no labels: `match_channels` matches the mean and the
standard deviation of each channel, and `coral` matches the covariance of the channels. The third method, `direct`
(direct standardisation), needs readings of both skins at the same places.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CORAL_RIDGE = 1.0  # number that is added to each variance of the standardised inputs (Sun, Feng & Saenko, AAAI 2016)
SD_MIN = 1e-6  # lower limit of standard deviations, which avoids a division by zero for constant channels
# Candidates for the argument `ridge` of `direct`. The penalty is this number, times the mean square of a channel, times
# the number of pairs.
RIDGES = tuple(10.0 ** np.arange(-4, 2.1, 0.5))
Inputs = Float[np.ndarray, "n c"]


@dataclass(frozen=True)
class Map:
    """An affine map, which converts inputs to (inputs - before) @ matrix + after."""

    before: Float[np.ndarray, " c"]
    matrix: Float[np.ndarray, "c c"]
    after: Float[np.ndarray, " c"]

    def __call__(self, inputs: Inputs) -> Inputs:
        """Map inputs of the source skin to inputs of the target skin."""
        return (inputs - self.before) @ self.matrix + self.after


def match_channels(source: Float[np.ndarray, "n c"], target: Float[np.ndarray, "m c"]) -> Map:
    """Fit the map after which each channel of the source skin has the same mean and standard deviation as the target's.

    Each channel is shifted and scaled separately.
    """
    return Map(source.mean(axis=0), np.diag(_sd(target) / _sd(source)), target.mean(axis=0))


def coral(source: Float[np.ndarray, "n c"], target: Float[np.ndarray, "m c"], ridge: float = CORAL_RIDGE) -> Map:
    """Fit the map after which the source skin's inputs have the same mean and covariance as the target's (CORAL).

    The inputs of both skins are divided by the standard deviations of `source`. Let C_source and C_target be the
    covariance matrices of these inputs, after `ridge` times the identity was added to each. In these units, the matrix
    of the map is C_source^-1/2 C_target^1/2. Because of the ridge, the covariances match only approximately.
    """
    scale = _sd(source)
    covariances = [np.cov(side / scale, rowvar=False) + ridge * np.eye(source.shape[1]) for side in (source, target)]
    matrix = _power(covariances[0], -0.5) @ _power(covariances[1], 0.5)
    return Map(source.mean(axis=0), matrix / scale[:, None] * scale, target.mean(axis=0))


def direct(source: Float[np.ndarray, "p c"], target: Float[np.ndarray, "p c"], ridge: float) -> Map:
    """Fit a linear map to p pairs of inputs (direct standardisation, Wang & Kowalski 1991).

    A pair consists of an input of each skin at the same place. The map is the identity plus a correction. The
    correction is a ridge regression of the difference between the two inputs of a pair. In directions without data,
    the ridge keeps the correction at zero, so that the map leaves inputs unchanged. The map has no constant term,
    because the field change without contact is zero for any skin.
    """
    origin = np.zeros(source.shape[1])
    gain = np.linalg.solve(source.T @ source + _penalty(source, ridge), source.T @ (target - source))
    return Map(origin, np.eye(source.shape[1]) + gain, origin)


def choose_ridge(source: Float[np.ndarray, "p c"], target: Float[np.ndarray, "p c"]) -> float:
    """Choose the argument `ridge` of `direct` from `RIDGES`, by leave-one-out cross-validation over the pairs."""

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
