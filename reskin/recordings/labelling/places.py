"""Places to press, numbered, and the order in which they come. In: `grid:9x9:2`. Out: places in mm.

Refuses to know when they are pressed and how hard.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reskin.errors import ParamsError

PLACES_MAX_N = 10_000
RANDOM, SNAKE = "random", "snake"


@dataclass(frozen=True)
class Places:
    """Numbered places in mm, [(x, y), ...], row by row; each row of a snake is gone through the other way."""

    name: str
    xy_mm: Sequence[tuple[float, float]]
    row_n: int

    def order(self, scan: str, rng: np.random.Generator) -> list[int]:
        """Order the places for one pass: drawn anew, or row by row, there and back."""
        if scan == RANDOM:
            return [int(i) for i in rng.permutation(len(self.xy_mm))]
        rows = [list(range(first, first + self.row_n)) for first in range(0, len(self.xy_mm), self.row_n)]
        return [i for row_i, row in enumerate(rows) for i in (row[::-1] if row_i % 2 else row)]


def parse_places(text: str) -> Places | None:
    """Read `line:N:STEP_MM`, along x, or `grid:NXxNY:STEP_MM`, both perhaps with `@X_MM,Y_MM` of the first place.

    >>> parse_places("line:3:2@0,8").xy_mm
    [(0.0, 8.0), (2.0, 8.0), (4.0, 8.0)]
    """
    number = r"(-?\d{1,4}(?:\.\d{1,3})?)"
    found = re.fullmatch(rf"(?:line:(\d{{1,4}})|grid:(\d{{1,4}})x(\d{{1,4}})):{number}(?:@{number},{number})?", text)
    if found is None:
        return None
    along_n, up_n = (int(found[1]), 1) if found[1] else (int(found[2]), int(found[3]))
    step_mm, x_mm, y_mm = float(found[4]), float(found[5] or 0), float(found[6] or 0)
    if not 0 < along_n * up_n <= PLACES_MAX_N or step_mm <= 0:
        raise ParamsError("--labels", "places", f"1 to {PLACES_MAX_N}, with a step above 0", text, "Try: grid:9x9:2")
    xy_mm = [(x_mm + step_mm * i, y_mm + step_mm * j) for j in range(up_n) for i in range(along_n)]
    return Places(text, xy_mm, along_n)
