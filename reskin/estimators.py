"""Estimators with the interface of scikit-learn, and the paper's metrics as scorers.

This module requires scikit-learn (`pip install '.[learn]'`). `ContactRegressor` is the paper's network, which is
trained on many contacts. Its inputs X and outputs y are:

- X [n ch] contains changes of the field since the no-load reading (the field without contact), in uT. The channels are
  Bx, By, Bz of chip 0, then of chip 1, and so on. These are the columns `dbx0_uT`, ... of `reskin.load_recording`.
- y [n 3] contains x_mm, y_mm and the normal force in N. Unknown values are NaN.
"""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import make_scorer
from sklearn.utils.validation import check_consistent_length, check_is_fitted, validate_data

from reskin import io, metrics
from reskin.config import parse
from reskin.data.rows import TARGETS
from reskin.errors import ParamsError, SchemaError, TrainingError, require
from reskin.models.job import TrainingData, TrainingJob, TrainingResult
from reskin.models.recipe import Recipe
from reskin.models.runner import MAX_ATTEMPTS_N
from reskin.models.trained import FORMAT, SUFFIX, Network

# Arguments of scikit-learn's function that validates y. They allow one or several targets, and unknown targets (NaN).
TARGET_CHECKS = {"dtype": np.float32, "ensure_2d": False, "ensure_all_finite": "allow-nan"}


class ContactRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """The paper's network, which estimates the place and the force of a contact.

    With equal data and settings, `fit` gives the same weights as a training run of the pipeline.

    Parameters
    ----------
    architecture, inputs, scaling, triplet_weight, batch_n, rate_max, gradient_norm_max, weight_decay
        The settings of the training, which are described in `reskin.models.recipe.Recipe`. The defaults are those of
        recipe `paper` in `params.yaml`.
    steps_n : int
        Number of training steps. The default is the number that scene `lab` uses.
    random_state : int
        Seed of the random initial weights and of the random batches.

    Attributes
    ----------
    network_ : Network
        The trained network, including the scaling of its inputs and outputs.
    loss_curve_ : list of float
        Mean squared error of the scaled targets during training. The curve has 50 points, each of which is the mean
        over an equal number of steps. If there are fewer than 50 steps, it has one point for each step.
    n_features_in_, feature_names_in_
        Number of channels of X, and their names if X was a DataFrame.

    Examples
    --------
    Measure the accuracy on boards that are not in the training data. Here, the boards are simulated:

    >>> import numpy as np
    >>> from sklearn.model_selection import GroupKFold, cross_val_score
    >>> rng = np.random.default_rng(0)
    >>> pokes = np.column_stack([rng.uniform(2, 14, (20, 2)), rng.uniform(0.4, 1.2, 20)])  # x_mm, y_mm, depth_mm
    >>> X, y, board = [], [], []
    >>> for name in ("b0", "b1", "b2"):
    ...     skin, circuit = reskin.draw_skin(f"{name}_s0"), reskin.draw_board(name)
    ...     noload_uT, b_uT, force_N = reskin.simulate_pokes(skin, pokes, board=circuit)
    ...     X.append(b_uT - noload_uT)
    ...     y.append(np.column_stack([pokes[:, :2], force_N]))
    ...     board += len(pokes) * [name]
    >>> X, y = np.concatenate(X), np.concatenate(y)
    >>> model = reskin.ContactRegressor(steps_n=20)  # few steps, for a quick example
    >>> within_1mm = reskin.SCORERS["accuracy_pct"]
    >>> len(cross_val_score(model, X, y, groups=board, cv=GroupKFold(3), scoring=within_1mm))  # one score per board
    3
    """

    def __init__(
        self,
        *,
        architecture: Literal["paper", "released"] = "paper",
        inputs: Literal["raw", "shape"] = "raw",
        scaling: Literal["standard", "released"] = "standard",
        triplet_weight: float = 0.0,
        steps_n: int = 3000,
        batch_n: int = 128,
        rate_max: float = 1.2e-2,
        gradient_norm_max: float = 1.0,
        weight_decay: float = 0.0,
        random_state: int = 0,
    ) -> None:
        self.architecture = architecture
        self.inputs = inputs
        self.scaling = scaling
        self.triplet_weight = triplet_weight
        self.steps_n = steps_n
        self.batch_n = batch_n
        self.rate_max = rate_max
        self.gradient_norm_max = gradient_norm_max
        self.weight_decay = weight_decay
        self.random_state = random_state

    def fit(self, X: ArrayLike, y: ArrayLike, *, skin: ArrayLike | None = None) -> "ContactRegressor":
        """Train the network.

        Parameters
        ----------
        X : array [n ch]
            Changes of the field in uT.
        y : array [n 3]
            x_mm, y_mm and the normal force in N. Unknown values are NaN. There may also be more or fewer targets.
        skin : array [n], optional
            Name of each row's skin. It is used only by the triplet loss (`triplet_weight` above 0), which compares
            places on the same skin. Default: all rows are from one skin.

        Raises
        ------
        ParamsError
            If a setting is invalid.
        TrainingError
            If training diverges, or if a target is unknown in all rows.

        Warns
        -----
        ConvergenceWarning
            If the trained network predicts nearly the same values for all rows (it has collapsed). A collapsed training
            run is repeated with other random numbers; the warning is issued if all `MAX_ATTEMPTS_N` runs collapse.
        """
        require("torch", "ContactRegressor")
        recipe, seed = self._recipe(), _as_seed(self.random_state)
        checks = ({"dtype": np.float32, "ensure_min_samples": 2}, TARGET_CHECKS)
        db_uT, targets = validate_data(self, X, y, validate_separately=checks)
        check_consistent_length(db_uT, targets, skin)
        target = targets.reshape(len(targets), -1)
        if np.isnan(target).all(axis=0).any():
            raise TrainingError("ContactRegressor: a target is unknown (NaN) in all rows. Remove this column of y.")
        data = TrainingData(db_uT, target, np.zeros(len(db_uT), int) if skin is None else np.asarray(skin))
        job = TrainingJob("fit", "own", recipe, "all", seed, 0, np.arange(len(db_uT)), np.zeros(0, np.int64))
        result, collapsed_before_n = _train(job, data)
        self._targets_shape = targets.shape[1:]
        self.loss_curve_ = result.curve
        self.network_ = Network(
            _card(recipe, seed, db_uT.shape[1], result, collapsed_before_n),
            dict(result.weights) | result.scaler.arrays(),
        )
        return self

    def predict(self, X: ArrayLike) -> np.ndarray:
        """Predict x_mm, y_mm and the normal force in N [n 3] from changes of the field [n ch] in uT."""
        check_is_fitted(self)
        db_uT = validate_data(self, X, dtype=np.float32, reset=False)
        return self.network_(db_uT).reshape(-1, *self._targets_shape).astype(np.float64)

    def save(self, file: Path | str) -> None:
        """Write the network (.safetensors) and its JSON card, which describes the network.

        The file can be loaded with `reskin.load_model(FILE)` and `reskin live --model FILE`.

        Raises
        ------
        ParamsError
            If the name of the file does not end in .safetensors.
        SchemaError
            If the network does not have three inputs (Bx, By, Bz) for each chip, or not three targets (x_mm, y_mm and
            force).
        """
        check_is_fitted(self)
        path = Path(file)
        if path.suffix != SUFFIX:
            raise ParamsError(file, "the name", f"one that ends in {SUFFIX}", path.name, f"Try: {path.name}{SUFFIX}")
        if self.n_features_in_ % 3 or self._targets_shape != (len(TARGETS),):
            got = f"{self.n_features_in_} channels and targets of shape {self._targets_shape}"
            rule = f"3 channels per chip and the targets {', '.join(TARGETS)}"
            raise SchemaError(file, "a saved network", f"for {rule}", got, "Save other networks with joblib.")
        io.write_model(path, self.network_.tensors, self.network_.card)

    def _recipe(self) -> Recipe:
        settings = {name: getattr(self, name) for name in Recipe.model_fields}
        values = {name: value.item() if isinstance(value, np.generic) else value for name, value in settings.items()}
        return parse(Recipe, values, "ContactRegressor")

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags


