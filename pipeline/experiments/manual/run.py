"""Stage manual: networks adapted to new skins by pokes along lines by hand (section 5, manual indentations).

Refuses to know how networks are adapted (`trials.adapting`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.settings import Adaptations, Settings
from pipeline.training.trainings import (
    Pokes,
    SceneData,
    Starts,
    adaptation,
    own_starts,
    pool_lines,
    prepare_training,
    read_data,
    read_starts,
)
from pipeline.training.variants import (  # fmt: skip
    AFTER,
    BEFORE,
    CONTROL,
    Answered,
    answers_after,
    answers_before,
    compare_arms,
    summarise_arms,
)
from reskin.data.lines import Lines, hand_rows, shifted
from reskin.data.rows import stack
from reskin.data.splits import Fold
from reskin.errors import SchemaError
from reskin.models.recipe import HEADLINE
from reskin.models.trial import Trial

GRID = "grid"  # as many pokes, by the robot


def answer_manual(answers: Sequence[Answered], *, pokes_n: Sequence[int], lines_n: Sequence[int]) -> dict[str, Any]:
    """Summarise over boards; `pokes_n` and `lines_n` are those of each skin, and what is told is their mean."""
    arms = summarise_arms(answers)
    counts = {
        "pokes_n": round(np.mean(pokes_n)),
        "lines_n": round(np.mean(lines_n)),
        "skins_n": len({one.skin for one in answers}),
        "boards_n": len({one.board for one in answers}),
        "seeds_n": len({one.seed_i for one in answers}),
    }
    differences = {
        f"{AFTER}_minus_{other}": compare_arms(answers, AFTER, other)
        for other in (BEFORE, CONTROL, GRID)
        if other in arms
    }
    return counts | arms | {"paired": differences}


def manual(settings: Settings, folds: Path, main: Path, indentations: Path, started: Path, answer: Path) -> None:
    """Adapt to every skin that was poked by hand, and by as many pokes of the robot; test on the robot's grid."""
    prepare_training()
    data = read_data(settings, main, folds)
    starts = read_starts(started)
    adapting = data.settings.adaptations()
    poked, found = hand_rows(read_folder(indentations))
    lines = {skin: shifted(own, len(data.rows)) for skin, own in found.items()}
    data = replace(data, rows=stack(data.rows, poked))
    trials: list[tuple[str, Trial]] = []
    answers: list[Answered] = []
    for skin, own in lines.items():
        fold = _fold_without(data, str(poked.board[poked.skin == skin][0]))
        answers += answers_before(data, fold, adapting.recipes[HEADLINE], starts, skin)
        trials += _trials(data, fold, adapting, starts, (skin, own))
    after, trainings = answers_after(data, trials, "manual")
    pokes_n, lines_n = zip(*((_pokes_n(data, own), len(np.unique(own.line_i))) for own in lines.values()), strict=True)
    numbers = answer_manual([*answers, *after], pokes_n=pokes_n, lines_n=lines_n)
    write_answer(answer, numbers, {}, read_losses(indentations, poked.dropped), trainings)


def _trials(
    data: SceneData, fold: Fold, adapting: Adaptations, starts: Starts, poked: tuple[str, Lines]
) -> Iterator[tuple[str, Trial]]:
    """Make the arms of one skin: by hand, by the robot, and as long without pokes if there is such a recipe."""
    (skin, by_hand), headline = poked, (HEADLINE, adapting.recipes[HEADLINE])
    for seed_i in own_starts(starts, headline[1].base, fold):
        by_robot = pool_lines(data, fold, skin, pokes_n=_pokes_n(data, by_hand), seed_i=seed_i)
        pokes = Pokes("manual", skin, seed_i, "hand", by_hand)
        yield AFTER, adaptation(data, fold, headline, starts, pokes)
        yield GRID, adaptation(data, fold, headline, starts, replace(pokes, what="grid", lines=by_robot))
        if CONTROL in adapting.recipes:
            yield CONTROL, adaptation(data, fold, (CONTROL, adapting.recipes[CONTROL]), starts, pokes)


def _pokes_n(data: SceneData, lines: Lines) -> int:
    return len(np.unique(data.rows.indentation[lines.row]))


def _fold_without(data: SceneData, board: str) -> Fold:
    folds = {fold.name: fold for fold in data.folds_of("lobo")}
    if board not in folds:
        remedy = "Poke skins by hand that the grid knows too."
        raise SchemaError("question manual", f"board {board}", f"one of {sorted(folds)}", "none", remedy)
    return folds[board]
