"""Tables whose columns have names: which chips, which phase, which row of a press. In: names and words. Out: numbers.

Refuses to know where a table comes from, and what its numbers are.
"""

import re
from collections import Counter

import numpy as np
from jaxtyping import Bool, Int

from pipeline.core.errors import CaptureError

PHASES = ("noload", "contact")


def count_chips_of(names: list[str]) -> int:
    """Count the chips that columns `T<i>`, `Bx<i>`, `By<i>`, `Bz<i>` are of."""
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"(?:T|Bx|By|Bz)(\d{1,3})", name))]
    return max(numbers, default=0) + 1


def check_columns(names: list[str], wanted: list[str], where: str, *, layout: str) -> None:
    """Raise for a column that is not there, and for one that is there twice."""
    missing = [name for name in wanted if name not in names]
    if missing:
        got = f"none named {', '.join(missing)}"
        raise CaptureError(
            where, "columns", "those of data/README.md", got, f"Is this layout {layout}, line 1 its names?"
        )
    twice = [name for name, times_n in Counter(names).items() if times_n > 1]
    if twice:
        raise CaptureError(where, "names of columns", "unique", f"{twice[0]} twice", "Remove one of the two.")


def contact_rows(phases: list[str], where: str, first_line_n: int) -> Bool[np.ndarray, " f"]:
    """Tell rows of contact from rows without; another word is an error, and so is a table without contact."""
    for row_i, phase in enumerate(phases):
        if phase not in PHASES:
            place = f"phase in line {first_line_n + row_i}"
            raise CaptureError(where, place, "noload or contact", repr(phase[:20]), "Mend the word.")
    if "contact" not in phases:
        raise CaptureError(where, "the file", "rows of phase contact", "none", "Was the recording cut?")
    return np.array([phase == "contact" for phase in phases])


def count_within(press: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Count 0, 1, 2 ... within each block of equal numbers."""
    begins = np.flatnonzero(np.diff(press, prepend=-1))
    return np.arange(len(press)) - np.repeat(begins, np.diff(begins, append=len(press)))
