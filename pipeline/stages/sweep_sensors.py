"""Stage sweep_sensors: the three methods, trained on few and many skins (paper figure 6b).

Refuses to know how networks are trained (`trials`).
"""

from pathlib import Path

import numpy as np

from pipeline.stage import run
from pipeline.training.trainings import (
    SceneData,
    adaptations,
    note_seconds,
    point_of,
    prepare_training,
    read_data,
    train_all,
)
from reskin import io
from reskin.config import Files, read_settings
from reskin.data.splits import Fold
from reskin.models.recipe import HEADLINE, Recipe, training
from reskin.models.recipe import adaptations as adaptations_of
from reskin.models.trial import Start, Trial


def sweep_sensors(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Train the headline recipes on every draw of skins, adapt to each held-out skin, and score."""
    prepare_training()
    data = read_data(read_settings("sweep_sensors", scene, files), indentations, folds)
    multi, triplet = (training(data.settings, section).recipes for section in ("train_multi", "train_triplet"))
    settings = adaptations_of(data.settings)
    recipe = settings.recipes[HEADLINE]
    trials = _trials(data, multi[HEADLINE], "multi") + _trials(data, triplet[recipe.base], "triplet")
    trained = train_all(data, trials, "sweep_sensors")
    starts = {
        (recipe.base, trial.fold, trial.seed_i): Start(result.key, result.weights, result.scaler)
        for trial, result in zip(trials, trained, strict=True)
        if trial.what == "triplet"
    }
    adapted = [
        trial
        for fold in _folds(data)
        for trial in adaptations(data, fold, (HEADLINE, recipe), starts, question="sensors", pokes_n=settings.pokes_n)
    ]
    methods = [trial.what for trial in trials] + ["adapted"] * len(adapted)
    trials, trained = trials + adapted, trained + train_all(data, adapted, "sweep_sensors")
    three = zip(trials, trained, methods, strict=True)
    io.write_json(scores, [point_of(data, trial, result, method) for trial, result, method in three])
    note_seconds(scene, "sweep_sensors", trials, trained)


def _folds(data: SceneData) -> list[Fold]:
    """Order folds by their number of training skins, most first: those of all skins then stack as in `train_multi`.

    Finished trainings are known by their whole stack, so that only then these are reused.
    """
    return sorted(data.folds_of("sensors"), key=lambda fold: -len(np.unique(data.rows.skin[fold.train])))


def _trials(data: SceneData, recipe: Recipe, method: str) -> list[Trial]:
    """One trial a draw of skins; the draw is its seed too, as the fold's name is part of the generator's."""
    return [
        Trial("sensors", HEADLINE, recipe, fold.name, data.settings.seed, 0, fold.train, fold.test, what=method)
        for fold in _folds(data)
    ]


if __name__ == "__main__":
    run(sweep_sensors)
