"""Fit the law of a skin (`reskin.universal.law`) to the recorded presses of one board."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from pipeline.fitting.presses import RecordedPresses, magnitudes_uT
from reskin.universal.law import Law, Setup, at_rest_uT, simulate_uT

# Assumed values for fits. Each is a `Law` whose fields contain one number per parameter: in PRIOR the standard
# deviation of the prior (see `fit`); in STEP the typical size of a change of the parameter, by which
# the optimiser scales the parameters.
PRIOR = Law(1.0, 1.0, 3.0, 0.4, 0.5, 1.0, 1.0, 0.25, 10.0, 60.0, 60.0, lets_go_N=8.0, stiffening=1.0)
STEP = Law(0.3, 0.3, 1.0, 0.2, 0.2, 0.4, 0.4, 0.07, 4.0, 20.0, 20.0, lets_go_N=8.0, stiffening=1.0)
OF_BOARD = ("seat_x_mm", "seat_y_mm", "gap_mm", "amplitude", "label_x_mm", "label_y_mm")
TEN = (*OF_BOARD, "modulus_MPa", "away_um_mm", "give_x_um", "give_y_um")
# Parameters that may differ between boards of a rig. If only these are fitted to a board, the other parameters come
# from a fit to another board.
SEVEN = (*OF_BOARD, "rotation_deg")
# Weight of the priors in a fit. The value was chosen on both boards of scene lab. With 0.5, one of four fits explains
# only 79.6 % of |dB|^2.
PRIOR_WEIGHT = 0.25
# Weight of the residuals that compare how |dB| grows with force in the simulation and in the recording. Each group of
# presses (see `RecordedPresses`) has one such residual: the mean error of log|dB| in this group minus the mean over all
# groups.
GROWTH_WEIGHT = 10.0
OFFSET_uT = 200.0  # standard deviation of the chips' offsets, which are part of the no-load field
# Maximum number of least-squares steps. The fits of scene lab need 5. More accurate fits are not needed: with a tenfold
# smaller `ftol`, the cosine between simulated and recorded field changes changes by only 0.0001.
EVALUATIONS_MAX_N = 10


@dataclass(frozen=True)
class AlignedPresses:
    """Recorded presses on a board, converted to the frame and the axes of the board.

    `recorded` contains the presses as they were recorded. `place_mm`, `db_uT` and `rest_uT` are their places, their
    field changes and the no-load field after the conversion.
    """

    recorded: RecordedPresses
    place_mm: Float[np.ndarray, "n 2"]
    db_uT: Float[np.ndarray, "n k 3"]
    rest_uT: Float[np.ndarray, "k 3"]


def fit(presses: AlignedPresses, setup: Setup, names: tuple[str, ...], mean: Law, start: Law | None = None) -> Law:
    """Fit the named parameters of the law to the presses on a board by least squares.

    `mean` contains the means of the priors. The fit starts at the law `start`, by default `mean`. All other parameters
    keep the values that they have in this law.
    """
    start = start or mean
    magnitude_uT = magnitudes_uT(presses.db_uT)
    counts = np.bincount(presses.recorded.group_i)
    centre, prior, step = (np.array([getattr(law, name) for name in names]) for law in (mean, PRIOR, STEP))

    def residuals(values: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        law = replace(start, **dict(zip(names, values.tolist(), strict=True)))
        simulated_uT = simulate_uT(law, setup, presses.place_mm, presses.recorded.force_N)
        changes = (simulated_uT - presses.db_uT) / magnitude_uT[:, None, None]
        ratio = np.log(magnitudes_uT(simulated_uT) / magnitude_uT)
        by_group = np.bincount(presses.recorded.group_i, ratio) / counts
        rest = (at_rest_uT(law, setup) - presses.rest_uT) / OFFSET_uT
        priors = PRIOR_WEIGHT * (values - centre) / prior
        return np.concatenate([changes.ravel(), rest.ravel(), priors, GROWTH_WEIGHT * (by_group - by_group.mean())])

    first = np.array([getattr(start, name) for name in names])
    # As functions of depth, simulated fields have kinks at the tabulated depths. With a smaller `diff_step`, these
    # kinks would distort the derivatives.
    result = least_squares(
        residuals, first, x_scale=step, diff_step=1e-3, ftol=1e-3, max_nfev=EVALUATIONS_MAX_N, bounds=_limits(names)
    )
    return replace(start, **dict(zip(names, result.x.tolist(), strict=True)))


def _limits(names: tuple[str, ...]) -> tuple[list[float], list[float]]:
    # The lower limits ensure that the skin is above its chips, is magnetised, has some stiffness, and does not soften.
    least = {"gap_mm": 0.3, "amplitude": 0.05, "modulus_MPa": 0.01, "lets_go_N": 0.5, "stiffening": 0.0}
    return [least.get(name, -np.inf) for name in names], [np.inf] * len(names)
