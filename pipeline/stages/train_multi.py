"""Stage train_multi: pooled boards, one held out (paper section 5.1)."""

from pathlib import Path

from pipeline.stages._models import write_models
from pipeline.stages._run import run
from pipeline.stages._train import cells_of, read_scenery, train_all


def train_multi(scene: str, settings: Path, indentations: Path, folds: Path, models: Path) -> None:
    """Train the recipes of section train_multi with one board held out."""
    at = read_scenery(scene, settings, indentations, folds)
    assert at.asked.train_multi is not None
    cells = cells_of(at, at.asked.train_multi, at.of("lobo"))
    write_models(models, at, cells, train_all(at, cells, "train_multi"), "train_multi")


if __name__ == "__main__":
    run(train_multi)
