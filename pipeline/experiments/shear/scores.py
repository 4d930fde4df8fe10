"""Place and all three forces of dragged lines. In: true and predicted x, y, Fx, Fy, Fz. Out: the paper's numbers.

The paper does not say whether MSE_xy and MSE_Fxy sum or average their two axes: here they are means, as MSE_xy is in
`metrics`. Refuses to know models, folds and files.
"""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from pipeline.evaluation.metrics import ACCURACY_LIMIT_MM
from pipeline.evaluation.scores import summarise

PLACE, SIDEWAYS, NORMAL = slice(0, 2), slice(2, 4), slice(4, 5)
PARTS = {"xy": (PLACE, "mse_xy_mm2"), "fxy": (SIDEWAYS, "mse_fxy_N2"), "fz": (NORMAL, "mse_fz_N2")}


def score5(true: Float[np.ndarray, "f 5"], predicted: Float[np.ndarray, "f 5"]) -> dict[str, float]:
    """Score predictions of (x_mm, y_mm, Fx_N, Fy_N, Fz_N).

    `explained_*` is 1 - MSE / variance of the truth: 1 is perfect, 0 is no better than the mean. It stands beside the
    errors because forces of another size than the paper's have errors of another size.
    """
    error = predicted.astype(float) - true
    near = np.abs(error[:, PLACE]) <= ACCURACY_LIMIT_MM
    numbers = {"accuracy_pct": 100.0 * float(near.all(axis=1).mean())}
    numbers |= {mse: float((error[:, part] ** 2).mean()) for part, mse in PARTS.values()}
    for name, (part, mse) in PARTS.items():
        numbers[f"explained_{name}"] = 1 - numbers[mse] / float(true[:, part].astype(float).var(axis=0).mean())
    return numbers


def answer_shear(
    by_reading: Sequence[tuple[Hashable, Mapping[str, float]]],
    by_line: Sequence[tuple[Hashable, Mapping[str, float]]],
    *,
    target: Float[np.ndarray, "f 5"],
    lines_n: int,
    passes_n: int,
) -> dict[str, Any]:
    """Summarise (fold, score) pairs of both splits over folds, each the mean of its seeds, with the forces' size.

    Of `lines_n` dragged lines in all, each place and depth was dragged along in each of `passes_n`.
    """
    rms_N = np.sqrt((target.astype(float) ** 2).mean(axis=0))
    sizes = {"fx_rms_N": float(rms_N[2]), "fy_rms_N": float(rms_N[3]), "fz_rms_N": float(rms_N[4])}
    return _over_folds(by_reading) | {
        "by_line": _over_folds(by_line), "readings_n": len(target), "lines_n": lines_n, "passes_n": passes_n, **sizes,
    }  # fmt: skip


def _over_folds(scored: Sequence[tuple[Hashable, Mapping[str, float]]]) -> dict[str, Any]:
    return summarise(pd.DataFrame([scores for _, scores in scored]).groupby([fold for fold, _ in scored]).mean())
