"""Physics inversion, which is a reference method with which the universal model is compared.

The law (`reskin.universal.law`) is a simulation of a press on a skin. Starting from nominal parameters, it is fitted by
least squares to the no-load field of one skin and to presses at unknown places. Then, for each reading, the place and
the force are searched for which the law gives the most similar field change. If the law does not describe the skin, the
residuals of the search are large. Places are in the board's frame, and fields are along its axes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from reskin.universal.law import PRIOR, STEP, Law, OFFSET_uT, Setup, at_rest_uT, inside, simulate_uT, with_parameters
from reskin.universal.map import FORCES_N, NOMINAL, lattice_mm

# Modulus and label offset keep their nominal values, because unlabelled presses do not determine them.
PARAMETERS = ("seat_x_mm", "seat_y_mm", "rotation_deg", "gap_mm", "amplitude", "away_um_mm", "give_x_um", "give_y_um")
LEAST = {"gap_mm": 0.3, "amplitude": 0.05}  # lower limits of a fit: the skin must be above its chips and be magnetised
# Weight of the priors of the parameters. This value is assumed, whereas the weight in `law.fit` was chosen on recorded
# boards.
PRIOR_WEIGHT = 0.5
# Number of rounds of the fit. Each round first searches for the places with the current law. It then fits parameters
# and places together.
ROUNDS_N = 3
EVALUATIONS_MAX_N = 8  # maximum number of least-squares steps per round
STEP_MM, STEP_LOG_N = 0.05, 0.03  # steps of the finite differences: in x and in y, and in log force
REACH_MM, REACH_N = 9.0, (0.2, 14.0)  # limits of a fit: largest |x| and |y|, and smallest and largest force
CELL = 1.0  # the Gauss-Newton step of a search is limited to this number of lattice steps along each coordinate
BLOCK_N = 500  # readings are processed in blocks of this number, which limits the memory


@dataclass(frozen=True)
class Chart:
    """A table of field changes for a lattice (grid) of places and forces, in which the place of a reading is searched.

    The field changes are computed with a law, the formula for the field change at a place and a force (law.py).

    `slope_uT` is the change of the field change per lattice step in x, in y and in log force.
    """

    place_mm: Float[np.ndarray, "h 2"]
    log_N: Float[np.ndarray, " h"]
    step: Float[np.ndarray, "3"]  # steps of the lattice in x (mm), y (mm) and log force
    field_uT: Float[np.ndarray, "h ch"]
    slope_uT: Float[np.ndarray, "h ch 3"]


@dataclass(frozen=True)
class SearchResult:
    """The place and the force that a search has found for each reading, and the residual that remains.

    The residual is |dB - simulated dB| / |dB|.
    """

    place_mm: Float[np.ndarray, "n 2"]
    force_N: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, " n"]


def chart(law: Law, setup: Setup) -> Chart:
    """Simulate presses with a law at all places and forces of the lattice.

    These are 4,356 presses, and the simulation takes about one second. The chart contains those that are on the skin.
    """
    axis_mm, log_N = lattice_mm(), np.log(FORCES_N)
    points = np.stack(np.meshgrid(axis_mm, axis_mm, log_N, indexing="ij"), axis=-1)
    flat = points.reshape(-1, 3)
    field_uT = simulate_uT(law, setup, flat[:, :2], np.exp(flat[:, 2])).reshape(*points.shape[:3], -1)
    slope_uT = np.stack(np.gradient(field_uT, axis=(0, 1, 2)), axis=-1).reshape(len(flat), -1, 3)
    on_skin = inside(flat[:, :2])
    step = np.array([axis_mm[1] - axis_mm[0], axis_mm[1] - axis_mm[0], log_N[1] - log_N[0]])
    return Chart(flat[on_skin, :2], flat[on_skin, 2], step, field_uT.reshape(len(flat), -1)[on_skin], slope_uT[on_skin])


def search(known: Chart, db_uT: Float[np.ndarray, "n ch"]) -> SearchResult:
    """Find the place and the force of each reading.

    The search begins at that lattice point of the chart whose field change is nearest to the reading. A Gauss-Newton
    step then moves from this point towards the best place and force.
    """
    blocks = [_search(known, db_uT[i : i + BLOCK_N]) for i in range(0, max(len(db_uT), 1), BLOCK_N)]
    names = SearchResult.__annotations__
    return SearchResult(*(np.concatenate([getattr(block, name) for block in blocks]) for name in names))


def _search(known: Chart, db_uT: Float[np.ndarray, "n ch"]) -> SearchResult:
    # Squared distance of each reading from the field change at each lattice point. The term |dB|^2 is omitted, because
    # it is the same for all points.
    distance_uT2 = (known.field_uT**2).sum(axis=1) - 2 * db_uT @ known.field_uT.T
    nearest = distance_uT2.argmin(axis=1)
    off_uT, slope_uT = db_uT - known.field_uT[nearest], known.slope_uT[nearest]
    square = slope_uT.transpose(0, 2, 1) @ slope_uT
    # Without damping, the equations could not be solved if one coordinate had no effect on the field.
    damping = 1e-6 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    steps = np.linalg.solve(square + damping, np.einsum("nci,nc->ni", slope_uT, off_uT)[..., None])[..., 0]
    steps = np.clip(steps, -CELL, CELL)
    residual_uT = off_uT - np.einsum("nci,ni->nc", slope_uT, steps)
    moved = steps * known.step
    residual = np.linalg.norm(residual_uT, axis=1) / np.linalg.norm(db_uT, axis=1)
    force_N = np.exp(known.log_N[nearest] + moved[:, 2])
    return SearchResult(known.place_mm[nearest] + moved[:, :2], force_N, residual)


def fit_unlabelled(db_uT: Float[np.ndarray, "n ch"], rest_uT: Float[np.ndarray, " ch"], setup: Setup) -> Law:
    """Fit a law to the unlabelled presses and the no-load field of a skin, starting from nominal parameters.

    This takes 6 s for 65 presses.
    """
    law = NOMINAL
    for _ in range(ROUNDS_N):
        law = _JointFit(law, setup, db_uT, rest_uT).solve(search(chart(law, setup), db_uT))
    return law


@dataclass(frozen=True)
class _JointFit:
    """A least-squares fit of the parameters of the law together with the places and forces of all presses.

    The vector of unknowns contains the parameters, followed by x, y and log F of each press.
    """

    law: Law
    setup: Setup
    db_uT: Float[np.ndarray, "n ch"]
    rest_uT: Float[np.ndarray, " ch"]

    def solve(self, start_points: SearchResult) -> Law:
        n = len(self.db_uT)
        low = [*(LEAST.get(name, -np.inf) for name in PARAMETERS), *[-REACH_MM, -REACH_MM, np.log(REACH_N[0])] * n]
        high = [*[np.inf] * len(PARAMETERS), *[REACH_MM, REACH_MM, np.log(REACH_N[1])] * n]
        coordinates = np.column_stack([start_points.place_mm, np.log(start_points.force_N)]).ravel()
        start = np.clip(np.concatenate([_values(self.law), coordinates]), low, high)
        result = least_squares(
            self.residuals, start, self.slopes, bounds=(low, high), ftol=1e-3, max_nfev=EVALUATIONS_MAX_N,
            x_scale=np.concatenate([_values(STEP), np.tile([1.0, 1.0, 0.5], n)]),
        )  # fmt: skip
        return with_parameters(self.law, PARAMETERS, result.x[: len(PARAMETERS)])

    def residuals(self, values: Float[np.ndarray, " p"]) -> Float[np.ndarray, " r"]:
        parameters, coordinates = values[: len(PARAMETERS)], values[len(PARAMETERS) :].reshape(-1, 3)
        law = with_parameters(self.law, PARAMETERS, parameters)
        simulated_uT = simulate_uT(law, self.setup, coordinates[:, :2], np.exp(coordinates[:, 2])).reshape(
            self.db_uT.shape
        )
        changes = (simulated_uT - self.db_uT) / np.linalg.norm(self.db_uT, axis=1, keepdims=True)
        rest = (at_rest_uT(law, self.setup).ravel() - self.rest_uT) / OFFSET_uT
        priors = PRIOR_WEIGHT * (parameters - _values(NOMINAL)) / _values(PRIOR)
        return np.concatenate([changes.ravel(), rest, priors])

    def slopes(self, values: Float[np.ndarray, " p"]) -> Float[np.ndarray, "r p"]:
        # The coordinates of a press (x, y and log F) affect only the residuals of this press. Therefore, three
        # simulations are sufficient for the derivatives with respect to the coordinates of all presses. In each of
        # them, one coordinate is changed, for all presses at once.
        n, channels_n = self.db_uT.shape
        first, parameters_n = self.residuals(values), len(PARAMETERS)
        columns = np.zeros((len(first), len(values)))
        for i, by in enumerate(0.1 * _values(STEP)):
            columns[:, i] = (self.residuals(values + by * (np.arange(len(values)) == i)) - first) / by
        rows = np.arange(n * channels_n).reshape(n, channels_n)
        for i, by in enumerate((STEP_MM, STEP_MM, STEP_LOG_N)):
            own = parameters_n + 3 * np.arange(n) + i
            moved = values.copy()
            moved[own] += by
            columns[rows, own[:, None]] = (self.residuals(moved) - first)[rows] / by
        return columns


def _values(law: Law) -> Float[np.ndarray, " p"]:
    return np.array([getattr(law, name) for name in PARAMETERS])
