"""How well a place is told before its touch, on the folds within one skin: scores of 2 neighbours. Knows no argv.

They stand beside a network's scores on the same rows: what they reach, the network may have learnt from the scan. The
hover control asks what was learnt on contacts for the place of a tip that does not touch: a skin that feels nothing
answers by chance, a magnet on the tip gives its place away.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32

from pipeline.training.jobs import SceneData
from reskin import io
from reskin.data.rows import Hover, Selection, gather_hover, gather_scan
from reskin.data.splits import SAME_SKIN, Fold
from reskin.metrics import score
from reskin.models.classical import Neighbours, fit
from reskin.models.trained import Network
from reskin.seeds import rng_for

NEIGHBOURS = Neighbours(method="knn", inputs="raw", neighbours_n=2)
PLACE = ("accuracy_pct", "mse_xy_mm2")
LENGTHS = ("hover_uT", "touch_uT")  # median |dB| of rows that hover, and of contacts of about 1 N
TOUCH_N = (0.8, 1.2)
BY_TIME = "single_temporal"  # whose tested passes are not trained on


def score_before_touch(
    data: SceneData, indentations: Path, captures: list[str], networks: Mapping[str, Sequence[Network]]
) -> pa.Table:
    """Score places told by the no-load field alone, by the number in the scan alone, and of a tip that only hovers.

    A row a fold and input. `networks` are those of each fold that the hover control asks too, beside 2 neighbours.
    """
    read = [io.read_readings(indentations / f"{name}.parquet") for name in captures]
    scan = gather_scan(read, data.settings.section(Selection, "selection"))
    told_by = {"noload": scan.noload_uT, "scan": scan.scan_i[:, None].astype(np.float32)}
    lines = [
        {"question": fold.experiment, "fold": fold.name, "told_by": name, **_score(data, inputs, fold.train, fold.test)}
        for fold in data.folds
        if fold.experiment in SAME_SKIN
        for name, inputs in told_by.items()
    ]
    hover = gather_hover(read)
    for fold in [fold for fold in data.folds if fold.experiment == BY_TIME]:
        lines += _hover(data, fold, hover, networks.get(fold.name, ()))
    kinds = dict.fromkeys(("question", "fold", "told_by"), pa.string())
    kinds |= dict.fromkeys((*PLACE, *LENGTHS), pa.float64())
    return pa.Table.from_pylist(lines, schema=pa.schema(kinds))


def _hover(data: SceneData, fold: Fold, hover: Hover, networks: Sequence[Network]) -> list[dict[str, Any]]:
    """Score rows that hover in the tested passes of a fold, by what was learnt on contacts."""
    rows, tested = data.rows, set(zip(data.rows.skin[fold.test], data.rows.pass_i[fold.test].tolist(), strict=True))
    own = np.array([pair in tested for pair in zip(hover.skin, hover.pass_i.tolist(), strict=True)], bool)
    if not own.any():
        return []
    db_uT, place_mm = hover.db_uT[own], hover.place_mm[own]
    rng = rng_for(data.settings.seed, "before-touch", "hover")
    neighbours = fit(NEIGHBOURS, rows.db_uT[fold.train], rows.target[fold.train], rng, weight=None)
    answers = {"hover": [neighbours.predict(db_uT)], "hover_network": [network(db_uT) for network in networks]}
    force_N = rows.target[fold.test, 2]
    touch_uT = np.linalg.norm(rows.db_uT[fold.test][(force_N > TOUCH_N[0]) & (force_N < TOUCH_N[1])], axis=1)
    lengths = {"hover_uT": float(np.median(np.linalg.norm(db_uT, axis=1))), "touch_uT": float(np.median(touch_uT))}
    true = np.column_stack([place_mm, np.full(len(place_mm), np.nan)])
    lines = []
    for told_by, found in answers.items():
        scores = [score(true, answer) for answer in found]
        if scores:
            means = {name: float(np.mean([one[name] for one in scores])) for name in PLACE}
            lines.append({"question": fold.experiment, "fold": fold.name, "told_by": told_by, **means, **lengths})
    return lines


def _score(
    data: SceneData, inputs: Float32[np.ndarray, "f c"], train: np.ndarray, test: np.ndarray
) -> Mapping[str, float]:
    rng = rng_for(data.settings.seed, "before-touch")  # neighbours draw nothing
    fitted = fit(NEIGHBOURS, inputs[train], data.rows.target[train], rng, weight=None)
    found = score(data.rows.target[test], fitted.predict(inputs[test]))
    return {name: found[name] for name in PLACE}
