"""Stage train_single: one skin at a time: same-sensor splits, and one skin to others (paper sections 4 and 5.1).

Refuses to know how a network is trained (`trials.training`).
"""

from pathlib import Path

from pipeline.stage import run
from pipeline.training.before_contact import BY_TIME, score_before_touch
from pipeline.training.trainings import prepare_training, read_data, train_all, trials_of, write_models
from reskin import io
from reskin.config import Files, Settings, read_settings
from reskin.data.rows import SCORED
from reskin.data.splits import ONE_SKIN
from reskin.models.recipe import Training, training
from reskin.models.trained import networks_by_fold


def read(settings: Settings) -> Training:
    """Read section train_single."""
    return training(settings, "train_single")


def train_single(scene: str, files: Files, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_single on every fold of the questions about one skin.

    Beside them: how well a place is told before its touch, where the skin that is tested was learnt on.
    """
    prepare_training()
    data = read_data(read_settings("train_single", scene, files), indentations, folds)
    own = [fold for fold in data.folds if fold.question in ONE_SKIN]
    trials = trials_of(data, read(data.settings), own)
    write_models(models, data, trials, train_all(data, trials, "train_single"), "train_single")
    told = score_before_touch(data, indentations, io.read_json(folds)["captures"], networks_by_fold(models, BY_TIME))
    io.write_table(models / SCORED, told)


if __name__ == "__main__":
    run(train_single)
