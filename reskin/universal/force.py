"""Calibration of a skin's force: a line from estimated to true log forces, fitted to presses with known forces.

The field change of a press grows slowly with its force, about as F^0.2 to F^0.3 on recorded boards. If the field change
according to the law (`reskin.universal.law`) has an error, it therefore causes a relative error of the estimated force
that is several times as large. This error is a similar factor all over one skin. The line corrects this factor and its
growth with force.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LOG_CENTRE_N = math.log(2.0)  # log force at which the line's intercept is defined
SCATTER_LABELS_N = 20  # weight of the scatter's prior, as a number of labels
NORMAL_90 = 1.645  # half width of a 90 % interval, in standard deviations


class LinePrior(NamedTuple):
    """Prior of the line of one estimator: mean and standard deviation of intercept and slope, and the scatter."""

    mean: tuple[float, float]
    sd: tuple[float, float]
    scatter_sd: float


# Estimators of the log force, and priors of their lines. "combined" uses map and networks, "map" the map alone.
# Lines that are fitted to simulated skins have the following means and standard deviations if the errors of the law are
# as large as in training (in brackets: twice as large).
# "combined": intercept -0.1 +- 0.35 (-0.7 +- 0.6), slope 1.0 +- 0.1 (1.0 +- 0.15), scatter 0.36 (0.55).
# "map": intercept -0.3 +- 0.5 (-1.4 +- 1.1), slope 1.15 +- 0.15 (1.5 +- 0.5).
# Each prior is between the two cases. The prior mean of "combined" is (0, 1), so that forces are not changed if none is
# known.
PRIORS = {
    "combined": LinePrior((0.0, 1.0), (0.5, 0.3), 0.4),
    "map": LinePrior((-0.6, 1.2), (0.8, 0.25), 0.4),
}
ESTIMATORS = tuple(PRIORS)
# With `FEW_N` or more known forces, "map" is used unless the labels clearly favour another estimator. With fewer,
# "combined" is used, because it is more accurate on simulated skins with one known force.
FEW_N = 5
FEW_ESTIMATOR, DEFAULT = "combined", "map"
MARGIN = 3.0  # difference of the labels' log likelihoods by which an estimator must exceed the default; assumed


@dataclass(frozen=True)
class ForceLine:
    """Distribution of a skin's line, which converts estimated log forces to true ones, and the scatter about the line.

    estimator: which estimate of the log force is calibrated, one of `ESTIMATORS`. mean, cov: mean and covariance of the
    line's intercept and slope, which have a normal distribution. With c = `LOG_CENTRE_N`, the line is true log force -
    c = intercept + slope (estimated log force - c). scatter_var: variance of single log forces about the line.
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
        squared = float(
            residual @ residual + ((row @ posterior.cov) * row).sum()
        )  # expected value under the line's posterior
        scatter_var = (SCATTER_LABELS_N * self.scatter_var + squared) / (SCATTER_LABELS_N + len(residual))
        return self._update(row, deviation, scatter_var)

    def _update(self, row: Float[np.ndarray, "m 2"], deviation: Float[np.ndarray, " m"], var: float) -> "ForceLine":
        prior = np.linalg.inv(self.cov)
        cov = np.linalg.inv(prior + row.T @ row / var)
        return ForceLine(self.estimator, cov @ (prior @ self.mean + row.T @ deviation / var), cov, var)


def prior_line(estimator: str = FEW_ESTIMATOR) -> ForceLine:
    """Return the line of an estimator before any force is known."""
    prior = PRIORS[estimator]
    return ForceLine(estimator, np.array(prior.mean), np.diag(np.square(prior.sd)), prior.scatter_sd**2)


def fit_line(by_estimator: Sequence[Float[np.ndarray, " m"]], true_log_N: Float[np.ndarray, " m"]) -> ForceLine:
    """Fit the line to presses with known forces, and select the estimator.

    With fewer than `FEW_N` labels, the estimator is `FEW_ESTIMATOR`. With `FEW_N` labels or more, it is `DEFAULT`,
    unless the labels are more likely under another estimator by a factor above exp(MARGIN). For this comparison, each
    label is predicted from the other labels.

    Parameters
    ----------
    by_estimator : for each of `ESTIMATORS`, log forces that were estimated without the label of the same press
    true_log_N : true log forces of these presses
    """
    log_forces, selected = dict(zip(ESTIMATORS, by_estimator, strict=True)), FEW_ESTIMATOR
    if len(true_log_N) >= FEW_N:
        score = {name: _held_out_likelihood(name, log_N, true_log_N) for name, log_N in log_forces.items()}
        best = max(score, key=lambda name: score[name])
        selected = best if score[best] > score[DEFAULT] + MARGIN else DEFAULT
    return prior_line(selected).condition(log_forces[selected], true_log_N)


def _held_out_likelihood(estimator: str, log_N: Float[np.ndarray, " m"], true_log_N: Float[np.ndarray, " m"]) -> float:
    """Return the sum of the log likelihoods of the labels, each under the line fitted to the other labels."""
    total = 0.0
    for i in range(len(log_N)):
        others = np.arange(len(log_N)) != i
        line = prior_line(estimator).condition(log_N[others], true_log_N[others])
        mean, sd = line.apply(log_N[i : i + 1])
        total -= 0.5 * float(((true_log_N[i] - mean[0]) / sd[0]) ** 2) + math.log(sd[0])
    return total


def _row(log_N: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    return np.column_stack([np.ones(len(log_N)), log_N - LOG_CENTRE_N])
