"""Stage train_triplet: pooled boards with the triplet term, one board held out (paper section 5)."""

from pathlib import Path

from pipeline.settings import Files, read_settings
from pipeline.stages._models import write_models
from pipeline.stages._run import run
from pipeline.stages._train import cells_of, read_scenery, train_all


def train_triplet(scene: str, files: Files, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_triplet on the folds of question lobo."""
    at = read_scenery(read_settings("train_triplet", scene, files), indentations, folds)
    cells = cells_of(at, at.asked.train_triplet, at.of("lobo"), question="triplet")
    write_models(models, at, cells, train_all(at, cells, "train_triplet"), "train_triplet")


if __name__ == "__main__":
    run(train_triplet)
