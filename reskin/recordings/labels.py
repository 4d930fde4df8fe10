"""Labels that arrive during a recording: take them from a source, and write them to the probe log `probe.csv`.

A label states whether the skin is touched and, if known, where, how deep and how hard. A sample is the label at one
time. A dwell is a time in which nothing moves, so that one label is valid. There are four sources: a person who presses
by hand at places that the program names; a Python function or generator that moves a robot; a CSV file to which a
robot's program appends rows; and a force gauge.
"""

import math
import os
import queue
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from reskin import io
from reskin.board.port import Device, open_port, read_waiting
from reskin.errors import CaptureError, ParamsError
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.probe import CONTACT, LABELS, NOLOAD, TYPES
from reskin.recordings.tables import MAGNITUDE_MAX, NUMBER_PATTERN
from reskin.recordings.units import SAME_PLACE_mm

TIME_STEP_s = 1e-6  # resolution of the written times
TIME_MAX_s = 1e11  # unix time in seconds stays below this value for 3,000 years; unix time in milliseconds is above it
# Possible names of the column of times: `unix_s` if the times are those of this machine's clock, `t_s` if the source of
# labels has a clock of its own.
CLOCKS = ("unix_s", "t_s")
COLUMNS = (*CLOCKS, "phase", "pass_i", *LABELS)
# A force of at least CONTACT_N is a contact (assumed: it is above the noise of a gauge). Below NOLOAD_N, there is no
# contact. Between them, a contact may be beginning or ending, so the sample has no label.
CONTACT_N, NOLOAD_N = 0.05, 0.025
# Assumed limits of the duration of a dwell. A longer contact is split into several dwells, each with its own mean
# force. A dwell also ends after DWELL_SAMPLES_MAX_N samples, because the source's clock may have stopped.
DWELL_MIN_s, DWELL_MAX_s, DWELL_SAMPLES_MAX_N = 0.05, 0.5, 10_000
LINE_BYTES_MAX_N = 4096
# names of the forces in a line of a gauge, by the number of values in the line
GAUGE_NUMBERS = {1: ("Fz_N",), 3: ("Fx_N", "Fy_N", "Fz_N")}
SAMPLES_MAX_N = 10_000  # number of latest samples of a gauge that are stored; a touch has a few hundred
PLACES_MAX_N = 10_000
RANDOM, SNAKE = "random", "snake"
TABLE_POLL_s, TYPED_POLL_s = 0.02, 0.05
BETTER_s = 0.005  # a sync mark is replaced only if the delay of the new mark is shorter by more than this
ENDS = ("q", "quit", "end")
# The person types a place, a force, or both. The space between them is needed: without it, 12N could mean a force of 12
# N or place 1 with a force of 2 N.
REPLY = re.compile(r"(?:(\d{1,5})(?:\s+|$))?(?:(\d{1,3}(?:\.\d{1,4})?)\s*[nN])?", re.ASCII)
Say = Callable[[str], object]


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


class Sample(NamedTuple):
    """A label at one time. It is None if there may be motion, for example while a contact begins or ends."""

    t_s: float
    label: Label | None


# --- Writing dwells ---


class ProbeLogWriter:
    """A writer of the probe log of a recording, which writes dwells as they arrive.

    A no-load dwell is written together with the contact that follows it. Therefore, the log is complete at any time,
    and `probe.parse` accepts it even if the recorder is killed. Contacts that `probe.parse` would refuse are not
    written. They are counted: in `without_noload_n` if no no-load dwell precedes them, and in `out_of_order_n` if they
    begin before the end of an earlier dwell.
    """

    def __init__(self, folder: Path) -> None:
        self.touches_n = self.without_noload_n = self.out_of_order_n = 0
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
        rows = ""
        for dwell in filter(None, (self._noload, touch)):
            numbers = [getattr(dwell.label, name) if dwell.label.contact else math.nan for name in LABELS]
            cells = ["" if math.isnan(value) else f"{value:.9g}" for value in numbers]
            indentation, phase = self.touches_n - 1 + is_new, CONTACT if dwell.label.contact else NOLOAD
            times = [f"{dwell.t_start_s:.6f}", f"{dwell.t_end_s:.6f}"]
            rows += ",".join([str(indentation), str(touch.label.pass_i), phase, *times, *cells]) + "\n"
        io.append(self._file, rows.encode())
        self._touch = touch.label if is_new else self._touch
        self._end_s, self._noload = touch.t_end_s, None
        self.touches_n += is_new


