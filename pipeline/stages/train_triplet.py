"""Stage train_triplet: pooled boards with the triplet term, one board held out (paper section 5).

Refuses to know how a network is trained (`trials.training`).
"""

from pathlib import Path

from pipeline.stage import run
from pipeline.training.trainings import prepare_training, read_data, train_all, trials_of, write_models
from reskin.config import Files, Settings, read_settings
from reskin.models.recipe import Training, training


def read(settings: Settings) -> Training:
    """Read section train_triplet."""
    return training(settings, "train_triplet")


def train_triplet(scene: str, files: Files, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_triplet on the folds of question lobo."""
    prepare_training()
    data = read_data(read_settings("train_triplet", scene, files), indentations, folds)
    trials = trials_of(data, read(data.settings), data.folds_of("lobo"), question="triplet")
    write_models(models, data, trials, train_all(data, trials, "train_triplet"), "train_triplet")


if __name__ == "__main__":
    run(train_triplet)
