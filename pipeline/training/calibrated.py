"""Experiment `calibrated`: a finished universal model is calibrated to each held-out board and scored on its test rows.

The model is the one that comes with the project, or one that `reskin model make` made for the layout of the scene's
boards. No recording is used to train it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int64
from pydantic import Field

from pipeline.settings import Settings
from pipeline.training.jobs import SceneData, score_test
from reskin.config import Strict
from reskin.data.splits import Fold, labelling_order
from reskin.errors import ParamsError
from reskin.schema import Readings
from reskin.universal.force import NORMAL_90
from reskin.universal.layout import BoardLayout
from reskin.universal.model import FILE, Universal, load_universal


class Calibrated(Strict):
    """Settings section `calibrated`.

    - model: path of the model's .safetensors file in the checkout. The card of the model must be beside it.
    - labels_n: numbers of labelled presses of the held-out board.
    - even: whether the presses are at the places of a grid around the board's centre, with equally many presses at each
      place.
    """

    model: str
    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    even: bool


@dataclass(frozen=True)
class Frame:
    """Conversion of places between the labels of a scene and the coordinates of the model.

    The conversion in one direction is the same operation as the conversion back.
    """

    centre_mm: tuple[float, float]
    mirrored: bool  # whether y of the labels points opposite to y of the board

    def convert(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (place_mm - self.centre_mm) * (1, -1 if self.mirrored else 1) + self.centre_mm


def read_model(file: Path, layout: BoardLayout | None, settings: Settings) -> Universal:
    """Read the model; raise `ParamsError` if it was made for a layout other than the scene's."""
    if layout is None:
        raise ParamsError(
            f"{settings.where}: experiment calibrated needs compare.layout. Add key layout to section compare."
        )
    model = load_universal(file=file)
    if replace_name(model.layout, layout.name) != layout:
        own, other = layout.model_dump(), model.layout.model_dump()
        differing = ", ".join(key for key in own if key != "name" and own[key] != other[key])
        remedy = f"Make a model for this layout: reskin model make --layout {settings.where} --out NEW.safetensors"
        raise ParamsError(
            f"{file}: the model was made for layout {model.layout.name}, which differs from compare.layout of "
            f"{settings.where} in {differing}. {remedy}. Then set calibrated.model to the new file."
        )
    return model


def replace_name(layout: BoardLayout, name: str) -> BoardLayout:
    """Return a copy of the layout that has another name."""
    return layout.model_copy(update={"name": name})


def rest_by_skin(captures: Iterable[Readings]) -> dict[str, Float[np.ndarray, " ch"]]:
    """Return the mean no-load field of each skin."""
    fields: dict[str, list[np.ndarray]] = {}
    for readings in captures:
        fields.setdefault(readings.skin, []).append(readings.noload_uT)
    return {skin: np.concatenate(parts).mean(axis=0, dtype=float) for skin, parts in fields.items()}


def score_fold(
    data: SceneData, fold: Fold, model: Universal, frame: Frame, rest_uT: Mapping[str, np.ndarray], section: Calibrated
) -> list[dict[str, Any]]:
    """Calibrate the model to each skin of the held-out board; score it for every number of labels.

    The calibration to a skin uses its no-load field and the presses of the fold's pool, which are reserved for
    calibration. The field changes of all these presses are used; of the first n presses, the labels are used, too.
    """
    points = []
    presses, tested = pool_rows(data, fold), data.rows.skin[fold.test]
    for n in section.labels_n:
        predicted = np.full((len(fold.test), 3), np.nan)
        sd_mm = np.full((len(fold.test), 2), np.nan)
        for skin in np.unique(tested):
            calibrated = _calibrate(data, model, skin, presses, n, frame, rest_uT[skin], even=section.even)
            estimate = calibrated.estimate(rest_uT[skin] + data.rows.db_uT[fold.test[tested == skin]].astype(float))
            predicted[tested == skin] = np.column_stack([frame.convert(estimate.place_mm), estimate.force_N])
            sd_mm[tested == skin] = estimate.sd_mm
        scores = score_test(data, fold.test, predicted.astype(np.float32))
        inside = np.abs(predicted[:, :2] - data.rows.target[fold.test, :2]) <= NORMAL_90 * sd_mm
        intervals = {
            "coverage_pct": 100 * float(inside.mean()), "half_width_mm": NORMAL_90 * float(np.median(sd_mm)),
        }  # fmt: skip
        points.append({
            "method": f"universal, {method_of(section, model)}", "inputs": "map and network", "labels_n": n,
            "fold": fold.board, "seed_i": fold.draw_i, "scores": scores | {"all": scores["all"] | intervals},
        })  # fmt: skip
    return points


def method_of(section: Calibrated, model: Universal) -> str:
    """Describe the model in tables."""
    shipped = Path(section.model).name == FILE.name
    return "shipped model" if shipped else f"made for layout {model.layout.name}"


def _calibrate(
    data: SceneData, model: Universal, skin: str, presses: list[np.ndarray], labels_n: int, frame: Frame,
    rest_uT: Float[np.ndarray, " ch"], *, even: bool,
) -> Universal:  # fmt: skip
    rows = data.rows
    means = [
        (i < labels_n, rows.db_uT[row].mean(axis=0, dtype=float), rows.target[row].mean(axis=0, dtype=float))
        for i, row in enumerate(presses)
        if rows.skin[row[0]] == skin
    ]
    calibrated = replace(model).zero(rest_uT[None]).see(np.array([rest_uT + db_uT for _, db_uT, _ in means]), even=even)
    labelled = [(db_uT, target) for is_labelled, db_uT, target in means if is_labelled]
    if labelled:
        target = np.array([target for _, target in labelled])
        force_N = np.maximum(target[:, 2], model.tables.force_N[0]) if np.isfinite(target[:, 2]).all() else None
        b_uT = rest_uT + np.array([db_uT for db_uT, _ in labelled])
        calibrated.label(frame.convert(target[:, :2]), force_N, b_uT)
    return calibrated


def pool_rows(data: SceneData, fold: Fold) -> list[Int64[np.ndarray, " r"]]:
    """Return the rows of each press in a fold's pool, in the order in which experiment `labels` adds labels."""
    indentation = data.rows.indentation[fold.pool]
    return [fold.pool[indentation == press] for press in labelling_order(data.rows, fold, data.settings.seed)]
