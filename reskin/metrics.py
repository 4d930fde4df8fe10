"""Metrics of predictions: the three metrics of the paper, the R^2 of the force, and scores of intervals.

A true force may be unknown (NaN). For such rows, only the place is scored.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

# A predicted place is accurate if its errors in x and in y are at most this large (section 4 of the paper).
ACCURACY_LIMIT_MM = 1.0
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "r2_f")
# Names of two further results of `score`: the mean and the variance of the true forces. They are needed to compute the
# R^2 of several groups of rows together from the scores of the groups.
TRUTH = ("force_mean_N", "force_var_N2")


def accuracy_pct(true_mm: Float[np.ndarray, "f 2"], predicted_mm: Float[np.ndarray, "f 2"]) -> float:
    """Return the percentage of rows whose errors in x and in y are at most 1 mm."""
    error_mm = np.abs(predicted_mm.astype(float) - true_mm)
    return 100.0 * float((error_mm <= ACCURACY_LIMIT_MM).all(axis=1).mean())


def mse(true: Float[np.ndarray, "..."], predicted: Float[np.ndarray, "..."]) -> float:
    """Return the mean squared error over all values."""
    return float(((predicted.astype(float) - true) ** 2).mean())


def r2(true: Float[np.ndarray, " f *c"], predicted: Float[np.ndarray, " f *c"]) -> float:
    """Return R^2, which is 1 - `mse` / variance of the true values; the variance is averaged over columns.

    It is 0 if the prediction is always the mean of the true values, and NaN if all true values are equal.
    """
    # Both conditions are needed because of rounding. The computed variance of equal values can differ from zero, and
    # the computed variance of nearly equal values can be zero.
    variance = float(true.astype(float).var(axis=0).mean())
    return 1 - mse(true, predicted) / variance if np.ptp(true, axis=0).any() and variance > 0 else float("nan")


def score(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> dict[str, float]:
    """Score predictions of x_mm, y_mm and F_N.

    Returns
    -------
    A dictionary with these keys:

    - `accuracy_pct`: percentage of rows whose errors in x and in y are at most 1 mm
    - `mse_xy_mm2`: mean squared error of the place, averaged over x and y. The paper does not say whether its MSE is
      the sum over x and y, or the mean.
    - `mse_f_N2`, `r2_f`: mean squared error and R^2 of the force
    - `force_mean_N`, `force_var_N2`: mean and variance of the true forces

    If no true force is known, the last four are missing. If all true forces are equal, `r2_f` is missing.
    """
    place, place_predicted = true[:, :2], predicted[:, :2]
    numbers = {"accuracy_pct": accuracy_pct(place, place_predicted), "mse_xy_mm2": mse(place, place_predicted)}
    known = ~np.isnan(true[:, 2]) & ~np.isnan(predicted[:, 2])
    if known.any():
        force_N, predicted_N = true[known, 2].astype(float), predicted[known, 2]
        numbers |= {"mse_f_N2": mse(force_N, predicted_N)}
        numbers |= {"force_mean_N": float(force_N.mean()), "force_var_N2": float(force_N.var())}
        if not np.isnan(explained := r2(force_N, predicted_N)):
            numbers["r2_f"] = explained
    return numbers


def score_shear(true: Float[np.ndarray, "f 5"], predicted: Float[np.ndarray, "f 5"]) -> dict[str, float]:
    """Score predictions of x_mm, y_mm, Fx_N, Fy_N and Fz_N.

    `explained_*` is R^2. Unlike an MSE, it does not grow with the size of the forces.
    """
    parts = {"xy_mm2": slice(0, 2), "fxy_N2": slice(2, 4), "fz_N2": slice(4, 5)}
    numbers = {"accuracy_pct": accuracy_pct(true[:, :2], predicted[:, :2])}
    for name, part in parts.items():
        numbers[f"mse_{name}"] = mse(true[:, part], predicted[:, part])
        numbers[f"explained_{name.partition('_')[0]}"] = r2(true[:, part], predicted[:, part])
    return numbers


def median_error_mm(true_mm: Float[np.ndarray, "f 2"], predicted_mm: Float[np.ndarray, "f 2"]) -> float:
    """Return the median distance between predicted and true places."""
    return float(np.median(np.linalg.norm(predicted_mm - true_mm, axis=1)))


def coverage_pct(
    true: Float[np.ndarray, "..."], low: Float[np.ndarray, "..."], high: Float[np.ndarray, "..."]
) -> float:
    """Return the percentage of true values that are inside their intervals, which extend from `low` to `high`."""
    return 100 * float(((low <= true) & (true <= high)).mean())


def register(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Shift all predicted places by the same offset, so that the mean error of x and the mean error of y become zero.

    The origin of the coordinates of each rig was set by hand, so it may differ between boards. Scores after this shift
    show how much of the error is due to such differences. They are a diagnostic and not a result, because the offset is
    computed from the true places.
    """
    shifted = predicted.astype(float)
    shifted[:, :2] -= (predicted[:, :2] - true[:, :2]).mean(axis=0)
    return shifted


def score_groups(
    true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"], board: np.ndarray, skin: np.ndarray
) -> dict[str, Any]:
    """Score test rows in several groups.

    `board` and `skin` contain the names of each row's board and skin. The result has these keys:

    - `all`: the scores over all rows
    - `registered`: the scores over all rows after the places on each board were shifted by `register`; a diagnostic
    - `by_skin`: the scores over the rows of each skin, by the name of the skin
    - `board_of`: the name of each skin's board
    - `rows_n`: the number of rows
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
