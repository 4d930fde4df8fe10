"""Classical regression methods, which are trained on the same folds as the networks, as reference methods."""

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
    """Base class of the settings of a method. `inputs` is a view of the field change (`reskin.models.inputs.VIEW`)."""

    inputs: Literal["raw", "shape"]


class Ridge(_Method):
    """Linear ridge regression. `alpha` is the weight of the penalty relative to the sum of scaled squared errors."""

    title: ClassVar[str] = "ridge"
    method: Literal["ridge"]
    alpha: Annotated[float, Field(gt=0)]


class CubicRidge(_Method):
    """Ridge regression on all products of up to three inputs: 815 products for 15 inputs, 968 products for 16."""

    title: ClassVar[str] = "cubic ridge"
    method: Literal["cubic_ridge"]
    alpha: Annotated[float, Field(gt=0)]


class Neighbours(_Method):
    """Mean of the targets of the nearest training rows, with weights (row weight / distance)."""

    title: ClassVar[str] = "k nearest neighbours"
    method: Literal["knn"]
    neighbours_n: Annotated[int, Field(ge=1)]


class RbfRidge(_Method):
    """Kernel ridge regression with kernel exp(-gamma d^2) and at most `rows_max_n` rows.

    Inputs are standardised, so the squared distance d^2 of two rows is on average 2 per input.
    """

    title: ClassVar[str] = "RBF kernel ridge"
    method: Literal["rbf_ridge"]
    alpha: Annotated[float, Field(gt=0)]
    gamma: Annotated[float, Field(gt=0)]
    rows_max_n: Annotated[int, Field(ge=1)]


class Boosting(_Method):
    """Gradient-boosted trees, one model per target.

    Early stopping is disabled, because it would split the readings of an indentation into training and validation.
    """

    title: ClassVar[str] = "gradient boosting"
    method: Literal["boosting"]
    rounds_n: Annotated[int, Field(ge=1)]
    rate: Annotated[float, Field(gt=0)]
    leaves_n: Annotated[int, Field(ge=2)]


Classical = Annotated[Ridge | CubicRidge | Neighbours | RbfRidge | Boosting, Field(discriminator="method")]


@dataclass(frozen=True)
class _Part:
    """A regressor for targets that are known in the same training rows."""

    targets: list[int]  # columns of the targets: 0 is x, 1 is y, 2 is the force
    regressor: Any  # has methods fit(inputs, target, weight) and predict(inputs)
    rows_n: int


