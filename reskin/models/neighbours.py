"""Regression by nearest neighbours, with which networks are compared. It estimates x_mm, y_mm and F_N of a reading."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from reskin.errors import TrainingError
from reskin.models.inputs import SCALE_FLOOR, Scaler, fit_standard


@dataclass(frozen=True)
class Neighbours:
    """Nearest neighbours that were fitted to training rows.

    `parts` has one regressor for each group of targets that are known in the same rows: the columns of its targets (0
    is x, 1 is y, 2 is the force), and the regressor. `scaler` standardises inputs and targets.
    """

    scaler: Scaler
    parts: tuple[tuple[list[int], Any], ...]

    def predict(self, inputs: Float32[np.ndarray, "f c"]) -> Float32[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and F_N; a target that was unknown in all training rows is NaN."""
        predicted = np.full((len(inputs), 3), np.nan, np.float32)
        encoded = self.scaler.encode(inputs).astype(np.float64)
        for targets, regressor in self.parts:
            predicted[:, targets] = regressor.predict(encoded)
        return self.scaler.decode(predicted)


def fit_neighbours(
    inputs: Float32[np.ndarray, "n c"], target: Float32[np.ndarray, "n 3"], neighbours_n: int
) -> Neighbours:
    """Fit nearest neighbours to training rows.

    A prediction is the mean of the targets of the `neighbours_n` nearest rows, weighted by 1 / distance. The columns of
    `target` are x in mm, y in mm and the force in N. Unknown targets are NaN.
    """
    from sklearn.neighbors import KNeighborsRegressor  # imported here, because the import takes 0.7 s

    known = ~np.isnan(target)
    fewest_n = min((int(n) for n in known.sum(axis=0) if n), default=0)
    if fewest_n < neighbours_n:
        rule, remedy = f"{neighbours_n} or more for each target", "Record more indentations with this target."
        raise TrainingError("nearest neighbours", "training rows", rule, fewest_n, remedy)
    if broken_n := int((~np.isfinite(inputs)).any(axis=1).sum()):
        raise TrainingError(f"nearest neighbours: the inputs of {broken_n} rows are not finite. Remove these rows.")
    scaler = fit_standard(inputs, target)
    # An input that is constant in the training rows, but not in the test rows, would dominate all distances after
    # division by its tiny scale. Division by infinity sets it to 0.
    scale = np.where(scaler.input_scale <= SCALE_FLOOR, np.float32(np.inf), scaler.input_scale)
    scaler = replace(scaler, input_scale=scale)
    encoded, encoded_target = (
        values.astype(np.float64) for values in (scaler.encode(inputs), scaler.encode_target(target))
    )
    groups: dict[bytes, list[int]] = {}
    for i in np.flatnonzero(known.any(axis=0)):
        groups.setdefault(known[:, i].tobytes(), []).append(int(i))
    parts = []
    for targets in groups.values():
        rows = known[:, targets[0]]
        # scikit-learn would use brute force for 16 or more inputs. A k-d tree is fast here even for so many inputs,
        # because readings vary along few directions only.
        regressor = KNeighborsRegressor(neighbours_n, weights="distance", algorithm="kd_tree")
        parts.append((targets, regressor.fit(encoded[rows], encoded_target[rows][:, targets])))
    return Neighbours(scaler, tuple(parts))
