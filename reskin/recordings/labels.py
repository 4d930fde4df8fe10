"""Labels that arrive during a recording: combine them into dwells, and write the dwells to the probe log `probe.csv`.

A label states whether the skin is touched and, if known, where, how deep and how hard. A sample is the label at one
time, which a robot's table or a force gauge provides. A dwell is a time in which nothing moves, so that one label is
valid. The sources of labels are in `label_sources`.
"""

import math
import re
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reskin import io
from reskin.errors import CaptureError
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.probe import CONTACT, LABELS, NOLOAD, TYPES
from reskin.recordings.units import SAME_PLACE_mm

FLOAT32_MAX = float(np.finfo(np.float32).max)
TIME_STEP_s = 1e-6  # resolution of the written times
TIME_MAX_s = 1e11  # unix time in seconds stays below this value for 3,000 years; unix time in milliseconds is above it
# Possible names of the column of times: `unix_s` if the times are those of this machine's clock, `t_s` if the source of
# labels has a clock of its own.
CLOCKS = ("unix_s", "t_s")
COLUMNS = (*CLOCKS, "phase", "pass_i", *LABELS)
CONTACT_N = 0.05  # assumed: a force of at least this magnitude is a contact; it is above the noise of a gauge
# Below this force, there is no contact. If the force is between NOLOAD_N and CONTACT_N, a contact may be beginning or
# ending, so the sample has no label.
NOLOAD_N = 0.025
# Assumed limits of the duration of a dwell. A longer contact is split into several dwells, each with its own mean
# force.
DWELL_MIN_s, DWELL_MAX_s = 0.05, 0.5
# A dwell also ends after this many samples. Otherwise, it could grow without limit if the source's clock has stopped.
DWELL_SAMPLES_MAX_N = 10_000
LINE_BYTES_MAX_N = 4096
# names of the forces in a line of a gauge, by the number of values in the line
GAUGE_NUMBERS = {1: ("Fz_N",), 3: ("Fx_N", "Fy_N", "Fz_N")}


class Label(NamedTuple):
    """Whether the skin is touched, and the place, depth and force of the touch.

    Unknown numbers are NaN. Forces have the signs of `reskin.schema`: they are forces on the skin, and `Fz_N` is
    positive in compression.
    """

    contact: bool
    x_mm: float = math.nan
    y_mm: float = math.nan
    depth_mm: float = math.nan
    Fx_N: float = math.nan
    Fy_N: float = math.nan
    Fz_N: float = math.nan
    pass_i: int = 0  # number of the pass over all places


class Dwell(NamedTuple):
    """A time in which nothing moves, on the clock of the source of labels, and the label that is valid in this time."""

    label: Label
    t_start_s: float
    t_end_s: float


class ProbeLogWriter:
    """A writer of the probe log of a recording, which writes dwells as they arrive.

    A no-load dwell is written together with the contact that follows it. Therefore, the log is complete at any time,
    and `probe.parse` accepts it even if the recorder is killed. Contacts that `probe.parse` would refuse are not
    written. They are counted: in `without_noload_n` if no no-load dwell precedes them, and in `out_of_order_n` if they
    begin before the end of an earlier dwell.
    """

    def __init__(self, folder: Path) -> None:
        self.touches_n = self.without_noload_n = self.out_of_order_n = 0
        self._indentation = -1
        self._end_s = -math.inf
        self._noload: Dwell | None = None
        self._touch: Label | None = None  # first label of the latest touch, which may continue
        self._lock = threading.Lock()
        self._file = (folder / PROBE_FILE).open("xb", buffering=0)
        io.append(self._file, (",".join(TYPES) + "\n").encode())

    def close(self) -> None:
        """Stop accepting labels."""
        with self._lock:
            self._file.close()

    @contextmanager
    def locked(self) -> Iterator[bool]:
        """Lock the writer during the `with` block; yield True if it still accepts labels, and False if it is closed."""
        with self._lock:
            yield not self._file.closed

    def write(self, dwell: Dwell) -> None:
        """Write a dwell with contact, or store a dwell without contact until the next contact.

        A contact at one place may consist of several dwells. Before a contact at another place, there must be a no-load
        dwell.
        """
        _check(dwell)
        with self.locked() as is_open:
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
        is_new = self._noload is not None  # if not, the dwell continues the latest touch
        self._touch = touch.label if is_new else self._touch
        indentation = self._indentation + is_new
        pass_i = touch.label.pass_i
        rows = [_row(dwell, indentation, pass_i) for dwell in (self._noload, touch) if dwell is not None]
        io.append(self._file, "".join(rows).encode())
        self._indentation, self._end_s, self._noload = indentation, touch.t_end_s, None
        self.touches_n += is_new


