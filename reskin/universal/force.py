"""The force of a press in newtons, from the estimate of the network and the known forces of labelled presses.

The network estimates logarithms of forces. A skin may be softer than usual, and its force may grow in another way than
that of simulated skins. `ForceHead` therefore corrects the estimates with a Gaussian process in newtons, which is
fitted to the known forces of a skin.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from reskin.universal.network import LENGTH_MIN_uT

# The Gaussian process is the error of the network's estimates. It is a sum of three parts with these standard
# deviations: an unknown fraction of the estimate, a smooth function of the field change, and noise. All but the first
# are relative to the spread of the known forces. They were chosen on simulated skins whose law errs as recorded ones.
SCALE_SD, OF_FIELD_SD, NOISE_SD = 0.4, 0.4, 0.7
# Length scale of the smooth function, and weights of the direction and of log |dB| in the distance of field changes.
FIELD_LENGTH, DIRECTION_WEIGHT, LOG_WEIGHT = 2.0, 3.0, 2.0
# Forces are limited to this range, relative to the smallest and the largest known force, if there are at least LIMIT_N
# known forces and they span at least the factor SPAN_MIN: beyond it, nothing is known of this skin.
RANGE, LIMIT_N, SPAN_MIN = (0.9, 1.1), 8, 3.0
LEAST_N, LOG_MAX_N = 0.01, float(np.log(40.0))  # smaller forces are not estimated; larger estimates count as 40 N
FLOOR = 0.3  # errors are assumed to grow with force, from this fraction of the mean known force on
PRIOR_N, PRIOR_SPREAD = 3, 0.7  # before any force is known, the spread of forces is this fraction of their mean
QUANTILE, NORMAL_90 = 0.9, 1.645  # 90 % of a normal distribution are within 1.645 standard deviations


def conformal(scores: Float[np.ndarray, " n"]) -> float:
    """Return the factor that 90 % of new scores do not exceed, from held-out scores (split conformal prediction)."""
    rank = min(int(np.ceil((len(scores) + 1) * QUANTILE)), len(scores))
    return float(np.sort(scores)[rank - 1])


@dataclass(frozen=True)
class ForceHead:
    """The correction of forces, fitted to the known forces of one skin.

    Parameters
    ----------
    estimated_N : forces of the labelled presses, estimated without knowing their labels
    features : features of their field changes (see `features_of`)
    weights : weights of the labelled presses in the correction of an estimate, in N
    mean_N, spread_N : mean and spread of the known forces
    limits_N : range of the forces that the head returns
    error : 90 % of held-out errors are at most this factor times the force (or FLOOR times `mean_N`, if larger)
    """

    estimated_N: Float[np.ndarray, " m"]
    features: Float[np.ndarray, "m k"]
    weights: Float[np.ndarray, " m"]
    mean_N: float
    spread_N: float
    limits_N: tuple[float, float]
    error: float

    @classmethod
    def fit(
        cls, log_N: Float[np.ndarray, " m"], db_uT: Float[np.ndarray, "m ch"], known_N: Float[np.ndarray, " m"]
    ) -> "ForceHead":
        """Fit a head to one or more known forces.

        Parameters
        ----------
        log_N : the network's estimates of the logarithms of these forces, made without knowing them
        db_uT : field changes of these presses
        known_N : the forces
        """
        n, mean_N = len(known_N), float(known_N.mean())
        estimated_N, features = np.exp(np.minimum(log_N, LOG_MAX_N)), features_of(db_uT)
        squares_N2 = known_N.var() * n + PRIOR_N * (PRIOR_SPREAD * mean_N) ** 2
        spread_N = float(np.sqrt(squares_N2 / (n + PRIOR_N)))
        covariance = _covariance(estimated_N / spread_N, estimated_N / spread_N, features, features)
        inverse = cho_solve(cho_factor(covariance + NOISE_SD**2 * np.eye(n)), np.eye(n))
        weights = inverse @ (known_N - estimated_N)
        wide = n >= LIMIT_N and known_N.max() >= SPAN_MIN * known_N.min()
        limits_N = (RANGE[0] * float(known_N.min()), RANGE[1] * float(known_N.max())) if wide else (LEAST_N, np.inf)
        held_out_N = np.clip(known_N - weights / np.diag(inverse), *limits_N)  # leave-one-out estimates in closed form
        error = conformal(np.abs(held_out_N - known_N) / np.maximum(held_out_N, FLOOR * mean_N))
        return cls(estimated_N, features, weights, mean_N, spread_N, limits_N, error)

    def force_N(self, log_N: Float[np.ndarray, " n"], db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, " n"]:
        """Correct the network's estimates."""
        estimated_N = np.exp(np.minimum(log_N, LOG_MAX_N))
        scaled = estimated_N / self.spread_N, self.estimated_N / self.spread_N
        correction_N = _covariance(*scaled, features_of(db_uT), self.features) @ self.weights
        return np.clip(estimated_N + correction_N, *self.limits_N)

    def sd_N(self, force_N: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the standard deviations of forces: 1.645 of them are the half width of 90 % intervals."""
        return self.error / NORMAL_90 * np.maximum(force_N, FLOOR * self.mean_N)


def features_of(db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n k"]:
    """Return the features of field changes whose distances the Gaussian process uses: direction, and log |dB|."""
    length_uT = np.maximum(np.sqrt((db_uT**2).sum(axis=1, keepdims=True)), LENGTH_MIN_uT)
    return np.concatenate([DIRECTION_WEIGHT * db_uT / length_uT, LOG_WEIGHT * np.log(length_uT)], axis=1)


def _covariance(
    scaled: Float[np.ndarray, " n"], others_scaled: Float[np.ndarray, " m"], features: Float[np.ndarray, "n k"],
    others: Float[np.ndarray, "m k"],
) -> Float[np.ndarray, "n m"]:  # fmt: skip
    apart2 = (features**2).sum(axis=1)[:, None] + (others**2).sum(axis=1) - 2 * features @ others.T
    of_field = np.exp(apart2 * (-0.5 / FIELD_LENGTH**2))
    return SCALE_SD**2 * np.multiply.outer(scaled, others_scaled) + OF_FIELD_SD**2 * of_field
