"""What the training stages write: models with cards and predictions, or points of a sweep. Knows no argv."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Int64

from pipeline.core import io
from pipeline.core.provenance import SECONDS, code_version
from pipeline.dataset.rows import TARGETS, Rows
from pipeline.evaluation.metrics import score_groups
from pipeline.learning.card import describe
from pipeline.learning.trial import Trained, Trial
from pipeline.trials.data import SceneData


def write_models(
    models: Path, data: SceneData, trials: Sequence[Trial], trained: Sequence[Trained], stage: str
) -> None:
    """Write models, their cards and predictions; what they took here stands beside, as it is no result."""
    cards = [card_of(data, trial, result) for trial, result in zip(trials, trained, strict=True)]
    with io.replacing(models) as folder:
        folder.mkdir()
        for trial, result, card in zip(trials, trained, cards, strict=True):
            tensors = dict(result.weights) | result.scaler.arrays()
            io.write_tensors(folder / f"{trial.name}.safetensors", tensors, {"format": card["format"]})
            io.write_json(folder / f"{trial.name}.json", card)
        io.write_table(folder / "predictions.parquet", _predictions(trials, trained, data.rows))
    note_seconds(data.scene, stage, trials, trained)


def card_of(data: SceneData, trial: Trial, trained: Trained) -> dict[str, Any]:
    """Describe a training, with its scores on the rows that it was not trained on."""
    card = describe(trial, trained, data.rows, data.scene, code_version())
    return card | {"scores": score_test(data, trial.test, trained.predicted)}


def score_test(data: SceneData, test: Int64[np.ndarray, " b"], predicted: Float32[np.ndarray, "b 3"]) -> dict[str, Any]:
    """Score predictions for tested rows."""
    return score_groups(data.rows.target[test], predicted, data.rows.board[test], data.rows.skin[test])


def point_of(data: SceneData, trial: Trial, trained: Trained, method: str) -> dict[str, Any]:
    """Keep of a training in a sweep what its curve needs: no weights, no predictions."""
    card = card_of(data, trial, trained)
    kept = ("key", "question", "fold", "seed_i", "stopped_step", "git", "scores", "collapsed", "collapsed_before_n")
    return {name: card[name] for name in kept} | {"method": method, "trained_on_skins_n": len(card["train_skins"])}


def note_seconds(scene: str, stage: str, trials: Sequence[Any], trained: Sequence[Any]) -> None:
    """Keep what trainings, of networks or of classical methods, took here."""
    took = [
        {"name": trial.name, "train_s": result.seconds, "one_reading_s": result.one_reading_s}
        for trial, result in zip(trials, trained, strict=True)
    ]
    io.write_json(SECONDS / scene / f"{stage}.json", took)


def _predictions(trials: Sequence[Trial], trained: Sequence[Trained], rows: Rows) -> pa.Table:
    """One row a test row and training: the truth and the prediction, side by side."""
    tables = []
    for trial, result in zip(trials, trained, strict=True):
        words = {"question": trial.question, "recipe": trial.recipe_name, "fold": trial.fold, "seed_i": trial.seed_i}
        columns = {name: pa.repeat(word, len(trial.test)) for name, word in words.items()}
        columns["skin"] = pa.array(rows.skin[trial.test].tolist())
        for i, name in enumerate(TARGETS):
            columns[f"true_{name}"] = pa.array(rows.target[trial.test, i])
            columns[f"predicted_{name}"] = pa.array(result.predicted[:, i])
        tables.append(pa.table(columns))
    return pa.concat_tables(tables)
