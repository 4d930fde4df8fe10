"""Stage train_single: one skin at a time: same-sensor splits, and one skin to others (paper sections 4 and 5.1)."""

from pathlib import Path

from pipeline.questions import ANSWERED_BY
from pipeline.settings import Files, read_settings
from pipeline.stages._models import write_models
from pipeline.stages._run import run
from pipeline.stages._train import cells_of, read_scenery, train_all


def train_single(scene: str, files: Files, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_single on every fold of the questions about one skin."""
    at = read_scenery(read_settings("train_single", scene, files), indentations, folds)
    own = [fold for fold in at.folds if ANSWERED_BY[fold.question] == "train_single"]
    cells = cells_of(at, at.asked.train_single, own)
    write_models(models, at, cells, train_all(at, cells, "train_single"), "train_single")


if __name__ == "__main__":
    run(train_single)