@dataclass(frozen=True)
class FittedRegressor:
    """A fitted method: one regressor per group of targets, and the scaler, fitted to the same training rows."""

    scaler: Scaler
    parts: tuple[_Part, ...]

    @property
    def rows_n(self) -> int:
        """Number of training rows for the target that has the most known values."""
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
    """Fit a method to rows; the targets are x in mm, y in mm and the force in N, and unknown targets are NaN.

    Targets that are known in different rows are fitted separately. `weight` is the weight of each row in the loss, or
    in the mean over nearest neighbours. It is not used for fitting the scaler.
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
        regressor = make_regressor(settings, rng)
        with one_thread():
            regressor.fit(encoded[rows], encoded_target[rows][:, targets], row_weights)
        parts.append(_Part(targets, regressor, len(rows)))
    return FittedRegressor(scaler, tuple(parts))


def _ignore_constant_inputs(scaler: Scaler) -> Scaler:
    """Set the scale of constant inputs to infinity, so that they are scaled to 0.

    With the scale `SCALE_FLOOR`, an input that is constant in training but not in the test would dominate all
    distances.
    """
    constant = scaler.input_scale <= SCALE_FLOOR
    return replace(scaler, input_scale=np.where(constant, np.float32(np.inf), scaler.input_scale))


def _group_targets(target: Float32[np.ndarray, "n 3"]) -> list[tuple[list[int], Int64[np.ndarray, " a"]]]:
    """Group the targets that are known in the same rows; return the columns and the row numbers of each group."""
    known = ~np.isnan(target)
    together: dict[bytes, list[int]] = {}
    for i in np.flatnonzero(known.any(axis=0)):
        together.setdefault(known[:, i].tobytes(), []).append(int(i))
    return [(targets, np.flatnonzero(known[:, targets[0]])) for targets in together.values()]


def _thin(
    rows_n: int, most_n: int, weight: Float[np.ndarray, " n"] | None, rng: np.random.Generator
) -> tuple[Int64[np.ndarray, " a"], Float[np.ndarray, " a"] | None]:
    """Draw `most_n` of `rows_n` rows without replacement; return the row numbers and the weights of the drawn rows.

    All rows whose weight is above the minimum are kept, because they are the few labelled rows of a new skin. Their
    weight is multiplied by the kept fraction of the other rows, so that their share of the total weight is unchanged.
    """
    if weight is None:
        return np.sort(rng.choice(rows_n, most_n, replace=False)), None
    heavy = weight > weight.min()
    light = np.flatnonzero(~heavy)
    left_n = most_n - int(heavy.sum())
    if left_n < 1:
        raise TrainingError(
            "rbf_ridge", "rows_max_n", f"more than the {heavy.sum()} labelled rows of the skin", most_n, "Increase it."
        )
    kept = np.sort(np.concatenate([np.flatnonzero(heavy), rng.choice(light, left_n, replace=False)]))
    return kept, np.where(heavy, weight * left_n / len(light), weight)[kept]


def _check_rows(settings: Classical, inputs: Float32[np.ndarray, "n c"], target: Float32[np.ndarray, "n 3"]) -> None:
    known_n = (~np.isnan(target)).sum(axis=0)
    fewest_n = min((int(n) for n in known_n if n), default=0)
    least_n = settings.neighbours_n if isinstance(settings, Neighbours) else 1
    if fewest_n < least_n:
        rule = f"{least_n} or more for each target"
        raise TrainingError(settings.method, "training rows", rule, fewest_n, "Record more indentations.")
    if not np.isfinite(inputs).all():
        broken_n = int((~np.isfinite(inputs)).any(axis=1).sum())
        raise TrainingError(f"{settings.method}: the inputs of {broken_n} rows are not finite. Remove these rows.")


BLOCK_ROWS_N = 4096  # rows per block, to limit memory: the kernel matrix with 6000 training rows takes 200 MB
_THREADS = ThreadpoolController()  # created once, because its creation takes 3 ms, and each use only 15 us


def one_thread() -> Any:
    """Return a context manager that limits linear algebra to one thread."""
    return _THREADS.limit(limits=1)


def make_regressor(settings: Classical, rng: np.random.Generator) -> Any:
    """Create the regressor of these settings, which has methods fit(inputs, target, weight) and predict(inputs)."""
    # scikit-learn is imported late, because it takes .7 s, and modules that only read settings do not need it.
    match settings:
        case Ridge():
            from sklearn import linear_model

            return linear_model.Ridge(settings.alpha)
        case CubicRidge():
            return _BlockwiseCubicRidge(settings.alpha)
        case Neighbours(neighbours_n=k):
            from sklearn.neighbors import KNeighborsRegressor

            # A k-d tree is fast, because readings vary along few directions. With 16 or more inputs, scikit-learn would
            # use brute force by default.
            return _WeightedNeighbours(KNeighborsRegressor(k, weights="distance", algorithm="kd_tree"))
        case RbfRidge():
            from sklearn.kernel_ridge import KernelRidge

            return KernelRidge(kernel="rbf", alpha=settings.alpha, gamma=settings.gamma)
        case Boosting():
            from sklearn.ensemble import HistGradientBoostingRegressor
            from sklearn.multioutput import MultiOutputRegressor

            trees = HistGradientBoostingRegressor(
                max_iter=settings.rounds_n,
                learning_rate=settings.rate,
                max_leaf_nodes=settings.leaves_n,
                early_stopping=False,
                random_state=int(rng.integers(2**32)),
            )
            return MultiOutputRegressor(trees)


class _BlockwiseCubicRidge:
    """Ridge regression on products of inputs, computed in blocks of rows to limit memory.

    The products for all rows of the paper's data would take 5 GB.
    """

    def __init__(self, alpha: float) -> None:
        from sklearn.preprocessing import PolynomialFeatures

        self.alpha = alpha
        self.lift = PolynomialFeatures(3)  # the first product is 1; its coefficient is not penalised

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
    """Nearest neighbours with row weights w, which scikit-learn does not support.

    The prediction is scikit-learn's prediction of the target w y, divided by its prediction of the target w.
    """

    neighbours: Any  # sklearn.neighbors.KNeighborsRegressor

    def fit(self, inputs: np.ndarray, target: np.ndarray, weight: np.ndarray | None, /) -> None:
        weights = np.ones(len(inputs)) if weight is None else weight
        self.neighbours.fit(inputs, np.column_stack([weights[:, None] * target, weights]))

    def predict(self, inputs: np.ndarray, /) -> np.ndarray:
        summed = self.neighbours.predict(inputs)
        return summed[:, :-1] / summed[:, -1:]


def blocks(rows_n: int) -> list[slice]:
    """Return slices that split `rows_n` rows into blocks of at most `BLOCK_ROWS_N`."""
    return [slice(i, i + BLOCK_ROWS_N) for i in range(0, rows_n, BLOCK_ROWS_N)]


@dataclass(frozen=True)
class ClassicalJob:
    """Training and test of a method on one fold; `train` and `test` are row numbers.

    At most `rows_max_n` training rows are used, drawn at random. `few_labels` are the row numbers of additional
    training rows, from a new skin. Their total weight equals that of all other training rows.
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
    """Predictions (mm, mm, N) for the test rows, the number of training rows, and computing times."""

    predicted: Float32[np.ndarray, "b 3"]
    rows_n: int
    seconds: float  # time of the fit
    started_s: float  # Unix time at which the fit started
    one_reading_s: float  # median time of a prediction for a single reading


@dataclass(frozen=True)
class _JobRows:
    """The rows that one job needs; only they are sent to the process that runs the job."""

    train: Float32[np.ndarray, "a c"]
    target: Float32[np.ndarray, "a 3"]
    weight: Float32[np.ndarray, " a"] | None
    test: Float32[np.ndarray, "b c"]


def run_classical_jobs(
    jobs: Sequence[ClassicalJob], data: TrainingData, executor: Executor, log: Callable[[str], None]
) -> list[ClassicalResult]:
    """Run all jobs in the executor, and return the results in the order of `jobs`."""
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
