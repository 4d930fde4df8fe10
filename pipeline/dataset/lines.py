"""Pokes along lines, all that an unlabelled recording knows. In: rows, or the order of pokes by hand. Out: `Lines`.

The paper's way (section 5): "indent in a straight line and incrementally index these points". Places serve here to
index the robot's grid, and stay here: row, line and index leave. Refuses to know fields, forces and trainings.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float32, Int32, Int64

from pipeline.core.errors import ParamsError
from pipeline.dataset.rows import TARGETS, Rows

PLACE_STEP_MM = 0.1  # assumed: places nearer than this are one, however a recording wrote them
PLACES_MIN_N = 2  # one place orders nothing
X, Y = TARGETS.index("x_mm"), TARGETS.index("y_mm")


@dataclass(frozen=True)
class Lines:
    """Pokes by line and index; no place, no force. A row may lie on two lines (a grid's row and column).

    Sorted by line, then index, then row.
    """

    row: Int64[np.ndarray, " p"]  # row numbers
    line_i: Int32[np.ndarray, " p"]  # 0.., unique over skins
    order_i: Int32[np.ndarray, " p"]  # index along its line; readings and visits of one place share it

    def __len__(self) -> int:
        return len(self.row)


def grid_lines(rows: Rows, chosen: Int64[np.ndarray, " c"]) -> Lines:
    """Index chosen rows along the rows and the columns of each skin's grid, as the robot's operator does.

    Sees skins and commanded places. The index is the rank of a coordinate among the distinct ones of the skin's chosen
    rows, so a place that one line lacks leaves a gap. A line of one place orders nothing and is left out.
    """
    row, line, order_i = [chosen[:0]], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for skin_i, skin in enumerate(np.unique(rows.skin[chosen])):
        own = chosen[rows.skin[chosen] == skin]
        x_i, y_i = (np.unique(steps, return_inverse=True)[1] for steps in _steps(rows.target[own]).T)
        for direction, (across_i, along_i) in enumerate(((y_i, x_i), (x_i, y_i))):
            row.append(own)
            line.append(np.stack([np.full(len(own), skin_i), np.full(len(own), direction), across_i], axis=1))
            order_i.append(along_i)
    return _number(np.concatenate(row), np.concatenate(line), np.concatenate(order_i))


def hand_lines(pass_i: Int32[np.ndarray, " f"], indentation: Int32[np.ndarray, " f"]) -> Lines:
    """Index the readings of one capture by hand: the pass counts lines, the indentation counts along it.

    Sees these two counts alone; `row` is the reading's number in the capture. An indentation that was lost leaves a
    gap; a line of one indentation orders nothing and is left out.
    """
    order_i = indentation.astype(np.int64)
    for one in np.unique(pass_i):
        order_i[pass_i == one] -= order_i[pass_i == one].min()
    return _number(np.arange(len(pass_i)), pass_i[:, None].astype(np.int64), order_i)


def take_pokes(
    rows: Rows, pool: Int64[np.ndarray, " c"], indentations_n: int, rng: np.random.Generator
) -> Int64[np.ndarray, " d"]:
    """Choose so many indentations of one skin's pool, every place equally often; give all their rows, sorted.

    Sees which indentation is at which place (that of its first row), and nothing else. A place's visits, be they depths
    or passes, come in random order: one of every place first, then a second; a remainder takes places at random. From
    the same state of `rng`, a smaller choice is part of a larger one.
    """
    _check_pool(rows, pool, indentations_n)
    indentations, first = np.unique(rows.indentation[pool], return_index=True)
    _, place_i = np.unique(_steps(rows.target[pool[first]]), axis=0, return_inverse=True)
    shuffled = rng.permutation(len(indentations))
    visit_i = pd.Series(shuffled).groupby(place_i.ravel()[shuffled]).cumcount().to_numpy()
    in_turn = np.lexsort((rng.random(len(indentations)), visit_i))
    taken = indentations[shuffled[in_turn[:indentations_n]]]
    return np.sort(pool[np.isin(rows.indentation[pool], taken)])


def _steps(target: Float32[np.ndarray, "f 3"]) -> Int64[np.ndarray, "f 2"]:
    return np.round(target[:, [X, Y]].astype(np.float64) / PLACE_STEP_MM).astype(np.int64)


def _number(row: Int64[np.ndarray, " p"], line: Int64[np.ndarray, "p key"], order_i: Int64[np.ndarray, " p"]) -> Lines:
    """Leave out the lines of one place, number the others from 0, and sort."""
    line_i = np.unique(line, axis=0, return_inverse=True)[1].ravel()
    places = np.unique(np.stack([line_i, order_i], axis=1), axis=0)
    ordering = np.bincount(places[:, 0]) >= PLACES_MIN_N
    keep = ordering[line_i]
    row, line_i, order_i = row[keep], (np.cumsum(ordering) - 1)[line_i[keep]], order_i[keep]
    in_order = np.lexsort((row, order_i, line_i))
    return Lines(row[in_order], line_i[in_order].astype(np.int32), order_i[in_order].astype(np.int32))


def _check_pool(rows: Rows, pool: Int64[np.ndarray, " c"], indentations_n: int) -> None:
    skins, pool_n = np.unique(rows.skin[pool]), len(np.unique(rows.indentation[pool]))
    if len(skins) > 1:
        raise ParamsError(
            "a choice of pokes", "its pool", "of one skin", ", ".join(skins), "Choose on each skin by itself."
        )
    if indentations_n > pool_n:
        raise ParamsError(
                f"skin {', '.join(skins)}", "pokes to choose", f"at most the {pool_n} indentations of its pool",
                indentations_n, "Ask for fewer, or let section split keep a larger pool.",
            )  # fmt: skip