def same_place(a: Label, b: Label) -> bool:
    """Return whether two labels have the same place.

    A coordinate that is unknown (NaN) in both labels counts as equal.
    """
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
    label, remedy = dwell.label, "Leave out numbers that are not known."
    for name in LABELS:
        value = getattr(label, name)
        if math.isinf(value) or abs(value) > FLOAT32_MAX:
            raise CaptureError("a label", name, "a finite number", value, remedy)
    if not 0 <= label.pass_i < 2**31:
        raise CaptureError("a label", "pass_i", "0 or more", label.pass_i, "Number the passes from 0.")
    if not -TIME_MAX_s < dwell.t_start_s <= dwell.t_end_s - TIME_STEP_s < TIME_MAX_s:  # False for NaN
        raise CaptureError(
            f"a label: {dwell.t_start_s} to {dwell.t_end_s} s is not a valid time span. Check that the clock is in "
            "seconds."
        )


class Sample(NamedTuple):
    """A label at one time. It is None if there may be motion, for example while a contact begins or ends."""

    t_s: float
    label: Label | None


class LineBuffer:
    """A buffer that splits arriving bytes into lines of text; a line longer than `LINE_BYTES_MAX_N` is cut in two."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[str]:
        *whole, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LINE_BYTES_MAX_N:
            whole, self._rest = [*whole, self._rest[:LINE_BYTES_MAX_N]], b""
        return [line.decode("utf-8", errors="replace").strip() for line in whole]


class SampleTable:
    """A parser of samples in CSV text, which may be passed in several parts of any length.

    `clock` is the name of the column of times. `bad_n` is the number of lines that could not be read, and `first_bad`
    is the first of them.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._names: list[str] = []
        self._lines = LineBuffer()
        self.clock, self.bad_n, self.first_bad = "", 0, ""

    def feed(self, data: bytes) -> list[Sample]:
        """Process the next bytes; return the samples whose lines are now complete.

        Raises `CaptureError` if the line with the column names lacks necessary columns.
        """
        samples = []
        for line in self._lines.feed(data):
            if not self._names:
                self._begin([name.strip() for name in line.removeprefix("\ufeff").split(",")])
            elif line:
                try:
                    samples.append(self._sample(line.split(",")))
                except ValueError:
                    self.bad_n, self.first_bad = self.bad_n + 1, self.first_bad or line[:60]
        return samples

    def _begin(self, names: list[str]) -> None:
        clocks = [name for name in CLOCKS if name in names]
        shows_touch = "phase" in names or "Fz_N" in names
        if len(clocks) != 1 or not shows_touch or len(set(names)) < len(names):
            needed = (
                f"exactly one of the columns {' and '.join(CLOCKS)}, at least one of phase and Fz_N, and no column "
                "twice"
            )
            raise CaptureError(
                f"{self._where}: row 1 must name {needed}; got {ascii(names)[:120]}. Possible columns: "
                f"{', '.join(COLUMNS)}."
            )
        self.clock, self._names = clocks[0], names

    def _sample(self, cells: list[str]) -> Sample:
        row = dict(zip(self._names, cells, strict=True))
        t_s = _number(row[self.clock])
        known: dict[str, Any] = {
            name: _number(row[name]) if row[name].strip() else math.nan for name in LABELS if name in row
        }
        pass_i = int(row["pass_i"]) if "pass_i" in row else 0
        if not math.isfinite(t_s) or pass_i < 0:
            raise ValueError(cells)
        if "phase" in row:
            contact = {CONTACT: True, NOLOAD: False}.get(row["phase"].strip())
        else:
            contact = _is_contact(known["Fz_N"])
        return Sample(t_s, None if contact is None else Label(contact, **known, pass_i=pass_i))