def same_place(a: Label, b: Label) -> bool:
    """Return whether two labels have the same place.

    A coordinate that is unknown (NaN) in both labels counts as equal.
    """
    return all(
        abs(a_mm - b_mm) <= SAME_PLACE_mm or (math.isnan(a_mm) and math.isnan(b_mm))
        for a_mm, b_mm in ((a.x_mm, b.x_mm), (a.y_mm, b.y_mm))
    )


def _check(dwell: Dwell) -> None:
    for name in LABELS:
        value = getattr(dwell.label, name)
        if abs(value) >= MAGNITUDE_MAX:  # False for NaN
            rule = f"a number below {MAGNITUDE_MAX:g}"
            raise CaptureError("a label", name, rule, value, "Leave out numbers that are not known.")
    if not 0 <= dwell.label.pass_i < 2**31:
        raise CaptureError("a label", "pass_i", "0 or more", dwell.label.pass_i, "Number the passes from 0.")
    if not -TIME_MAX_s < dwell.t_start_s <= dwell.t_end_s - TIME_STEP_s < TIME_MAX_s:  # False for NaN
        raise CaptureError(
            f"a label: {dwell.t_start_s} to {dwell.t_end_s} s is not a valid time span. Check that the clock is in "
            "seconds."
        )


# --- Samples, and how they become dwells ---


class _Lines:
    """A buffer that splits arriving bytes into lines of text; a line longer than `LINE_BYTES_MAX_N` is cut in two.

    `bad_n` is the number of lines that could not be read as a sample, and `first_bad` is the first of them.
    """

    def __init__(self, where: str) -> None:
        self._where, self._rest = where, b""
        self.bad_n, self.first_bad = 0, ""

    def split(self, data: bytes) -> list[str]:
        *whole, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LINE_BYTES_MAX_N:
            whole, self._rest = [*whole, self._rest[:LINE_BYTES_MAX_N]], b""
        return [line.decode("utf-8", errors="replace").strip() for line in whole]

    def count_bad(self, line: str) -> None:
        self.bad_n, self.first_bad = self.bad_n + 1, self.first_bad or line[:60]

    def problem(self) -> str:
        """Return a text that says how many lines could not be read; return "" if there are none."""
        if not self.bad_n:
            return ""
        return f"{self._where}: {self.bad_n} lines could not be read; the first of them is {self.first_bad!a}"


class SampleTable(_Lines):
    """A parser of samples in CSV text, which may be passed in several parts of any length.

    `clock` is the name of the column of times.
    """

    def __init__(self, where: str) -> None:
        super().__init__(where)
        self._names: list[str] = []
        self.clock = ""

    def feed(self, data: bytes) -> list[Sample]:
        """Process the next bytes; return the samples whose lines are now complete.

        Raises `CaptureError` if the line with the column names lacks necessary columns.
        """
        samples = []
        for line in self.split(data):
            if not self._names:
                self._begin([name.strip() for name in line.removeprefix("\ufeff").split(",")])
            elif line:
                try:
                    samples.append(self._sample(line.split(",")))
                except ValueError:
                    self.count_bad(line)
        return samples

    def _begin(self, names: list[str]) -> None:
        clocks = [name for name in CLOCKS if name in names]
        shows_touch = "phase" in names or "Fz_N" in names
        if len(clocks) != 1 or not shows_touch or len(set(names)) < len(names):
            raise CaptureError(
                f"{self._where}: row 1 must name exactly one of the columns {' and '.join(CLOCKS)}, at least one of "
                f"phase and Fz_N, and no column twice; got {ascii(names)[:120]}. Possible columns: "
                f"{', '.join(COLUMNS)}."
            )
        self.clock, self._names = clocks[0], names

    def _sample(self, cells: list[str]) -> Sample:
        row = dict(zip(self._names, map(str.strip, cells), strict=True))
        known: dict[str, Any] = {name: _number(row[name]) if row[name] else math.nan for name in LABELS if name in row}
        pass_i = _number(row.get("pass_i", "0"))
        if pass_i < 0 or not pass_i.is_integer():
            raise ValueError(cells)
        if "phase" in row:
            contact = {CONTACT: True, NOLOAD: False}.get(row["phase"])
        else:
            contact = _is_contact(known["Fz_N"])
        label = None if contact is None else Label(contact, **known, pass_i=int(pass_i))
        return Sample(_number(row[self.clock]), label)


