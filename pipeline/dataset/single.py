"""Splits within one skin, side by side: random readings, indentations or passes; last passes. In: rows. Out: folds.

Random readings are the paper's way, which has readings of one indentation on both sides; the others keep indentations,
or whole passes, together. The drawing is scikit-learn's. Refuses to know other skins.
"""

import numpy as np
from jaxtyping import Int64, Shaped
from sklearn.model_selection import GroupShuffleSplit, train_test_split

from pipeline.core.errors import ParamsError
from pipeline.core.seeds import seed_for
from pipeline.dataset.hold_out import NO_POOL, Fold, Split
from pipeline.dataset.rows import Rows

STATES_N = 2**32  # scikit-learn's seeds are below it

Pair = tuple[Int64[np.ndarray, " a"], Int64[np.ndarray, " b"]]


def random_readings(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Hold out random readings of the first skin, repeatedly (paper section 4).

    Readings of one indentation fall on both sides: the paper's way, which flatters the model.
    """
    return _of_first_skin(rows, split, "single_random", np.arange(len(rows)), seed)


def random_indentations(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Hold out random indentations of the first skin, repeatedly; the readings of one stay together."""
    return _of_first_skin(rows, split, "single_indentation", rows.indentation, seed_for(seed, "single_indentation"))


def random_passes(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Hold out random passes of the first skin, repeatedly: one at least, however small the fraction."""
    return _of_first_skin(rows, split, "single_pass", rows.pass_i, seed_for(seed, "single_pass"))


def last_passes(rows: Rows, split: Split, seed: int) -> list[Fold]:
    """Train on the first passes of a skin, test on its last; one fold a skin."""
    assert split.temporal_test_fraction is not None
    folds = []
    for skin in np.unique(rows.skin):
        own = np.flatnonzero(rows.skin == skin)
        captures = np.unique(rows.capture[own])
        if len(captures) > 1:
            raise ParamsError(
                    "question single_temporal", f"the captures of skin {skin}", "one, as no clock orders several",
                    ", ".join(captures), "Record the passes in one capture, or ask single_random.",
                )  # fmt: skip
        passes = np.unique(rows.pass_i[own])
        test_n = _test_n(
            len(passes), split.temporal_test_fraction, f"passes of skin {skin}", "question single_temporal"
        )
        first, last = train_test_split(passes, test_size=test_n, shuffle=False)
        folds.append(
            Fold(
                "single_temporal", str(skin),
                own[np.isin(rows.pass_i[own], first)], own[np.isin(rows.pass_i[own], last)], NO_POOL,
            )
        )  # fmt: skip
    return folds


def draw_sides(
    group: Shaped[np.ndarray, " f"], *, test_fraction: float, repeats_n: int, state: int, what: str, where: str
) -> list[Pair]:
    """Draw test groups, repeatedly: rows of equal `group` stay together; one group at least is tested.

    `what` the groups are and `where` they are asked for are words for people.
    """
    groups_n = len(np.unique(group))
    test_n = _test_n(groups_n, max(test_fraction, 1 / groups_n), what, where)
    shuffle = GroupShuffleSplit(repeats_n, test_size=test_n, random_state=state % STATES_N)
    return [(train, test) for train, test in shuffle.split(group, groups=group)]


def _of_first_skin(rows: Rows, split: Split, question: str, group: Shaped[np.ndarray, " f"], state: int) -> list[Fold]:
    assert split.random_test_fraction is not None
    assert split.random_repeats_n is not None
    own = np.flatnonzero(rows.skin == np.unique(rows.skin)[0])
    what = {"single_random": "readings", "single_indentation": "indentations", "single_pass": "passes"}[question]
    drawn = draw_sides(
        group[own], test_fraction=split.random_test_fraction, repeats_n=split.random_repeats_n, state=state,
        what=f"{what} of skin {rows.skin[own[0]]}", where=f"question {question}",
    )  # fmt: skip
    return [Fold(question, f"repeat{i}", own[train], own[test], NO_POOL) for i, (train, test) in enumerate(drawn)]


def _test_n(all_n: int, fraction: float, what: str, where: str) -> int:
    """Round the number held out to the nearest; both sides need one at least."""
    test_n = round(fraction * all_n)
    if not 0 < test_n < all_n:
        raise ParamsError(
                where, what, "enough for both sides", f"{all_n}, of which {fraction:g} are {test_n}",
                "Record more, change the fraction, or take the question out of the scene's.",
            )  # fmt: skip
    return test_n
