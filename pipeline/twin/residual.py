"""What a law misses on boards that it was fitted on, carried to other boards of the rig: pokes -> relative errors.

Boards share a good half of it (cosine 0.45 to 0.62 between two recorded ones). Refuses to know laws and numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Relative = Float[np.ndarray, "n ch"]  # of |dB|
LENGTH_MM, LENGTH_LOG_N = 3.0, 1.2  # over which errors are alike: their correlation is 0.74 at 2 mm and 0.2 at 6 mm
NOISE = 0.1  # of the variance, between pokes at one place
SHARED = 0.55  # of the variance, between boards
EVEN = 0.5  # of the covariance between channels is taken as the same for all: the errors of a few boards are few


@dataclass(frozen=True)
class Residual:
    """Relative errors of the law that a further board is expected to have, from those of known boards."""

    place_mm: Float[np.ndarray, "m 2"]
    log_N: Float[np.ndarray, " m"]
    solved: Float[np.ndarray, "m ch"]
    share: Float[np.ndarray, "ch ch"]  # of the errors' covariance between channels; a trace of 1
    noise: float

    def at(self, place_mm: Float[np.ndarray, "n 2"], log_N: Float[np.ndarray, " n"]) -> Relative:
        """Give the errors expected at places under forces."""
        return SHARED * kernel(place_mm, self.place_mm, log_N, self.log_N) @ self.solved


def no_residual(channels_n: int) -> Residual:
    """Expect no error anywhere, and as much uncertainty in every channel."""
    none = np.empty((0, 2)), np.empty(0), np.empty((0, channels_n))
    return Residual(*none, np.eye(channels_n) / channels_n, noise=NOISE / 2)


def carry(
    place_mm: Sequence[Float[np.ndarray, "b 2"]],
    force_N: Sequence[Float[np.ndarray, " b"]],
    missed: Sequence[Float[np.ndarray, "b ch"]],
) -> Residual:
    """Split the errors of boards into what they share and each one's own; carry what they share.

    A Gaussian process: of one board, it expects `SHARED` of that board's errors; of many, nearly their mean.
    """
    board_i = np.repeat(np.arange(len(missed)), [len(one) for one in missed])
    at_mm, log_N, off = np.concatenate(place_mm), np.log(np.concatenate(force_N)), np.concatenate(missed)
    alike = np.where(board_i[:, None] == board_i, 1.0, SHARED)
    cov = alike * kernel(at_mm, at_mm, log_N, log_N) + NOISE * np.eye(len(off))
    between, channels_n = off.T @ off, off.shape[1]
    even = np.eye(channels_n) / channels_n
    share = EVEN * even + (1 - EVEN) * between / np.trace(between)
    return Residual(at_mm, log_N, np.linalg.solve(cov, off), share, noise=NOISE / 2)


def kernel(
    a_mm: Float[np.ndarray, "n 2"], b_mm: Float[np.ndarray, "m 2"], a_log_N: Float[np.ndarray, " n"],
    b_log_N: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "n m"]:  # fmt: skip
    """Give how alike errors are: squared exponential over place and logarithm of force."""
    apart_mm2 = ((a_mm[:, None] - b_mm[None]) ** 2).sum(axis=2)
    apart_log2 = (a_log_N[:, None] - b_log_N[None]) ** 2
    return np.exp(-apart_mm2 / (2 * LENGTH_MM**2) - apart_log2 / (2 * LENGTH_LOG_N**2))
