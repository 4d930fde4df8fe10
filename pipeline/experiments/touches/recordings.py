"""The recordings of numbered places: readings and accounts -> touched rows, in blocks of time.

A recording is of one place or of two, pressed again and again. It is never split at random: neighbouring rows are one
press. Refuses to know millimetres, which nobody states, and what is asked of the rows.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from reskin.data.baseline import subtract
from reskin.data.rows import Selection
from reskin.errors import ParamsError
from reskin.schema import Readings

PLACE_COUNT = re.compile(r"place_(\d+)_rows_n")  # of an account, by layouts that number places
ROWS_MIN_N = 20  # touched rows that three blocks are cut of


@dataclass(frozen=True)
class Touched:
    """The touched rows of one recording, in order of time: changes of field, forces, and the place or places."""

    name: str
    places: tuple[int, ...]
    db_uT: Float32[np.ndarray, "f ch"]
    force_N: Float32[np.ndarray, " f"]

    def part(self, rows: slice) -> "Touched":
        """Keep some of the rows."""
        return Touched(self.name, self.places, self.db_uT[rows], self.force_N[rows])


@dataclass(frozen=True)
class Blocks:
    """A recording's rows by time: what is learned from, what a threshold is set on, what is tested; in this order."""

    train: Touched
    aside: Touched
    test: Touched


def touched(readings: Readings, account: Mapping[str, int], selection: Selection) -> Touched:
    """Take the rows with enough force; raise for a recording whose places have no numbers."""
    places = tuple(sorted(int(found[1]) for name in account if (found := PLACE_COUNT.fullmatch(name))))
    if len(places) not in (1, 2):
        rule = "one or two, by number"
        remedy = "Only layout eflash7 has such; ask this of a scene of its own."
        raise ParamsError(f"capture {readings.capture}", "its places", rule, list(places), remedy)
    rows = readings.Fz_N >= selection.force_min_N
    db_uT = subtract(readings.b_uT[rows], readings.noload_uT[rows])
    return Touched(readings.capture, places, db_uT, readings.Fz_N[rows])


def in_blocks(recording: Touched, train_fraction: float, aside_fraction: float) -> Blocks:
    """Cut a recording's rows in three by time."""
    rows_n = len(recording.db_uT)
    first, second = (round(share * rows_n) for share in (train_fraction, train_fraction + aside_fraction))
    parts = (slice(0, first), slice(first, second), slice(second, None))
    return Blocks(*(recording.part(part) for part in parts))


@dataclass(frozen=True)
class Sorted:
    """Recordings of one place and of two, why others are left out (by name), and why nothing can be computed."""

    single: list[Touched]
    double: list[Touched]
    left_out: dict[str, str]
    problem: str | None


def sort_recordings(recordings: Iterable[Touched]) -> Sorted:
    """Sort recordings by how many places they touch, and leave out those that cannot be used.

    A recording needs `ROWS_MIN_N` touched rows, a pair of places that each was recorded alone, too. A place that was
    recorded alone twice would mix two blocks of time, so only its first recording is used.
    """
    ordered = sorted(recordings, key=lambda one: (len(one.places), one.places, one.name))  # single places first
    left_out = {
        one.name: f"{len(one.db_uT)} touched rows, fewer than {ROWS_MIN_N}"
        for one in ordered
        if len(one.db_uT) < ROWS_MIN_N
    }
    usable = [one for one in ordered if one.name not in left_out]
    single: dict[int, Touched] = {}
    double = []
    for one in usable:
        unknown = sorted(set(one.places) - single.keys()) if len(one.places) == 2 else []
        if unknown:
            left_out[one.name] = f"place {' and '.join(map(str, unknown))} not recorded alone"
        elif len(one.places) == 2:
            double.append(one)
        elif one.places[0] in single:
            left_out[one.name] = f"place {one.places[0]} already recorded alone, by {single[one.places[0]].name}"
        else:
            single[one.places[0]] = one
    problem = None
    if len(single) < 2:
        problem = f"places recorded alone: {len(single)}; at least 2 are needed. Add their recordings to this scene."
    return Sorted(list(single.values()), double, left_out, problem)


def joined(parts: Sequence[Touched]) -> tuple[Float32[np.ndarray, "f ch"], Float64[np.ndarray, " f"]]:
    """Stack the changes of field of single touches, and the number of the place of each row."""
    numbers = np.repeat(np.array([float(part.places[0]) for part in parts]), [len(part.db_uT) for part in parts])
    return np.concatenate([part.db_uT for part in parts]), numbers