class GaugeLines(_Lines):
    """A parser of the lines that a force gauge sends.

    A line contains one number (Fz) or three numbers (Fx Fy Fz). Forces are in N and have the signs of `Label`.
    """

    def feed(self, data: bytes, arrival_s: float) -> list[Sample]:
        """Process bytes that arrived at time `arrival_s`; return a sample for each line that is now complete."""
        samples = []
        for line in self.split(data):
            try:
                numbers = [_number(cell) for cell in re.split(r"[\s,;]+", line)]
                forces: dict[str, Any] = dict(zip(GAUGE_NUMBERS[len(numbers)], numbers, strict=True))
            except (ValueError, KeyError):
                self.count_bad(line)
                continue
            contact = _is_contact(forces["Fz_N"])
            samples.append(Sample(arrival_s, None if contact is None else Label(contact, **forces)))
        return samples


def _is_contact(force_N: float) -> bool | None:
    """Return whether a force indicates contact; None if it is NaN, or between `NOLOAD_N` and `CONTACT_N`."""
    if abs(force_N) >= CONTACT_N:
        return True
    return False if abs(force_N) < NOLOAD_N else None


def _number(text: str) -> float:
    """Parse a finite number; raise `ValueError` for anything else, such as 1_000 or digits that are not ASCII."""
    if not re.match(NUMBER_PATTERN, text, re.ASCII) or not math.isfinite(number := float(text)):
        raise ValueError(text)
    return number


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
            if self._run and not _continues(self._run[0], self._run[-1], sample):
                yield from self.close()
            if sample.label is not None:
                # Without contact, a dwell needs only its first and its last sample, so replace the last one.
                if len(self._run) > 1 and not sample.label.contact:
                    self._run.pop()
                self._run.append(sample)
                is_long = self._lasts_s() >= DWELL_MAX_s or len(self._run) >= DWELL_SAMPLES_MAX_N
                if sample.label.contact and is_long:
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
        """Return a text that says how many contacts were too short for a dwell; return "" if there are none."""
        if not self.short_n:
            return ""
        # All contacts may be too short if a program does not append rows continuously.
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


# --- Sources of labels ---


@dataclass
class LabelContext:
    """The objects that a source of labels uses during a recording."""

    writer: ProbeLogWriter
    unix_s: Callable[[], float]  # function that returns the time on this machine's clock, in unix seconds
    stop: threading.Event  # the event that stops the recording
    # Function that writes a sync mark to the capture's header. Its arguments are two times of the same event: the unix
    # time, and the time on the clock of the source.
    mark: Callable[[float, float], object]

    def hold(self, label: Label, dwell_s: float) -> Dwell:
        """Wait for `dwell_s`, or until the recording stops; return a dwell with the label and the time of the wait."""
        start_s = self.unix_s()
        self.stop.wait(dwell_s)
        return Dwell(label, start_s, self.unix_s())


class LabelSource(NamedTuple):
    """A source of labels, which a recording runs in a thread of its own (see `LabelThread`)."""

    name: str  # name of the source, for the capture's header
    scan: str | None  # order of the places
    # function that writes labels until there are no more labels or the recording stops, and then returns a summary
    run: Callable[[LabelContext], str]


class LabelThread:
    """A thread that runs a source of labels. If the source fails, `failed` is the exception."""

    def __init__(self, source: LabelSource, context: LabelContext) -> None:
        self.failed: Exception | None = None
        self._summary, self._source, self._context = "", source, context
        self._thread = threading.Thread(target=self._run, name="labels", daemon=True)
        self._thread.start()

    def end(self, wait_s: float = 1.0) -> str:
        """Stop the source of labels and the recording; return a summary of the labels.

        The method waits for the source to stop, but at most `wait_s`. Labels that were written before are kept.
        """
        self._context.stop.set()
        self._thread.join(wait_s)
        writer = self._context.writer
        writer.close()
        lost = {"without a no-load dwell before them": writer.without_noload_n, "out of order": writer.out_of_order_n}
        counts = [f"{writer.touches_n} touches labelled", *(f"{n} {why}" for why, n in lost.items() if n)]
        problem = f"labels ended: {self.failed or type(self.failed).__name__}" if self.failed is not None else ""
        return "; ".join(filter(None, (", ".join(counts), self._summary, problem)))

    def _run(self) -> None:
        try:
            self._summary = self._source.run(self._context)
        except Exception as error:
            self.failed = error
        finally:
            self._context.stop.set()


