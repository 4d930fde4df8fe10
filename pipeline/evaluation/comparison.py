"""Cards of trainings over boards: their scores with intervals, and one method against another on equal test rows.

In: cards, each of networks that never saw the boards that they are scored on. Out: plain numbers. Refuses to know
pages and claims.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.evaluation import inference
from pipeline.evaluation.inference import Scored, interval
from pipeline.evaluation.summary import over_test_skins

Cards = Sequence[dict[str, Any]]


def over_boards(cards: Cards, part: str = "all") -> dict[str, dict[str, Any]]:
    """Summarise `part` of cards of one held-out board each, a board the mean of its trainings (seeds, draws of skins).

    Of one board alone, `sd_seeds` says how much its trainings vary.
    """
    scored: list[Scored] = [(_board(card), "", card["scores"][part]) for card in cards]
    summary = inference.summarise_boards(inference.board_means(scored))
    if len({board for board, _, _ in scored}) == 1 and len(scored) > 1:
        for name, value in summary.items():
            value["sd_seeds"] = float(np.std([scores[name] for _, _, scores in scored], ddof=1))
    return summary


def over_pairs(cards: Cards) -> dict[str, dict[str, Any]]:
    """Summarise pairs of a training and a test skin, as the paper does (`mean`, `sd`, `n`), `ci95` over test boards.

    The same few networks answer on every board, so the interval says nothing of other training skins.
    """
    pairs: dict[str, dict[str, Any]] = {name: dict(value) for name, value in over_test_skins(cards).items()}
    by_board = inference.board_means(scored_skins(cards)).values()
    for name, value in pairs.items():
        ends = interval([scores[name] for scores in by_board if name in scores])
        value |= {} if ends is None else {"ci95": ends}
    return pairs


def scored_skins(cards: Cards) -> list[Scored]:
    """Give the scores of every network on every held-out skin."""
    return [
        (card["scores"]["board_of"][skin], skin, scores)
        for card in cards
        for skin, scores in card["scores"]["by_skin"].items()
    ]


def paired(cards: Cards, others: Cards) -> dict[str, Any]:
    """Compare two methods on each held-out board (`inference.paired`)."""
    return inference.paired(scored_skins(cards), scored_skins(others))


def paired_where_tested(cards: Cards, others: Cards) -> dict[str, Any]:
    """Compare on the skins that the others were tested on, as one skin on others is on some boards only."""
    theirs = scored_skins(others)
    return inference.paired(inference.on_skins_of(scored_skins(cards), theirs), theirs)


def _board(card: dict[str, Any]) -> str:
    (board,) = set(card["scores"]["board_of"].values())  # a fold that holds one board out
    return str(board)
