"""Networks of rigid boards on flexible ones: errors, force bias, how much stronger fields are. In: answers, readings.

Out: plain numbers. Refuses to know networks, boards and files.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.evaluation.scores import statistic
from pipeline.trials.arms import AFTER, BEFORE, FORCE, Answered, biases, compare_arms, summarise_arms

DEPTH_DECIMALS = 2  # of a commanded depth in mm: nearer ones are one
DRAWN_N = 400  # more points than these are not told apart in a panel
FORCE_DECIMALS = 3  # in newtons: more than are seen

ByDepth = Mapping[float, Float[np.ndarray, " d"]]  # |dB| in uT by commanded depth in mm


def by_depth(depth_mm: Float[np.ndarray, " f"], db_uT: Float[np.ndarray, "f ch"]) -> dict[float, np.ndarray]:
    """Sort the lengths of changes of field by commanded depth."""
    length_uT, depth_mm = np.linalg.norm(db_uT, axis=1), np.round(depth_mm.astype(float), DEPTH_DECIMALS)
    return {float(depth): length_uT[depth_mm == depth] for depth in np.unique(depth_mm)}


def strength_ratio(flexible: Sequence[ByDepth], rigid: Sequence[ByDepth]) -> dict[str, float]:
    """Median |dB| of flexible boards' captures over that of rigid ones, at each depth that both have, over depths."""
    both = set().union(*flexible) & set().union(*rigid)
    return statistic([_median_uT(flexible, depth) / _median_uT(rigid, depth) for depth in sorted(both)])


def gap_less_pct(gap_mm: Mapping[str, float]) -> float:
    """By how much nearer chips of flexible boards are to their skins than those of rigid ones, in % of the latter."""
    return 100 * (1 - gap_mm["flexible"] / gap_mm["rigid"])


def answer_flexible(answers: Sequence[Answered]) -> dict[str, Any]:
    """Summarise over boards, by arm; the force bias and the gain by adaptation apart."""
    differences = {f"{AFTER}_minus_{BEFORE}": compare_arms(answers, AFTER, BEFORE)}
    return summarise_arms(answers) | biases(answers) | {"paired": differences}


def forces_drawn(answers: Sequence[Answered], rng: np.random.Generator) -> dict[str, dict[str, list[float]]]:
    """Choose equal readings of both arms' first networks at random: true and predicted force, in newtons."""
    arms = {arm: [one for one in answers if one.arm == arm and one.seed_i == 0] for arm in (BEFORE, AFTER)}
    shown = rng.permutation(sum(len(one.true) for one in arms[BEFORE]))[:DRAWN_N]
    return {
        arm: {
            f"{side}_N": np.round(np.concatenate([getattr(one, side)[:, FORCE] for one in own])[shown], FORCE_DECIMALS)
            .astype(float).round(FORCE_DECIMALS).tolist()
            for side in ("true", "predicted")
        }
        for arm, own in arms.items()
    }  # fmt: skip


def _median_uT(captures: Sequence[ByDepth], depth_mm: float) -> float:
    return float(np.median(np.concatenate([one[depth_mm] for one in captures if depth_mm in one])))
