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
    """Mean and sd over trainings (folds x seeds), one score each."""
    return summarise([card["scores"][part] for card in cards])


def over_test_skins(cards: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and sd over pairs of (training, test skin), as for the paper's single-sensor row: 3 x 9 pairs."""
    return summarise([one for card in cards for one in card["scores"]["by_skin"].values()])