def from_program(labels: Iterable[Label] | Callable[[], Label | None], dwell_s: float) -> LabelSource:
    """Make a source that takes labels from a generator, or from a function that is called until it returns None.

    The generator or function first moves the robot, and then yields or returns the label. The robot then stays where it
    is for `dwell_s`, after which the next label is requested.
    """
    label_iterator = iter(labels, None) if callable(labels) else iter(labels)

    def run(context: LabelContext) -> str:
        for label in label_iterator:
            if not isinstance(label, Label):
                remedy = "Yield or return the result of reskin.lifted() or reskin.touch(x_mm, y_mm)."
                raise ParamsError(
                    "labels", "each label", "reskin.lifted() or reskin.touch(...)", repr(label)[:60], remedy
                )
            context.writer.write(context.hold(label, dwell_s))
            if context.stop.is_set():
                break
        return ""

    return LabelSource("program", None, run)


def from_table(file: Path) -> LabelSource:
    """Make a source that takes labels from a CSV file to which a robot's program appends rows.

    Rows that were written before the recording are skipped.
    """

    def run(context: LabelContext) -> str:
        table, dwells, least_delay_s = SampleTable(str(file)), DwellBuilder(), math.inf
        try:
            for data, is_new in _follow(file, context.stop):
                arrival_s, samples = context.unix_s(), table.feed(data)
                if not samples or not is_new:
                    continue
                delay_s = arrival_s - samples[-1].t_s if table.clock == "t_s" else least_delay_s
                # A sync mark pairs the time at which a row was read with the time in the row. Rows are read some time
                # after they were written, so the mark with the shortest delay is the most accurate.
                if delay_s < least_delay_s - BETTER_s:
                    least_delay_s = delay_s
                    context.mark(arrival_s, samples[-1].t_s)
                context.writer.write_all(dwells.feed(samples))
        finally:
            context.writer.write_all(dwells.close())
        return "; ".join(filter(None, (table.problem(), dwells.summary())))

    return LabelSource(f"table {file.name}", None, run)


def _follow(file: Path, stop: threading.Event) -> Iterator[tuple[bytes, bool]]:
    """Yield the content of a file, and then all data that is appended to it, until `stop` is set.

    Each yielded pair consists of a chunk of bytes and a flag. The flag is True if the chunk was written after the call
    of this function. If the file does not exist yet, the function waits for it.
    """
    is_new = not file.exists()
    while not stop.is_set() and not file.exists():
        stop.wait(TABLE_POLL_s)
    if stop.is_set():
        return
    with file.open("rb") as stream:
        while not stop.is_set():
            if data := stream.read(2**20):
                yield data, is_new
            else:
                is_new = True
                _check_grows(file, stream)
                stop.wait(TABLE_POLL_s)
        yield stream.read(2**20), True


def _check_grows(file: Path, stream: BinaryIO) -> None:
    """Raise `CaptureError` if the file was removed, replaced or shortened."""
    problem = ""
    try:
        status = file.stat()
        if not os.path.samestat(status, os.fstat(stream.fileno())):
            problem = "replaced while it was read"
        elif status.st_size < stream.tell():
            problem = f"shortened to {status.st_size} bytes, but {stream.tell()} bytes had already been read"
    except FileNotFoundError:
        problem = "removed while it was read"
    if problem:
        raise CaptureError(
            f"{file}: the file was {problem}. The program of the robot must append rows to this file, and must not "
            "replace or shorten the file."
        )


