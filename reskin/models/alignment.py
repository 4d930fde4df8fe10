"""Reference methods for adaptation that align two skins by a linear map in closed form.

Matching the mean and the standard deviation of each channel, or the covariance of the channels (CORAL), needs no
labels. Direct standardisation needs pairs of readings at the same places.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CORAL_RIDGE = 1.0  # added to every variance of standardised inputs (Sun, Feng & Saenko, AAAI 2016)
SD_MIN = 1e-6  # lower limit of standard deviations, so that a constant channel can be divided by it
RIDGES = tuple(10.0 ** np.arange(-4, 2.1, 0.5))  # in units of (mean square of a channel) * (number of pairs)
Inputs = Float[np.ndarray, "n c"]


@dataclass(frozen=True)
class Map:
    """The affine map (inputs - before) @ matrix + after."""

    before: Float[np.ndarray, " c"]
    matrix: Float[np.ndarray, "c c"]
    after: Float[np.ndarray, " c"]

    def __call__(self, inputs: Inputs) -> Inputs:
        """Map inputs of skin `of` to inputs of skin `to`."""
        return (inputs - self.before) @ self.matrix + self.after


def match_channels(of: Float[np.ndarray, "n c"], to: Float[np.ndarray, "m c"]) -> Map:
    """Fit the map that matches the mean and the standard deviation of each channel."""
    return Map(of.mean(axis=0), np.diag(_sd(to) / _sd(of)), to.mean(axis=0))


def coral(of: Float[np.ndarray, "n c"], to: Float[np.ndarray, "m c"], ridge: float = CORAL_RIDGE) -> Map:
    """Fit the map that whitens inputs, recolours them with the other skin's covariance, and matches the means (CORAL).

    With both skins in units of the standard deviations of `of`, the matrix is C_of^-1/2 C_to^1/2, where `ridge` times
    the identity is added to each covariance C.
    """
    scale = _sd(of)
    covariances = [np.cov(side / scale, rowvar=False) + ridge * np.eye(of.shape[1]) for side in (of, to)]
    matrix = _power(covariances[0], -0.5) @ _power(covariances[1], 0.5)
    return Map(of.mean(axis=0), matrix / scale[:, None] * scale, to.mean(axis=0))


def direct(of: Float[np.ndarray, "p c"], to: Float[np.ndarray, "p c"], ridge: float) -> Map:
    """Fit the linear map from inputs to paired inputs of another skin (direct standardisation, Wang & Kowalski 1991).

    The map is the identity plus a ridge regression of the differences within pairs, so that it is the identity in
    directions without data. There is no constant term, because without contact the field change of every skin is zero.
    """
    none = np.zeros(of.shape[1])
    gain = np.linalg.solve(of.T @ of + _penalty(of, ridge), of.T @ (to - of))
    return Map(none, np.eye(of.shape[1]) + gain, none)


def choose_ridge(of: Float[np.ndarray, "p c"], to: Float[np.ndarray, "p c"]) -> float:
    """Choose the ridge of `direct` by leave-one-out cross-validation over the pairs."""

    def error(ridge: float) -> float:
        hat = of @ np.linalg.solve(of.T @ of + _penalty(of, ridge), of.T)
        off = (to - of) - hat @ (to - of)
        return float(((off / (1 - np.diag(hat))[:, None]) ** 2).sum())

    return min(RIDGES, key=error)


def _penalty(of: Float[np.ndarray, "p c"], ridge: float) -> Float[np.ndarray, "c c"]:
    return ridge * (of**2).sum() / of.shape[1] * np.eye(of.shape[1])


def _sd(inputs: Inputs) -> Float[np.ndarray, " c"]:
    return np.maximum(inputs.std(axis=0, ddof=1), SD_MIN)


def _power(symmetric: Float[np.ndarray, "c c"], exponent: float) -> Float[np.ndarray, "c c"]:
    values, vectors = np.linalg.eigh(symmetric)
    return vectors * values**exponent @ vectors.T
