"""Stage adapt: networks with the triplet term, adapted to each held-out skin by its unlabelled pokes (section 5)."""

from pathlib import Path

from pipeline.settings import Files, read_settings
from pipeline.stages._adapt import adaptations, read_starts
from pipeline.stages._models import write_models
from pipeline.stages._run import run
from pipeline.stages._train import read_scenery, train_all


def adapt(scene: str, files: Files, indentations: Path, folds: Path, started: Path, models: Path) -> None:
    """Fine-tune by every recipe of section adapt."""
    at, starts = (
        read_scenery(read_settings("adapt", scene, files), indentations, folds),
        read_starts(started),
    )
    asked = at.asked.adapt
    cells = [
        cell
        for fold in at.of("lobo")
        for named in asked.recipes.items()
        for cell in adaptations(at, fold, named, starts, question="adapt", pokes_n=asked.pokes_n)
    ]
    write_models(models, at, cells, train_all(at, cells, "adapt"), "adapt")


if __name__ == "__main__":
    run(adapt)
