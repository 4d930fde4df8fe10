"""Inference over boards: scores of networks by board and skin -> differences a board, 95 % intervals, verdicts.

The unit is the board: skins of one board share it and the network that never saw it, so only boards are taken as
independent. Refuses to know what a score is of, and who claims what.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import t

from pipeline.core.errors import SchemaError

CONFIDENCE = 0.95  # convention
YES, NO, INCONCLUSIVE = "yes", "no", "inconclusive"
ONE_BOARD = "inconclusive (one board)"
VERDICTS = (
    "Yes: the 95 % interval lies wholly on the claim's side of 0 or of the stated threshold. No: wholly on the other "
    "side. Inconclusive: it includes 0 or the threshold; one board has no interval. The interval is over boards "
    "(Student's t of the boards' means; skins and networks of a board are averaged first)."
)

Scores = Mapping[str, float]
Scored = tuple[str, str, Scores]  # board, skin, and one network's scores there
Stat = Mapping[str, Any]  # mean, n; where n > 1 also sd, and where n are boards ci95: [low, high]


def interval(values: Sequence[float]) -> list[float] | None:
    """Give the two-sided 95 % interval of a mean by Student's t with n - 1 degrees of freedom; None below two values.

    >>> interval([1.0]) is None
    True
    >>> [round(float(end), 2) for end in interval([1.0, 3.0])]  # t is 12.71 with one degree of freedom
    [-10.71, 14.71]
    """
    n = len(values)
    if n < 2:
        return None
    reach = float(t.ppf((1 + CONFIDENCE) / 2, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return [float(np.mean(values)) - reach, float(np.mean(values)) + reach]


def over_boards(values: Sequence[float]) -> dict[str, Any]:
    """Summarise one value a board: mean, number, and of two boards or more sd (n - 1) and the interval `ci95`."""
    stat = {"mean": float(np.mean(values)), "n": len(values)}
    if len(values) < 2:
        return stat
    return stat | {"sd": float(np.std(values, ddof=1)), "ci95": interval(values)}


def board_means(scored: Iterable[Scored]) -> dict[str, dict[str, float]]:
    """Average networks on each skin, then the skins of each board."""
    boards: dict[str, list[Scores]] = {}
    for (board, _), scores in _skin_means(scored).items():
        boards.setdefault(board, []).append(scores)
    return {board: _means(own) for board, own in sorted(boards.items())}


def summarise_boards(by_board: Mapping[str, Scores]) -> dict[str, dict[str, Any]]:
    """Summarise every score over the boards that have it."""
    names = dict.fromkeys(name for scores in by_board.values() for name in scores)
    return {name: over_boards([scores[name] for scores in by_board.values() if name in scores]) for name in names}


def paired(of: Iterable[Scored], over: Iterable[Scored]) -> dict[str, Any]:
    """Compare two sides skin by skin: every score's difference over boards, and `by_board` the differences themselves.

    Each side is the mean of its networks on a skin, and a board the mean of its skins. Both sides have the same skins.
    """
    ours, theirs = _skin_means(of), _skin_means(over)
    if ours.keys() != theirs.keys():
        unpaired = sorted(ours.keys() ^ theirs.keys())
        remedy = "Train both on the same folds."
        raise SchemaError("a paired difference", "held-out skins", "the same on both sides", unpaired, remedy)
    differences = [
        (board, skin, {name: own[name] - theirs[board, skin][name] for name in own if name in theirs[board, skin]})
        for (board, skin), own in ours.items()
    ]
    by_board = board_means(differences)
    return {**summarise_boards(by_board), "by_board": by_board}


def on_skins_of(scored: Iterable[Scored], others: Iterable[Scored]) -> list[Scored]:
    """Keep what was scored on skins that the others were scored on too."""
    skins = {(board, skin) for board, skin, _ in others}
    return [one for one in scored if one[:2] in skins]


def verdict(stat: Stat, *, above: float = 0.0) -> str:
    """Judge whether a mean over boards is above a threshold, by its interval."""
    if "ci95" not in stat:
        return ONE_BOARD
    low, high = stat["ci95"]
    return YES if low > above else NO if high < above else INCONCLUSIVE


def verdict_within(stat: Stat, reach: float) -> str:
    """Judge whether a mean over boards is nearer to 0 than `reach`, by its interval (equivalence)."""
    if "ci95" not in stat:
        return ONE_BOARD
    low, high = stat["ci95"]
    if -reach < low and high < reach:
        return YES
    return NO if low > reach or high < -reach else INCONCLUSIVE


def negated(stat: Stat) -> dict[str, Any]:
    """Turn a difference round: of an error, less is a gain."""
    turned = {**stat, "mean": -stat["mean"]}
    return turned | ({"ci95": [-end for end in reversed(stat["ci95"])]} if "ci95" in stat else {})


def all_of(verdicts: Sequence[str]) -> str:
    """Judge a claim of several parts: one no is enough to deny it, and only yes throughout affirms it."""
    for word in (NO, ONE_BOARD, INCONCLUSIVE):
        if word in verdicts:
            return word
    return YES


def _skin_means(scored: Iterable[Scored]) -> dict[tuple[str, str], dict[str, float]]:
    skins: dict[tuple[str, str], list[Scores]] = {}
    for board, skin, scores in scored:
        skins.setdefault((board, skin), []).append(scores)
    return {key: _means(own) for key, own in sorted(skins.items())}


def _means(scores: Sequence[Scores]) -> dict[str, float]:
    names = dict.fromkeys(name for one in scores for name in one)
    return {name: float(np.mean([one[name] for one in scores if name in one])) for name in names}
