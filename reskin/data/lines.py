"""Pokes along lines: the only labels of an unlabelled recording.

The paper's way (section 5): "indent in a straight line and incrementally index these points". Places are used here to
index the robot's grid, and are not passed on: `Lines` hold row, line and index.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from jaxtyping import Float32, Int32, Int64

from reskin.data.baseline import subtract
from reskin.data.rows import TARGETS, Rows, stack
from reskin.errors import ParamsError
from reskin.schema import Readings

PLACE_STEP_MM = 0.1  # assumed: nearer places are the same place
PLACES_MIN_N = 2  # one place orders nothing
X, Y = TARGETS.index("x_mm"), TARGETS.index("y_mm")


@dataclass(frozen=True)
class Lines:
    """Pokes by line and index, without place and force. A row may lie on two lines (a grid's row and column).

    Sorted by line, then index, then row.
    """

    row: Int64[np.ndarray, " p"]  # row numbers
    line_i: Int32[np.ndarray, " p"]  # 0.., unique over skins
    order_i: Int32[np.ndarray, " p"]  # index along its line; readings and visits of one place share it

    def __len__(self) -> int:
        return len(self.row)


def grid_lines(rows: Rows, chosen: Int64[np.ndarray, " c"]) -> Lines:
    """Index chosen rows along the rows and the columns of each skin's grid, as the robot's operator does.

    Uses skins and commanded places. The index is the rank of a coordinate among the distinct ones of the skin's chosen
    rows, so a place that one line lacks leaves a gap. A line of one place orders nothing and is left out.
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
    """Index the readings of one capture by hand: a pass is a line, the indentation counts along it.

    `row` is the reading's number in the capture. An indentation that was lost leaves a
    gap; a line of one indentation orders nothing and is left out.
    """
    order_i = indentation.astype(np.int64)
    for line in np.unique(pass_i):
        order_i[pass_i == line] -= order_i[pass_i == line].min()
    return _number(np.arange(len(pass_i)), pass_i[:, None].astype(np.int64), order_i)


def hand_rows(captures: Sequence[Readings]) -> tuple[Rows, dict[str, Lines]]:
    """Make rows of pokes by hand, whose places and forces are unknown, and index each skin's along its lines.

    The lines name rows of the returned stack.
    """
    parts: list[Rows] = []
    lines: dict[str, Lines] = {}
    for readings in captures:
        if readings.skin in lines:
            what = f"skin {readings.skin} is poked by hand in another capture too"
            raise ParamsError(f"capture {readings.capture}: {what}. Remove one of the two.")
        lines[readings.skin] = shifted(hand_lines(readings.pass_i, readings.indentation), sum(map(len, parts)))
        f = len(readings)
        parts.append(
            Rows(
                capture=np.repeat(readings.capture, f),
                board=np.repeat(readings.board, f),
                skin=np.repeat(readings.skin, f),
                db_uT=subtract(readings.b_uT, readings.noload_uT),
                target=np.full((f, len(TARGETS)), np.nan, np.float32),
                pass_i=readings.pass_i,
                indentation=readings.indentation.astype(np.int64),
                dropped={},
            )
        )
    return reduce(stack, parts), lines


def shifted(lines: Lines, rows_n: int) -> Lines:
    """Return the lines of rows that are stacked below `rows_n` others."""
    return replace(lines, row=lines.row + rows_n)


def take_pokes(
    rows: Rows, pool: Int64[np.ndarray, " c"], indentations_n: int, rng: np.random.Generator
) -> Int64[np.ndarray, " d"]:
    """Choose indentations of one skin's pool, every place equally often; return all their rows, sorted.

    Uses the place of each indentation (that of its first row) alone. The visits of a place (depths or passes) come in
    random order: one of every place first, then a second; the remainder is at random places. From the same state of
    `rng`, a smaller choice is part of a larger one.
    """
    _check_pool(rows, pool, indentations_n)
    indentations, first = np.unique(rows.indentation[pool], return_index=True)
    _, place_i = np.unique(_steps(rows.target[pool[first]]), axis=0, return_inverse=True)
    shuffled = rng.permutation(len(indentations))
    in_turn = np.lexsort((rng.random(len(indentations)), _visit_numbers(place_i.ravel()[shuffled])))
    taken = indentations[shuffled[in_turn[:indentations_n]]]
    return np.sort(pool[np.isin(rows.indentation[pool], taken)])


def _visit_numbers(place_i: Int64[np.ndarray, " c"]) -> Int64[np.ndarray, " c"]:
    """Count the visits of each place in their order.

    >>> _visit_numbers(np.array([1, 0, 1, 1, 0]))
    array([0, 0, 1, 2, 1])
    """
    by_place = np.argsort(place_i, kind="stable")
    visits_n = np.bincount(place_i)
    visit_i = np.empty(len(place_i), np.int64)
    visit_i[by_place] = np.arange(len(place_i)) - np.repeat(np.cumsum(visits_n) - visits_n, visits_n)
    return visit_i


def _steps(target: Float32[np.ndarray, "f 3"]) -> Int64[np.ndarray, "f 2"]:
    return np.round(target[:, [X, Y]].astype(np.float64) / PLACE_STEP_MM).astype(np.int64)


def _number(row: Int64[np.ndarray, " p"], line: Int64[np.ndarray, "p key"], order_i: Int64[np.ndarray, " p"]) -> Lines:
    """Drop lines of one place, number the others from 0, and sort."""
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
            f"the pool of pokes is of several skins: {', '.join(skins)}. Choose pokes of one skin at a time."
        )
    if indentations_n > pool_n:
        rule = f"at most the {pool_n} indentations of its pool"
        remedy = "Choose fewer, or let section split keep a larger pool."
        raise ParamsError(f"skin {', '.join(skins)}", "pokes to choose", rule, indentations_n, remedy)