def _as_seed(random_state: Any) -> int:
    if not isinstance(random_state, int | np.integer):
        remedy = "Pass a seed, so that the training can be repeated."
        raise ParamsError("ContactRegressor", "random_state", "a whole number", repr(random_state), remedy)
    return int(random_state)


def _train(job: TrainingJob, data: TrainingData) -> tuple[TrainingResult, int]:
    """Train a network, and repeat the training with other random numbers if the network collapses.

    The same is done by `reskin.models.runner.run_jobs`. Returns the result, and the number of earlier runs that
    collapsed.
    """
    from reskin.models.train import train_stack  # imported here, because it imports torch

    for attempt_i in range(MAX_ATTEMPTS_N):
        (result,) = train_stack([replace(job, attempt_i=attempt_i)], data)
        if result.stopped_step is not None:
            remedy = "Lower rate_max or gradient_norm_max, which limit the training steps."
            raise TrainingError(f"ContactRegressor: training diverged by step {result.stopped_step}. {remedy}")
        if not result.collapsed:
            return result, attempt_i
    warnings.warn(
        f"the network collapsed in all of {MAX_ATTEMPTS_N} runs: it predicts nearly the same for all rows. Check "
        "that the rows of X and y are in the same order. If they are, try another rate_max or more steps.",
        ConvergenceWarning,
        stacklevel=3,
    )
    return result, MAX_ATTEMPTS_N - 1


def _card(
    recipe: Recipe, seed: int, channels_n: int, result: TrainingResult, collapsed_before_n: int
) -> dict[str, Any]:
    """Return the card of a trained network: the entries that predictions need, and some details of the training."""
    return {
        "format": FORMAT,
        "recipe": recipe.model_dump(mode="json"),
        "seed": seed,
        "input": {"quantity": "change of field", "unit": "uT", "channels_n": channels_n, "view": recipe.inputs},
        "output": {name: name.rsplit("_", 1)[1] for name in TARGETS},
        "collapsed": result.collapsed,
        "collapsed_before_n": collapsed_before_n,
        "curve": [round(value, 9) for value in result.curve],
    }


def _metric(y: ArrayLike, predicted: ArrayLike, *, name: str) -> float:
    """Compute one of the metrics of `reskin.metrics.score` for the rows whose place is known.

    The result is NaN if no row has the true values that are needed to compute the metric.
    """
    true, estimated = np.asarray(y, float), np.asarray(predicted, float)
    placed = ~np.isnan(true[:, :2]).any(axis=1)
    return metrics.score(true[placed], estimated[placed]).get(name, np.nan) if placed.any() else np.nan


# Scorers for the metrics of the paper (see `reskin.metrics.score`). They can be passed to functions and classes of
# scikit-learn, such as `cross_validate` and `GridSearchCV`, as the argument `scoring`. scikit-learn expects that larger
# scores are better, so errors are negated (names with `neg_`). Rows with an unknown place are not scored.
SCORERS = {
    "accuracy_pct": make_scorer(_metric, name="accuracy_pct"),  # percentage of rows within 1 mm in x and in y
    "neg_mse_xy_mm2": make_scorer(_metric, greater_is_better=False, name="mse_xy_mm2"),
    "neg_mse_f_N2": make_scorer(_metric, greater_is_better=False, name="mse_f_N2"),
    "r2_f": make_scorer(_metric, name="r2_f"),
}
