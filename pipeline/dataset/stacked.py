"""Rows of other captures below those of a scene, so that one call trains on both. In: `Rows`, `Readings`. Out: `Rows`.

Row numbers of the scene stay what they were. Refuses to know folds, networks and files.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.core.errors import ParamsError
from pipeline.core.schema import Readings
from pipeline.dataset.baseline import subtract
from pipeline.dataset.lines import Lines, hand_lines
from pipeline.dataset.rows import TARGETS, Rows

COLUMNS = ("capture", "board", "skin", "db_uT", "target", "pass_i")  # columns that are stacked as they are


def stack(above: Rows, below: Rows) -> Rows:
    """Put rows below others; their indentations are numbered after those above."""
    if below.db_uT.shape[1:] != above.db_uT.shape[1:]:
        rule = f"the {above.db_uT.shape[1]} of {above.capture[0]}"
        raise ParamsError(
            f"capture {below.capture[0]}", "channels", rule, below.db_uT.shape[1], "Use boards of one kind."
        )
    stacked = {name: np.concatenate([getattr(above, name), getattr(below, name)]) for name in COLUMNS}
    indentation = np.concatenate([above.indentation, below.indentation + above.indentation.max() + 1])
    return Rows(**stacked, indentation=indentation, dropped=above.dropped)


def hand_rows(captures: Sequence[Readings]) -> tuple[Rows, dict[str, Lines]]:
    """Make rows of pokes by hand, whose places and forces nobody knows, and index each skin's along its lines.

    The lines name rows of the answer.
    """
    rows, lines, before_n = [], {}, 0
    for one in captures:
        if one.skin in lines:
            raise ParamsError(
                f"capture {one.capture}", "its skin", "poked by hand in one capture", one.skin, "Drop one."
            )
        own = _unplaced(one)
        rows.append(own)
        found = hand_lines(one.pass_i, one.indentation)
        lines[one.skin] = replace(found, row=found.row + before_n)
        before_n += len(own)
    together = rows[0]
    for own in rows[1:]:
        together = stack(together, own)
    return together, lines


def shifted(lines: Lines, rows_n: int) -> Lines:
    """Give the lines of rows that were stacked below so many others."""
    return replace(lines, row=lines.row + rows_n)


def _unplaced(one: Readings) -> Rows:
    f = len(one)
    return Rows(
        capture=np.repeat(one.capture, f), board=np.repeat(one.board, f), skin=np.repeat(one.skin, f),
        db_uT=subtract(one.b_uT, one.noload_uT), target=np.full((f, len(TARGETS)), np.nan, np.float32),
        pass_i=one.pass_i, indentation=one.indentation.astype(np.int64), dropped={},
    )  # fmt: skip
