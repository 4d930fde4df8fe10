"""Stage train_multi: pooled boards, one held out (paper section 5.1)."""

from pathlib import Path

from pipeline.settings import Files, read_settings
from pipeline.stages._models import write_models
from pipeline.stages._run import run
from pipeline.stages._train import cells_of, read_scenery, train_all


def train_multi(scene: str, files: Files, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_multi with one board held out."""
    at = read_scenery(read_settings("train_multi", scene, files), indentations, folds)
    cells = cells_of(at, at.asked.train_multi, at.of("lobo"))
    write_models(models, at, cells, train_all(at, cells, "train_multi"), "train_multi")


if __name__ == "__main__":
    run(train_multi)
