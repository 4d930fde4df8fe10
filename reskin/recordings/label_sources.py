"""Labels for a recording: places that a person presses, a robot's program or CSV, a force gauge."""

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
from reskin.recordings.labels import Dwell, Dwells, Gauge, Label, ProbeTape, Sample, Table, mean_label


@dataclass
class Desk:
    """What a source works with: the tape, a clock in unix seconds, and when to stop; `mark` tells of another clock."""

    tape: ProbeTape
    unix_s: Callable[[], float]
    stop: threading.Event
    mark: Callable[[float, float], object]  # unix time and the source's time of one event

    def hold(self, label: Label, dwell_s: float) -> Dwell:
        """Let a label hold from now on for so long, or until the recording stops."""
        start_s = self.unix_s()
        self.stop.wait(dwell_s)
        return Dwell(label, start_s, self.unix_s())


class Source(NamedTuple):
    """A source of labels: what it is called in the header, in which order places come, and what to run."""

    name: str
    scan: str | None
    run: Callable[[Desk], str]  # gives what is to be told at the end


def from_program(labels: Iterable[Label] | Callable[[], Label | None], dwell_s: float) -> Source:
    """Take labels from a generator, or from a function that is called each time until it gives None.

    The program moves the robot before it gives a label; while the label holds, it is not asked for the next one.
    """
    each = iter(labels, None) if callable(labels) else iter(labels)

    def run(desk: Desk) -> str:
        for label in each:
            if not isinstance(label, Label):
                remedy = "Yield reskin.lifted() or reskin.touch(x_mm, y_mm)."
                raise ParamsError(
                    "labels", "what the program gives", "reskin.lifted() or reskin.touch(...)", repr(label)[:60], remedy
                )
            desk.tape.write(desk.hold(label, dwell_s))
            if desk.stop.is_set():
                break
        return ""

    return Source("program", None, run)


def told_bad(where: str, bad_n: int, first_bad: str) -> str:
    return f"{where}: {bad_n} lines could not be read, the first {first_bad!a}" if bad_n else ""


class Labeller:
    """Runs a source beside a recording; `problem` is what ended it, if it did not end by itself."""

    def __init__(self, source: Source, desk: Desk) -> None:
        self.told, self.problem = "", ""
        self.failed: Exception | None = None
        self._source, self._desk = source, desk
        self._thread = threading.Thread(target=self._run, name="labels", daemon=True)
        self._thread.start()

    def end(self, wait_s: float = 1.0) -> str:
        """Stop, and give in a sentence what came: a program that hangs is not waited for, and its labels are kept."""
        self._desk.stop.set()
        self._thread.join(wait_s)
        tape = self._desk.tape
        tape.close()
        lost = {"without a no-load dwell before": tape.without_noload_n, "out of order": tape.out_of_order_n}
        words = [f"{tape.touches_n} touches labelled", *(f"{n} {why}" for why, n in lost.items() if n)]
        return "; ".join(word for word in (", ".join(words), self.told, self.problem) if word)

    def _run(self) -> None:
        try:
            self.told = self._source.run(self._desk)
        except Exception as error:
            self.failed, self.problem = error, f"labels ended: {error or type(error).__name__}"
        finally:
            self._desk.stop.set()


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


TABLE_POLL_s = 0.02
BETTER_s = 0.005  # a mark of two clocks that is so much better is written down


def from_table(file: Path) -> Source:
    """Follow a CSV that a robot's program appends to; what stands in it before the recording begins is passed over."""

    def run(desk: Desk) -> str:
        table, dwells, best_s = Table(str(file)), Dwells(), math.inf
        try:
            for data, is_new in _grown(file, desk.stop):
                came_s, samples = desk.unix_s(), table.feed(data)
                if not samples or not is_new:
                    continue
                late_s = came_s - samples[-1].t_s if table.clock == "t_s" else best_s
                if late_s < best_s - BETTER_s:  # a row is written after its time: the least delay is nearest to none
                    best_s = late_s
                    desk.mark(came_s, samples[-1].t_s)
                desk.tape.write_all(dwells.feed(samples))
        finally:
            desk.tape.write_all(dwells.close())
        return "; ".join(filter(None, (told_bad(str(file), table.bad_n, table.first_bad), dwells.told())))

    return Source(f"table {file.name}", None, run)


def _grown(file: Path, stop: threading.Event) -> Iterator[tuple[bytes, bool]]:
    """Give what a file holds, and what is appended to it, and whether it came since; wait for one that is not there."""
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
    """Raise if the file is no longer the one that is followed, or shorter than what was read of it."""
    rule, remedy = "the same file, with rows appended", "Open it once, or append: do not write it anew."
    try:
        there = file.stat()
    except FileNotFoundError:
        raise CaptureError(file, "a table that is followed", rule, "no file", remedy) from None
    if not os.path.samestat(there, os.fstat(stream.fileno())):
        raise CaptureError(file, "a table that is followed", rule, "another file in its place", remedy)
    if there.st_size < stream.tell():
        got = f"{there.st_size} bytes, of which {stream.tell()} were read"
        raise CaptureError(file, "a table that is followed", rule, got, remedy)


KEPT_N = 10_000  # samples, of which a touch is a few hundred


