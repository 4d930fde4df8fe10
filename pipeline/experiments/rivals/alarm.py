"""This is no skin that I know: what a fitted law leaves over, of the right skin and of strangers -> rates of alarm.

The limit is set on boards that are not held out, so that so many of their readings raise it. Refuses to know places.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.experiments.contacts.pairs import roc_area
from pipeline.experiments.rivals.flagged import EVERY_N, first_folds, limits_of, worse
from pipeline.experiments.rivals.points import INVERSION, means_uT, pokes_of
from pipeline.report.statistics import statistic
from pipeline.training.trainings import SceneData
from pipeline.training.universal import Frame
from reskin.data.splits import Fold
from reskin.universal.inversion import Chart, chart, fit_unlabelled, search
from reskin.universal.law import Seen, Setup

OF_RIGHT, OF_STRANGER = "the right skin's", "fitted anew to the stranger"
ANOTHER = "another skin of the rig"
QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
Chips = Float[np.ndarray, "n k 3"]
# Boards that this law does not know, made of the board itself: what a wrong plug, driver or skin does to its fields.
STRANGERS: Mapping[str, Callable[[Chips], Chips]] = {
    "x axis of every chip mirrored": lambda chips: chips * (-1.0, 1.0, 1.0),
    "two chips exchanged": lambda chips: chips[:, [0, 2, 1, *range(3, chips.shape[1])]],
    "every chip turned by a quarter": lambda chips: chips @ QUARTER,
    "north for south": lambda chips: -chips,
}


@dataclass(frozen=True)
class Board:
    """A board in its chips' axes: the field at rest, unlabelled pokes, and readings that are asked."""

    rest_uT: Float[np.ndarray, "1 ch"]
    pool_uT: Float[np.ndarray, "m ch"]
    asked_uT: Float[np.ndarray, "b ch"]

    def seen_as(self, change: Callable[[Chips], Chips]) -> "Board":
        """Give the board as it would be read if its chips were changed."""
        parts = self.rest_uT, self.pool_uT, self.asked_uT
        return Board(*(change(part.reshape(len(part), -1, 3)).reshape(part.shape) for part in parts))


def alarm(
    data: SceneData, frame: Frame, setup: Setup, seen: Mapping[str, Seen], folds: Sequence[Fold], fraction: float
) -> dict[str, Any]:
    """Fit a law to each board's unlabelled pokes, on its first fold; ask it of readings of its own and of strangers."""
    first = first_folds(folds)
    boards = {board: board_seen(data, seen[board], fold) for board, fold in first.items()}
    known = {board: known_of(frame, setup, own) for board, own in boards.items()}
    found = {board: search(known[board], frame.field(own.asked_uT)) for board, own in boards.items()}
    left = {board: own.left for board, own in found.items()}
    true = {board: data.rows.target[first[board].test[::EVERY_N], :2].astype(float) for board in boards}
    off_mm = {board: own.place_mm - frame.place(true[board]) for board, own in found.items()}
    limits = limits_of(left, fraction)
    strangers: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    names = list(boards)
    for i, (board, own) in enumerate(boards.items()):
        other = boards[names[(i + 1) % len(names)]]
        strangers.setdefault((ANOTHER, OF_RIGHT), {})[board] = left_over(frame, known[board], other)
        for name, change in STRANGERS.items():
            stranger = own.seen_as(change)
            of_right = left_over(frame, known[board], stranger)
            anew = left_over(frame, known_of(frame, setup, stranger), stranger)
            strangers.setdefault((name, OF_RIGHT), {})[board] = of_right
            strangers.setdefault((name, OF_STRANGER), {})[board] = anew
    return {
        "asked_pct": 100 * fraction,
        "limit": statistic(list(limits.values()), boards=True),
        "right": told(left, left, limits),
        "flagged": {"method": INVERSION, "by": "left over"} | worse(left, off_mm, fraction),
        "strangers": [
            {"stranger": stranger, "law": law} | told(of, left, limits) for (stranger, law), of in strangers.items()
        ],
    }


def told(
    left: Mapping[str, Float[np.ndarray, "_"]],
    right: Mapping[str, Float[np.ndarray, "_"]],
    limits: Mapping[str, float],
) -> dict[str, Any]:
    """Summarise over boards: readings that raise the alarm, the area under the ROC curve, the median left over."""
    by_board = {
        "alarm_pct": [100 * float((own > limits[board]).mean()) for board, own in left.items()],
        "auc": [roc_area(right[board], own) for board, own in left.items()],
        "left_median": [float(np.median(own)) for own in left.values()],
    }
    return {name: statistic(values, boards=True) for name, values in by_board.items()}


def board_seen(data: SceneData, seen: Seen, fold: Fold) -> Board:
    """Take of a board what an alarm is told and asked."""
    rest_uT = seen.pokes.noload_uT.mean(axis=0).reshape(1, -1)
    return Board(rest_uT, means_uT(data, pokes_of(data, fold)), data.rows.db_uT[fold.test[::EVERY_N]].astype(float))


def known_of(frame: Frame, setup: Setup, board: Board) -> Chart:
    """Fit a law to what a board gives without a label."""
    return chart(fit_unlabelled(frame.field(board.pool_uT), frame.field(board.rest_uT)[0], setup), setup)


def left_over(frame: Frame, known: Chart, board: Board) -> Float[np.ndarray, " b"]:
    """Give what a law leaves over of each reading, |dB - simulated| / |dB|."""
    return search(known, frame.field(board.asked_uT)).left