class ForceGauge:
    """A force gauge at a port.

    The gauge can be read in a thread (see `listening`), which stores the latest samples. `during` then returns the mean
    force between two times.
    """

    def __init__(self, port: str, baud: int) -> None:
        self.port, self._baud, self._lines = port, baud, GaugeLines(f"the gauge at {port}")
        self._latest: deque[Sample] = deque(maxlen=SAMPLES_MAX_N)
        self._problem = ""
        self._without_force_n = 0

    def during(self, start_s: float, end_s: float) -> Label:
        """Return a label with the mean force between two times.

        If the gauge sent no sample in this time, the force is NaN, and the contact is counted as one without force.
        """
        labels = [sample.label for sample in list(self._latest) if sample.label and start_s <= sample.t_s <= end_s]
        self._without_force_n += not labels
        return mean_label(labels) if labels else Label(True)

    def summary(self) -> str:
        """Return a text on lines that could not be read, a lost connection, and contacts without force."""
        without = f"{self._without_force_n} touches during which the gauge at {self.port} sent no force"
        return "; ".join(filter(None, (self._lines.problem(), self._problem, without if self._without_force_n else "")))

    @contextmanager
    def listening(self, context: LabelContext) -> Iterator[None]:
        """Read the gauge in a thread during the `with` block; raise `CaptureError` if its port cannot be opened."""

        def listen() -> None:
            try:
                self._read(device, context, self._latest.extend)
            except CaptureError as error:
                self._problem = f"{error} All later forces are missing"

        with open_port(self.port, self._baud) as device:
            thread = threading.Thread(target=listen, daemon=True)
            thread.start()
            try:
                yield
            finally:
                context.stop.set()
                thread.join()

    def run(self, context: LabelContext) -> str:
        """Take labels from the gauge alone: the times and forces of contacts, without places."""
        dwells = DwellBuilder()
        try:
            with open_port(self.port, self._baud) as device:
                self._read(device, context, lambda samples: context.writer.write_all(dwells.feed(samples)))
        finally:
            context.writer.write_all(dwells.close())
        return "; ".join(filter(None, (self.summary(), dwells.summary())))

    def _read(self, device: Device, context: LabelContext, use: Callable[[list[Sample]], object]) -> None:
        """Pass the samples of the gauge to `use` until the recording stops; raise if the gauge is unplugged."""
        while not context.stop.is_set():
            try:
                chunk = read_waiting(device)
            except OSError as error:
                raise CaptureError(
                    f"{self.port}: lost the connection to the force gauge: {error}. The forces that it sent are kept. "
                    "Plug the gauge in, and record again."
                ) from None
            if chunk:
                use(self._lines.feed(chunk, context.unix_s()))


def from_gauge(port: str, baud: int) -> LabelSource:
    return LabelSource("gauge", None, ForceGauge(port, baud).run)


# --- Prompts for a person ---


@dataclass(frozen=True)
class Places:
    """A grid of places (x, y) in mm, numbered row by row; `row_n` is the number of places in a row."""

    name: str
    xy_mm: Sequence[tuple[float, float]]
    row_n: int

    def order(self, scan: str, rng: np.random.Generator) -> list[int]:
        """Return the numbers of all places in the order in which they are to be pressed.

        If `scan` is `RANDOM`, the order is random. Otherwise, it is row by row, with every other row backwards.
        """
        if scan == RANDOM:
            return [int(i) for i in rng.permutation(len(self.xy_mm))]
        rows = [list(range(first, first + self.row_n)) for first in range(0, len(self.xy_mm), self.row_n)]
        return [i for row_i, row in enumerate(rows) for i in (row[::-1] if row_i % 2 else row)]


def parse_places(text: str) -> Places | None:
    """Parse a text that describes places: `line:N:STEP_MM` or `grid:NXxNY:STEP_MM`; return None for any other text.

    A line is along x. The first place is (0, 0), unless the text ends with another place, as in `@X_MM,Y_MM`.

    >>> parse_places("line:3:2@0,8").xy_mm
    [(0.0, 8.0), (2.0, 8.0), (4.0, 8.0)]
    """
    number = r"(-?\d{1,4}(?:\.\d{1,3})?)"
    pattern = rf"(?:line:(\d{{1,4}})|grid:(\d{{1,4}})x(\d{{1,4}})):{number}(?:@{number},{number})?"
    match = re.fullmatch(pattern, text, re.ASCII)
    if match is None:
        return None
    along_n, up_n = (int(match[1]), 1) if match[1] else (int(match[2]), int(match[3]))
    step_mm, x_mm, y_mm = float(match[4]), float(match[5] or 0), float(match[6] or 0)
    if not 0 < along_n * up_n <= PLACES_MAX_N or step_mm <= 0:
        raise ParamsError(
            "--labels", "places", f"1 to {PLACES_MAX_N} places, with a step above 0", text, "Example: grid:9x9:2"
        )
    xy_mm = [(x_mm + step_mm * i, y_mm + step_mm * j) for j in range(up_n) for i in range(along_n)]
    return Places(text, xy_mm, along_n)