class Forces:
    """What a gauge says; it remembers the last of it, and why it fell silent."""

    def __init__(self, port: str, baud: int) -> None:
        self.port, self._baud, self._gauge = port, baud, Gauge()
        self._kept: deque[Sample] = deque(maxlen=KEPT_N)
        self._silent = ""
        self._without_n = 0

    def during(self, start_s: float, end_s: float) -> Label:
        """Give the mean force between two times; NaN, and counted, where nothing was said."""
        found = [one.label for one in list(self._kept) if one.label and start_s <= one.t_s <= end_s]
        self._without_n += not found
        return mean_label(found) if found else Label(True)

    def told(self) -> str:
        """Say what could not be read of it, and how many touches have no force."""
        bad = told_bad(f"the gauge at {self.port}", self._gauge.bad_n, self._gauge.first_bad)
        without = f"{self._without_n} touches without a force: the gauge at {self.port} said none while they lasted"
        return "; ".join(words for words in (bad, self._silent, without if self._without_n else "") if words)

    @contextmanager
    def listening(self, desk: Desk) -> Iterator[None]:
        """Keep what it says while something else is done; raise if its port does not open."""
        with open_port(self.port, self._baud) as device:
            ear = threading.Thread(target=self._listen, args=[device, desk], daemon=True)
            ear.start()
            try:
                yield
            finally:
                desk.stop.set()
                ear.join()

    def _listen(self, device: Device, desk: Desk) -> None:
        try:
            self.read(device, desk, self._kept.extend)
        except CaptureError as error:
            self._silent = f"{error} Forces are missing from then on"

    def read(self, device: Device, desk: Desk, use: Callable[[list[Sample]], object]) -> None:
        """Read until the recording stops; raise if the gauge is unplugged before."""
        while not desk.stop.is_set():
            try:
                chunk = read_waiting(device)
            except OSError as error:
                rule, remedy = "plugged in until the recording ends", "What came is kept; plug it in, record again."
                raise CaptureError(self.port, "the force gauge", rule, error, remedy) from None
            if chunk:
                use(self._gauge.feed(chunk, desk.unix_s()))


def from_gauge(port: str, baud: int) -> Source:
    """Take forces alone: touches without places, told by the force."""

    def run(desk: Desk) -> str:
        forces, dwells = Forces(port, baud), Dwells()
        try:
            with open_port(port, baud) as device:
                forces.read(device, desk, lambda samples: desk.tape.write_all(dwells.feed(samples)))
        finally:
            desk.tape.write_all(dwells.close())
        return "; ".join(filter(None, (forces.told(), dwells.told())))

    return Source("gauge", None, run)


POLL_s = 0.05
ENDS = ("q", "quit", "end")
# A place, a force, or both with a blank between: else 12N would be place 1 with 2 N.
ANSWER = re.compile(r"(?:(\d{1,5})(?:\s+|$))?(?:(\d{1,3}(?:\.\d{1,4})?)\s*[nN])?")
Say = Callable[[str], object]


@dataclass(frozen=True)
class Prompts:
    """Asks a person to press places one after the other; Enter says that the finger, or the tip, stands still."""

    places: Places
    dwell_s: float
    say: Say
    lines: Callable[[], Iterable[str]]  # what is typed, line by line
    forces: Forces | None
    rng: np.random.Generator
    scan: str = RANDOM

    def source(self) -> Source:
        return Source(self.places.name, self.scan, self.run)

    def run(self, desk: Desk) -> str:
        with self.forces.listening(desk) if self.forces else nullcontext():
            self._ask(desk, typed_until(self.lines, desk.stop))
        return self.forces.told() if self.forces else ""

    def _ask(self, desk: Desk, typed: Iterator[str]) -> None:
        n = len(self.places.xy_mm)
        self.say(f"{n} places, {self.scan} order. Enter when it holds still; or type the number of another place, a "
                 "force such as 0.8N, or both; s passes a place over, q ends.")  # fmt: skip
        for pass_i in count():
            order = self.places.order(self.scan, self.rng)
            for i, place_i in enumerate(order):
                self.say(f"pass {pass_i}, {i + 1} of {n}: lift off, Enter")
                if next(typed, ENDS[0]) in ENDS:
                    return
                desk.tape.write(desk.hold(Label(False), self.dwell_s))
                following = f"; then {self._name(order[i + 1])}" if i + 1 < n else ""
                self.say(f"  press {self._name(place_i)}, hold, Enter{following}")
                label = self._answer(typed, place_i)
                if label is None:
                    return
                if label.contact:
                    desk.tape.write(self._with_force(desk.hold(label._replace(pass_i=pass_i), self.dwell_s)))

    def _name(self, place_i: int) -> str:
        x_mm, y_mm = self.places.xy_mm[place_i]
        return f"place {place_i} (x {x_mm:g}, y {y_mm:g} mm)"

    def _answer(self, typed: Iterator[str], place_i: int) -> Label | None:
        """Give the label that a person means; None at the end, one without contact for a place that is passed over."""
        for words in typed:
            found = ANSWER.fullmatch(words)
            if words in ENDS:
                return None
            if words == "s":
                return Label(False)
            if found and int(found[1] or place_i) < len(self.places.xy_mm):
                x_mm, y_mm = self.places.xy_mm[int(found[1] or place_i)]
                return Label(True, x_mm, y_mm, Fz_N=float(found[2] or math.nan))
            self.say(f"  {words[:20]!r} is no place from 0 to {len(self.places.xy_mm) - 1}, and no force such as 0.8N")
        return None

    def _with_force(self, dwell: Dwell) -> Dwell:
        if self.forces is None or not math.isnan(dwell.label.Fz_N):
            return dwell
        felt = self.forces.during(dwell.t_start_s, dwell.t_end_s)
        return dwell._replace(label=dwell.label._replace(Fx_N=felt.Fx_N, Fy_N=felt.Fy_N, Fz_N=felt.Fz_N))


def typed_until(lines: Callable[[], Iterable[str]], stop: threading.Event) -> Iterator[str]:
    """Give lines as they are typed, until they end or the recording does: no key is waited for then."""
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
