"""Who is held out: leave-one-board-out, fewer sensors, few labels, one skin to others. In: rows. Out: folds.

The drawing is scikit-learn's; this module names the groups and proves that no skin or board is on both sides of
a fold that claims so; `single` draws within one skin. Refuses to know what is trained on a fold.
"""

from collections.abc import Callable, Iterable

import numpy as np
from sklearn.model_selection import LeaveOneGroupOut

from pipeline.core.errors import ParamsError
from pipeline.core.seeds import rng_for
from pipeline.dataset.hold_out import NO_POOL, ONE_SKIN, Fold, Question, Split
from pipeline.dataset.lines import take_pokes
from pipeline.dataset.rows import Rows
from pipeline.dataset.single import last_passes, random_indentations, random_passes, random_readings

__all__ = ["NO_POOL", "ONE_SKIN", "Fold", "Question", "Split", "draw_folds", "hold_out_skins"]


def draw_folds(rows: Rows, questions: Iterable[str], split: Split, seed: int) -> list[Fold]:
    """Draw the folds of every question that a scene asks.

    >>> rows = Rows.of_labels(boards=["b1", "b1", "b2"], skins=["s1", "s2", "s3"])
    >>> [(fold.name, fold.train.tolist(), fold.test.tolist()) for fold in draw_folds(rows, ["lobo"], Split(), 0)]
    [('b1', [2], [0, 1]), ('b2', [0, 1], [2])]

    With a pool, the first passes of each held-out skin are adapted on, and its later ones tested:

    >>> rows = Rows.of_labels(["b1"] * 3 + ["b2"] * 2, ["s1"] * 3 + ["s2"] * 2, pass_i=[0, 1, 2, 0, 1])
    >>> def show(folds):
    ...     for fold in folds:
    ...         print(fold.name, fold.train, fold.pool, fold.test)
    >>> show(draw_folds(rows, ["lobo"], Split(pool_passes_n=1), 0))
    b1 [3 4] [0] [1 2]
    b2 [0 1 2] [3] [4]

    Fewer sensors: every board is held out in turn, and each draw adds skins to those that it had:

    >>> rows = Rows.of_labels(["b1", "b1", "b2", "b3"], ["s1", "s2", "s3", "s4"])
    >>> show(draw_folds(rows, ["sensors"], Split(sensors_skins_n=(1, 2), sensors_draws_n=1), 0))
    b1-01skins-draw0 [3] [] [0 1]
    b1-02skins-draw0 [2 3] [] [0 1]
    b2-01skins-draw0 [1] [] [2]
    b2-02skins-draw0 [0 1] [] [2]
    b3-01skins-draw0 [0] [] [3]
    b3-02skins-draw0 [0 1] [] [3]
    """
    return [fold for question in questions for fold in _DRAW[question](rows, split, seed)]


