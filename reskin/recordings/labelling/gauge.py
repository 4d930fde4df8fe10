"""A force gauge on a serial port: lines of one number (Fz) or three (Fx Fy Fz), in N. In: a port. Out: dwells.

Refuses to know places and the board.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from reskin.board.port import Device, open_port, read_waiting
from reskin.errors import CaptureError
from reskin.recordings.labelling.source import Desk, Source, told_bad
from reskin.recordings.labels import Label
from reskin.recordings.samples import Dwells, Gauge, Sample, mean_label

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
