"""Stage train_multi: pooled boards, one held out (paper section 5.1).

Refuses to know how a network is trained (`trials.training`).
"""

from pathlib import Path

from pipeline.stage import run
from pipeline.training.trainings import prepare_training, read_data, train_all, trials_of, write_models
from reskin.config import Files, Settings, read_settings
from reskin.models.recipe import Training, training


def read(settings: Settings) -> Training:
    """Read section train_multi."""
    return training(settings, "train_multi")


def train_multi(scene: str, files: Files, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_multi with one board held out."""
    prepare_training()
    data = read_data(read_settings("train_multi", scene, files), indentations, folds)
    trials = trials_of(data, read(data.settings), data.folds_of("lobo"))
    write_models(models, data, trials, train_all(data, trials, "train_multi"), "train_multi")


if __name__ == "__main__":
    run(train_multi)
