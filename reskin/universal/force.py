"""Calibration of the forces of a skin: a straight line from estimated to true forces, on logarithmic scales.

The field change of a press grows slowly with its force F, about as F^0.2 to F^0.3 on recorded boards. Therefore, if
the simulated field change (`reskin.universal.law`) has a small relative error, the relative error of the estimated
force is several times as large. The estimated forces of one skin are all wrong by a similar factor, which changes
slowly with force. The line corrects this factor. It is fitted to presses with known forces.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LOG_CENTRE_N = math.log(2.0)  # logarithm of the force at which the intercept of the line is defined
SCATTER_LABELS_N = 20  # the prior of the scatter about the line has the same weight as this number of labels
NORMAL_90 = 1.645  # half width of a 90 % interval, in standard deviations


class LinePrior(NamedTuple):
    """Prior of the line for one estimator.

    `mean` and `sd` are the means and standard deviations of the intercept and the slope. `scatter_sd` is the standard
    deviation of log forces about the line.
    """

    mean: tuple[float, float]
    sd: tuple[float, float]
    scatter_sd: float


# Two estimators of the log force, each with the prior of its line: "combined" uses map and networks, "map" uses the map
# alone. Lines were fitted to simulated skins with errors of the law as large as in training, and to skins with errors
# twice as large. They have the following means and standard deviations, with those for doubled errors in brackets:
# "combined": intercept -0.1 +- 0.35 (-0.7 +- 0.6), slope 1.0 +- 0.1 (1.0 +- 0.15), scatter 0.36 (0.55).
# "map": intercept -0.3 +- 0.5 (-1.4 +- 1.1), slope 1.15 +- 0.15 (1.5 +- 0.5).
# The prior of "map" is between the two cases. The prior of "combined" has a mean intercept of 0 and a mean slope of 1,
# so that forces are not changed as long as no force is known.
PRIORS = {
    "combined": LinePrior((0.0, 1.0), (0.5, 0.3), 0.4),
    "map": LinePrior((-0.6, 1.2), (0.8, 0.25), 0.4),
}
ESTIMATORS = tuple(PRIORS)
# With `FEW_N` or more known forces, the estimator "map" is used, unless the labels clearly favour another estimator.
# With fewer known forces, "combined" is used, because it is more accurate on simulated skins with one known force.
FEW_N = 5
FEW_ESTIMATOR, DEFAULT = "combined", "map"
# Another estimator than the default is selected only if the log likelihood of the labels is larger by more than this
# assumed value.
MARGIN = 3.0


@dataclass(frozen=True)
class ForceLine:
    """The line that converts the estimated log forces of one skin to true log forces, and its uncertainty.

    With c = `LOG_CENTRE_N`, the line is

        true log force - c = intercept + slope * (estimated log force - c).

    Parameters
    ----------
    estimator : the estimator whose log forces the line converts, one of `ESTIMATORS`
    mean, cov : mean and covariance of intercept and slope, which have a normal distribution
    scatter_var : variance of the true log force of a single press about the line
    """

    estimator: str
    mean: Float[np.ndarray, "2"]
    cov: Float[np.ndarray, "2 2"]
    scatter_var: float

    def apply(self, log_N: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Convert estimated log forces to calibrated log forces. Returns these and their standard deviations."""
        # Written without matrix products, because this is faster for a single reading.
        (intercept, slope), off = self.mean, log_N - LOG_CENTRE_N
        var = self.cov[0, 0] + self.scatter_var + off * (2 * self.cov[0, 1] + off * self.cov[1, 1])
        return LOG_CENTRE_N + intercept + slope * off, np.sqrt(var)

    def condition(self, log_N: Float[np.ndarray, " m"], true_log_N: Float[np.ndarray, " m"]) -> "ForceLine":
        """Condition the line on presses with known forces.

        Parameters
        ----------
        log_N : estimated log forces of the presses
        true_log_N : true log forces of the presses
        """
        row, deviation = _row(log_N), true_log_N - LOG_CENTRE_N
        posterior = self._update(row, deviation, self.scatter_var)
        residual = deviation - row @ posterior.mean
        # The sum of the squared residuals, as an expected value over the posterior distribution of the line.
        squared = float(residual @ residual + ((row @ posterior.cov) * row).sum())
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
    """Select the estimator, and fit its line to presses with known forces.

    With fewer than `FEW_N` known forces, the estimator is `FEW_ESTIMATOR`. Otherwise, it is `DEFAULT`, unless the known
    forces are more likely under another estimator by a factor above exp(`MARGIN`). For this comparison, each known
    force is predicted with the line that is fitted to the other known forces.

    Parameters
    ----------
    by_estimator : log forces of the presses, once for each of `ESTIMATORS`. The log force of a press must have been
        estimated by a model that is not calibrated to the label of this press.
    true_log_N : true log forces of the presses
    """
    log_forces, selected = dict(zip(ESTIMATORS, by_estimator, strict=True)), FEW_ESTIMATOR
    if len(true_log_N) >= FEW_N:
        score = {name: _held_out_likelihood(name, log_N, true_log_N) for name, log_N in log_forces.items()}
        best = max(score, key=lambda name: score[name])
        selected = best if score[best] > score[DEFAULT] + MARGIN else DEFAULT
    return prior_line(selected).condition(log_forces[selected], true_log_N)


def _held_out_likelihood(estimator: str, log_N: Float[np.ndarray, " m"], true_log_N: Float[np.ndarray, " m"]) -> float:
    """Return the log likelihood of the known forces by leave-one-out cross-validation.

    This is a sum over presses. Each term is the log likelihood of one known force under the line that is fitted to all
    other known forces.
    """
    total = 0.0
    for i in range(len(log_N)):
        others = np.arange(len(log_N)) != i
        line = prior_line(estimator).condition(log_N[others], true_log_N[others])
        mean, sd = line.apply(log_N[i : i + 1])
        total -= 0.5 * float(((true_log_N[i] - mean[0]) / sd[0]) ** 2) + math.log(sd[0])
    return total


def _row(log_N: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    return np.column_stack([np.ones(len(log_N)), log_N - LOG_CENTRE_N])