@dataclass(frozen=True)
class Prompts:
    """A source of labels that asks a person to press one place after another.

    The person hits the Enter key when the tip does not move. The dwell then begins, and lasts for `dwell_s`.
    """

    places: Places
    dwell_s: float
    say: Say
    lines: Callable[[], Iterable[str]]  # function that returns the lines that the person types
    forces: ForceGauge | None  # the gauge that measures the forces; None if there is no gauge
    rng: np.random.Generator
    scan: str = RANDOM  # the order of the places, see `Places.order`

    def source(self) -> LabelSource:
        return LabelSource(self.places.name, self.scan, self.run)

    def run(self, context: LabelContext) -> str:
        with self.forces.listening(context) if self.forces else nullcontext():
            self._ask(context, typed_until(self.lines, context.stop))
        return self.forces.summary() if self.forces else ""

    def _ask(self, context: LabelContext, typed: Iterator[str]) -> None:
        n = len(self.places.xy_mm)
        self.say(f"{n} places in {self.scan} order. When you press a place, hold the tip still, and hit Enter. If you "
                 "press another place, type its number before you hit Enter. If you know the force, type it too, as "
                 "0.8N. "
                 "Type s to skip a place, and q to end the recording.")  # fmt: skip
        for pass_i in count():
            order = self.places.order(self.scan, self.rng)
            for i, place_i in enumerate(order):
                self.say(f"pass {pass_i}, {i + 1} of {n}: lift the tip off the skin, and hit Enter")
                if next(typed, ENDS[0]) in ENDS:
                    return
                context.writer.write(context.hold(Label(False), self.dwell_s))
                following = f"; the next place is {self._name(order[i + 1])}" if i + 1 < n else ""
                self.say(f"  press {self._name(place_i)}, hold the tip still, and hit Enter{following}")
                label = self._read_label(typed, place_i)
                if label is None:
                    return
                if label.contact:
                    context.writer.write(self._with_force(context.hold(label._replace(pass_i=pass_i), self.dwell_s)))

    def _name(self, place_i: int) -> str:
        x_mm, y_mm = self.places.xy_mm[place_i]
        return f"place {place_i} (x {x_mm:g}, y {y_mm:g} mm)"

    def _read_label(self, typed: Iterator[str], place_i: int) -> Label | None:
        """Return the label of a press from the line that the person types; return None to end the recording.

        If the person skips the place, the label is one without contact.
        """
        for line in typed:
            if line in ENDS:
                return None
            if line == "s":
                return Label(False)
            match = REPLY.fullmatch(line)
            if match and int(match[1] or place_i) < len(self.places.xy_mm):
                x_mm, y_mm = self.places.xy_mm[int(match[1] or place_i)]
                return Label(True, x_mm, y_mm, Fz_N=float(match[2] or math.nan))
            last = len(self.places.xy_mm) - 1
            self.say(f"  {line[:20]!r} is neither a place from 0 to {last} nor a force such as 0.8N")
        return None

    def _with_force(self, dwell: Dwell) -> Dwell:
        if self.forces is None or not math.isnan(dwell.label.Fz_N):
            return dwell
        measured = self.forces.during(dwell.t_start_s, dwell.t_end_s)
        return dwell._replace(label=dwell.label._replace(Fx_N=measured.Fx_N, Fy_N=measured.Fy_N, Fz_N=measured.Fz_N))


def typed_until(lines: Callable[[], Iterable[str]], stop: threading.Event) -> Iterator[str]:
    """Yield the lines that a person types, without surrounding spaces, until the input ends or `stop` is set.

    A thread waits for the input, so that `stop` is noticed even if nothing is typed.
    """
    typed: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read() -> None:
        for line in lines():
            typed.put(line.strip())
        typed.put(None)

    threading.Thread(target=read, daemon=True).start()
    while not stop.is_set():
        try:
            line = typed.get(timeout=TYPED_POLL_s)
        except queue.Empty:
            continue
        if line is None:
            return
        yield line
