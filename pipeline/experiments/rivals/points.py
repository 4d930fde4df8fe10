"""What rivals share: pokes of a held-out board, a point of the table, and its summary over boards.

Refuses to know methods.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from pipeline.report.statistics import AS_LABELLED, REGISTERED, by_skin, over_boards, paired, tidy
from pipeline.training.trainings import SceneData, score_test
from reskin.data.splits import Fold
from reskin.seeds import rng_for

INVERSION = "physics inversion"  # a method
OWN, NONE, FOREIGN = "its own", "none", "another skin's"  # unlabelled pokes that a method is given
Point = dict[str, Any]
Key = tuple[str, str, int]  # method, unlabelled pokes, number of labels


def pokes_of(data: SceneData, fold: Fold) -> list[Int64[np.ndarray, " r"]]:
    """Give the rows of each poke of the pool, in the order in which question labels hands out labels."""
    indentation = data.rows.indentation[fold.pool]
    order = rng_for(data.settings.seed, "labelled", fold.name).permutation(np.unique(indentation))
    return [fold.pool[indentation == one] for one in order]


def means_uT(data: SceneData, pokes: Sequence[Int64[np.ndarray, " r"]]) -> Float[np.ndarray, "m ch"]:
    """Give the mean change of field of each poke, in the chips' axes."""
    return np.array([data.rows.db_uT[row].mean(axis=0, dtype=np.float64) for row in pokes])


def board_of(fold: Fold) -> str:
    """Name the board that a fold of question labels holds out."""
    return fold.name.rsplit("-draw", 1)[0]


def next_board(fold: Fold, folds: Iterable[Fold]) -> Fold:
    """Give the fold of the board after this one, of the same draw: its pool is another skin's pokes."""
    same = [one for one in folds if one.name.rsplit("-draw", 1)[1] == fold.name.rsplit("-draw", 1)[1]]
    names = [one.name for one in same]
    return same[(names.index(fold.name) + 1) % len(same)]


def point(
    data: SceneData, fold: Fold, predicted: Float[np.ndarray, "b 3"], *, method: str, pokes: str, labels_n: int = 0
) -> Point:
    """Score predictions (x and y as labelled, F) for the tested rows of a fold."""
    board, draw = fold.name.rsplit("-draw", 1)
    words = {"method": method, "name": pokes, "labels_n": labels_n, "fold": board, "seed_i": int(draw)}
    return words | {"scores": score_test(data, fold.test, predicted.astype(np.float32))}


def summarise(points: Sequence[Point], controls: Mapping[Key, Key]) -> list[dict[str, Any]]:
    """Summarise every method over boards; beside it, paired by board, what it is better by than its control."""
    table = tidy([], {"rivals": points})
    table["labels_n"] = table["labels_n"].astype(int)
    groups: dict[Any, Any] = dict(iter(table.groupby(["method", "recipe", "labels_n"], sort=False)))
    rows = []
    for key, group in groups.items():
        row = dict(zip(("method", "pokes", "labels_n"), key, strict=True))
        row |= {places: over_boards(group, places) for places in (AS_LABELLED, REGISTERED)}
        if key in controls:
            over = paired(by_skin(group), by_skin(groups[controls[key]]))
            row["over"] = dict(zip(("method", "pokes", "labels_n"), controls[key], strict=True)) | over
        rows.append(row)
    return rows
