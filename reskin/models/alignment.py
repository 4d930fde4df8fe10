"""Alignment of two skins by a linear map in closed form: reference methods for adaptation.

Matching the means and standard deviations of channels, or their covariance (CORAL), needs no labels; direct
standardisation needs pairs of readings at the same places.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

CORAL_RIDGE = 1.0  # added to every variance of standardised inputs (Sun, Feng & Saenko, AAAI 2016)
SD_MIN = 1e-6  # a constant channel is shifted, not scaled
RIDGES = tuple(10.0 ** np.arange(-4, 2.1, 0.5))  # in units of a channel's mean square times the number of pairs
Inputs = Float[np.ndarray, "n c"]


@dataclass(frozen=True)
class Map:
    """The affine map (inputs - before) @ matrix + after."""

    before: Float[np.ndarray, " c"]
    matrix: Float[np.ndarray, "c c"]
    after: Float[np.ndarray, " c"]

    def __call__(self, inputs: Inputs) -> Inputs:
        """Map inputs of the first skin to those of the second."""
        return (inputs - self.before) @ self.matrix + self.after


def match_channels(of: Float[np.ndarray, "n c"], to: Float[np.ndarray, "m c"]) -> Map:
    """Match the mean and the standard deviation of every channel."""
    return Map(of.mean(axis=0), np.diag(_sd(to) / _sd(of)), to.mean(axis=0))


def coral(of: Float[np.ndarray, "n c"], to: Float[np.ndarray, "m c"], ridge: float = CORAL_RIDGE) -> Map:
    """Whiten inputs and colour them with the other skin's covariance, and match the means (CORAL).

    In units of the first skin's standard deviations, the matrix is C_of^-1/2 C_to^1/2, where `ridge` times the identity
    is added to each covariance C.
    """
    scale = _sd(of)
    covariances = [np.cov(side / scale, rowvar=False) + ridge * np.eye(of.shape[1]) for side in (of, to)]
    matrix = _power(covariances[0], -0.5) @ _power(covariances[1], 0.5)
    return Map(of.mean(axis=0), matrix / scale[:, None] * scale, to.mean(axis=0))


def direct(of: Float[np.ndarray, "p c"], to: Float[np.ndarray, "p c"], ridge: float) -> Map:
    """Fit the linear map from a few inputs to the paired inputs (direct standardisation, Wang & Kowalski 1991).

    This is ridge regression of the differences within pairs, so that directions without data are left unchanged. There
    is no constant term, because without contact the field change is zero on any skin.
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
