"""Who is held out: leave-one-board-out, one skin to others, random, temporal. In: rows. Out: folds.

The drawing is scikit-learn's; this module names the groups and proves that no skin or board is on both sides of
a fold that claims so. Refuses to know what is trained on a fold.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Int64
from pydantic import Field
from sklearn.model_selection import LeaveOneGroupOut, ShuffleSplit, train_test_split

from pipeline.dataset.rows import Rows
from pipeline.errors import ParamsError, complain
from pipeline.strict import Strict

Question = Literal["lobo", "transfer", "single_random", "single_temporal"]


class Split(Strict):
    """How folds are drawn; each part is there if, and only if, its question is asked."""

    random_test_fraction: Annotated[float, Field(gt=0, lt=1)] | None = None
    random_repeats_n: Annotated[int, Field(ge=1)] | None = None
    temporal_test_fraction: Annotated[float, Field(gt=0, lt=1)] | None = None
    transfer_skins_n: Annotated[int, Field(ge=1)] | None = None


@dataclass(frozen=True)
class Fold:
    """Row numbers (of `Rows`) on both sides of one hold-out."""

    question: str
    name: str
    train: Int64[np.ndarray, " a"]
    test: Int64[np.ndarray, " b"]


def draw_folds(rows: Rows, questions: Iterable[str], split: Split, seed: int) -> list[Fold]:
    """Draw the folds of every question that a scene asks.

    >>> rows = Rows.of_labels(boards=["b1", "b1", "b2"], skins=["s1", "s2", "s3"])
    >>> [(fold.name, fold.train.tolist(), fold.test.tolist()) for fold in draw_folds(rows, ["lobo"], Split(), 0)]
    [('b1', [2], [0, 1]), ('b2', [0, 1], [2])]
    """
    return [fold for question in questions for fold in _DRAW[question](rows, split, seed)]


def leave_one_board_out(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """One fold a board: train on all other boards, test on its skins (paper section 5.1)."""
    boards = np.unique(rows.board)
    if len(boards) < 2:
        raise ParamsError(
            complain(
                "question lobo", "boards", "two or more", f"{len(boards)} ({', '.join(boards)})",
                "Add another board's recording, or take lobo out of the scene's questions.",
            )
        )  # fmt: skip
    drawn = LeaveOneGroupOut().split(np.empty((len(rows), 0)), groups=rows.board)
    folds = [Fold("lobo", str(rows.board[test[0]]), train, test) for train, test in drawn]
    for fold in folds:
        _prove_apart(rows, fold)
    return folds


def one_skin_to_others(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Train on one skin, test on skins of other boards; one fold a training skin.

    The paper trains on 3 skins, one at a time, and tests on 9 others: with 6 boards of 3 skins, the training skins
    are the first of the first three boards and the tests all skins of the other three.
    """
    assert split.transfer_skins_n is not None
    boards = np.unique(rows.board)
    train_n = min(split.transfer_skins_n, len(boards) - 1)
    if train_n < 1:
        raise ParamsError(
            complain(
                "question transfer", "boards", "two or more", f"{len(boards)}",
                "Add another board's recording, or take transfer out of the scene's questions.",
            )
        )  # fmt: skip
    test = np.flatnonzero(np.isin(rows.board, boards[train_n:]))
    folds = []
    for board in boards[:train_n]:
        skin = np.unique(rows.skin[rows.board == board])[0]
        folds.append(Fold("transfer", str(skin), np.flatnonzero((rows.board == board) & (rows.skin == skin)), test))
        _prove_apart(rows, folds[-1])
    return folds


def random_readings(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Random readings of the first skin held out, repeatedly (paper section 4).

    Readings of one indentation fall on both sides: the paper's way, which flatters the model.
    """
    assert split.random_test_fraction is not None
    assert split.random_repeats_n is not None
    own = np.flatnonzero(rows.skin == np.unique(rows.skin)[0])
    if len(own) < 2:
        raise ParamsError(complain("question single_random", "rows of a skin", "two or more", len(own), "Record more."))
    shuffle = ShuffleSplit(split.random_repeats_n, test_size=split.random_test_fraction, random_state=seed % 2**32)
    return [
        Fold("single_random", f"repeat{i}", np.sort(own[train]), np.sort(own[test]))
        for i, (train, test) in enumerate(shuffle.split(own))
    ]


def last_passes(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Train on the first passes of a skin, test on its last; one fold a skin."""
    assert split.temporal_test_fraction is not None
    folds = []
    for skin in np.unique(rows.skin):
        own = np.flatnonzero(rows.skin == skin)
        passes = np.unique(rows.pass_i[own])
        if len(passes) < 2:
            raise ParamsError(
                complain(
                    "question single_temporal", f"passes of skin {skin}", "two or more", len(passes),
                    "Record more passes, or take single_temporal out of the scene's questions.",
                )
            )  # fmt: skip
        first, last = train_test_split(passes, test_size=split.temporal_test_fraction, shuffle=False)
        folds.append(
            Fold(
                "single_temporal", str(skin),
                own[np.isin(rows.pass_i[own], first)], own[np.isin(rows.pass_i[own], last)],
            )
        )  # fmt: skip
    return folds


def _prove_apart(rows: Rows, fold: Fold) -> None:
    for what, labels in (("board", rows.board), ("skin", rows.skin)):
        both = np.intersect1d(np.unique(labels[fold.train]), np.unique(labels[fold.test]))
        if len(both):
            raise ParamsError(
                complain(
                    f"fold {fold.question}/{fold.name}", f"a {what}", "on one side only",
                    f"{', '.join(both)} on both", "Give every skin its own name, and each skin one board.",
                )
            )  # fmt: skip


_DRAW: dict[str, Callable[[Rows, Split, int], list[Fold]]] = {
    "lobo": leave_one_board_out,
    "transfer": one_skin_to_others,
    "single_random": random_readings,
    "single_temporal": last_passes,
}
