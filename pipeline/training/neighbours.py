"""Regression by nearest neighbours, with which networks are compared. It estimates x_mm, y_mm and F_N of a reading."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from reskin.errors import TrainingError
from reskin.models.inputs import SCALE_FLOOR, fit_standard


def predict_by_neighbours(
    inputs: Float32[np.ndarray, "n c"],
    target: Float32[np.ndarray, "n 3"],
    tested: Float32[np.ndarray, "f c"],
    neighbours_n: int,
) -> Float32[np.ndarray, "f 3"]:
    """Predict x_mm, y_mm and F_N of the inputs `tested` from training rows (`inputs` and `target`).

    A prediction is the mean of the targets of the `neighbours_n` nearest training rows, weighted by 1 / distance. The
    columns of `target` are x in mm, y in mm and the force in N. Unknown targets are NaN. A target that is unknown in
    all training rows is predicted as NaN.
    """
    from sklearn.neighbors import KNeighborsRegressor  # imported here, because the import takes 0.7 s

    known = ~np.isnan(target)
    fewest_n = min((int(n) for n in known.sum(axis=0) if n), default=0)
    if fewest_n < neighbours_n:
        rule, remedy = f"{neighbours_n} or more for each target", "Record more indentations with this target."
        raise TrainingError("nearest neighbours", "training rows", rule, fewest_n, remedy)
    scaler = fit_standard(inputs, target)
    # An input that is constant in the training rows, but not in the test rows, would dominate all distances after
    # division by its tiny scale. Division by infinity sets it to 0.
    scale = np.where(scaler.input_scale <= SCALE_FLOOR, np.float32(np.inf), scaler.input_scale)
    scaler = replace(scaler, input_scale=scale)
    encoded, encoded_target, encoded_tested = (
        values.astype(np.float64)
        for values in (scaler.encode(inputs), scaler.encode_target(target), scaler.encode(tested))
    )
    predicted = np.full((len(tested), 3), np.nan, np.float32)
    for rows in np.unique(known[:, known.any(axis=0)], axis=1).T:
        targets = (known == rows[:, None]).all(axis=0)  # targets that are known in the same rows
        # scikit-learn would use brute force for 16 or more inputs. A k-d tree is fast here even for so many inputs,
        # because readings vary along few directions only.
        regressor = KNeighborsRegressor(neighbours_n, weights="distance", algorithm="kd_tree")
        regressor.fit(encoded[rows], encoded_target[rows][:, targets])
        predicted[:, targets] = regressor.predict(encoded_tested)
    return scaler.decode(predicted)
