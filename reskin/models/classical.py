"""Classical regression methods, with which the networks are compared.

These reference methods are fitted on the same folds as the networks. All of them estimate the targets x_mm, y_mm and
F_N of a reading from its field change.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float, Float32, Int64
from pydantic import Field
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

from reskin.config import Strict
from reskin.errors import TrainingError
from reskin.models.inputs import SCALE_FLOOR, VIEW, Scaler, fit_standard
from reskin.models.job import TrainingData, median_call_s
from reskin.seeds import rng_for


class _Method(Strict):
    """Base class of the settings of a method.

    `inputs` is the name of a view, a function of the field change that gives the inputs of the method (see
    `reskin.models.inputs.VIEW`).
    """

    inputs: Literal["raw", "shape"]


class Ridge(_Method):
    """Settings of linear ridge regression.

    The loss is the sum of the squared errors of the scaled targets, plus `alpha` times the sum of the squared
    coefficients.
    """

    title: ClassVar[str] = "ridge"
    method: Literal["ridge"]
    alpha: Annotated[float, Field(gt=0)]


class CubicRidge(_Method):
    """Settings of ridge regression on products of up to three inputs.

    There are 815 such products for 15 inputs, and 968 for 16 inputs. `alpha` is the weight of the penalty, as in
    `Ridge`.
    """

    title: ClassVar[str] = "cubic ridge"
    method: Literal["cubic_ridge"]
    alpha: Annotated[float, Field(gt=0)]


class Neighbours(_Method):
    """Settings of regression by nearest neighbours.

    The prediction is a weighted mean of the targets of the `neighbours_n` nearest training rows. In this mean, a row
    counts in proportion to its row weight (see `fit`), divided by its distance.
    """

    title: ClassVar[str] = "k nearest neighbours"
    method: Literal["knn"]
    neighbours_n: Annotated[int, Field(ge=1)]


class RbfRidge(_Method):
    """Settings of kernel ridge regression with a Gaussian kernel (radial basis function).

    The kernel of two rows at distance d is exp(-gamma d^2). The inputs are standardised, so d^2 is on average twice the
    number of inputs. If there are more than `rows_max_n` training rows, a random selection of them is used.
    """

    title: ClassVar[str] = "RBF kernel ridge"
    method: Literal["rbf_ridge"]
    alpha: Annotated[float, Field(gt=0)]
    gamma: Annotated[float, Field(gt=0)]
    rows_max_n: Annotated[int, Field(ge=1)]


Classical = Annotated[Ridge | CubicRidge | Neighbours | RbfRidge, Field(discriminator="method")]


@dataclass(frozen=True)
class _Part:
    """A fitted regressor that predicts one group of targets. The targets of a group are known in the same rows."""

    targets: list[int]  # columns of the targets: 0 is x, 1 is y, 2 is the force
    regressor: Any  # has methods fit(inputs, target, weight) and predict(inputs)
    rows_n: int


@dataclass(frozen=True)
class FittedRegressor:
    """A classical method after it was fitted to training rows.

    It consists of one regressor for each group of targets (see `_Part`), and of a scaler for inputs and targets that
    was fitted to the same training rows.
    """

    scaler: Scaler
    parts: tuple[_Part, ...]

    @property
    def rows_n(self) -> int:
        """Number of training rows of the regressor that has the most training rows."""
        return max(part.rows_n for part in self.parts)

    def predict(self, inputs: Float32[np.ndarray, "f c"]) -> Float32[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and F_N; a target that was unknown in all training rows is NaN."""
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
) -> FittedRegressor:
    """Fit a method to training rows.

    The columns of `target` are x in mm, y in mm and the force in N. Unknown targets are NaN. If some targets are known
    in different rows than others, they are fitted separately.

    `weight` contains the weight of each row in the loss or, for nearest neighbours, in the mean over the neighbours.
    With None, all rows have equal weights. The scaler ignores the weights.
    """
    assert weight is None or (weight > 0).all()
    _check_rows(settings, inputs, target)
    scaler = _ignore_constant_inputs(fit_standard(inputs, target))
    encoded = scaler.encode(inputs).astype(np.float64)
    encoded_target = scaler.encode_target(target).astype(np.float64)
    weights = None if weight is None else weight.astype(np.float64)
    parts = []
    for targets, rows in _group_targets(target):
        row_weights = None if weights is None else weights[rows]
        if isinstance(settings, RbfRidge) and len(rows) > settings.rows_max_n:
            kept, row_weights = _thin(len(rows), settings.rows_max_n, row_weights, rng)
            rows = rows[kept]
        regressor = make_regressor(settings)
        with one_thread():
            regressor.fit(encoded[rows], encoded_target[rows][:, targets], row_weights)
        parts.append(_Part(targets, regressor, len(rows)))
    return FittedRegressor(scaler, tuple(parts))


