"""A person presses places one after the other, and says with a key that it holds still. In: lines typed. Out: dwells.

Refuses to know who types: a terminal, or a test.
"""

import math
import queue
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import count

import numpy as np

from reskin.recordings.labelling.gauge import Forces
from reskin.recordings.labelling.places import RANDOM, Places
from reskin.recordings.labelling.source import Desk, Source
from reskin.recordings.labels import Dwell, Label

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
