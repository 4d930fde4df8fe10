"""Control experiments: predict the place of a contact from inputs that do not contain the signal of the contact.

A robot presses the places of a skin in a certain order, and repeats this in several passes. A network could therefore
learn to predict the place from the progress of the scan, and not from the contact. The first control predicts places
from one of two inputs: the no-load field before the indentation, or the number of the indentation in its pass. It uses
nearest neighbours (k = 2). If its predictions are accurate, the scores of networks on the same folds do not prove that
the networks recognise contacts.

The second control, the hover control, takes models that were trained on contacts and applies them to readings that were
taken while the tip hovers over the skin. The accuracy of these predictions is at chance level, unless the chips sense
the tip itself.

Both controls use only folds in which training rows and test rows are from the same skin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Int64

from pipeline.training.jobs import SceneData
from reskin import io
from reskin.data.rows import Selection, contacts
from reskin.data.splits import SAME_SKIN, Fold
from reskin.metrics import score
from reskin.models.classical import Neighbours, fit
from reskin.models.trained import Network
from reskin.schema import Readings
from reskin.seeds import rng_for

NEIGHBOURS = Neighbours(method="knn", inputs="raw", neighbours_n=2)
PLACE = ("accuracy_pct", "mse_xy_mm2")
# Names of two columns: the median |dB| of the rows in which the tip hovers, and of contacts with a force of about 1 N.
MAGNITUDES = ("hover_uT", "touch_uT")
TOUCH_N = (0.8, 1.2)  # smallest and largest force that count as "about 1 N"
BY_TIME = "single_temporal"  # experiment that trains on some passes and tests on others


@dataclass(frozen=True)
class Scan:
    """The inputs of the first control, for each row of the scene.

    noload_uT: the no-load field before the row's indentation.
    scan_i: the number of the row's indentation in its pass, counted from 0.
    """

    noload_uT: Float32[np.ndarray, "f ch"]
    scan_i: Int64[np.ndarray, " f"]


def gather_scan(captures: Sequence[Readings], selection: Selection) -> Scan:
    """Gather the inputs of the first control from all captures, in the order of the scene's rows.

    `selection` must be the one with which the rows were loaded, because it determines which readings are rows.
    """
    captures = sorted(captures, key=lambda readings: readings.capture)
    kept = [contacts(readings, selection) for readings in captures]
    noload = [readings.noload_uT[keep] for readings, keep in zip(captures, kept, strict=True)]
    scan = [number_in_pass(readings)[keep] for readings, keep in zip(captures, kept, strict=True)]
    return Scan(np.concatenate(noload), np.concatenate(scan))


def number_in_pass(readings: Readings) -> Int64[np.ndarray, " f"]:
    """Return, for each reading, the number of earlier indentations in its pass.

    Indentations without a contact are counted too.
    """
    passes, of_pass = np.unique(readings.pass_i, return_inverse=True)
    indentation = readings.indentation.astype(np.int64)
    first = np.full(len(passes), indentation.max())
    np.minimum.at(first, of_pass, indentation)
    return indentation - first[of_pass]


@dataclass(frozen=True)
class Hover:
    """Readings that were taken while the tip hovered over a known place without contact.

    The passes of each skin are numbered as in `Rows`, so that a row can be assigned to a training or a test pass.
    """

    db_uT: Float32[np.ndarray, "f ch"]
    place_mm: Float32[np.ndarray, "f 2"]
    skin: np.ndarray
    pass_i: Int64[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.skin)


def gather_hover(captures: Sequence[Readings]) -> Hover:
    """Gather all rows in which the tip hovers: rows without force and between two contacts of the same pass.

    The place of such a row is that of the next contact, because a tip that descends in steps first hovers over the
    place that it then presses. Rows before the first contact of a pass are omitted, because they are the pass's no-load
    reading. Rows after the last contact are omitted, because no contact follows.
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
) -> pa.Table:
    """Run both controls, and return a table of their scores.

    For the first control, the table has one row for each fold and each of the two inputs. For the hover control, it has
    one row for each fold and each kind of model: nearest neighbours, and the trained networks that `networks` contains
    for the fold. The scores of the networks are averaged.
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
    kinds |= dict.fromkeys((*PLACE, *MAGNITUDES), pa.float64())
    return pa.Table.from_pylist(lines, schema=pa.schema(kinds))


def _hover(data: SceneData, fold: Fold, hover: Hover, networks: Sequence[Network]) -> list[dict[str, Any]]:
    """Run the hover control on one fold: predict the places of the hovering rows in the fold's test passes.

    The models are nearest neighbours, fitted to the contacts of the training rows, and the given networks.
    """
    rows = data.rows
    test_passes = set(zip(rows.skin[fold.test], rows.pass_i[fold.test].tolist(), strict=True))
    in_test_passes = np.array(
        [pair in test_passes for pair in zip(hover.skin, hover.pass_i.tolist(), strict=True)], bool
    )
    if not in_test_passes.any():
        return []
    db_uT, place_mm = hover.db_uT[in_test_passes], hover.place_mm[in_test_passes]
    rng = rng_for(data.settings.seed, "before-touch", "hover")
    neighbours = fit(NEIGHBOURS, rows.db_uT[fold.train], rows.target[fold.train], rng, weight=None)
    predictions = {"hover": [neighbours.predict(db_uT)], "hover_network": [network(db_uT) for network in networks]}
    force_N = rows.target[fold.test, 2]
    touch_uT = np.linalg.norm(rows.db_uT[fold.test][(force_N > TOUCH_N[0]) & (force_N < TOUCH_N[1])], axis=1)
    magnitudes = {"hover_uT": float(np.median(np.linalg.norm(db_uT, axis=1))), "touch_uT": float(np.median(touch_uT))}
    true = np.column_stack([place_mm, np.full(len(place_mm), np.nan)])
    lines = []
    for name, of_models in predictions.items():
        scores = [score(true, predicted) for predicted in of_models]
        if scores:
            means = {metric: float(np.mean([values[metric] for values in scores])) for metric in PLACE}
            lines.append({"question": fold.experiment, "fold": fold.name, "told_by": name, **means, **magnitudes})
    return lines


def _score(
    data: SceneData, inputs: Float32[np.ndarray, "f c"], train: np.ndarray, test: np.ndarray
) -> Mapping[str, float]:
    """Run the first control on one fold: fit nearest neighbours to the training rows, and score the test rows."""
    rng = rng_for(data.settings.seed, "before-touch")  # `fit` requires a generator, although this method is not random
    fitted = fit(NEIGHBOURS, inputs[train], data.rows.target[train], rng, weight=None)
    scores = score(data.rows.target[test], fitted.predict(inputs[test]))
    return {name: scores[name] for name in PLACE}
