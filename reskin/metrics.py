"""Metrics of predictions: the three metrics of the paper, and R^2 of the force. Unknown true forces are NaN.

For rows with an unknown true force, only the place is scored.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

ACCURACY_LIMIT_MM = 1.0  # section 4 of the paper: a place counts as accurate if |dx| and |dy| are at most 1 mm
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "r2_f")
# Mean and variance of the true forces of the scored rows. They are needed to compute the R^2 of several groups
# together.
TRUTH = ("force_mean_N", "force_var_N2")


def score(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> dict[str, float]:
    """Score predictions of (x_mm, y_mm, F_N); return the scores by the names in `METRICS` and `TRUTH`.

    `mse_xy_mm2` is averaged over x and y; the paper does not say whether its MSE is the sum or the mean. `r2_f` is
    1 - `mse_f_N2` / (variance of the true forces), which is 0 for a constant prediction of the mean force. The scores
    of the force are missing if no true force is known; `r2_f` is also missing if all true forces are equal.
    """
    error = predicted.astype(float) - true
    known = ~np.isnan(error[:, 2])
    place = error[:, :2]
    numbers = {
        "accuracy_pct": 100.0 * float((np.abs(place) <= ACCURACY_LIMIT_MM).all(axis=1).mean()),
        "mse_xy_mm2": float((place**2).mean()),
    }
    if known.any():
        numbers["mse_f_N2"] = float((error[known, 2] ** 2).mean())
        force_N = true[known, 2].astype(float)
        numbers |= {"force_mean_N": float(force_N.mean()), "force_var_N2": float(force_N.var())}
        # Both conditions are needed: because of rounding, the computed variance can be nonzero for equal forces, and
        # zero for nearly equal forces.
        if np.ptp(force_N) > 0 and numbers["force_var_N2"] > 0:
            numbers["r2_f"] = 1 - numbers["mse_f_N2"] / numbers["force_var_N2"]
    return numbers


def median_error_mm(true_mm: Float[np.ndarray, "f 2"], predicted_mm: Float[np.ndarray, "f 2"]) -> float:
    """Return the median distance between predicted and true places."""
    return float(np.median(np.linalg.norm(predicted_mm - true_mm, axis=1)))


def coverage_pct(
    true: Float[np.ndarray, "..."], low: Float[np.ndarray, "..."], high: Float[np.ndarray, "..."]
) -> float:
    """Return the percentage of true values that are inside their intervals."""
    return 100 * float(((low <= true) & (true <= high)).mean())


def interval_score(
    true: Float[np.ndarray, "..."], low: Float[np.ndarray, "..."], high: Float[np.ndarray, "..."]
) -> float:
    """Return the mean interval score of 90 % intervals.

    The score of an interval is its width, plus 20 times the distance of the true value from the interval if it is
    outside.

    The expected score is smallest if the limits are the true 5 % and 95 % quantiles (Gneiting & Raftery, JASA 2007).
    """
    outside = np.maximum(low - true, 0) + np.maximum(true - high, 0)
    return float((high - low + 2 / 0.1 * outside).mean())


def register(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Shift all predicted places by the constant offset for which the mean errors of x and of y are zero.

    The origin of each rig's coordinates was set manually. Scores after this shift show how much of the error is due to
    this origin. Because the offset is computed from the true places, these scores are a diagnostic and not a result.
    """
    shifted = predicted.astype(float)
    shifted[:, :2] -= (predicted[:, :2] - true[:, :2]).mean(axis=0)
    return shifted


def score_groups(
    true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"], board: np.ndarray, skin: np.ndarray
) -> dict[str, Any]:
    """Score all test rows together, the rows of each test skin, and all rows after `register` on each test board.

    `board` and `skin` are the names of each row's board and skin. The scores after `register` (key `registered`) are a
    diagnostic.
    """
    registered = predicted.copy()
    for name in np.unique(board):
        registered[board == name] = register(true[board == name], predicted[board == name])
    return {
        "all": score(true, predicted),
        "registered": score(true, registered),
        "by_skin": {str(name): score(true[skin == name], predicted[skin == name]) for name in np.unique(skin)},
        "board_of": {str(name): str(board[skin == name][0]) for name in np.unique(skin)},
        "rows_n": len(true),
    }
