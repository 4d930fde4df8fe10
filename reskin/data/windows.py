"""Windows of time in captures, for experiment `drift` (paper section 4).

The experiment trains on the first window of captures, and tests on later windows, with several baseline policies. A
baseline policy is a rule that chooses the no-load reading to subtract from each row (`reskin.data.baseline`). Windows
are measured in units. A unit is an indentation or a pass, and a window is a range of successive units. A part consists
of the rows of one window of one capture, with the baselines of one policy.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Int64

from reskin.data.rows import Rows, Selection, gather
from reskin.errors import ParamsError
from reskin.schema import LABELS, Readings

Policy = Callable[[Readings], np.ndarray]  # returns the baseline of each row
TRAIN = -1  # index of the training window, whereas test windows are numbered from 0


@dataclass(frozen=True)
class Windows:
    """The training window and the test windows, as half-open ranges of units.

    After the last test window, another one could begin, but it would not be complete in the shortest capture.
    `left_out_units_n` is the number of units from the beginning of this incomplete window to the end of each capture,
    summed over all captures.
    """

    train: tuple[int, int]
    tests: tuple[tuple[int, int], ...]
    left_out_units_n: int


@dataclass(frozen=True)
class Part:
    """One window of one capture, with the baselines of one policy.

    `stack` combines the rows of all parts to one dataset, which is called the stack.
    """

    policy: str
    window_i: int
    readings: Readings
    rows: Rows
    # Difference between the baseline and the no-load reading before the contact, as an rms over rows and channels.
    noload_off_uT: float
    first_row_i: int  # number that the first row of the part has in the stack

    @property
    def row_i(self) -> Int64[np.ndarray, " f"]:
        """The numbers that the rows of the part have in the stack of all parts."""
        return np.arange(self.first_row_i, self.first_row_i + len(self.rows))


def make_windows(units_n: Sequence[int], *, train_n: int, test_n: int, every_n: int) -> Windows:
    """Return the training window and the test windows.

    The training window contains the first `train_n` units. Test windows contain `test_n` units each, and begin at the
    units `every_n`, 2 `every_n`, 3 `every_n`, and so on. `units_n` contains the length of each capture in units. All
    windows are within the shortest capture.

    >>> make_windows([23], train_n=5, test_n=2, every_n=5)
    Windows(train=(0, 5), tests=((5, 7), (10, 12), (15, 17), (20, 22)), left_out_units_n=0)
    >>> make_windows([21], train_n=5, test_n=2, every_n=5)
    Windows(train=(0, 5), tests=((5, 7), (10, 12), (15, 17)), left_out_units_n=1)
    """
    windows_n = max(0, (min(units_n) - test_n) // every_n)
    if not windows_n:
        rule = f"at least drift.every_n + drift.test_n = {every_n + test_n} units long"
        remedy = "Record a longer capture, or reduce drift.every_n or drift.test_n in the scene."
        raise ParamsError("experiment drift", "the shortest capture", rule, min(units_n), remedy)
    tests = tuple((i * every_n, i * every_n + test_n) for i in range(1, windows_n + 1))
    left_out_n = sum(max(0, length_n - (windows_n + 1) * every_n) for length_n in units_n)
    return Windows((0, train_n), tests, left_out_n)


def take(readings: Readings, rows: Bool[np.ndarray, " f"]) -> Readings:
    """Return those readings for which `rows` is True."""
    arrays = [name for name in Readings.__dataclass_fields__ if name not in LABELS]
    return replace(readings, **{name: getattr(readings, name)[rows] for name in arrays})


def check_one_per_skin(captures: Sequence[Readings]) -> None:
    """Raise ParamsError if several captures have the same skin, because their order in time is unknown."""
    names: dict[str, list[str]] = {}
    for readings in captures:
        names.setdefault(readings.skin, []).append(readings.capture)
    for skin, captures_of_skin in names.items():
        if len(captures_of_skin) > 1:
            what = f"the order in time of the {len(captures_of_skin)} captures of skin {skin} is unknown"
            remedy = (
                "Record all contacts of the skin in one capture. If the skins differ, give each skin a name of its own."
            )
            raise ParamsError(f"experiment drift: {what}: {', '.join(captures_of_skin)}. {remedy}")


def make_parts(
    captures: Sequence[tuple[Readings, Int64[np.ndarray, " _"]]],
    policies: Mapping[str, Policy],
    *,
    windows: Windows,
    selection: Selection,
) -> list[Part]:
    """Make one part for each combination of capture, policy and window.

    Each element of `captures` is a pair, which consists of a capture and the unit number of each of its rows. A policy
    is applied to the whole capture, including rows that are in no window and rows that `selection` does not select.
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
    """Combine the rows of all parts to one dataset.

    Dropped rows are counted for only one policy, because they are the same for all policies.
    """
    arrays = [field.name for field in fields(Rows) if field.name != "dropped"]
    stacked = {name: np.concatenate([getattr(part.rows, name) for part in parts]) for name in arrays}
    dropped = [part.rows.dropped for part in parts if part.policy == parts[0].policy]
    return Rows(**stacked, dropped={reason: sum(counts[reason] for counts in dropped) for reason in dropped[0]})
