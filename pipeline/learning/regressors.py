"""What classical methods fit with, of scikit-learn. In: settings. Out: regressors that take weights of rows.

Refuses to know scalers, unknown targets and which rows are left out.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import Ridge as LinearRidge
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.preprocessing import PolynomialFeatures
from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

from pipeline.learning.classical import Boosting, Classical, CubicRidge, Neighbours, RbfRidge, Ridge

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
