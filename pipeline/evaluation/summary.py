"""Scores of one training and summaries over folds. In: predictions with their groups. Out: plain numbers.

Refuses to know models and pages.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.evaluation.metrics import register, score, summarise


def score_groups(
    true: Float[np.ndarray, "b 3"], predicted: Float[np.ndarray, "b 3"], board: np.ndarray, skin: np.ndarray
) -> dict[str, Any]:
    """Score all test rows, each test skin, and all rows after one offset a test board (a diagnosis)."""
    registered = predicted.copy()
    for name in np.unique(board):
        registered[board == name] = register(true[board == name], predicted[board == name])
    return {
        "all": score(true, predicted),
        "registered": score(true, registered),
        "by_skin": {str(name): score(true[skin == name], predicted[skin == name]) for name in np.unique(skin)},
        "rows_n": len(true),
    }


def over_folds(cards: Sequence[dict[str, Any]], part: str = "all") -> dict[str, dict[str, float]]:
    """Mean and sd over folds, each the mean of its seeds."""
    return _over_units([(card["fold"], card["scores"][part]) for card in cards])


def over_test_skins(cards: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and sd over pairs (training skin, test skin), as for the paper's single-sensor row: 3 x 9 pairs."""
    return _over_units(
        [((card["fold"], skin), one) for card in cards for skin, one in card["scores"]["by_skin"].items()]
    )


def _over_units(scores: Sequence[tuple[Any, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Summarise over units (`mean`, `sd`, `n`); with several seeds, also `sd_seeds`, the mean spread within a unit."""
    units: dict[Any, list[dict[str, float]]] = {}
    for unit, one in scores:
        units.setdefault(unit, []).append(one)
    within = [summarise(own) for own in units.values()]
    summary = summarise([{name: value["mean"] for name, value in one.items()} for one in within])
    for name, value in summary.items():
        spreads = [one[name]["sd"] for one in within if "sd" in one.get(name, {})]
        if spreads:
            value["sd_seeds"] = float(np.mean(spreads))
    return summary
