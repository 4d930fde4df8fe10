"""Stage flexible: networks of rigid boards on flexible ones, before and after they are adapted (paper section 5)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.dataset.rows import gather
from pipeline.dataset.splits import hold_out_skins
from pipeline.dataset.stacked import stack
from pipeline.evaluation.adapted import AFTER, CONTROL
from pipeline.evaluation.flexible import answer_flexible, by_depth, forces_drawn, gap_less_pct, strength_ratio
from pipeline.learning.recipe import HEADLINE
from pipeline.questions import EXPERIMENTS, MAIN_PROTOCOL
from pipeline.schema import Readings
from pipeline.seeds import rng_for
from pipeline.settings import Files, read_settings
from pipeline.stages._adapt import adaptations, read_starts
from pipeline.stages._answers import answers_after, answers_before
from pipeline.stages._experiment import read_folder, read_losses, write_answer
from pipeline.stages._run import run
from pipeline.stages._train import Scenery, read_scenery

SHAPE = "shape"  # the recipe on directions, if the scene has one: it ought to care less about the gap


def flexible(
    scene: str, files: Files, folds: Path, main: Path, indentations: Path, started: Path, answer: Path
) -> None:
    """Adapt the networks of the first fold of lobo to every flexible skin, and test on its later passes."""
    at = read_scenery(read_settings("flexible", scene, files), main, folds)
    starts, captures = read_starts(started), read_folder(indentations)
    asked, first, trained_n = at.asked.adapt, at.of("lobo")[0], len(at.rows)
    poked = gather(captures, at.asked.selection)
    at = replace(at, rows=stack(at.rows, poked))
    sides = (first.train, np.arange(trained_n, len(at.rows)))
    fold = hold_out_skins(at.rows, "flexible", first.name, sides, at.asked.split)
    arms = {name: arm for name, arm in ((HEADLINE, AFTER), (CONTROL, CONTROL), (SHAPE, SHAPE)) if name in asked.recipes}
    cells = [
        (arm, cell)
        for name, arm in arms.items()
        for cell in adaptations(
            at, fold, (name, asked.recipes[name]), starts, question="flexible", pokes_n=asked.pokes_n
        )
    ]
    skins = [str(skin) for skin in np.unique(at.rows.skin[fold.test])]
    before = {
        name: [one for skin in skins for one in answers_before(at, fold, asked.recipes[name], starts, skin)]
        for name in arms if name != CONTROL
    }  # fmt: skip
    after, trainings = answers_after(at, cells, "flexible")
    own = before[HEADLINE] + [one for one in after if one.arm != SHAPE]
    numbers: dict[str, Any] = {
        "skins_n": len(skins), "boards_n": len(np.unique(at.rows.board[fold.test])),
        "seeds_n": len({one.seed_i for one in own}), "pokes_n": asked.pokes_n, "fold": first.name,
        "trained_on_skins_n": len(np.unique(at.rows.skin[fold.train])),
        "strength_ratio": strength_ratio(_by_depth(captures), _by_depth(read_folder(main))),
    } | _gaps(at) | answer_flexible(own)  # fmt: skip
    if SHAPE in arms:
        numbers[SHAPE] = answer_flexible(before[SHAPE] + [replace(one, arm=AFTER) for one in after if one.arm == SHAPE])
    drawn = forces_drawn(own, rng_for(at.asked.seed, "flexible", "drawn"))
    write_answer(answer, numbers, drawn, read_losses(indentations, poked.dropped), trainings)


def _by_depth(captures: Sequence[Readings]) -> list[dict[float, np.ndarray]]:
    return [by_depth(one.depth_mm, one.b_uT - one.noload_uT) for one in captures]


def _gaps(at: Scenery) -> dict[str, Any]:
    """Tell the gaps between skin and chips of both kinds of boards, and by how much one is less."""
    kinds = {"rigid": MAIN_PROTOCOL, "flexible": str(EXPERIMENTS["flexible"])}
    boards = {kind: at.asked.words(f"simulate.protocols.{of}.boards") for kind, of in kinds.items()}
    gap_mm = {kind: float(at.asked.words(f"simulate.boards.{of}.design.gap_mm")) for kind, of in boards.items()}
    return {"gap_mm": gap_mm, "gap_less_pct": gap_less_pct(gap_mm)}


if __name__ == "__main__":
    run(flexible)
