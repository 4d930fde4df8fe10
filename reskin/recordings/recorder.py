"""Recording from a board: a port -> a capture folder that `reskin add` takes. Or the part that came, kept.

The header is written first and sealed last, into `<folder>.part`, which is renamed when the recording has ended: a
killed recorder leaves a `.part` that can still be added, with the labels that had come. Refuses to know ports
(`capture.port`), and where labels come from (`labelling`).
"""

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from errno import ENOSPC
from pathlib import Path
from typing import NamedTuple

from reskin import io
from reskin.board.port import PortSettings, Recording, Report, Watch, record
from reskin.errors import CaptureError
from reskin.recordings.header import HEADER_FILE, Clock, Header, Wire, recorded, render, seal
from reskin.recordings.label_sources import Desk, Labeller, Source
from reskin.recordings.labels import ProbeTape
from reskin.recordings.preparing import UNNAMED

PROGRESS_s = 1.0
CAPTURES = Path("captures")


@dataclass(frozen=True)
class Told:
    """What the user says of a recording to come; `scan` is the order of the rig's places: random, snake, or words.

    `labels` is where its labels come from, if they come while it is recorded.
    """

    board: str
    skin: str
    scan: str
    labels: Source | None = None


class Recorded(NamedTuple):
    """What a port gave, what is told of the labels, and the error that ended these, if one did."""

    stream: Recording
    labels: str
    failed: Exception | None


UNTOLD = Told(UNNAMED, UNNAMED, "not stated")


def record_capture(
    port: str, folder: Path, *, told: Told, settings: PortSettings, report: Report, watch: Watch
) -> Recorded:
    """Record what a port sends as a native capture, and beside it what a source of labels says, until either ends."""
    part, header = begin_capture(folder, told, wire=settings.wire, chips_n=settings.chips_n, by="reskin record")
    stop, headers, labeller = threading.Event(), [header], None
    try:
        if told.labels is not None:
            labeller = Labeller(told.labels, _desk(part, headers, stop))
        done = record(port, part, settings=settings, stop=stop, report=report, watch=watch)
    except CaptureError as error:
        if labeller is not None:
            labeller.end()
        io.remove(part)  # no frame came: there is nothing to keep
        if labeller is not None and labeller.failed is not None:  # this ended the recording, before a frame came
            raise labeller.failed from error
        raise
    said = labeller.end() if labeller is not None else ""
    failed = labeller.failed if labeller is not None else None
    if isinstance(failed, OSError) and failed.errno == ENOSPC:
        done = replace(done, ended="not written")
    if done.ended != "not written":  # else there is no room for hashes either; the part can be added as it is
        end_capture(folder, headers[-1])
    return Recorded(done, said, failed)


def _desk(part: Path, headers: list[Header], stop: threading.Event) -> Desk:
    """Lay out what a source of labels works with; its clock is the port's until it says that it has another."""
    offset_s = time.time() - time.monotonic()  # the system's clock may be set while we record
    tape = ProbeTape(part)

    def unix_s() -> float:
        return offset_s + time.monotonic()

    def mark(stream_s: float, source_s: float) -> None:
        with tape.held_open() as is_open:
            if is_open:  # else the header is sealed, or soon will be
                clock = headers[-1].clock.model_copy(update={"marks": ((stream_s, source_s),)})
                headers[-1] = headers[-1].model_copy(update={"clock": clock})
                io.write_text(part / HEADER_FILE, render(headers[-1]))

    now_s = unix_s()
    mark(now_s, now_s)
    return Desk(tape, unix_s, stop, mark)


def begin_capture(folder: Path, told: Told, *, wire: Wire, chips_n: int, by: str) -> tuple[Path, Header]:
    """Make the folder that a stream is written into, with its header; it becomes `folder` at the end."""
    part = _part_of(folder)
    for path in (folder, part):
        if path.exists():
            raise CaptureError(path, "the capture's folder", "new", "one that is there", "Choose another --out.")
    options = {"scan": told.scan} | ({"labels": told.labels.name} if told.labels is not None else {})
    header = recorded(
        f"--out {folder.name}", capture=folder.name, board=told.board, skin=told.skin, layout="native",
        wire=wire, chips_n=chips_n, options=options,
        clock=Clock(kind="arrivals", rate_hz=None, marks=()), protocol="as the probe log says",
        note=f"recorded by {by}; arrival times are unix seconds of the host",
    )  # fmt: skip
    part.mkdir(parents=True)
    io.write_text(part / HEADER_FILE, render(header))
    return part, header


def end_capture(folder: Path, header: Header) -> None:
    """Seal what was written, and give it its name."""
    seal(_part_of(folder), header)
    _part_of(folder).rename(folder)


def _part_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.part")


def new_folder() -> Path:
    """Name a capture's folder after the time."""
    return CAPTURES / time.strftime("%Y%m%d-%H%M%S")


def print_progress(alarms: Callable[[], Sequence[str]]) -> Report:
    """Make a report that writes rate, losses and alarms to stderr once a second; nothing where that is no terminal."""
    start_s = last_s = time.monotonic()
    last_n = 0

    def report(account: Mapping[str, int]) -> None:
        nonlocal last_s, last_n
        now_s, frames_n = time.monotonic(), account["frames_n"]
        if now_s - last_s < PROGRESS_s or not sys.stderr.isatty():
            return
        rate_hz = (frames_n - last_n) / (now_s - last_s)
        lost_n = sum(count for name, count in account.items() if name.startswith("skipped_"))
        line = f"{now_s - start_s:.0f} s: {rate_hz:.1f} frames/s, {frames_n} frames, {lost_n} bytes lost"
        line = "; ".join([line, *alarms()])
        print(line, file=sys.stderr, flush=True)
        last_s, last_n = now_s, frames_n

    return report
