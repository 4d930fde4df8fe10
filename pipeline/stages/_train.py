"""What the training stages share: a scene's rows and folds -> cells -> finished trainings. Knows no argv."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline import io
from pipeline.dataset.folds import load_rows, parse_folds
from pipeline.dataset.rows import Rows
from pipeline.dataset.splits import Fold
from pipeline.home import home
from pipeline.learning.cell import Cell, Measured, Trained
from pipeline.learning.executors import make_executor
from pipeline.learning.grid import run_cells
from pipeline.learning.recipe import Training
from pipeline.provenance import note_trainings
from pipeline.settings import Settings
from pipeline.stages._run import COSTS, say

CELLS = ".reskin/cells"  # finished trainings: a cache, and no output


@dataclass(frozen=True)
class Scenery:
    """What a stage that trains reads: the scene's settings, its rows and its folds."""

    scene: str
    asked: Settings
    rows: Rows
    folds: list[Fold]

    def of(self, question: str) -> list[Fold]:
        """Take the folds of one question."""
        return [fold for fold in self.folds if fold.question == question]


def read_scenery(asked: Settings, indentations: Path, folds: Path) -> Scenery:
    """Read the rows and folds that a stage trains on."""
    words = io.read_json(folds)
    rows = load_rows([indentations / f"{name}.parquet" for name in words["captures"]], asked.selection)
    return Scenery(asked.scene, asked, rows, parse_folds(words, rows, str(folds)))


def cells_of(at: Scenery, training: Training, folds: Iterable[Fold], *, question: str | None = None) -> list[Cell]:
    """Make a cell of every recipe, fold and seed; they answer the folds' own question, or the one that is named."""
    return [
        Cell(question or fold.question, name, recipe, fold.name, at.asked.seed, seed_i, fold.train, fold.test)
        for fold in folds
        for name, recipe in training.recipes.items()
        for seed_i in range(training.seeds_n)
    ]


def train_all(at: Scenery, cells: Sequence[Cell], stage: str) -> list[Trained]:
    """Train what is not finished yet; say what stopped early, for it is used as it last was."""
    rows, start_s = Measured(at.rows.db_uT, at.rows.target, at.rows.skin), time.monotonic()
    with make_executor() as executor:
        trained = run_cells(
            cells, rows, executor=executor, cache=home() / CELLS, tell=lambda line: say(f"{at.scene} {stage}: {line}")
        )
    took = {one.key: (one.seconds, one.reused) for one in trained}
    note_trainings(COSTS / at.scene, stage, took, time.monotonic() - start_s)
    for cell, one in zip(cells, trained, strict=True):
        if one.stopped_step is not None:
            say(f"warning: {at.scene} {stage}: {cell.name} diverged by step {one.stopped_step}: kept as it was before")
    return trained
