"""Finds the numbers of a law on the pokes of one board: pokes -> a `Law`. Least squares, weak priors, seconds.

Refuses to know whether the fit is good (`run`) and other boards.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from pipeline.twin.law import Law, Setup, at_rest_uT, simulate_uT, with_numbers
from pipeline.twin.pokes import Pokes, lengths_uT

# Where a fit starts, what its priors centre on; then their standard deviations and the size of a step. Assumed.
START = Law(0.0, 0.0, 0.0, 1.5, 1.5, 0.0, 0.0, 0.2, 5.0, 0.0, 0.0)
PRIOR = Law(1.0, 1.0, 3.0, 0.4, 0.5, 1.0, 1.0, 0.25, 10.0, 60.0, 60.0)
STEP = Law(0.3, 0.3, 1.0, 0.2, 0.2, 0.4, 0.4, 0.07, 4.0, 20.0, 20.0)
OF_BOARD = ("seat_x_mm", "seat_y_mm", "gap_mm", "amplitude", "label_x_mm", "label_y_mm")
TEN = (*OF_BOARD, "modulus_MPa", "away_um_mm", "give_x_um", "give_y_um")
SEVEN = (*OF_BOARD, "rotation_deg")  # what may differ between boards, the law of another one held
PRIOR_WEIGHT = 0.25  # chosen with both boards of scene lab in view: at twice as much, one of four fits explains 0.796
GROWTH_WEIGHT = 10.0  # of how log|dB| is off by group, less its mean: growth with force
OFFSET_uT = 200.0  # of a chip (spreads.chip_offset_uT): how far the field at rest may be off
EVALUATIONS_MAX_N = 10  # of all derivatives; the fits of scene lab take 5, and a tenth of ftol changes 0.0001 of cosine


@dataclass(frozen=True)
class Seen:
    """What is fitted: pokes, with fields and places turned into the board's axes."""

    pokes: Pokes
    place_mm: Float[np.ndarray, "n 2"]
    db_uT: Float[np.ndarray, "n k 3"]
    rest_uT: Float[np.ndarray, "k 3"]


def fit(seen: Seen, setup: Setup, names: tuple[str, ...], start: Law = START) -> Law:
    """Fit the named numbers; the others stay as in `start`."""
    length_uT = lengths_uT(seen.db_uT)
    counts = np.bincount(seen.pokes.group_i)
    centre, prior, step = (np.array([getattr(law, name) for name in names]) for law in (START, PRIOR, STEP))

    def residuals(values: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        law = with_numbers(start, names, values)
        simulated_uT = simulate_uT(law, setup, seen.place_mm, seen.pokes.force_N)
        each = (simulated_uT - seen.db_uT) / length_uT[:, None, None]
        ratio = np.log(lengths_uT(simulated_uT) / length_uT)
        by_group = np.bincount(seen.pokes.group_i, ratio) / counts
        rest = (at_rest_uT(law, setup) - seen.rest_uT) / OFFSET_uT
        held = PRIOR_WEIGHT * (values - centre) / prior
        return np.concatenate([each.ravel(), rest.ravel(), held, GROWTH_WEIGHT * (by_group - by_group.mean())])

    first = np.array([getattr(start, name) for name in names])
    # Fields have kinks of the size of the flow's table, so differences are not taken over less.
    found = least_squares(
        residuals, first, x_scale=step, diff_step=1e-3, ftol=1e-3, max_nfev=EVALUATIONS_MAX_N, bounds=_limits(names)
    )
    return with_numbers(start, names, found.x)


def _limits(names: tuple[str, ...]) -> tuple[list[float], list[float]]:
    # Below these a skin would lie in its chips, or push back.
    least = {"gap_mm": 0.3, "amplitude": 0.05, "modulus_MPa": 0.01}
    return [least.get(name, -np.inf) for name in names], [np.inf] * len(names)
