"""Cut captures into windows of time, and apply baseline policies, for experiment `drift` (paper section 4).

A unit is an indentation or a pass. A window is a range of successive units. A baseline policy chooses the no-load
reading to subtract from each row (see `reskin.data.baseline`). A part consists of the rows of one window of one
capture, with the baselines of one policy.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Int64

from reskin.data.rows import Rows, Selection, gather
from reskin.errors import ParamsError
from reskin.schema import LABELS, Readings

Policy = Callable[[Readings], np.ndarray]  # returns the baseline of each row
TRAIN = -1  # index of the training window; test windows are numbered from 0


@dataclass(frozen=True)
class Windows:
    """The training window and the test windows, as half-open ranges of units.

    `left_out_units_n` counts the units after the last complete window, over all captures.
    """

    train: tuple[int, int]
    tests: tuple[tuple[int, int], ...]
    left_out_units_n: int


@dataclass(frozen=True)
class Part:
    """One window of one capture, with the baselines of one policy, and its position in the stack of all parts."""

    policy: str
    window_i: int
    readings: Readings
    rows: Rows
    noload_off_uT: float  # rms, over rows and channels, of the baseline minus the no-load reading before the contact
    first_row_i: int  # number of the part's first row in the stack

    @property
    def row_i(self) -> Int64[np.ndarray, " f"]:
        """The numbers of the part's rows in the stack of all parts."""
        return np.arange(self.first_row_i, self.first_row_i + len(self.rows))


def make_windows(units_n: Sequence[int], *, train_n: int, test_n: int, every_n: int) -> Windows:
    """Return the training window (the first `train_n` units) and the test windows (`test_n` units each).

    Test windows begin at units `every_n`, 2 `every_n`, 3 `every_n`, and so on. `units_n` contains the length of each
    capture in units. All windows are within the shortest capture.

    >>> make_windows([23], train_n=5, test_n=2, every_n=5)
    Windows(train=(0, 5), tests=((5, 7), (10, 12), (15, 17), (20, 22)), left_out_units_n=0)
    >>> make_windows([21], train_n=5, test_n=2, every_n=5)
    Windows(train=(0, 5), tests=((5, 7), (10, 12), (15, 17)), left_out_units_n=1)
    """
    windows_n = max(0, (min(units_n) - test_n) // every_n)
    if not windows_n:
        rule = f"at least drift.every_n + drift.test_n = {every_n + test_n} units long"
        remedy = "Record more, or reduce the size of the windows."
        raise ParamsError("experiment drift", "the shortest capture", rule, min(units_n), remedy)
    tests = tuple((i * every_n, i * every_n + test_n) for i in range(1, windows_n + 1))
    left_out_n = sum(max(0, length_n - (windows_n + 1) * every_n) for length_n in units_n)
    return Windows((0, train_n), tests, left_out_n)


def take(readings: Readings, rows: Bool[np.ndarray, " f"]) -> Readings:
    """Return the readings that the mask `rows` selects."""
    arrays = [name for name in Readings.__dataclass_fields__ if name not in LABELS]
    return replace(readings, **{name: getattr(readings, name)[rows] for name in arrays})


def check_one_per_skin(captures: Sequence[Readings]) -> None:
    """Raise if several captures have the same skin, because their order in time would be unknown."""
    names: dict[str, list[str]] = {}
    for readings in captures:
        names.setdefault(readings.skin, []).append(readings.capture)
    for skin, captures_of_skin in names.items():
        if len(captures_of_skin) > 1:
            what = f"the order in time of the {len(captures_of_skin)} captures of skin {skin} is unknown"
            remedy = "Record its contacts in one capture, or give each skin its own name."
            raise ParamsError(f"experiment drift: {what}: {', '.join(captures_of_skin)}. {remedy}")


def make_parts(
    captures: Sequence[tuple[Readings, Int64[np.ndarray, " _"]]],
    policies: Mapping[str, Policy],
    *,
    windows: Windows,
    selection: Selection,
) -> list[Part]:
    """Make one part per capture, policy and window.

    Each element of `captures` is a pair: a capture, and the unit number of each of its rows. A policy is applied to the
    whole capture, including rows that are in no window or are not selected by `selection`.
    """
    parts: list[Part] = []
    next_i = 0
    for readings, unit_i in captures:
        for policy, choose_baseline in policies.items():
            with_baseline = replace(readings, noload_uT=choose_baseline(readings))
            difference_uT = (with_baseline.noload_uT - readings.noload_uT).astype(float)
            for window_i, (start, end) in enumerate((windows.train, *windows.tests), TRAIN):
                in_window = (unit_i >= start) & (unit_i < end)
                window, rms_uT = take(with_baseline, in_window), float(np.sqrt((difference_uT[in_window] ** 2).mean()))
                parts.append(Part(policy, window_i, window, gather([window], selection), rms_uT, next_i))
                next_i += len(parts[-1].rows)
    return parts


def stack(parts: Sequence[Part]) -> Rows:
    """Stack the rows of all parts.

    The dropped rows are counted for only one policy, because they are the same for all policies.
    """
    arrays = [field.name for field in fields(Rows) if field.name != "dropped"]
    stacked = {name: np.concatenate([getattr(part.rows, name) for part in parts]) for name in arrays}
    dropped = [part.rows.dropped for part in parts if part.policy == parts[0].policy]
    return Rows(**stacked, dropped={reason: sum(counts[reason] for counts in dropped) for reason in dropped[0]})
