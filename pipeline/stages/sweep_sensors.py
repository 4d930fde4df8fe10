"""Stage sweep_sensors: the three methods, trained on few and many skins (paper figure 6b)."""

from pathlib import Path

from pipeline.core import io
from pipeline.core.config import Files, read_settings
from pipeline.core.stage import run
from pipeline.learning.recipe import HEADLINE, Recipe, training
from pipeline.learning.recipe import adaptations as adaptations_of
from pipeline.learning.trial import Start, Trial
from pipeline.trials.adapting import adaptations
from pipeline.trials.data import SceneData, read_data, train_all
from pipeline.trials.models import note_seconds, point_of


def sweep_sensors(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Train the headline recipes on every draw of skins, adapt to each held-out skin, and score."""
    data = read_data(read_settings("sweep_sensors", scene, files), indentations, folds)
    multi, triplet = (training(data.settings, section) for section in ("train_multi", "train_triplet"))
    own = adaptations_of(data.settings)
    fine = own.recipes[HEADLINE]
    plain = _trials(data, multi.recipes[HEADLINE], "multi")
    based = _trials(data, triplet.recipes[fine.base], "triplet")
    trained = train_all(data, [*plain, *based], "sweep_sensors")
    starts = {
        (fine.base, trial.fold, trial.seed_i): Start(one.key, one.weights, one.scaler)
        for trial, one in zip(based, trained[len(plain) :], strict=True)
    }
    adapted = [
        trial
        for fold in data.folds_of("sensors")
        for trial in adaptations(data, fold, (HEADLINE, fine), starts, question="sensors", pokes_n=own.pokes_n)
    ]
    trained += train_all(data, adapted, "sweep_sensors")
    trials = [*plain, *based, *adapted]
    methods = [trial.what for trial in [*plain, *based]] + ["adapted"] * len(adapted)
    three = zip(trials, trained, methods, strict=True)
    io.write_json(scores, [point_of(data, trial, one, method) for trial, one, method in three])
    note_seconds(scene, "sweep_sensors", trials, trained)


def _trials(data: SceneData, recipe: Recipe, method: str) -> list[Trial]:
    """One trial a draw of skins; the draw is its seed too, as the fold's name is part of the generator's."""
    return [
        Trial("sensors", HEADLINE, recipe, one.name, data.settings.seed, 0, one.train, one.test, what=method)
        for one in data.folds_of("sensors")
    ]


if __name__ == "__main__":
    run(sweep_sensors)
