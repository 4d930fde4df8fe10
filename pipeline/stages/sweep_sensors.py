"""Stage sweep_sensors: the three methods, trained on few and many skins (paper figure 6b)."""

from pathlib import Path

from pipeline import io
from pipeline.learning.cell import Cell, Start
from pipeline.learning.recipe import HEADLINE, Recipe
from pipeline.settings import Files, read_settings
from pipeline.stages._adapt import adaptations
from pipeline.stages._models import note_seconds, point_of
from pipeline.stages._run import run
from pipeline.stages._train import Scenery, read_scenery, train_all


def sweep_sensors(scene: str, files: Files, indentations: Path, folds: Path, scores: Path) -> None:
    """Train the headline recipes on every draw of skins, adapt to each held-out skin, and score."""
    at = read_scenery(read_settings("sweep_sensors", scene, files), indentations, folds)
    multi, triplet, own = at.asked.train_multi, at.asked.train_triplet, at.asked.adapt
    fine = own.recipes[HEADLINE]
    plain = _cells(at, multi.recipes[HEADLINE], "multi")
    based = _cells(at, triplet.recipes[fine.base], "triplet")
    trained = train_all(at, [*plain, *based], "sweep_sensors")
    starts = {
        (fine.base, cell.fold, cell.seed_i): Start(one.key, one.weights, one.scaler)
        for cell, one in zip(based, trained[len(plain) :], strict=True)
    }
    adapted = [
        cell
        for fold in at.of("sensors")
        for cell in adaptations(at, fold, (HEADLINE, fine), starts, question="sensors", pokes_n=own.pokes_n)
    ]
    trained += train_all(at, adapted, "sweep_sensors")
    cells = [*plain, *based, *adapted]
    methods = [cell.what for cell in [*plain, *based]] + ["adapted"] * len(adapted)
    three = zip(cells, trained, methods, strict=True)
    io.write_json(scores, [point_of(at, cell, one, method) for cell, one, method in three])
    note_seconds(scene, "sweep_sensors", cells, trained)


def _cells(at: Scenery, recipe: Recipe, method: str) -> list[Cell]:
    """One cell a draw of skins; the draw is its seed too, as the fold's name is part of the generator's."""
    return [
        Cell("sensors", HEADLINE, recipe, one.name, at.asked.seed, 0, one.train, one.test, what=method)
        for one in at.of("sensors")
    ]


if __name__ == "__main__":
    run(sweep_sensors)
