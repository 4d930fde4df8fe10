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

from pipeline.capture.header import HEADER_FILE, Clock, recorded, render, seal
from pipeline.capture.port import PortSettings, Recording, Report, record
from pipeline.core import io
from pipeline.core.errors import CaptureError

PROGRESS_s = 1.0


@dataclass(frozen=True)
class Told:
    """What the user says of a recording to come; `scan` is the order of the rig's places: random, snake, or words."""

    board: str
    skin: str
    scan: str


def record_capture(port: str, folder: Path, *, told: Told, settings: PortSettings, report: Report) -> Recording:
    """Record what a port sends, as a native capture without labels."""
    part = folder.with_name(f"{folder.name}.part")
    for path in (folder, part):
        if path.exists():
            raise CaptureError(path, "the capture's folder", "new", "one that is there", "Choose another --out.")
    header = recorded(
        f"--out {folder.name}", capture=folder.name, board=told.board, skin=told.skin, layout="native",
        wire=settings.wire, chips_n=settings.chips_n, options={"scan": told.scan},
        clock=Clock(kind="arrivals", rate_hz=None, marks=()), protocol="as the probe log says",
        note="recorded by reskin record; arrival times are unix seconds of the host",
    )  # fmt: skip
    part.mkdir(parents=True)
    io.write_text(part / HEADER_FILE, render(header))
    try:
        done = record(port, part, settings=settings, stop=threading.Event(), report=report)
    except CaptureError:
        io.remove(part)  # no frame came: there is nothing to keep
        raise
    seal(part, header)
    part.rename(folder)
    return done


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
