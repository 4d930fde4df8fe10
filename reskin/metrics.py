"""Metrics of predictions: the paper's three, and R^2 of the force. True forces that are NaN (unknown) are left out."""

from typing import Any

import numpy as np
from jaxtyping import Float

ACCURACY_LIMIT_MM = 1.0  # paper section 4: both |dx| and |dy| within 1 mm
METRICS = ("accuracy_pct", "mse_xy_mm2", "mse_f_N2", "r2_f")
TRUTH = ("force_mean_N", "force_var_N2")  # of the scored rows, so that scores of parts can be combined


def score(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> dict[str, float]:
    """Score predictions of (x_mm, y_mm, F_N); the keys of the result are in `METRICS` and `TRUTH`.

    MSE_xy is the mean over the two axes (the paper does not say whether it sums or averages). R^2 of the force is
    1 - MSE_F / (variance of the true forces); a constant prediction of their mean scores 0. The force has no scores if
    no true force is known, and no R^2 if the true force does not vary.
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
        # Rounding can make the variance of equal forces nonzero, and that of nearly equal forces zero.
        if np.ptp(force_N) > 0 and numbers["force_var_N2"] > 0:
            numbers["r2_f"] = 1 - numbers["mse_f_N2"] / numbers["force_var_N2"]
    return numbers


def register(true: Float[np.ndarray, "f 3"], predicted: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Shift predicted places by one constant offset, so that their mean error is zero.

    Each rig's origin was set manually; this shows how much of the error is due to registration. It uses the true
    places, so it is a diagnostic, not a result.
    """
    shifted = predicted.astype(float)
    shifted[:, :2] -= (predicted[:, :2] - true[:, :2]).mean(axis=0)
    return shifted


def score_groups(
    true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"], board: np.ndarray, skin: np.ndarray
) -> dict[str, Any]:
    """Score all test rows, each test skin, and (as a diagnostic) all rows after removing one offset per test board."""
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
