"""A CSV that a robot's program appends to, followed as it grows. In: a file. Out: dwells, and how its clock runs.

Refuses to know the board and to guess a unit.
"""

import math
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from reskin.errors import CaptureError
from reskin.recordings.labelling.source import Desk, Source, told_bad
from reskin.recordings.samples import Dwells, Table

POLL_s = 0.02
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
        stop.wait(POLL_s)
    if stop.is_set():
        return
    with file.open("rb") as stream:
        while not stop.is_set():
            if data := stream.read(2**20):
                yield data, is_new
            else:
                is_new = True
                _check_grows(file, stream)
                stop.wait(POLL_s)
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
