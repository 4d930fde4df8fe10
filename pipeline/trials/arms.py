"""Networks before and after they are adapted to a skin, side by side. In: answers by arm and board. Out: numbers.

An arm is one way to treat the same networks: left as they were, adapted, adapted without the skin's pokes, ...
Refuses to know networks, pokes and files.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.evaluation import inference
from pipeline.evaluation.inference import Scored, board_means, summarise_boards
from pipeline.evaluation.metrics import score

FORCE = 2  # column
BEFORE, AFTER, CONTROL = "before", "after", "control"  # arms: as it was, adapted, as long without the skin's pokes
Judge = Callable[[np.ndarray, np.ndarray], dict[str, float]]  # of true and predicted x_mm, y_mm, F_N


@dataclass(frozen=True)
class Answered:
    """What one network answers on one skin's tested rows, axes x_mm, y_mm, F_N."""

    arm: str
    board: str
    skin: str
    seed_i: int
    true: Float[np.ndarray, "b 3"]
    predicted: Float[np.ndarray, "b 3"]


def bias(true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"]) -> dict[str, float]:
    """By how much force is over-estimated, in newtons and as a part of the mean force; negative is too little."""
    true_N = true[:, FORCE].astype(float)
    over_N = float((predicted[:, FORCE].astype(float) - true_N).mean())
    return {"bias_f_N": over_N, "bias_f_pct": 100 * over_N / float(true_N.mean())}


def over_boards(answers: Sequence[Answered]) -> dict[str, dict[str, Any]]:
    """Summarise every metric over boards, each the mean of its skins, each of these of its seeds; by arm."""
    return {arm: summarise_boards(board_means(_scored(own, score))) for arm, own in _by_arm(answers).items()}


def biases(answers: Sequence[Answered]) -> dict[str, dict[str, Any]]:
    """Both ways to say the force bias, each by arm, over boards."""
    by_arm = {arm: summarise_boards(board_means(_scored(own, bias))) for arm, own in _by_arm(answers).items()}
    return {name: {arm: one[name] for arm, one in by_arm.items()} for name in ("bias_f_N", "bias_f_pct")}


def paired(answers: Sequence[Answered], arm: str, other: str) -> dict[str, Any]:
    """Compare two arms skin by skin, `arm` less `other`: over boards, and `by_board`."""
    by_arm = _by_arm(answers)
    return inference.paired(_scored(by_arm[arm], score), _scored(by_arm[other], score))


def _scored(answers: Sequence[Answered], judge: Judge) -> list[Scored]:
    return [(one.board, one.skin, judge(one.true, one.predicted)) for one in answers]


def _by_arm(answers: Sequence[Answered]) -> dict[str, list[Answered]]:
    arms: dict[str, list[Answered]] = {}
    for one in answers:
        arms.setdefault(one.arm, []).append(one)
    return arms
