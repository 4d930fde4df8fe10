"""Sources of labels (places and forces of contacts) during a recording.

There are four sources: a person who presses by hand at places that the program names; a Python function or generator
that moves a robot; a CSV file to which a robot's program appends rows; and a force gauge.
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
from typing import BinaryIO, NamedTuple

import numpy as np

from reskin.board.port import Device, open_port, read_waiting
from reskin.errors import CaptureError, ParamsError
from reskin.recordings.labels import (
    Dwell,
    DwellBuilder,
    GaugeLines,
    Label,
    ProbeLogWriter,
    Sample,
    SampleTable,
    mean_label,
)


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


class LabelThread:
    """A thread that runs a source of labels.

    If the source fails, `failed` is the exception, and `problem` is a text that describes it.
    """

    def __init__(self, source: LabelSource, context: LabelContext) -> None:
        self.summary, self.problem = "", ""
        self.failed: Exception | None = None
        self._source, self._label_context = source, context
        self._thread = threading.Thread(target=self._run, name="labels", daemon=True)
        self._thread.start()

    def end(self, wait_s: float = 1.0) -> str:
        """Stop the source of labels and the recording; return a summary of the labels.

        The method waits for the source to stop, but at most `wait_s`. Labels that were written before are kept.
        """
        self._label_context.stop.set()
        self._thread.join(wait_s)
        writer = self._label_context.writer
        writer.close()
        lost = {"without a no-load dwell before them": writer.without_noload_n, "out of order": writer.out_of_order_n}
        counts = [f"{writer.touches_n} touches labelled", *(f"{n} {why}" for why, n in lost.items() if n)]
        return "; ".join(filter(None, (", ".join(counts), self.summary, self.problem)))

    def _run(self) -> None:
        try:
            self.summary = self._source.run(self._label_context)
        except Exception as error:
            self.failed, self.problem = error, f"labels ended: {error or type(error).__name__}"
        finally:
            self._label_context.stop.set()


PLACES_MAX_N = 10_000
RANDOM, SNAKE = "random", "snake"


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
    match = re.fullmatch(rf"(?:line:(\d{{1,4}})|grid:(\d{{1,4}})x(\d{{1,4}})):{number}(?:@{number},{number})?", text)
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


TABLE_POLL_s = 0.02
BETTER_s = 0.005  # a sync mark is replaced only if the delay of the new mark is shorter by more than this


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
        return "; ".join(filter(None, (_bad_lines(str(file), table), dwells.summary())))

    return LabelSource(f"table {file.name}", None, run)


def _bad_lines(where: str, lines: SampleTable | GaugeLines) -> str:
    return (
        f"{where}: {lines.bad_n} lines could not be read; the first of them is {lines.first_bad!a}"
        if lines.bad_n
        else ""
    )


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
    """Raise `CaptureError` if the file was replaced or shortened."""
    remedy = "The program of the robot must append rows to this file, and must not replace or shorten the file."
    try:
        status = file.stat()
    except FileNotFoundError:
        raise CaptureError(f"{file}: the file was removed while it was read. {remedy}") from None
    if not os.path.samestat(status, os.fstat(stream.fileno())):
        raise CaptureError(f"{file}: the file was replaced while it was read. {remedy}")
    if status.st_size < stream.tell():
        raise CaptureError(
            f"{file}: the file was shortened to {status.st_size} bytes, but {stream.tell()} bytes had already been "
            f"read. {remedy}"
        )


KEPT_N = 10_000  # number of latest samples that a gauge stores; a touch has a few hundred


class ForceGauge:
    """A force gauge at a port.

    The gauge can be read in a thread (see `listening`), which stores the latest samples. `during` then returns the mean
    force between two times.
    """

    def __init__(self, port: str, baud: int) -> None:
        self.port, self._baud, self._gauge = port, baud, GaugeLines()
        self._kept: deque[Sample] = deque(maxlen=KEPT_N)
        self._problem = ""
        self._without_force_n = 0

    def during(self, start_s: float, end_s: float) -> Label:
        """Return a label with the mean force between two times.

        If the gauge sent no sample in this time, the force is NaN, and the contact is counted as one without force.
        """
        labels = [sample.label for sample in list(self._kept) if sample.label and start_s <= sample.t_s <= end_s]
        self._without_force_n += not labels
        return mean_label(labels) if labels else Label(True)

    def summary(self) -> str:
        """Return a text on the problems of the gauge; "" if there are none.

        The problems are lines that could not be read, a lost connection, and contacts without force.
        """
        bad = _bad_lines(f"the gauge at {self.port}", self._gauge)
        without = f"{self._without_force_n} touches during which the gauge at {self.port} sent no force"
        return "; ".join(filter(None, (bad, self._problem, without if self._without_force_n else "")))

    @contextmanager
    def listening(self, context: LabelContext) -> Iterator[None]:
        """Read the gauge in a thread during the `with` block; raise `CaptureError` if its port cannot be opened."""
        with open_port(self.port, self._baud) as device:
            thread = threading.Thread(target=self._listen, args=[device, context], daemon=True)
            thread.start()
            try:
                yield
            finally:
                context.stop.set()
                thread.join()

    def _listen(self, device: Device, context: LabelContext) -> None:
        try:
            self.read(device, context, self._kept.extend)
        except CaptureError as error:
            self._problem = f"{error} All later forces are missing"

    def read(self, device: Device, context: LabelContext, use: Callable[[list[Sample]], object]) -> None:
        """Read samples from the gauge, and pass them to the function `use`, until the recording stops.

        Raises `CaptureError` if the gauge is unplugged during the recording.
        """
        while not context.stop.is_set():
            try:
                chunk = read_waiting(device)
            except OSError as error:
                raise CaptureError(
                    f"{self.port}: lost the connection to the force gauge: {error}. The forces that it sent are kept. "
                    "Plug the gauge in, and record again."
                ) from None
            if chunk:
                use(self._gauge.feed(chunk, context.unix_s()))


def from_gauge(port: str, baud: int) -> LabelSource:
    """Make a source that takes labels from a force gauge: the times and forces of contacts, without places."""

    def run(context: LabelContext) -> str:
        forces, dwells = ForceGauge(port, baud), DwellBuilder()
        try:
            with open_port(port, baud) as device:
                forces.read(device, context, lambda samples: context.writer.write_all(dwells.feed(samples)))
        finally:
            context.writer.write_all(dwells.close())
        return "; ".join(filter(None, (forces.summary(), dwells.summary())))

    return LabelSource("gauge", None, run)


POLL_s = 0.05
ENDS = ("q", "quit", "end")
# The person types a place, a force, or both. The space between them is needed: without it, 12N could mean a force of 12
# N or place 1 with a force of 2 N.
REPLY = re.compile(r"(?:(\d{1,5})(?:\s+|$))?(?:(\d{1,3}(?:\.\d{1,4})?)\s*[nN])?")
Say = Callable[[str], object]


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
            match = REPLY.fullmatch(line)
            if line in ENDS:
                return None
            if line == "s":
                return Label(False)
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
            line = typed.get(timeout=POLL_s)
        except queue.Empty:
            continue
        if line is None:
            return
        yield line
