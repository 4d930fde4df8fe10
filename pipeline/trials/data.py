"""What the training stages share: a scene's rows and folds -> trials -> finished trainings. Knows no argv."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.core import io
from pipeline.core.config import Settings
from pipeline.core.executors import make_executor, prepare_workers
from pipeline.core.provenance import COSTS, home, note_trainings
from pipeline.core.stage import say
from pipeline.dataset.folds import load_rows, parse_folds
from pipeline.dataset.rows import Rows, Selection
from pipeline.dataset.splits import Fold
from pipeline.learning.grid import run_trials
from pipeline.learning.recipe import Training
from pipeline.learning.trial import Measured, Trained, Trial

TRAINS = "pipeline.learning.train"
CACHE = ".reskin/cells"  # finished trainings: a cache, and no output


@dataclass(frozen=True)
class SceneData:
    """What a stage that trains reads: the scene's settings, its rows and its folds."""

    scene: str
    settings: Settings
    rows: Rows
    folds: list[Fold]

    def folds_of(self, question: str) -> list[Fold]:
        """Take the folds of one question."""
        return [fold for fold in self.folds if fold.question == question]


def prepare_training() -> None:
    """Let what trains be imported while the stage reads what it trains on."""
    prepare_workers(TRAINS)


def read_data(settings: Settings, indentations: Path, folds: Path) -> SceneData:
    """Read the rows and folds that a stage trains on."""
    words = io.read_json(folds)
    rows = load_rows(
        [indentations / f"{name}.parquet" for name in words["captures"]], settings.section(Selection, "selection")
    )
    return SceneData(settings.scene, settings, rows, parse_folds(words, rows, str(folds)))


def trials_of(
    data: SceneData, training: Training, folds: Iterable[Fold], *, question: str | None = None
) -> list[Trial]:
    """Make a trial of every recipe, fold and seed; they answer the folds' own question, or the one that is named."""
    return [
        Trial(question or fold.question, name, recipe, fold.name, data.settings.seed, seed_i, fold.train, fold.test)
        for fold in folds
        for name, recipe in training.recipes.items()
        for seed_i in range(training.seeds_n)
    ]


def measured(data: SceneData) -> Measured:
    """Give of the rows what trainings read."""
    return Measured(data.rows.db_uT, data.rows.target, data.rows.skin)


def train_all(data: SceneData, trials: Sequence[Trial], stage: str) -> list[Trained]:
    """Train what is not finished yet; say what stopped early, for it is used as it last was."""
    start_s, stage_words = time.monotonic(), f"{data.scene} {stage}"

    def tell(line: str) -> None:
        say(f"{stage_words}: {line}")

    with make_executor(imports=TRAINS) as executor:
        trained = run_trials(trials, measured(data), executor=executor, cache=home() / CACHE, tell=tell)
    took = {result.key: (result.seconds, result.reused) for result in trained}
    note_trainings(COSTS / data.scene, stage, took, time.monotonic() - start_s)
    for trial, result in zip(trials, trained, strict=True):
        if result.stopped_step is not None:
            diverged = f"{trial.name} diverged by step {result.stopped_step}: kept as it was before"
            say(f"warning: {stage_words}: {diverged}")
    return trained