def leave_one_board_out(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """One fold a board: train on all other boards, test on its skins (paper section 5.1)."""
    boards = np.unique(rows.board)
    if len(boards) < 2:
        raise ParamsError(
                "question lobo", "boards", "two or more", f"{len(boards)} ({', '.join(boards)})",
                "Add another board's recording, or take lobo out of the scene's questions.",
            )  # fmt: skip
    drawn = LeaveOneGroupOut().split(np.empty((len(rows), 0)), groups=rows.board)
    return [hold_out_skins(rows, "lobo", str(rows.board[held[0]]), (train, held), split) for train, held in drawn]


def fewer_sensors(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Train on k skins of all boards but one, test on that board; one fold a board, k and draw (paper figure 6b).

    Every board is held out in turn and has draws of its own. Within a draw, the skins of a smaller k are among those of
    a larger one.
    """
    assert split.sensors_skins_n is not None
    assert split.sensors_draws_n is not None
    folds = []
    for board in np.unique(rows.board):
        held, skins = np.flatnonzero(rows.board == board), np.unique(rows.skin[rows.board != board])
        if max(split.sensors_skins_n) > len(skins):
            raise ParamsError(
                    "question sensors", "split.sensors_skins_n",
                    f"at most the {len(skins)} skins beside held-out board {board}", max(split.sensors_skins_n),
                    "Ask for fewer, or add another board's recording.",
                )  # fmt: skip
        draws = range(split.sensors_draws_n)
        orders = [rng_for(seed, "sensors", str(board), draw_i).permutation(skins) for draw_i in draws]
        for skins_n in split.sensors_skins_n:
            for draw_i, order in enumerate(orders):
                train = np.flatnonzero(np.isin(rows.skin, order[:skins_n]))
                name = f"{board}-{skins_n:02d}skins-draw{draw_i}"
                folds.append(hold_out_skins(rows, "sensors", name, (train, held), split))
    return folds


def few_labels(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Hold a board out as in `lobo`, a drawn pool of its indentations to be labelled; one fold a board and draw.

    What was drawn is not tested, whether its labels are used or not, so that all numbers of labels meet equal tests.
    """
    assert split.labels_pool_n is not None
    assert split.labels_draws_n is not None
    plain = split.model_copy(update={"pool_passes_n": None})
    folds = []
    for whole in leave_one_board_out(rows, plain, seed):
        skins = np.unique(rows.skin[whole.test])
        for draw_i in range(split.labels_draws_n):
            taken = [
                take_pokes(
                    rows, whole.test[rows.skin[whole.test] == skin], split.labels_pool_n,
                    rng_for(seed, "labels", str(skin), draw_i),
                )
                for skin in skins
            ]  # fmt: skip
            pool = np.sort(np.concatenate(taken))
            test = np.setdiff1d(whole.test, pool)
            if not len(test):
                raise ParamsError(
                        f"fold labels/{whole.name}", "split.labels_pool_n", "less than its indentations",
                        split.labels_pool_n, "Ask for fewer, or record more.",
                    )  # fmt: skip
            folds.append(Fold("labels", f"{whole.name}-draw{draw_i}", whole.train, test, pool))
    return folds


def one_skin_to_others(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Train on one skin, test on skins of other boards; one fold a training skin.

    Where others adapt, the pool is left out of the tests here too, so that all are scored on the same rows.

    The paper trains on 3 skins, one at a time, and tests on 9 others: with 6 boards of 3 skins, the training skins
    are the first of the first three boards and the tests all skins of the other three.
    """
    assert split.transfer_skins_n is not None
    boards, train_n = np.unique(rows.board), split.transfer_skins_n
    if train_n >= len(boards):
        raise ParamsError(
                "question transfer", "split.transfer_skins_n", f"less than the scene's {len(boards)} boards", train_n,
                "Each training skin takes a board; another must be left to test on.",
            )  # fmt: skip
    held = np.flatnonzero(np.isin(rows.board, boards[train_n:]))
    folds = []
    for board in boards[:train_n]:
        skin = np.unique(rows.skin[rows.board == board])[0]
        train = np.flatnonzero((rows.board == board) & (rows.skin == skin))
        folds.append(hold_out_skins(rows, "transfer", str(skin), (train, held), split))
    return folds


def hold_out_skins(rows: Rows, question: str, name: str, sides: tuple[np.ndarray, np.ndarray], split: Split) -> Fold:
    """Make a fold of train and held-out rows; the first passes of each held-out skin are its pool, if one is asked."""
    train, held = sides
    pooled = np.zeros(len(held), bool)
    if split.pool_passes_n is not None:
        for skin in np.unique(rows.skin[held]):
            own = rows.skin[held] == skin
            passes = np.unique(rows.pass_i[held[own]])
            if len(passes) <= split.pool_passes_n:
                raise ParamsError(
                        f"question {question}", f"passes of held-out skin {skin}",
                        f"more than split.pool_passes_n, {split.pool_passes_n}", len(passes),
                        "Record more passes, or make the pool smaller.",
                    )  # fmt: skip
            pooled |= own & np.isin(rows.pass_i[held], passes[: split.pool_passes_n])
    fold = Fold(question, name, train, held[~pooled], held[pooled])
    _prove_apart(rows, fold)
    return fold


def _prove_apart(rows: Rows, fold: Fold) -> None:
    held = np.concatenate([fold.test, fold.pool])
    for what, labels in (("board", rows.board), ("skin", rows.skin)):
        both = np.intersect1d(np.unique(labels[fold.train]), np.unique(labels[held]))
        if len(both):
            raise ParamsError(
                    f"fold {fold.question}/{fold.name}", f"a {what}", "on one side only",
                    f"{', '.join(both)} on both", "Give every skin its own name, and each skin one board.",
                )  # fmt: skip


_DRAW: dict[str, Callable[[Rows, Split, int], list[Fold]]] = {
    "lobo": leave_one_board_out,
    "sensors": fewer_sensors,
    "labels": few_labels,
    "transfer": one_skin_to_others,
    "single_random": random_readings,
    "single_indentation": random_indentations,
    "single_pass": random_passes,
    "single_temporal": last_passes,
}
