"""Recording from a board: a port -> a capture folder that `reskin add` takes. Or the part that came, kept.

The header is written first and sealed last, into `<folder>.part`, which is renamed when the recording has ended: a
killed recorder leaves a `.part` that can still be added. Refuses to know ports (`capture.port`).
"""

import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.capture.header import HEADER_FILE, Clock, Header, Wire, recorded, render, seal
from pipeline.capture.port import PortSettings, Recording, Report, record
from pipeline.core import io
from pipeline.core.errors import CaptureError
from pipeline.preparing import UNNAMED

PROGRESS_s = 1.0
CAPTURES = Path("captures")


@dataclass(frozen=True)
class Told:
    """What the user says of a recording to come; `scan` is the order of the rig's places: random, snake, or words."""

    board: str
    skin: str
    scan: str


UNTOLD = Told(UNNAMED, UNNAMED, "not stated")


def record_capture(port: str, folder: Path, *, told: Told, settings: PortSettings, report: Report) -> Recording:
    """Record what a port sends, as a native capture without labels."""
    part, header = begin_capture(folder, told, wire=settings.wire, chips_n=settings.chips_n, by="reskin record")
    try:
        done = record(port, part, settings=settings, stop=threading.Event(), report=report)
    except CaptureError:
        io.remove(part)  # no frame came: there is nothing to keep
        raise
    if done.ended != "not written":  # else there is no room for hashes either; the part can be added as it is
        end_capture(folder, header)
    return done


def begin_capture(folder: Path, told: Told, *, wire: Wire, chips_n: int, by: str) -> tuple[Path, Header]:
    """Make the folder that a stream is written into, with its header; it becomes `folder` at the end."""
    part = _part_of(folder)
    for path in (folder, part):
        if path.exists():
            raise CaptureError(path, "the capture's folder", "new", "one that is there", "Choose another --out.")
    header = recorded(
        f"--out {folder.name}", capture=folder.name, board=told.board, skin=told.skin, layout="native",
        wire=wire, chips_n=chips_n, options={"scan": told.scan},
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


def print_progress() -> Report:
    """Make a report that writes rate, frames and losses to stderr once a second; nothing where that is no terminal."""
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
        print(line, file=sys.stderr, flush=True)
        last_s, last_n = now_s, frames_n

    return report
