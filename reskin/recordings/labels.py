"""Labels as they come: where the skin was touched, or that it was not, and when -> rows of `probe.csv` at once.

Refuses to know where labels come from (`samples`, `reskin.recordings.labelling`), and frames.
"""

import math
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reskin.board.port import append
from reskin.errors import CaptureError
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.probe import CONTACT, LABELS, NOLOAD, TYPES
from reskin.recordings.text import SAME_PLACE_mm

FLOAT32_MAX = float(np.finfo(np.float32).max)
TIME_STEP_s = 1e-6  # as it is written
TIME_MAX_s = 1e11  # unix time is below it for 3,000 years, unless it is in milliseconds


class Label(NamedTuple):
    """What is known of a dwell, in which nothing moves; NaN where it is not known.

    Forces have the signs of `core.schema`: on the skin, `Fz_N` positive in compression.
    """

    contact: bool
    x_mm: float = math.nan
    y_mm: float = math.nan
    depth_mm: float = math.nan
    Fx_N: float = math.nan
    Fy_N: float = math.nan
    Fz_N: float = math.nan
    pass_i: int = 0  # which round over all places


class Dwell(NamedTuple):
    """A label, and from when to when it held, on the clock of its source."""

    label: Label
    t_start_s: float
    t_end_s: float


class ProbeTape:
    """The probe log of a recording as it grows; a touch is written with the no-load dwell before it, or not at all.

    So what a killed recorder leaves is a log that `probe.parse` takes. Touches that it would refuse are counted.
    """

    def __init__(self, folder: Path) -> None:
        self.touches_n = self.without_noload_n = self.out_of_order_n = 0
        self._indentation = -1
        self._end_s = -math.inf
        self._noload: Dwell | None = None
        self._touch: Label | None = None  # the first of the touch that may go on
        self._lock = threading.Lock()
        self._file = (folder / PROBE_FILE).open("xb", buffering=0)
        append(self._file, (",".join(TYPES) + "\n").encode())

    def close(self) -> None:
        """Take no more labels: what a source says from now on is of another time."""
        with self._lock:
            self._file.close()

    @contextmanager
    def held_open(self) -> Iterator[bool]:
        """Tell whether labels are still taken; while this is asked, they cannot end."""
        with self._lock:
            yield not self._file.closed

    def write(self, dwell: Dwell) -> None:
        """Write a touch; keep a no-load dwell for the touch that follows it.

        A touch may go on over several dwells, at the same place; elsewhere, it is one without a no-load dwell.
        """
        _check(dwell)
        with self.held_open() as is_open:
            if not is_open:
                return
            if dwell.t_start_s < (self._noload.t_end_s if self._noload else self._end_s):
                self.out_of_order_n += 1
            elif not dwell.label.contact:
                self._noload = dwell
            elif self._noload is None and not (self._touch and same_place(self._touch, dwell.label)):
                self.without_noload_n += 1
            else:
                self._append(dwell)

    def write_all(self, dwells: Iterable[Dwell]) -> None:
        for dwell in dwells:
            self.write(dwell)

    def _append(self, touch: Dwell) -> None:
        opens = self._noload is not None
        self._touch = touch.label if opens else self._touch
        indentation = self._indentation + opens
        pass_i = touch.label.pass_i
        rows = [_row(dwell, indentation, pass_i) for dwell in (self._noload, touch) if dwell is not None]
        append(self._file, "".join(rows).encode())
        self._indentation, self._end_s, self._noload = indentation, touch.t_end_s, None
        self.touches_n += opens


def same_place(a: Label, b: Label) -> bool:
    """Tell whether two labels are of one place; of two that are not known, nothing says otherwise."""
    return all(
        abs(a_mm - b_mm) <= SAME_PLACE_mm or (math.isnan(a_mm) and math.isnan(b_mm))
        for a_mm, b_mm in ((a.x_mm, b.x_mm), (a.y_mm, b.y_mm))
    )


def _row(dwell: Dwell, indentation: int, pass_i: int) -> str:
    label = dwell.label
    labels = [getattr(label, name) for name in LABELS] if label.contact else [math.nan] * len(LABELS)
    cells = ["" if math.isnan(value) else f"{value:.9g}" for value in labels]
    times = f"{dwell.t_start_s:.6f},{dwell.t_end_s:.6f}"
    return ",".join([f"{indentation},{pass_i},{CONTACT if label.contact else NOLOAD},{times}", *cells]) + "\n"


def _check(dwell: Dwell) -> None:
    label, remedy = dwell.label, "Leave out what is not known."
    for name in LABELS:
        value = getattr(label, name)
        if math.isinf(value) or abs(value) > FLOAT32_MAX:
            raise CaptureError("a label", name, "a number", value, remedy)
    if not 0 <= label.pass_i < 2**31:
        raise CaptureError("a label", "pass_i", "0 or more", label.pass_i, "Count rounds from 0.")
    if not -TIME_MAX_s < dwell.t_start_s <= dwell.t_end_s - TIME_STEP_s < TIME_MAX_s:  # of NaN, nothing is so
        got = f"{dwell.t_start_s} to {dwell.t_end_s} s"
        raise CaptureError("a label", "its time", "a span of the clock", got, "Is the clock in seconds?")
