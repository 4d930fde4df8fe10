"""Stage flexible: networks of rigid boards on flexible ones, before and after they are adapted (paper section 5)."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.config import Files, parse_parts, read_settings
from pipeline.core.schema import Readings
from pipeline.core.seeds import rng_for
from pipeline.core.stage import run
from pipeline.dataset.rows import Selection, gather, stack
from pipeline.dataset.splits import Split, hold_out_skins
from pipeline.experiments.answer import read_folder, read_losses, write_answer
from pipeline.experiments.flexible.boards import answer_flexible, by_depth, forces_drawn, gap_less_pct, strength_ratio
from pipeline.learning.recipe import HEADLINE
from pipeline.learning.recipe import adaptations as adaptations_of
from pipeline.trials.adapting import adaptations, read_starts
from pipeline.trials.arms import AFTER, CONTROL, answers_after, answers_before
from pipeline.trials.data import SceneData, read_data

SHAPE = "shape"  # the recipe on directions, if the scene has one: it ought to care less about the gap


def flexible(
    scene: str, files: Files, folds: Path, main: Path, indentations: Path, started: Path, answer: Path
) -> None:
    """Adapt the networks of the first fold of lobo to every flexible skin, and test on its later passes."""
    data = read_data(read_settings("flexible", scene, files), main, folds)
    starts, captures = read_starts(started), read_folder(indentations)
    asked, first, trained_n = adaptations_of(data.settings), data.folds_of("lobo")[0], len(data.rows)
    poked = gather(captures, data.settings.section(Selection, "selection"))
    data = replace(data, rows=stack(data.rows, poked))
    sides = (first.train, np.arange(trained_n, len(data.rows)))
    fold = hold_out_skins(
        data.rows, "flexible", first.name, sides, parse_parts(Split, data.settings.words("split"), "split")
    )
    arms = {name: arm for name, arm in ((HEADLINE, AFTER), (CONTROL, CONTROL), (SHAPE, SHAPE)) if name in asked.recipes}
    trials = [
        (arm, trial)
        for name, arm in arms.items()
        for trial in adaptations(
            data, fold, (name, asked.recipes[name]), starts, question="flexible", pokes_n=asked.pokes_n
        )
    ]
    skins = [str(skin) for skin in np.unique(data.rows.skin[fold.test])]
    before = {
        name: [one for skin in skins for one in answers_before(data, fold, asked.recipes[name], starts, skin)]
        for name in arms if name != CONTROL
    }  # fmt: skip
    after, trainings = answers_after(data, trials, "flexible")
    own = before[HEADLINE] + [one for one in after if one.arm != SHAPE]
    numbers: dict[str, Any] = {
        "skins_n": len(skins), "boards_n": len(np.unique(data.rows.board[fold.test])),
        "seeds_n": len({one.seed_i for one in own}), "pokes_n": asked.pokes_n, "fold": first.name,
        "trained_on_skins_n": len(np.unique(data.rows.skin[fold.train])),
        "strength_ratio": strength_ratio(_by_depth(captures), _by_depth(read_folder(main))),
    } | _gaps(data) | answer_flexible(own)  # fmt: skip
    if SHAPE in arms:
        numbers[SHAPE] = answer_flexible(before[SHAPE] + [replace(one, arm=AFTER) for one in after if one.arm == SHAPE])
    drawn = forces_drawn(own, rng_for(data.settings.seed, "flexible", "drawn"))
    write_answer(answer, numbers, drawn, read_losses(indentations, poked.dropped), trainings)


def _by_depth(captures: Sequence[Readings]) -> list[dict[float, np.ndarray]]:
    return [by_depth(one.depth_mm, one.b_uT - one.noload_uT) for one in captures]


def _gaps(data: SceneData) -> dict[str, Any]:
    """Tell the gaps between skin and chips of both kinds of boards, and by how much one is less."""
    kinds = {"rigid": "grid", "flexible": "flexible"}
    boards = {kind: data.settings.words(f"simulate.protocols.{of}.boards") for kind, of in kinds.items()}
    gap_mm = {kind: float(data.settings.words(f"simulate.boards.{of}.design.gap_mm")) for kind, of in boards.items()}
    return {"gap_mm": gap_mm, "gap_less_pct": gap_less_pct(gap_mm)}


if __name__ == "__main__":
    run(flexible)
