"""Stage adapt: networks with the triplet term, adapted to each held-out skin by its unlabelled pokes (section 5).

Refuses to show a network labels of the skin that it adapts to.
"""

from pathlib import Path

from pipeline.stage import run
from pipeline.training.trainings import adaptations, prepare_training, read_data, read_starts, train_all, write_models
from reskin.config import Files, Settings, read_settings
from reskin.models.recipe import Adaptations
from reskin.models.recipe import adaptations as adaptations_of


def read(settings: Settings) -> Adaptations:
    """Read section adapt."""
    return adaptations_of(settings)


def adapt(scene: str, files: Files, indentations: Path, folds: Path, started: Path, models: Path) -> None:
    """Fine-tune by every recipe of section adapt."""
    prepare_training()
    data, starts = read_data(read_settings("adapt", scene, files), indentations, folds), read_starts(started)
    settings = read(data.settings)
    trials = [
        trial
        for fold in data.folds_of("lobo")
        for named in settings.recipes.items()
        for trial in adaptations(data, fold, named, starts, question="adapt", pokes_n=settings.pokes_n)
    ]
    write_models(models, data, trials, train_all(data, trials, "adapt"), "adapt")


if __name__ == "__main__":
    run(adapt)