def _ignore_constant_inputs(scaler: Scaler) -> Scaler:
    """Set the scale of constant inputs to infinity, so that these inputs become 0 when they are divided by it.

    An input may be constant in the training rows, but not in the test rows. The scale of such an input would otherwise
    be the tiny number `SCALE_FLOOR`. Its scaled values in the test rows would then be so large that they dominate all
    distances between rows.
    """
    constant = scaler.input_scale <= SCALE_FLOOR
    return replace(scaler, input_scale=np.where(constant, np.float32(np.inf), scaler.input_scale))


def _group_targets(target: Float32[np.ndarray, "n 3"]) -> list[tuple[list[int], Int64[np.ndarray, " a"]]]:
    """Group the targets that are known in the same rows.

    Returns a list of the groups. A group is a pair: the columns of its targets, and the numbers of the rows in which
    these targets are known.
    """
    known = ~np.isnan(target)
    together: dict[bytes, list[int]] = {}
    for i in np.flatnonzero(known.any(axis=0)):
        together.setdefault(known[:, i].tobytes(), []).append(int(i))
    return [(targets, np.flatnonzero(known[:, targets[0]])) for targets in together.values()]


def _thin(
    rows_n: int, most_n: int, weight: Float[np.ndarray, " n"] | None, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " a"], Float[np.ndarray, " a"] | None]:
    """Draw `most_n` of `rows_n` rows without replacement; return the row numbers and the weights of the drawn rows.

    If the weights of the rows differ, the rows with a weight above the minimum are the few labelled rows of a new skin.
    All of them are kept, and only the other rows are drawn. The weights of the labelled rows are multiplied by the
    fraction of the other rows that was drawn. The labelled rows thus have the same fraction of the total weight as
    before.
    """
    if weight is None:
        return np.sort(rng.choice(rows_n, most_n, replace=False)), None
    heavy = weight > weight.min()
    light = np.flatnonzero(~heavy)
    left_n = most_n - int(heavy.sum())
    if left_n < 1:
        raise TrainingError(
            "rbf_ridge",
            "rows_max_n",
            f"more than the {heavy.sum()} labelled rows of the skin",
            most_n,
            "Increase rows_max_n.",
        )
    kept = np.sort(np.concatenate([np.flatnonzero(heavy), rng.choice(light, left_n, replace=False)]))
    return kept, np.where(heavy, weight * left_n / len(light), weight)[kept]


def _check_rows(settings: Classical, inputs: Float32[np.ndarray, "n c"], target: Float32[np.ndarray, "n 3"]) -> None:
    known_n = (~np.isnan(target)).sum(axis=0)
    fewest_n = min((int(n) for n in known_n if n), default=0)
    least_n = settings.neighbours_n if isinstance(settings, Neighbours) else 1
    if fewest_n < least_n:
        rule = f"{least_n} or more for each target"
        raise TrainingError(
            settings.method, "training rows", rule, fewest_n, "Record more indentations of which this target is known."
        )
    if not np.isfinite(inputs).all():
        broken_n = int((~np.isfinite(inputs)).any(axis=1).sum())
        raise TrainingError(f"{settings.method}: the inputs of {broken_n} rows are not finite. Remove these rows.")


# Predictions are computed in blocks of this number of rows, to limit the use of memory. With 6000 training rows, the
# kernel matrix of a block takes 200 MB.
BLOCK_ROWS_N = 4096
_THREADS = ThreadpoolController()  # created only once, because its creation takes 3 ms, while a use takes only 15 us


def one_thread() -> Any:
    """Return a context manager that limits linear algebra to one thread."""
    return _THREADS.limit(limits=1)


def make_regressor(settings: Classical) -> Any:
    """Create a regressor with these settings.

    The regressor has the methods fit(inputs, target, weight) and predict(inputs).
    """
    # scikit-learn is imported here, because the import takes 0.7 s, and modules that only read settings do not need it.
    match settings:
        case Ridge():
            from sklearn import linear_model

            return linear_model.Ridge(settings.alpha)
        case CubicRidge():
            return _BlockwiseCubicRidge(settings.alpha)
        case Neighbours(neighbours_n=k):
            from sklearn.neighbors import KNeighborsRegressor

            # The tree is requested explicitly, because scikit-learn would use brute force for 16 or more inputs. A k-d
            # tree is fast here even for so many inputs, because readings vary along few directions only.
            return _WeightedNeighbours(KNeighborsRegressor(k, weights="distance", algorithm="kd_tree"))
        case RbfRidge():
            from sklearn.kernel_ridge import KernelRidge

            return KernelRidge(kernel="rbf", alpha=settings.alpha, gamma=settings.gamma)


