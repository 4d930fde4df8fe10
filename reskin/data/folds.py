"""`folds.json`: which rows are on which side or in the pool, for people. In: `Fold`s. Out: JSON words, and back.

Row numbers stand as half-open ranges, because folds by board or pass are few long runs. Refuses to know how folds
are chosen.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

from reskin import io
from reskin.data.rows import Rows, Selection, gather
from reskin.data.splits import Fold
from reskin.errors import SchemaError

SIDES = ("train", "test", "pool")


def load_rows(files: Sequence[Path], selection: Selection) -> Rows:
    """Read the captures of a scene and stack their rows."""
    return gather([io.read_readings(file) for file in files], selection)


def render_folds(captures: Sequence[str], rows: Rows, folds: Sequence[Fold]) -> dict[str, Any]:
    """Write folds as JSON words, with the boards and skins of each side and of the pool for the reader."""
    return {
        "captures": list(captures),
        "rows_n": len(rows),
        "dropped": rows.dropped,
        "folds": [
            {
                "experiment": fold.experiment,
                "name": fold.name,
                **{key: labels for side in SIDES for key, labels in _labels(side, rows, getattr(fold, side)).items()},
                **{side: to_ranges(getattr(fold, side)) for side in SIDES},
            }
            for fold in folds
        ],
    }


def parse_folds(words: dict[str, Any], rows: Rows, where: str) -> list[Fold]:
    """Read folds back, for the rows they were drawn from."""
    if words["rows_n"] != len(rows):
        raise SchemaError(where, "rows_n", f"the {len(rows)} rows of its captures", words["rows_n"], "Split again.")
    return [
        Fold(fold["experiment"], fold["name"], *(from_ranges(fold[side]) for side in SIDES)) for fold in words["folds"]
    ]


def to_ranges(numbers: Int64[np.ndarray, " n"]) -> list[list[int]]:
    """Write increasing numbers as half-open ranges.

    >>> to_ranges(np.array([3, 4, 5, 9]))
    [[3, 6], [9, 10]]
    """
    if len(numbers) == 0:
        return []
    cuts = np.flatnonzero(np.diff(numbers) != 1) + 1
    return [[int(run[0]), int(run[-1]) + 1] for run in np.split(numbers, cuts)]


def from_ranges(ranges: Sequence[Sequence[int]]) -> Int64[np.ndarray, " n"]:
    return np.concatenate([np.arange(start, stop) for start, stop in ranges] or [np.zeros(0, np.int64)])


def _labels(side: str, rows: Rows, numbers: np.ndarray) -> dict[str, list[str]]:
    return {
        f"{side}_boards": np.unique(rows.board[numbers]).tolist(),
        f"{side}_skins": np.unique(rows.skin[numbers]).tolist(),
    }
