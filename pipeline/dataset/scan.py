"""What is known of a row before its touch: the field without load, the number in the scan; and rows that only hover.

A model that is tested on the skin it learnt on may answer by these alone. Refuses to know fields in contact, folds and
scores.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from pipeline.core.schema import Readings
from pipeline.dataset.rows import Selection, contacts

SCORED = "before_touch.parquet"  # beside the models of one skin: how well this alone tells a place


@dataclass(frozen=True)
class Scan:
    """Of the rows that `gather` stacks: the no-load field, and the number of the indentation in its pass."""

    noload_uT: Float32[np.ndarray, "f ch"]
    scan_i: Int64[np.ndarray, " f"]


def gather_scan(captures: Sequence[Readings], selection: Selection) -> Scan:
    """Stack what is known before each touch, in the order of `gather`."""
    captures = sorted(captures, key=lambda readings: readings.capture)
    kept = [contacts(readings, selection) for readings in captures]
    noload = [readings.noload_uT[keep] for readings, keep in zip(captures, kept, strict=True)]
    scan = [number_in_pass(readings)[keep] for readings, keep in zip(captures, kept, strict=True)]
    return Scan(np.concatenate(noload), np.concatenate(scan))


def number_in_pass(readings: Readings) -> Int64[np.ndarray, " f"]:
    """Number the indentations of each pass from 0, those that are no row for a model included."""
    passes, of_pass = np.unique(readings.pass_i, return_inverse=True)
    indentation = readings.indentation.astype(np.int64)
    first = np.full(len(passes), indentation.max())
    np.minimum.at(first, of_pass, indentation)
    return indentation - first[of_pass]


@dataclass(frozen=True)
class Hover:
    """Rows of a tip that is over a known place and does not touch; `pass_i` counts as that of `Rows` does."""

    db_uT: Float32[np.ndarray, "f ch"]
    place_mm: Float32[np.ndarray, "f 2"]
    skin: np.ndarray
    pass_i: Int64[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.skin)


def gather_hover(captures: Sequence[Readings]) -> Hover:
    """Stack the rows without force between the contacts of a pass, each at the place of the contact that comes next.

    A tip that goes down on a place in steps hovers over it first. Rows before the first contact of a pass are its
    no-load reading, and rows after the last have no place.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    passes_n: dict[str, int] = {}
    for one in sorted(captures, key=lambda readings: readings.capture):
        before_n = passes_n.get(one.skin, 0)
        passes_n[one.skin] = before_n + int(one.pass_i.max()) + 1
        touches = np.flatnonzero(np.isfinite(one.x_mm) & (one.Fz_N > 0))
        empty = np.flatnonzero(np.isnan(one.x_mm) & (one.Fz_N == 0))
        after = np.searchsorted(touches, empty)
        inside = (after > 0) & (after < len(touches))
        empty, last, coming = empty[inside], touches[after[inside] - 1], touches[after[inside]]
        same = (one.pass_i[last] == one.pass_i[empty]) & (one.pass_i[coming] == one.pass_i[empty])
        empty, coming = empty[same], coming[same]
        place_mm = np.column_stack([one.x_mm[coming], one.y_mm[coming]])
        skins, pass_i = np.full(len(empty), one.skin), one.pass_i[empty].astype(np.int64) + before_n
        parts.append((one.b_uT[empty] - one.noload_uT[empty], place_mm, skins, pass_i))
    return Hover(*(np.concatenate(part) for part in zip(*parts, strict=True)))
