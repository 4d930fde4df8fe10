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
        "board_of": {str(name): str(board[skin == name][0]) for name in np.unique(skin)},
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


def pool_skins(cards: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Put the cards of networks adapted to one skin each together: one a fold and seed, over all their rows."""
    together: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for card in cards:
        together.setdefault((card["fold"], card["seed_i"]), []).append(card)
    return [
        {"fold": fold, "seed_i": seed_i, "scores": _pool([card["scores"] for card in own])}
        for (fold, seed_i), own in together.items()
    ]


def _pool(scores: Sequence[dict[str, Any]]) -> dict[str, Any]:
    by_skin = {skin: one for own in scores for skin, one in own["by_skin"].items()}
    board_of = {skin: board for own in scores for skin, board in own["board_of"].items()}
    rows_n = np.array([own["rows_n"] for own in scores])
    parts = {
        part: {name: float(np.average([own[part][name] for own in scores], weights=rows_n)) for name in scores[0][part]}
        for part in ("all", "registered")
    }
    return parts | {"by_skin": by_skin, "board_of": board_of, "rows_n": int(rows_n.sum())}


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
