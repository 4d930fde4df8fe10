"""Windows of a capture in order of time: the first units to train on, later ones to test. In: counts, readings.

Units are indentations or passes. Refuses to know no-load policies, networks and scores.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from pipeline.core.errors import ParamsError
from pipeline.core.schema import LABELS, Readings


@dataclass(frozen=True)
class Windows:
    """Half-open ranges of units: those trained on, and each test's; a window that was cut short is left out."""

    train: tuple[int, int]
    tests: tuple[tuple[int, int], ...]
    left_out_units_n: int


def lay_windows(units_n: Sequence[int], *, train_n: int, test_n: int, every_n: int) -> Windows:
    """Train on the first units, test on some after every so many, as far as all captures go (paper section 4).

    `units_n` is the length of each capture, in units.

    >>> lay_windows([23], train_n=5, test_n=2, every_n=5)
    Windows(train=(0, 5), tests=((5, 7), (10, 12), (15, 17), (20, 22)), left_out_units_n=0)
    >>> lay_windows([21], train_n=5, test_n=2, every_n=5)
    Windows(train=(0, 5), tests=((5, 7), (10, 12), (15, 17)), left_out_units_n=1)
    """
    windows_n = max(0, (min(units_n) - test_n) // every_n)
    if not windows_n:
        raise ParamsError(
                "question drift", "the shortest capture", f"at least drift.every_n + test_n = {every_n + test_n} long",
                min(units_n), "Record more, or make the windows smaller.",
            )  # fmt: skip
    tests = tuple((i * every_n, i * every_n + test_n) for i in range(1, windows_n + 1))
    left_out_n = sum(max(0, one_n - (windows_n + 1) * every_n) for one_n in units_n)
    return Windows((0, train_n), tests, left_out_n)


def take(readings: Readings, rows: Bool[np.ndarray, " f"]) -> Readings:
    """Keep some readings of a capture."""
    arrays = [name for name in Readings.__dataclass_fields__ if name not in LABELS]
    return replace(readings, **{name: getattr(readings, name)[rows] for name in arrays})


def check_one_each(captures: Sequence[Readings]) -> None:
    """Raise if a skin has several captures: no clock orders them."""
    of: dict[str, list[str]] = {}
    for one in captures:
        of.setdefault(one.skin, []).append(one.capture)
    for skin, names in of.items():
        if len(names) > 1:
            raise ParamsError(
                    "question drift", f"the captures of skin {skin}", "one, as no clock orders several",
                    ", ".join(names), "Record its contacts in one capture, or give each skin its own name.",
                )  # fmt: skip
