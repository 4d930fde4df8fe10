"""What the training stages write: models with cards and predictions, or points of a sweep. Knows no argv."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.core import io
from pipeline.core.provenance import SECONDS, code_version
from pipeline.dataset.rows import TARGETS, Rows
from pipeline.evaluation.summary import score_groups
from pipeline.learning.card import collapse_record, describe
from pipeline.learning.trial import Trained, Trial
from pipeline.trials.data import SceneData


def write_models(
    models: Path, data: SceneData, trials: Sequence[Trial], trained: Sequence[Trained], stage: str
) -> None:
    """Write models, their cards and predictions; what they took here stands beside, as it is no result."""
    cards = [card_of(data, trial, one) for trial, one in zip(trials, trained, strict=True)]
    with io.replacing(models) as folder:
        folder.mkdir()
        for trial, one, card in zip(trials, trained, cards, strict=True):
            tensors = dict(one.weights) | one.scaler.arrays()
            io.write_tensors(folder / f"{trial.name}.safetensors", tensors, {"format": card["format"]})
            io.write_json(folder / f"{trial.name}.json", card)
        io.write_table(folder / "predictions.parquet", _predictions(trials, trained, data.rows))
    note_seconds(data.scene, stage, trials, trained)


def card_of(data: SceneData, trial: Trial, one: Trained) -> dict[str, Any]:
    """Describe a training, with its scores on the rows that it was not trained on."""
    card = describe(trial, one, data.rows, data.scene, code_version())
    true, board, skin = (values[trial.test] for values in (data.rows.target, data.rows.board, data.rows.skin))
    return card | {"scores": score_groups(true, one.predicted, board, skin)}


def point_of(data: SceneData, trial: Trial, one: Trained, method: str) -> dict[str, Any]:
    """Keep of a training in a sweep what its curve needs: no weights, no predictions."""
    card = card_of(data, trial, one)
    words = {name: card[name] for name in ("key", "question", "fold", "seed_i", "stopped_step", "git", "scores")}
    return words | collapse_record(one) | {"method": method, "trained_on_skins_n": len(card["train_skins"])}


def note_seconds(scene: str, stage: str, trials: Sequence[Trial], trained: Sequence[Trained]) -> None:
    """Keep what trainings took here."""
    took = [
        {"name": trial.name, "train_s": one.seconds, "one_reading_s": one.one_reading_s}
        for trial, one in zip(trials, trained, strict=True)
    ]
    io.write_json(SECONDS / scene / f"{stage}.json", took)


def _predictions(trials: Sequence[Trial], trained: Sequence[Trained], rows: Rows) -> pa.Table:
    """One row a test row and training: the truth and the prediction, side by side."""
    tables = []
    for trial, one in zip(trials, trained, strict=True):
        columns = {
            "question": pa.repeat(trial.question, len(trial.test)),
            "recipe": pa.repeat(trial.recipe_name, len(trial.test)),
            "fold": pa.repeat(trial.fold, len(trial.test)), "seed_i": pa.repeat(trial.seed_i, len(trial.test)),
            "skin": pa.array(rows.skin[trial.test].tolist()),
        }  # fmt: skip
        for i, name in enumerate(TARGETS):
            columns[f"true_{name}"] = pa.array(rows.target[trial.test, i])
            columns[f"predicted_{name}"] = pa.array(one.predicted[:, i])
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)
