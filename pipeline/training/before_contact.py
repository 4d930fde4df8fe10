"""Scores of places that are estimated without the contact, on the folds within one skin, by 2 neighbours.

Inputs are the no-load field alone, or the row's number in the scan: an accuracy that they reach, a network may have
learnt from the scan rather than from contacts. The hover control predicts the place of a tip that hovers, from models
of contacts: chance for a tip that the skin does not sense, better for a magnet on it.
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
BY_TIME = "single_temporal"  # whose tested passes are not in training


def score_before_contact(
    data: SceneData, indentations: Path, captures: list[str], networks: Mapping[str, Sequence[Network]]
) -> pa.Table:
    """Score places by the no-load field alone, by the number in the scan alone, and of a tip that hovers.

    networks: by fold, for the hover control beside 2 neighbours. Returns a row for each fold and input.
    """
    read = [io.read_readings(indentations / f"{name}.parquet") for name in captures]
    scan = gather_scan(read, data.settings.section(Selection, "selection"))
    inputs_by_name = {"noload": scan.noload_uT, "scan": scan.scan_i[:, None].astype(np.float32)}
    lines = [
        {"question": fold.experiment, "fold": fold.name, "told_by": name, **_score(data, inputs, fold.train, fold.test)}
        for fold in data.folds
        if fold.experiment in SAME_SKIN
        for name, inputs in inputs_by_name.items()
    ]
    hover = gather_hover(read)
    for fold in [fold for fold in data.folds if fold.experiment == BY_TIME]:
        lines += _hover(data, fold, hover, networks.get(fold.name, ()))
    kinds = dict.fromkeys(("question", "fold", "told_by"), pa.string())
    kinds |= dict.fromkeys((*PLACE, *LENGTHS), pa.float64())
    return pa.Table.from_pylist(lines, schema=pa.schema(kinds))


def _hover(data: SceneData, fold: Fold, hover: Hover, networks: Sequence[Network]) -> list[dict[str, Any]]:
    """Score hovering rows in the tested passes of a fold, by models of contacts."""
    rows, tested = data.rows, set(zip(data.rows.skin[fold.test], data.rows.pass_i[fold.test].tolist(), strict=True))
    own = np.array([pair in tested for pair in zip(hover.skin, hover.pass_i.tolist(), strict=True)], bool)
    if not own.any():
        return []
    db_uT, place_mm = hover.db_uT[own], hover.place_mm[own]
    rng = rng_for(data.settings.seed, "before-touch", "hover")
    neighbours = fit(NEIGHBOURS, rows.db_uT[fold.train], rows.target[fold.train], rng, weight=None)
    predictions = {"hover": [neighbours.predict(db_uT)], "hover_network": [network(db_uT) for network in networks]}
    force_N = rows.target[fold.test, 2]
    touch_uT = np.linalg.norm(rows.db_uT[fold.test][(force_N > TOUCH_N[0]) & (force_N < TOUCH_N[1])], axis=1)
    lengths = {"hover_uT": float(np.median(np.linalg.norm(db_uT, axis=1))), "touch_uT": float(np.median(touch_uT))}
    true = np.column_stack([place_mm, np.full(len(place_mm), np.nan)])
    lines = []
    for name, found in predictions.items():
        scores = [score(true, predicted) for predicted in found]
        if scores:
            means = {metric: float(np.mean([one[metric] for one in scores])) for metric in PLACE}
            lines.append({"question": fold.experiment, "fold": fold.name, "told_by": name, **means, **lengths})
    return lines


def _score(
    data: SceneData, inputs: Float32[np.ndarray, "f c"], train: np.ndarray, test: np.ndarray
) -> Mapping[str, float]:
    rng = rng_for(data.settings.seed, "before-touch")  # neighbours are not random
    fitted = fit(NEIGHBOURS, inputs[train], data.rows.target[train], rng, weight=None)
    found = score(data.rows.target[test], fitted.predict(inputs[test]))
    return {name: found[name] for name in PLACE}
