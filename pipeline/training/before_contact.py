"""Predict places from inputs that do not contain the signal of the contact, on the folds within one skin.

A rig presses the places of a skin in some order (a scan). A network could learn this order instead of the contacts. To
find out, places are predicted by k nearest neighbours (k = 2) from one of two inputs: the no-load field before the
indentation, or the number of the indentation in its pass over the skin. If these predictions are accurate, networks may
have learnt places from the order of the scan.

The hover control tests another possible cause. Models that were trained on contacts predict the place of a tip that
hovers over the skin without touching it. Their accuracy is at chance level, unless the chips sense the tip itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from pipeline.training.jobs import SceneData
from pipeline.training.neighbours import predict_by_neighbours
from reskin import io
from reskin.data.rows import Selection, contacts
from reskin.data.splits import SAME_SKIN, Fold
from reskin.metrics import score
from reskin.models.trained import Network
from reskin.schema import Readings

NEIGHBOURS_N = 2
PLACE = ("accuracy_pct", "mse_xy_mm2")
MAGNITUDES = ("hover_uT", "touch_uT")  # names of the median |dB| of hovering rows, and of contacts at about 1 N
TOUCH_N = (0.8, 1.2)  # range of forces of the contacts at about 1 N
BY_TIME = "single_temporal"  # experiment that trains on some passes and tests on others


@dataclass(frozen=True)
class Scan:
    """What is known about each row of the scene before the contact.

    `noload_uT` is the no-load field, and `scan_i` is the number of the row's indentation in its pass over the skin.
    """

    noload_uT: Float32[np.ndarray, "f ch"]
    scan_i: Int64[np.ndarray, " f"]


def gather_scan(captures: Sequence[Readings], selection: Selection) -> Scan:
    """Stack the no-load field and the indentation's number in its pass, in the order of the scene's rows."""
    captures = sorted(captures, key=lambda readings: readings.capture)
    kept = [contacts(readings, selection) for readings in captures]
    noload = [readings.noload_uT[keep] for readings, keep in zip(captures, kept, strict=True)]
    scan = [number_in_pass(readings)[keep] for readings, keep in zip(captures, kept, strict=True)]
    return Scan(np.concatenate(noload), np.concatenate(scan))


def number_in_pass(readings: Readings) -> Int64[np.ndarray, " f"]:
    """For each reading, count the earlier indentations in its pass, including those without a contact."""
    passes, of_pass = np.unique(readings.pass_i, return_inverse=True)
    indentation = readings.indentation.astype(np.int64)
    first = np.full(len(passes), indentation.max())
    np.minimum.at(first, of_pass, indentation)
    return indentation - first[of_pass]


@dataclass(frozen=True)
class Hover:
    """Readings while a tip hovers over a known place without contact; `pass_i` is numbered as in `Rows`."""

    db_uT: Float32[np.ndarray, "f ch"]
    place_mm: Float32[np.ndarray, "f 2"]
    skin: np.ndarray
    pass_i: Int64[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.skin)


def gather_hover(captures: Sequence[Readings]) -> Hover:
    """Stack the rows without force between the contacts of a pass, each with the place of the next contact.

    A tip that descends in steps first hovers over the place of the contact. Rows before the first contact of a pass are
    omitted, because they are the pass's no-load reading. Rows after the last contact are omitted, because no contact
    follows.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    passes_n: dict[str, int] = {}
    for capture in sorted(captures, key=lambda readings: readings.capture):
        before_n = passes_n.get(capture.skin, 0)
        passes_n[capture.skin] = before_n + int(capture.pass_i.max()) + 1
        contact_i = np.flatnonzero(np.isfinite(capture.x_mm) & (capture.Fz_N > 0))
        hover_i = np.flatnonzero(np.isnan(capture.x_mm) & (capture.Fz_N == 0))
        following = np.searchsorted(contact_i, hover_i)
        between = (following > 0) & (following < len(contact_i))
        hover_i, previous_i, next_i = hover_i[between], contact_i[following[between] - 1], contact_i[following[between]]
        in_pass = capture.pass_i[hover_i]
        same_pass = (capture.pass_i[previous_i] == in_pass) & (capture.pass_i[next_i] == in_pass)
        hover_i, next_i = hover_i[same_pass], next_i[same_pass]
        place_mm = np.column_stack([capture.x_mm[next_i], capture.y_mm[next_i]])
        skins, pass_i = np.full(len(hover_i), capture.skin), capture.pass_i[hover_i].astype(np.int64) + before_n
        parts.append((capture.b_uT[hover_i] - capture.noload_uT[hover_i], place_mm, skins, pass_i))
    return Hover(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def score_before_contact(
    data: SceneData, indentations: Path, captures: list[str], networks: Mapping[str, Sequence[Network]]
) -> list[dict[str, Any]]:
    """Score places that are predicted without the signal of the contact, and the hover control.

    Places are predicted from the no-load field alone, and from the number of the indentation in its pass alone. The
    hover control uses nearest neighbours and the trained networks of each fold (`networks`). Returns rows of the table
    of scores: one row for each fold and input, and one row for each fold and model of the hover control.
    """
    read = [io.read_readings(indentations / f"{name}.parquet") for name in captures]
    scan = gather_scan(read, data.settings.section(Selection, "selection"))
    inputs_by_name = {"noload": scan.noload_uT, "scan": scan.scan_i[:, None].astype(np.float32)}
    lines = [
        {
            "experiment": fold.experiment,
            "fold": fold.name,
            "method": name,
            **_score(data, inputs, fold.train, fold.test),
        }
        for fold in data.folds
        if fold.experiment in SAME_SKIN
        for name, inputs in inputs_by_name.items()
    ]
    hover = gather_hover(read)
    for fold in [fold for fold in data.folds if fold.experiment == BY_TIME]:
        lines += _hover(data, fold, hover, networks.get(fold.name, ()))
    return lines


def _hover(data: SceneData, fold: Fold, hover: Hover, networks: Sequence[Network]) -> list[dict[str, Any]]:
    """Apply models that were trained on contacts to the hovering rows in a fold's test passes, and score them."""
    rows = data.rows
    test_passes = set(zip(rows.skin[fold.test], rows.pass_i[fold.test].tolist(), strict=True))
    in_test_passes = np.array(
        [pair in test_passes for pair in zip(hover.skin, hover.pass_i.tolist(), strict=True)], bool
    )
    if not in_test_passes.any():
        return []
    db_uT, place_mm = hover.db_uT[in_test_passes], hover.place_mm[in_test_passes]
    by_neighbours = predict_by_neighbours(rows.db_uT[fold.train], rows.target[fold.train], db_uT, NEIGHBOURS_N)
    predictions = {"hover": [by_neighbours], "hover_network": [network(db_uT) for network in networks]}
    force_N = rows.target[fold.test, 2]
    touch_uT = np.linalg.norm(rows.db_uT[fold.test][(force_N > TOUCH_N[0]) & (force_N < TOUCH_N[1])], axis=1)
    magnitudes = {"hover_uT": float(np.median(np.linalg.norm(db_uT, axis=1))), "touch_uT": float(np.median(touch_uT))}
    true = np.column_stack([place_mm, np.full(len(place_mm), np.nan)])
    lines = []
    for name, of_models in predictions.items():
        scores = [score(true, predicted) for predicted in of_models]
        if scores:
            means = {metric: float(np.mean([values[metric] for values in scores])) for metric in PLACE}
            lines.append({"experiment": fold.experiment, "fold": fold.name, "method": name, **means, **magnitudes})
    return lines


def _score(
    data: SceneData, inputs: Float32[np.ndarray, "f c"], train: np.ndarray, test: np.ndarray
) -> dict[str, float]:
    """Train nearest neighbours on inputs without the contact's signal, and score the places predicted for test rows."""
    predicted = predict_by_neighbours(inputs[train], data.rows.target[train], inputs[test], NEIGHBOURS_N)
    scores = score(data.rows.target[test], predicted)
    return {name: scores[name] for name in PLACE}
