"""What every source of labels is: a function that runs beside a recording and writes dwells to its `ProbeTape`.

It runs on a thread of its own until it has no more, or the recording stops. Refuses to know the board and its frames.
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from reskin.errors import ParamsError
from reskin.recordings.labels import Dwell, Label, ProbeTape


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
