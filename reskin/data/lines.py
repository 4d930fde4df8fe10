"""Pokes along straight lines, whose only label is their order along the line.

Such labels need no robot. This is the method of section 5 of the paper: "indent in a straight line and incrementally
index these points". For pokes that a robot has made on a grid, the index of a poke along a line is derived from its
place. The places are then discarded, so that `Lines` contains only row numbers, line numbers and indices.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from reskin.data.rows import TARGETS, Rows
from reskin.errors import ParamsError

PLACE_STEP_MM = 0.1  # two places are assumed to be the same if their coordinates, rounded to this step, are equal
PLACES_MIN_N = 2  # smallest number of places on a line, because a line with a single place has no order
X, Y = TARGETS.index("x_mm"), TARGETS.index("y_mm")


@dataclass(frozen=True)
class Lines:
    """Assignment of rows (readings) to lines, without places and forces.

    Each array has one element per pair of a row and a line. The elements are sorted by line, then by index along the
    line, then by row number. A row may be part of two lines, because a grid point is on a line along x and on a line
    along y.
    """

    row: Int64[np.ndarray, " p"]  # row number in `Rows` or in a capture
    line_i: Int32[np.ndarray, " p"]  # number of the line, counted from 0 over all skins
    order_i: Int32[np.ndarray, " p"]  # index along the line; equal for all readings at one place

    def __len__(self) -> int:
        return len(self.row)


def grid_lines(rows: Rows, chosen: Int64[np.ndarray, " c"]) -> Lines:
    """Assign the chosen rows to the lines of the grid of each skin.

    Each row is assigned to a line along x and to a line along y. Of its labels, only the skin and the commanded place
    are used. To compute the index along a line in direction x, all distinct values of x in the chosen rows of the skin
    are sorted. The index is the rank of the row's x among these values. Lines in direction y are treated in the same
    way. If a line has no row at one of the values, its indices have a gap. Lines with a single place have no order, and
    are left out.
    """
    row, line, order_i = [chosen[:0]], [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for skin_i, skin in enumerate(np.unique(rows.skin[chosen])):
        on_skin = chosen[rows.skin[chosen] == skin]
        x_i, y_i = (np.unique(steps, return_inverse=True)[1] for steps in _steps(rows.target[on_skin]).T)
        for direction, (across_i, along_i) in enumerate(((y_i, x_i), (x_i, y_i))):
            row.append(on_skin)
            key = np.broadcast_to([skin_i, direction], (len(on_skin), 2))
            line.append(np.column_stack([key, across_i]))
            order_i.append(along_i)
    return _number(np.concatenate(row), np.concatenate(line), np.concatenate(order_i))


def hand_lines(pass_i: Int32[np.ndarray, " f"], indentation: Int32[np.ndarray, " f"]) -> Lines:
    """Assign the readings of a capture of manual pokes to lines, where each pass is one line.

    The index along the line is the number of the indentation within the pass, counted from 0. If an indentation is
    missing, the indices have a gap. `Lines.row` is the number of the reading in the capture. Lines with a single
    indentation have no order, and are left out.
    """
    order_i = indentation.astype(np.int64)
    for line in np.unique(pass_i):
        order_i[pass_i == line] -= order_i[pass_i == line].min()
    return _number(np.arange(len(pass_i)), pass_i[:, None].astype(np.int64), order_i)


def take_pokes(
    rows: Rows, pool: Int64[np.ndarray, " c"], indentations_n: int, rng: np.random.Generator
) -> Int64[np.ndarray, " d"]:
    """Draw indentations of one skin at random, so that they are distributed evenly over the places.

    In the first round, one indentation is drawn at each place; in the second round, another one at each place, and so
    on. The last round may cover only some of the places, which are chosen at random. With the same state of `rng`, a
    call that draws fewer indentations returns a subset of the rows.

    Parameters
    ----------
    rows : rows of a dataset. Of their labels, only the place of the first row of each indentation is used.
    pool : numbers of the rows from which indentations are drawn. They must be of one skin.
    indentations_n : number of indentations
    rng : random generator

    Returns
    -------
    The numbers of all rows of the drawn indentations, sorted
    """
    _check_pool(rows, pool, indentations_n)
    indentations, first = np.unique(rows.indentation[pool], return_index=True)
    _, place_i = np.unique(_steps(rows.target[pool[first]]), axis=0, return_inverse=True)
    shuffled = rng.permutation(len(indentations))
    by_round = np.lexsort((rng.random(len(indentations)), _visit_numbers(place_i.ravel()[shuffled])))
    taken = indentations[shuffled[by_round[:indentations_n]]]
    return np.sort(pool[np.isin(rows.indentation[pool], taken)])


def _visit_numbers(place_i: Int64[np.ndarray, " c"]) -> Int64[np.ndarray, " c"]:
    """Return, for each element, how many earlier elements have the same place.

    >>> _visit_numbers(np.array([1, 0, 1, 1, 0]))
    array([0, 0, 1, 2, 1])
    """
    by_place = np.argsort(place_i, kind="stable")
    visits_n = np.bincount(place_i)
    visit_i = np.empty(len(place_i), np.int64)
    visit_i[by_place] = np.arange(len(place_i)) - np.repeat(np.cumsum(visits_n) - visits_n, visits_n)
    return visit_i


def _steps(target: Float32[np.ndarray, "f 3"]) -> Int64[np.ndarray, "f 2"]:
    """Return x and y as multiples of `PLACE_STEP_MM`, rounded to integers."""
    return np.round(target[:, [X, Y]].astype(np.float64) / PLACE_STEP_MM).astype(np.int64)


def _number(row: Int64[np.ndarray, " p"], line: Int64[np.ndarray, "p key"], order_i: Int64[np.ndarray, " p"]) -> Lines:
    """Create `Lines`: drop lines with a single place, and number the other lines.

    `line` contains, for each row, a key of one or several numbers that identifies the line of this row.
    """
    line_i = np.unique(line, axis=0, return_inverse=True)[1].ravel()
    places = np.unique(np.stack([line_i, order_i], axis=1), axis=0)
    has_order = np.bincount(places[:, 0]) >= PLACES_MIN_N  # one element per line
    keep = has_order[line_i]
    row, line_i, order_i = row[keep], (np.cumsum(has_order) - 1)[line_i[keep]], order_i[keep]
    in_order = np.lexsort((row, order_i, line_i))
    return Lines(row[in_order], line_i[in_order].astype(np.int32), order_i[in_order].astype(np.int32))


def _check_pool(rows: Rows, pool: Int64[np.ndarray, " c"], indentations_n: int) -> None:
    """Raise ParamsError if the pool has rows of several skins, or fewer than `indentations_n` indentations."""
    skins, pool_n = np.unique(rows.skin[pool]), len(np.unique(rows.indentation[pool]))
    if len(skins) > 1:
        raise ParamsError(
            f"the pool contains pokes of several skins: {', '.join(skins)}. Use a pool with pokes of one skin only."
        )
    if indentations_n > pool_n:
        rule = f"at most the {pool_n} indentations of the skin's pool"
        remedy = "Draw fewer pokes, or increase the pool of the skin in section split of the scene."
        raise ParamsError(f"skin {', '.join(skins)}", "the number of pokes to draw", rule, indentations_n, remedy)