class _BlockwiseCubicRidge:
    """A regressor for cubic ridge regression (see `CubicRidge`), which computes the products in blocks of rows.

    For all rows of the paper's data at once, the products would take 5 GB of memory.
    """

    def __init__(self, alpha: float) -> None:
        from sklearn.preprocessing import PolynomialFeatures

        self.alpha = alpha
        # The first product is the constant 1. Its coefficient is not penalised.
        self.lift = PolynomialFeatures(3)

    def fit(self, inputs: np.ndarray, target: np.ndarray, weight: np.ndarray | None, /) -> None:
        c = self.lift.fit(inputs[:1]).n_output_features_
        squares, moments = np.diag([0.0] + [self.alpha] * (c - 1)), np.zeros((c, target.shape[1]))
        root = np.ones(len(inputs)) if weight is None else np.sqrt(weight)
        for block in blocks(len(inputs)):
            lifted = root[block, None] * self.lift.transform(inputs[block])  # [b c]
            squares += lifted.T @ lifted
            moments += lifted.T @ (root[block, None] * target[block])
        self.factors = np.linalg.solve(squares, moments)

    def predict(self, inputs: np.ndarray, /) -> np.ndarray:
        return self.lift.transform(inputs) @ self.factors


@dataclass(frozen=True)
class _WeightedNeighbours:
    """A regressor by nearest neighbours that supports weights of the training rows, which scikit-learn's does not.

    Let w be the weights and y the targets. scikit-learn's regressor predicts w y and w as if they were targets. The
    quotient of both predictions is the weighted mean of y over the neighbours.
    """

    neighbours: Any  # sklearn.neighbors.KNeighborsRegressor

    def fit(self, inputs: np.ndarray, target: np.ndarray, weight: np.ndarray | None, /) -> None:
        weights = np.ones(len(inputs)) if weight is None else weight
        self.neighbours.fit(inputs, np.column_stack([weights[:, None] * target, weights]))

    def predict(self, inputs: np.ndarray, /) -> np.ndarray:
        summed = self.neighbours.predict(inputs)
        return summed[:, :-1] / summed[:, -1:]


def blocks(rows_n: int) -> list[slice]:
    """Return slices that split `rows_n` rows into blocks of at most `BLOCK_ROWS_N` rows."""
    return [slice(i, i + BLOCK_ROWS_N) for i in range(0, rows_n, BLOCK_ROWS_N)]


@dataclass(frozen=True)
class ClassicalJob:
    """A job: fit a method to the training rows of a fold, and predict the test rows.

    train, test: row numbers of the training rows and of the test rows.
    few_labels: row numbers of additional training rows, which are from the new skin. Together, these rows have the same
        weight as all other training rows together.
    rows_max_n: if there are more training rows than this, a random selection of them is used. This number does not
        include the rows in `few_labels`.
    """

    name: str
    method: Classical
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]
    few_labels: Int64[np.ndarray, " o"]
    rows_max_n: int
    seed: int


@dataclass(frozen=True)
class ClassicalResult:
    """The result of a job: predictions for the test rows (x in mm, y in mm, force in N), and computing times."""

    predicted: Float32[np.ndarray, "b 3"]
    rows_n: int
    seconds: float  # time of the fit
    started_s: float  # Unix time at which the fit started
    one_reading_s: float  # median time that a prediction for a single reading takes


@dataclass(frozen=True)
class _JobRows:
    """The rows that one job needs. Only these rows are sent to the process that runs the job."""

    train: Float32[np.ndarray, "a c"]
    target: Float32[np.ndarray, "a 3"]
    weight: Float32[np.ndarray, " a"] | None
    test: Float32[np.ndarray, "b c"]


def run_classical_jobs(
    jobs: Sequence[ClassicalJob], data: TrainingData, executor: Executor, log: Callable[[str], None]
) -> list[ClassicalResult]:
    """Run all jobs in the executor, and return the results in the order of `jobs`.

    `log` is called with one line of text for each finished job.
    """
    running = [executor.submit(_fit, job.method, job.name, job.seed, _rows_of(job, data)) for job in jobs]
    results = []
    for job, future in zip(jobs, running, strict=True):
        results.append(future.result())
        log(f"{len(results)}/{len(jobs)} {job.name}")
    return results


def _rows_of(job: ClassicalJob, data: TrainingData) -> _JobRows:
    train, weight, view = job.train, None, VIEW[job.method.inputs]
    if len(train) > job.rows_max_n:
        kept = rng_for(job.seed, "thin", job.name).choice(len(train), job.rows_max_n, replace=False)
        train = train[np.sort(kept)]
    if len(job.few_labels):
        share = len(train) / len(job.few_labels)
        weight = np.concatenate([np.ones(len(train)), np.full(len(job.few_labels), share)]).astype(np.float32)
        train = np.concatenate([train, job.few_labels])
    return _JobRows(view(data.db_uT[train]), data.target[train], weight, view(data.db_uT[job.test]))


def _fit(method: Classical, name: str, seed: int, rows: _JobRows) -> ClassicalResult:
    started_s, start_s = time.time(), time.monotonic()
    fitted = fit(method, rows.train, rows.target, rng_for(seed, "baseline", name), weight=rows.weight)
    seconds = time.monotonic() - start_s
    one_reading_s = median_call_s(partial(fitted.predict, rows.test[:1]))
    return ClassicalResult(fitted.predict(rows.test), fitted.rows_n, seconds, started_s, one_reading_s)
