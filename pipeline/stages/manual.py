"""Stage manual: networks adapted to new skins by pokes along lines by hand (paper section 5, manual indentations)."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.dataset.lines import Lines
from pipeline.dataset.splits import Fold
from pipeline.dataset.stacked import hand_rows, shifted, stack
from pipeline.errors import SchemaError, complain
from pipeline.evaluation.adapted import AFTER, CONTROL, Answered
from pipeline.evaluation.manual import GRID, answer_manual
from pipeline.learning.cell import Cell
from pipeline.learning.recipe import HEADLINE, Adaptations
from pipeline.settings import Files, read_settings
from pipeline.stages._adapt import Pokes, Starts, adaptation, own_starts, pool_lines, read_starts
from pipeline.stages._answers import answers_after, answers_before
from pipeline.stages._experiment import read_folder, read_losses, write_answer
from pipeline.stages._run import run
from pipeline.stages._train import Scenery, read_scenery


def manual(scene: str, files: Files, folds: Path, main: Path, indentations: Path, started: Path, answer: Path) -> None:
    """Adapt to every skin that was poked by hand, and by as many pokes of the robot; test on the robot's grid."""
    at = read_scenery(read_settings("manual", scene, files), main, folds)
    starts = read_starts(started)
    asked = at.asked.adapt
    poked, found = hand_rows(read_folder(indentations))
    lines = {skin: shifted(own, len(at.rows)) for skin, own in found.items()}
    at = replace(at, rows=stack(at.rows, poked))
    cells: list[tuple[str, Cell]] = []
    answers: list[Answered] = []
    for skin, own in lines.items():
        fold = _fold_without(at, str(poked.board[poked.skin == skin][0]))
        answers += answers_before(at, fold, asked.recipes[HEADLINE], starts, skin)
        cells += _cells(at, fold, asked, starts, (skin, own))
    after, trainings = answers_after(at, cells, "manual")
    pokes_n, lines_n = zip(*((_pokes_n(at, own), len(np.unique(own.line_i))) for own in lines.values()), strict=True)
    numbers = answer_manual([*answers, *after], pokes_n=pokes_n, lines_n=lines_n)
    write_answer(answer, numbers, {}, read_losses(indentations, poked.dropped), trainings)


def _cells(
    at: Scenery, fold: Fold, asked: Adaptations, starts: Starts, poked: tuple[str, Lines]
) -> Iterator[tuple[str, Cell]]:
    """Make the arms of one skin: by hand, by the robot, and as long without pokes if there is such a recipe."""
    (skin, by_hand), headline = poked, (HEADLINE, asked.recipes[HEADLINE])
    for seed_i in own_starts(starts, headline[1].base, fold):
        by_robot = pool_lines(at, fold, skin, pokes_n=_pokes_n(at, by_hand), seed_i=seed_i)
        pokes = Pokes("manual", skin, seed_i, "hand", by_hand)
        yield AFTER, adaptation(at, fold, headline, starts, pokes)
        yield GRID, adaptation(at, fold, headline, starts, replace(pokes, what="grid", lines=by_robot))
        if CONTROL in asked.recipes:
            yield CONTROL, adaptation(at, fold, (CONTROL, asked.recipes[CONTROL]), starts, pokes)


def _pokes_n(at: Scenery, lines: Lines) -> int:
    return len(np.unique(at.rows.indentation[lines.row]))


def _fold_without(at: Scenery, board: str) -> Fold:
    folds = {fold.name: fold for fold in at.of("lobo")}
    if board not in folds:
        remedy = "Poke skins by hand that the grid knows too."
        raise SchemaError(complain("question manual", f"board {board}", f"one of {sorted(folds)}", "none", remedy))
    return folds[board]


if __name__ == "__main__":
    run(manual)
