"""Networks before and after they are adapted to a skin, side by side. In: answers by arm, skin, seed. Out: numbers.

An arm is one way to treat the same networks: left as they were, adapted, adapted without the skin's pokes, ...
Refuses to know networks, pokes and files.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.evaluation.metrics import score
from pipeline.evaluation.statistic import over_units, statistic

FORCE = 2  # column
BEFORE, AFTER, CONTROL = "before", "after", "control"  # arms: as it was, adapted, as long without the skin's pokes


@dataclass(frozen=True)
class Answered:
    """What one network answers on one skin's tested rows, axes x_mm, y_mm, F_N."""

    arm: str
    skin: str
    seed_i: int
    true: Float[np.ndarray, "b 3"]
    predicted: Float[np.ndarray, "b 3"]


def bias(true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"]) -> dict[str, float]:
    """By how much force is over-estimated, in newtons and as a part of the mean force; negative is too little."""
    true_N = true[:, FORCE].astype(float)
    over_N = float((predicted[:, FORCE].astype(float) - true_N).mean())
    return {"bias_f_N": over_N, "bias_f_pct": 100 * over_N / float(true_N.mean())}


def over_skins(answers: Sequence[Answered]) -> dict[str, dict[str, Any]]:
    """Mean, sd and number over skins of every metric, each skin the mean of its seeds; by arm."""
    return {
        arm: over_units([(one.skin, score(one.true, one.predicted)) for one in own])
        for arm, own in _by_arm(answers).items()
    }


def biases(answers: Sequence[Answered]) -> dict[str, dict[str, Any]]:
    """Both ways to say the force bias, each by arm, over skins."""
    by_arm = {
        arm: over_units([(one.skin, bias(one.true, one.predicted)) for one in own])
        for arm, own in _by_arm(answers).items()
    }
    return {name: {arm: one[name] for arm, one in by_arm.items()} for name in ("bias_f_N", "bias_f_pct")}


def paired(answers: Sequence[Answered], arm: str, other: str) -> dict[str, Any]:
    """Mean, sd and number over skins of the differences `arm` less `other`, both the mean of their seeds."""
    by_arm = _by_arm(answers)
    ours, theirs = (_means(by_arm[name]) for name in (arm, other))
    assert ours.keys() == theirs.keys(), "every arm answers on the same skins"
    names = next(iter(ours.values()))
    return {name: statistic([ours[skin][name] - theirs[skin][name] for skin in ours]) for name in names}


def _means(answers: Sequence[Answered]) -> dict[str, Mapping[str, float]]:
    """Mean over seeds of every metric, by skin."""
    return {
        skin: {
            name: one["mean"]
            for name, one in over_units([(skin, score(a.true, a.predicted)) for a in answers if a.skin == skin]).items()
        }
        for skin in sorted({one.skin for one in answers})
    }


def _by_arm(answers: Sequence[Answered]) -> dict[str, list[Answered]]:
    arms: dict[str, list[Answered]] = {}
    for one in answers:
        arms.setdefault(one.arm, []).append(one)
    return arms
