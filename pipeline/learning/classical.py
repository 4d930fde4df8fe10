"""Classical methods on the networks' folds. In: settings, and rows as a view gives them. Out: a fit.

A fit standardises by its own training rows and runs in one thread. Refuses to know folds, skins, views and scores; and
imports what fits late: scenes are checked against these settings, and scikit-learn takes a second to import.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float, Float32, Int64
from pydantic import Field

from pipeline.core.config import Strict
from pipeline.core.errors import TrainingError
from pipeline.learning.inputs import SCALE_FLOOR, Scaler, fit_standard


class _Method(Strict):
    """What all methods share: the view (pipeline.learning.inputs) that they are to be given."""

    inputs: Literal["raw", "shape"]


class Ridge(_Method):
    """Linear least squares; `alpha` weighs the penalty against squared errors summed over rows, all standardised."""

    title: ClassVar[str] = "ridge"
    method: Literal["ridge"]
    alpha: Annotated[float, Field(gt=0)]


class CubicRidge(_Method):
    """Ridge on all products of up to three inputs: 815 of 15, 968 of 16."""

    title: ClassVar[str] = "cubic ridge"
    method: Literal["cubic_ridge"]
    alpha: Annotated[float, Field(gt=0)]


class Neighbours(_Method):
    """The mean of the nearest training rows, each counting its weight over its distance."""

    title: ClassVar[str] = "k nearest neighbours"
    method: Literal["knn"]
    neighbours_n: Annotated[int, Field(ge=1)]


class RbfRidge(_Method):
    """exp(-gamma d^2) around each of at most `rows_max_n` rows; d^2 is 2 an input on average."""

    title: ClassVar[str] = "RBF kernel ridge"
    method: Literal["rbf_ridge"]
    alpha: Annotated[float, Field(gt=0)]
    gamma: Annotated[float, Field(gt=0)]
    rows_max_n: Annotated[int, Field(ge=1)]


class Boosting(_Method):
    """Trees on binned inputs, one row of trees a target; no early stop, whose hold-out would split indentations."""

    title: ClassVar[str] = "gradient boosting"
    method: Literal["boosting"]
    rounds_n: Annotated[int, Field(ge=1)]
    rate: Annotated[float, Field(gt=0)]
    leaves_n: Annotated[int, Field(ge=2)]


Classical = Annotated[Ridge | CubicRidge | Neighbours | RbfRidge | Boosting, Field(discriminator="method")]


@dataclass(frozen=True)
class _Part:
    """A regressor of those targets (0, 1, 2) that are known in the same training rows."""

    targets: list[int]
    regressor: Any  # fit(inputs, target, weight), predict(inputs)
    rows_n: int


@dataclass(frozen=True)
class Fitted:
    """A fitted method with the scaler of its training rows."""

    scaler: Scaler
    parts: tuple[_Part, ...]

    @property
    def rows_n(self) -> int:
        """Training rows that were used, by the target that is known in most of them."""
        return max(part.rows_n for part in self.parts)

    def predict(self, inputs: Float32[np.ndarray, "f c"]) -> Float32[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and F_N; NaN where no training row knew the target."""
        from pipeline.learning.regressors import blocks, one_thread

        predicted = np.full((len(inputs), 3), np.nan, np.float32)
        encoded = self.scaler.encode(inputs).astype(np.float64)
        with one_thread():
            for block in blocks(len(inputs)):
                for part in self.parts:
                    values = part.regressor.predict(encoded[block])
                    predicted[block, part.targets] = values.reshape(-1, len(part.targets))
        return self.scaler.decode(predicted)


def fit(
    settings: Classical,
    inputs: Float32[np.ndarray, "n c"],
    target: Float32[np.ndarray, "n 3"],
    rng: np.random.Generator,
    *,
    weight: Float32[np.ndarray, " n"] | None,
) -> Fitted:
    """Fit to the rows that know a target (mm, mm, N), each target by itself where they differ.

    `weight` counts a row as so many in the loss (in a vote, of neighbours); the scaler does not know it.
    """
    from pipeline.learning.regressors import make_regressor, one_thread

    assert weight is None or (weight > 0).all()
    _check(settings, inputs, target)
    scaler = _without_constant_channels(fit_standard(inputs, target))
    encoded = scaler.encode(inputs).astype(np.float64)
    encoded_target = scaler.encode_target(target).astype(np.float64)
    weights = None if weight is None else weight.astype(np.float64)
    parts = []
    for targets, rows in _known_together(target):
        row_weights = None if weights is None else weights[rows]
        if isinstance(settings, RbfRidge) and len(rows) > settings.rows_max_n:
            kept, row_weights = _thin(len(rows), settings.rows_max_n, row_weights, rng)
            rows = rows[kept]
        regressor = make_regressor(settings, rng)
        with one_thread():
            regressor.fit(encoded[rows], encoded_target[rows][:, targets], row_weights)
        parts.append(_Part(targets, regressor, len(rows)))
    return Fitted(scaler, tuple(parts))


def _without_constant_channels(scaler: Scaler) -> Scaler:
    """Scale an input that is constant in training to 0: at the floor's scale it would dominate all others in use."""
    constant = scaler.input_scale <= SCALE_FLOOR
    return replace(scaler, input_scale=np.where(constant, np.float32(np.inf), scaler.input_scale))


def _known_together(target: Float32[np.ndarray, "n 3"]) -> list[tuple[list[int], Int64[np.ndarray, " a"]]]:
    """Gather the targets that are known in the same rows, with these rows."""
    known = ~np.isnan(target)
    together: dict[bytes, list[int]] = {}
    for i in np.flatnonzero(known.any(axis=0)):
        together.setdefault(known[:, i].tobytes(), []).append(int(i))
    return [(targets, np.flatnonzero(known[:, targets[0]])) for targets in together.values()]


def _thin(
    rows_n: int, most_n: int, weight: Float[np.ndarray, " n"] | None, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " a"], Float[np.ndarray, " a"] | None]:
    """Draw `most_n` of more rows without replacement.

    Rows above the least weight all stay, or few labelled rows of a new skin would be lost among all others; their
    weight is lowered as the others' number is, so that they keep their share.
    """
    if weight is None:
        return np.sort(rng.choice(rows_n, most_n, replace=False)), None
    heavy = weight > weight.min()
    light = np.flatnonzero(~heavy)
    left_n = most_n - int(heavy.sum())
    if left_n < 1:
        raise TrainingError(
            "rbf_ridge", "rows_max_n", f"more than the {heavy.sum()} rows of greater weight", most_n, "Raise it."
        )
    kept = np.sort(np.concatenate([np.flatnonzero(heavy), rng.choice(light, left_n, replace=False)]))
    return kept, np.where(heavy, weight * left_n / len(light), weight)[kept]


def _check(settings: Classical, inputs: Float32[np.ndarray, "n c"], target: Float32[np.ndarray, "n 3"]) -> None:
    known_n = (~np.isnan(target)).sum(axis=0)
    fewest_n = min((int(n) for n in known_n if n), default=0)
    least_n = settings.neighbours_n if isinstance(settings, Neighbours) else 1
    if fewest_n < least_n:
        rule = f"{least_n} or more for each target"
        raise TrainingError(settings.method, "training rows", rule, fewest_n, "Record more.")
    if not np.isfinite(inputs).all():
        broken_n = int((~np.isfinite(inputs)).any(axis=1).sum())
        raise TrainingError(settings.method, "inputs", "finite", f"{broken_n} rows that are not", "Drop them.")
