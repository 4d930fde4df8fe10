"""Classical regression methods on the folds of the networks."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float, Float32, Int64
from pydantic import Field
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge as LinearRidge
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.preprocessing import PolynomialFeatures
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

from reskin.config import Strict
from reskin.errors import TrainingError
from reskin.models.inputs import SCALE_FLOOR, VIEW, Scaler, fit_standard
from reskin.models.job import TrainingData, median_call_s
from reskin.seeds import rng_for


class _Method(Strict):
    """What all methods share: the view (reskin.models.inputs) that they are to be given."""

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
class FittedRegressor:
    """A fitted method with the scaler of its training rows."""

    scaler: Scaler
    parts: tuple[_Part, ...]

    @property
    def rows_n(self) -> int:
        """Training rows that were used, by the target that is known in most of them."""
        return max(part.rows_n for part in self.parts)

    def predict(self, inputs: Float32[np.ndarray, "f c"]) -> Float32[np.ndarray, "f 3"]:
        """Predict x_mm, y_mm and F_N; NaN where no training row knew the target."""

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
    """Fit to the rows that know a target (mm, mm, N), each target by itself where they differ.

    `weight` counts a row as so many in the loss (in a vote, of neighbours); the scaler does not know it.
    """

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
    return FittedRegressor(scaler, tuple(parts))


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


BLOCK_ROWS_N = 4096  # handled at once, to bound memory: a kernel of them and 6000 rows is 200 MB
_THREADS = ThreadpoolController()  # of the libraries above: finding them takes 3 ms, limiting them 15 us


def one_thread() -> Any:
    """Limit the libraries of linear algebra to one thread, as a context."""
    return _THREADS.limit(limits=1)


def make_regressor(settings: Classical, rng: np.random.Generator) -> Any:
    """Make what fits by these settings: fit(inputs, target, weight), predict(inputs)."""
    match settings:
        case Ridge():
            return LinearRidge(settings.alpha)
        case CubicRidge():
            return _Cubic(settings.alpha)
        case Neighbours(neighbours_n=k):
            # A tree, as few of the 15 directions are ever taken; scikit-learn's choice is brute force from 16 on.
            return _Voting(KNeighborsRegressor(k, weights="distance", algorithm="kd_tree"))
        case RbfRidge():
            return KernelRidge(kernel="rbf", alpha=settings.alpha, gamma=settings.gamma)
        case Boosting():
            trees = HistGradientBoostingRegressor(
                max_iter=settings.rounds_n,
                learning_rate=settings.rate,
                max_leaf_nodes=settings.leaves_n,
                early_stopping=False,
                random_state=int(rng.integers(2**32)),
            )
            return MultiOutputRegressor(trees)


class _Cubic:
    """Ridge on products, its sums gathered a block at a time: all products of the paper's rows would be 5 GB."""

    def __init__(self, alpha: float) -> None:
        self.alpha = alpha
        self.lift = PolynomialFeatures(3)  # the first product is 1, whose factor is free

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
class _Voting:
    """scikit-learn's neighbours take no weights: sum(w y / d) / sum(w / d) is the ratio of two of its answers."""

    neighbours: KNeighborsRegressor

    def fit(self, inputs: np.ndarray, target: np.ndarray, weight: np.ndarray | None, /) -> None:
        votes = np.ones(len(inputs)) if weight is None else weight
        self.neighbours.fit(inputs, np.column_stack([votes[:, None] * target, votes]))

    def predict(self, inputs: np.ndarray, /) -> np.ndarray:
        voted = self.neighbours.predict(inputs)
        return voted[:, :-1] / voted[:, -1:]


def blocks(rows_n: int) -> list[slice]:
    """Cut rows into blocks that fit into memory."""
    return [slice(i, i + BLOCK_ROWS_N) for i in range(0, rows_n, BLOCK_ROWS_N)]


@dataclass(frozen=True)
class ClassicalJob:
    """A method on one fold; `few_labels` are labelled rows of a new skin, which together weigh as much as all others.

    More than `rows_max_n` training rows are thinned to this number at random.
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
    """Predictions (mm, mm, N) for the test rows, the number of training rows, and times of fit and prediction."""

    predicted: Float32[np.ndarray, "b 3"]
    rows_n: int
    seconds: float
    one_reading_s: float  # median time of a prediction for a single reading


@dataclass(frozen=True)
class _Inputs:
    """The rows of one task, as its method sees them: small enough for another process."""

    train: Float32[np.ndarray, "a c"]
    target: Float32[np.ndarray, "a 3"]
    weight: Float32[np.ndarray, " a"] | None
    test: Float32[np.ndarray, "b c"]


def run_classical_jobs(
    tasks: Sequence[ClassicalJob], rows: TrainingData, executor: Executor, tell: Callable[[str], None]
) -> list[ClassicalResult]:
    running = [executor.submit(_fit, task.method, task.name, task.seed, _inputs(task, rows)) for task in tasks]
    fits = []
    for task, future in zip(tasks, running, strict=True):
        fits.append(future.result())
        tell(f"{len(fits)}/{len(tasks)} {task.name}")
    return fits


def _inputs(task: ClassicalJob, rows: TrainingData) -> _Inputs:
    train, weight, view = task.train, None, VIEW[task.method.inputs]
    if len(train) > task.rows_max_n:
        kept = rng_for(task.seed, "thin", task.name).choice(len(train), task.rows_max_n, replace=False)
        train = train[np.sort(kept)]
    if len(task.few_labels):
        share = len(train) / len(task.few_labels)
        weight = np.concatenate([np.ones(len(train)), np.full(len(task.few_labels), share)]).astype(np.float32)
        train = np.concatenate([train, task.few_labels])
    return _Inputs(view(rows.db_uT[train]), rows.target[train], weight, view(rows.db_uT[task.test]))


def _fit(method: Classical, name: str, seed: int, inputs: _Inputs) -> ClassicalResult:
    start_s = time.monotonic()
    fitted = fit(method, inputs.train, inputs.target, rng_for(seed, "baseline", name), weight=inputs.weight)
    seconds = time.monotonic() - start_s
    one_reading_s = median_call_s(partial(fitted.predict, inputs.test[:1]))
    return ClassicalResult(fitted.predict(inputs.test), fitted.rows_n, seconds, one_reading_s)
