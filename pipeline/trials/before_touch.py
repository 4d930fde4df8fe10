"""How well a place is told before its touch, on the folds within one skin: scores of 2 neighbours. Knows no argv.

They stand beside a network's scores on the same rows: what they reach, the network may have learnt from the scan.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float32

from pipeline.core import io
from pipeline.core.seeds import rng_for
from pipeline.dataset.rows import Selection
from pipeline.dataset.scan import gather_scan
from pipeline.dataset.splits import SAME_SKIN
from pipeline.evaluation.metrics import score
from pipeline.learning.classical import Neighbours, fit
from pipeline.trials.training import SceneData

NEIGHBOURS = Neighbours(method="knn", inputs="raw", neighbours_n=2)
PLACE = ("accuracy_pct", "mse_xy_mm2")


def score_before_touch(data: SceneData, indentations: Path, captures: list[str]) -> pa.Table:
    """Score places told by the no-load field alone, and by the number in the scan alone; a row a fold and input."""
    files = [indentations / f"{name}.parquet" for name in captures]
    scan = gather_scan([io.read_readings(file) for file in files], data.settings.section(Selection, "selection"))
    told_by = {"noload": scan.noload_uT, "scan": scan.scan_i[:, None].astype(np.float32)}
    lines = [
        {"question": fold.question, "fold": fold.name, "told_by": name, **_score(data, inputs, fold.train, fold.test)}
        for fold in data.folds
        if fold.question in SAME_SKIN
        for name, inputs in told_by.items()
    ]
    kinds = dict.fromkeys(("question", "fold", "told_by"), pa.string()) | dict.fromkeys(PLACE, pa.float64())
    return pa.Table.from_pylist(lines, schema=pa.schema(kinds))


def _score(
    data: SceneData, inputs: Float32[np.ndarray, "f c"], train: np.ndarray, test: np.ndarray
) -> Mapping[str, float]:
    rng = rng_for(data.settings.seed, "before-touch")  # neighbours draw nothing
    fitted = fit(NEIGHBOURS, inputs[train], data.rows.target[train], rng, weight=None)
    found = score(data.rows.target[test], fitted.predict(inputs[test]))
    return {name: found[name] for name in PLACE}
