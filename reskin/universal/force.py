"""Calibration of a skin's force: a line from estimated to true log forces, fitted to presses with known forces.

The field change of a press grows slowly with its force, about as F^0.2 to F^0.3 on recorded boards. An error of the
law therefore changes the estimated force several times as much, and by a similar factor all over one skin. The
line corrects that factor and its growth with force.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

LOG_CENTRE_N = math.log(2.0)  # log force at which the line's intercept is defined
# Standard deviations of intercept and slope about the identity, and of single log forces about the line. On 24
# simulated skins with errors of the law as in training, they are 0.33, 0.10 and 0.36; with errors twice as large, they
# are 0.70, 0.23 and 0.55. The values below are between these.
INTERCEPT_SD, SLOPE_SD, SCATTER_SD = 0.5, 0.3, 0.4
SCATTER_LABELS_N = 20  # weight of SCATTER_SD, as a number of labels
NORMAL_90 = 1.645  # half width of a 90 % interval, in standard deviations

# Estimators of the log force. "combined" (map and networks) is used if no force is known; "map" if some are known,
# unless the labels clearly favour another one. On simulated skins, both are about equally good; on the boards of scene
# lab, the map is better.
ESTIMATORS = ("combined", "map", "constant")
DEFAULT = "map"
MARGIN = 3.0  # log likelihood of the labels by which another estimator must exceed the default; assumed
FEW_N = 5  # with fewer labels, no estimator is selected, and forces are estimated by the map without labels


@dataclass(frozen=True)
class ForceLine:
    """Gaussian belief about a skin's line from an estimated log force to the true one, and the scatter about it.

    estimator: which estimate of the log force is calibrated, one of `ESTIMATORS`. mean, cov: of intercept (at
    `LOG_CENTRE_N`, minus that value) and slope. scatter_var: variance of single log forces about the line.
    """

    estimator: str
    mean: Float[np.ndarray, "2"]
    cov: Float[np.ndarray, "2 2"]
    scatter_var: float

    def apply(self, log_N: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return calibrated log forces and their standard deviations for estimated log forces."""
        row = _row(log_N)
        return LOG_CENTRE_N + row @ self.mean, np.sqrt(((row @ self.cov) * row).sum(axis=1) + self.scatter_var)

    def condition(self, log_N: Float[np.ndarray, " m"], true_log_N: Float[np.ndarray, " m"]) -> "ForceLine":
        """Condition on presses with known forces, given their estimated and true log forces."""
        row, deviation = _row(log_N), true_log_N - LOG_CENTRE_N
        posterior = self._update(row, deviation, self.scatter_var)
        residual = deviation - row @ posterior.mean
        weight = SCATTER_LABELS_N
        scatter_var = (weight * self.scatter_var + float(residual @ residual)) / (weight + len(residual))
        return self._update(row, deviation, scatter_var)

    def _update(self, row: Float[np.ndarray, "m 2"], deviation: Float[np.ndarray, " m"], var: float) -> "ForceLine":
        prior = np.linalg.inv(self.cov)
        cov = np.linalg.inv(prior + row.T @ row / var)
        return ForceLine(self.estimator, cov @ (prior @ self.mean + row.T @ deviation / var), cov, var)


def prior_line(estimator: str = "combined") -> ForceLine:
    """Return the line before any force is known: the identity, or a line of slope 0 if the estimator is constant."""
    slope, sd = (0.0, 1e-6) if estimator == "constant" else (1.0, SLOPE_SD)
    intercept_sd = 2 * INTERCEPT_SD if estimator == "constant" else INTERCEPT_SD
    scatter_sd = 1.5 * SCATTER_SD if estimator == "constant" else SCATTER_SD
    return ForceLine(estimator, np.array([0.0, slope]), np.diag([intercept_sd**2, sd**2]), scatter_sd**2)


def fit_line(by_estimator: Sequence[Float[np.ndarray, " m"]], true_log_N: Float[np.ndarray, " m"]) -> ForceLine:
    """Fit the line to presses with known forces, and select the estimator.

    The default estimator is replaced by another one if the likelihood of the labels, each predicted from the others, is
    larger by a factor of at least exp(MARGIN). With fewer than `FEW_N` labels it is not replaced.

    Parameters
    ----------
    by_estimator : for each of `ESTIMATORS`, log forces that were estimated without the label of the same press
    true_log_N : true log forces of these presses
    """
    log_forces, selected = dict(zip(ESTIMATORS, by_estimator, strict=True)), DEFAULT
    if len(true_log_N) >= FEW_N:
        score = {name: _held_out_likelihood(name, log_N, true_log_N) for name, log_N in log_forces.items()}
        best = max(score, key=lambda name: score[name])
        selected = best if score[best] > score[DEFAULT] + MARGIN else DEFAULT
    return prior_line(selected).condition(log_forces[selected], true_log_N)


def _held_out_likelihood(estimator: str, log_N: Float[np.ndarray, " m"], true_log_N: Float[np.ndarray, " m"]) -> float:
    """Return the sum of the log likelihoods of the labels, each under the line fitted to the others."""
    total = 0.0
    for i in range(len(log_N)):
        others = np.arange(len(log_N)) != i
        line = prior_line(estimator).condition(log_N[others], true_log_N[others])
        mean, sd = line.apply(log_N[i : i + 1])
        total -= 0.5 * float(((true_log_N[i] - mean[0]) / sd[0]) ** 2) + math.log(sd[0])
    return total


def _row(log_N: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    return np.column_stack([np.ones(len(log_N)), log_N - LOG_CENTRE_N])
