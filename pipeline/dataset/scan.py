"""What is known of a row before its touch: the field without load, the number in the scan. In: captures. Out: a `Scan`.

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
