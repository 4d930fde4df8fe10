"""Adaptation by hand: before, after, and what the hand costs. In: answers by arm. Out: plain numbers.

Refuses to know networks, pokes and files.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.trials.arms import AFTER, BEFORE, CONTROL, Answered, compare_arms, summarise_arms

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