class GaugeLines:
    """A parser of the lines that a force gauge sends.

    A line contains one number (Fz) or three numbers (Fx Fy Fz). Forces are in N and have the signs of `Label`. `bad_n`
    is the number of lines that could not be read, and `first_bad` is the first of them.
    """

    def __init__(self) -> None:
        self._lines = LineBuffer()
        self.bad_n, self.first_bad = 0, ""

    def feed(self, data: bytes, arrival_s: float) -> list[Sample]:
        """Process bytes that arrived at time `arrival_s`; return a sample for each line that is now complete."""
        samples = []
        for line in self._lines.feed(data):
            try:
                numbers = [_number(cell) for cell in re.split(r"[\s,;]+", line)]
                forces: dict[str, Any] = dict(zip(GAUGE_NUMBERS[len(numbers)], numbers, strict=True))
            except (ValueError, KeyError):
                self.bad_n, self.first_bad = self.bad_n + 1, self.first_bad or line[:60]
                continue
            contact = _is_contact(forces["Fz_N"])
            samples.append(Sample(arrival_s, None if contact is None else Label(contact, **forces)))
        return samples


class DwellBuilder:
    """An object that combines samples into dwells, whose labels have the mean force and depth of the samples.

    A dwell consists of the samples of a contact at one place, or of the samples of a period without contact. A contact
    longer than `DWELL_MAX_s` is cut into several dwells. If the recorder is killed during a long contact, the dwells
    that were complete have then already been written. `short_n` counts the contacts that are too short for a dwell.
    """

    def __init__(self) -> None:
        self._run: list[Sample] = []
        self._cut: Sample | None = None  # last sample of the dwell that was cut off last, if its contact may continue
        self.short_n = 0

    def feed(self, samples: Iterable[Sample]) -> Iterator[Dwell]:
        """Process the next samples; yield the dwells that have ended."""
        for sample in samples:
            run = self._run
            if run and not _continues(run[0], run[-1], sample):
                yield from self.close()
            if sample.label is not None:
                # Without contact, a dwell needs only its first and its last sample, so replace the last one.
                if len(self._run) > 1 and not sample.label.contact:
                    self._run.pop()
                self._run.append(sample)
                if sample.label.contact and (self._lasts_s() >= DWELL_MAX_s or len(self._run) >= DWELL_SAMPLES_MAX_N):
                    yield from self.close()
                    self._cut = sample

    def close(self) -> Iterator[Dwell]:
        """End the current dwell; yield it if its samples span at least `DWELL_MIN_s`, or else yield nothing."""
        lasts_s, run, self._run = self._lasts_s(), self._run, []
        is_remainder = bool(run) and self._cut is not None and _continues(self._cut, self._cut, run[0])
        self._cut = None
        if lasts_s >= DWELL_MIN_s:
            yield Dwell(mean_label([sample.label for sample in run if sample.label]), run[0].t_s, run[-1].t_s)
        elif run and run[0].label and run[0].label.contact and not is_remainder:
            self.short_n += 1

    def summary(self) -> str:
        """Return a text that says how many contacts were too short for a dwell; return "" if there are none.

        All contacts may be too short if a program does not append rows continuously. Therefore, the text advises to
        write lines continuously.
        """
        if not self.short_n:
            return ""
        least = f"at least {DWELL_MIN_s:g} s must lie between the first and the last line of a touch"
        return f"{self.short_n} touches left out: {least}, so write lines continuously"

    def _lasts_s(self) -> float:
        return self._run[-1].t_s - self._run[0].t_s if self._run else 0.0


def mean_label(labels: list[Label]) -> Label:
    """Return the first label, with each number replaced by its mean over all labels.

    If a number is unknown (NaN) in any of the labels, it is unknown in the result.
    """
    means: dict[str, Any] = {name: math.fsum(getattr(label, name) for label in labels) / len(labels) for name in LABELS}
    return labels[0]._replace(**means)


def _continues(first: Sample, last: Sample, sample: Sample) -> bool:
    """Return whether `sample` continues the dwell that consists of the samples from `first` to `last`."""
    a, b = first.label, sample.label
    if a is None or b is None or a.contact != b.contact or a.pass_i != b.pass_i or sample.t_s < last.t_s:
        return False
    return not a.contact or same_place(a, b)


def _is_contact(force_N: float) -> bool | None:
    """Return whether a force indicates contact; None if it is NaN, or between `NOLOAD_N` and `CONTACT_N`."""
    if abs(force_N) >= CONTACT_N:
        return True
    return False if abs(force_N) < NOLOAD_N else None


def _number(text: str) -> float:
    """Parse a finite number; raise `ValueError` for anything else."""
    if not math.isfinite(number := float(text)) or "_" in text:
        raise ValueError(text)
    return number
