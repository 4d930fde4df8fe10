"""Stage shear: place and all three forces of dragged lines, by random readings and by whole lines (paper section 4)."""

from pathlib import Path

import numpy as np

from pipeline.core.config import Files, Settings, read_settings
from pipeline.core.seeds import rng_for, seed_for
from pipeline.core.stage import run
from pipeline.dataset.rows import SHEAR_TARGETS, Rows, Selection, gather
from pipeline.dataset.splits import NO_POOL, Fold, draw_sides
from pipeline.evaluation.scores import tally
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.shear.scores import answer_shear, score5
from pipeline.experiments.shear.settings import Shear
from pipeline.learning.card import collapse_record
from pipeline.learning.recipe import with_training
from pipeline.trials.data import SceneData, train_all, trials_of
from pipeline.trials.models import note_seconds

DRAWN_N = 400  # more points than these are not told apart in a panel
MILLI = 3  # decimals of a force in the figure: more than are seen


def read(settings: Settings) -> Shear:
    """Read section shear."""
    return with_training(settings, Shear, "shear")


def shear(scene: str, files: Files, indentations: Path, answer: Path) -> None:
    """Train with five targets on both splits of every skin, and score what was held out."""
    settings = read_settings("shear", scene, files)
    section = read(settings)
    rows = gather(read_folder(indentations), settings.section(Selection, "selection"), targets=SHEAR_TARGETS)
    by_reading = _folds(rows, np.arange(len(rows)), "reading", section, settings.seed)
    by_line = _folds(rows, rows.indentation, "line", section, settings.seed)
    data = SceneData(scene, settings, rows, [*by_reading, *by_line])
    trials = trials_of(data, section.training, data.folds)
    trained = train_all(data, trials, "shear")
    note_seconds(scene, "shear", trials, trained)
    scores = [
        (one.fold, score5(rows.target[one.test], done.predicted)) for one, done in zip(trials, trained, strict=True)
    ]
    names = {fold.name for fold in by_line}
    numbers = answer_shear(
        [one for one in scores if one[0] not in names], [one for one in scores if one[0] in names],
        target=rows.target, lines_n=len(np.unique(rows.indentation)), passes_n=len(np.unique(rows.pass_i)),
    )  # fmt: skip
    first_i = next(i for i, trial in enumerate(trials) if trial.fold in names)
    shown = rng_for(settings.seed, "shear", "drawn").permutation(len(trials[first_i].test))[:DRAWN_N]
    true, predicted = rows.target[trials[first_i].test], trained[first_i].predicted
    drawn = {"true": _forces(true[shown]), "predicted": _forces(predicted[shown])}
    write_answer(answer, numbers, drawn, read_losses(indentations, rows.dropped), tally(map(collapse_record, trained)))


def _folds(rows: Rows, group: np.ndarray, by: str, asked: Shear, seed: int) -> list[Fold]:
    """Draw the folds of every skin by itself; rows of equal `group` stay together."""
    folds = []
    for skin in np.unique(rows.skin):
        own = np.flatnonzero(rows.skin == skin)
        drawn = draw_sides(
            group[own], test_fraction=asked.test_fraction, repeats_n=asked.repeats_n,
            state=seed_for(seed, "shear", by, str(skin)), what=f"{by}s of skin {skin}", where="question shear",
        )  # fmt: skip
        folds += [
            Fold("shear", f"{skin}-{by}{i}", own[train], own[test], NO_POOL) for i, (train, test) in enumerate(drawn)
        ]
    return folds


def _forces(target: np.ndarray) -> list[list[float]]:
    """Give Fx, Fy, Fz as three lists."""
    return [np.round(target[:, i].astype(float), MILLI).tolist() for i in range(2, 5)]


if __name__ == "__main__":
    run(shear)
