"""Record a board to a capture folder for `reskin add`, together with the labels of a label source, if there is one.

During the recording, the capture is the folder `<folder>.part`, which contains the header from the start. When the
recording has ended, the folder is renamed. If the recorder is killed, the `.part` folder remains. It can still be
added, with the data and labels that were received before.
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
from reskin.board.custom import AnyWire
from reskin.board.rates import RateMeasurement
from reskin.errors import CaptureError
from reskin.recordings.header import HEADER_FILE, Clock, Header, Rate, Source, make_header, render, seal
from reskin.recordings.label_sources import LabelContext, LabelSource, LabelThread
from reskin.recordings.labels import ProbeLogWriter
from reskin.recordings.preparing import UNNAMED
from reskin.recordings.stream_recorder import PortSettings, Recording, Report, Watch, record

PROGRESS_s = 1.0
CAPTURES = Path("captures")


@dataclass(frozen=True)
class CaptureInfo:
    """What a recorder must know about a capture: the names for its header, and the source of its labels."""

    board: str
    skin: str
    scan: str  # order of the places: random, snake or other text
    labels: LabelSource | None = None
    source: Source = "recorded"  # "simulated" if the port is an emulated board that sends a simulation


class CaptureResult(NamedTuple):
    """The result of a finished recording: the summaries of its stream and of its labels."""

    stream: Recording
    labels: str  # a summary of the labels for the user
    failed: Exception | None  # the exception that ended the source of labels, if any


NO_INFO = CaptureInfo(UNNAMED, UNNAMED, "not stated")


def record_capture(
    port: str, folder: Path, *, info: CaptureInfo, settings: PortSettings, report: Report, watch: Watch
) -> CaptureResult:
    """Record a port to a capture folder, together with labels if `info` has a source of labels.

    The recording stops when the stream of the port ends, or when the source of labels ends.
    """
    part, header = begin_capture(folder, info, wire=settings.wire, chips_n=settings.chips_n, by="reskin record")
    stop, headers, label_thread = threading.Event(), [header], None
    try:
        if info.labels is not None:
            label_thread = LabelThread(info.labels, _label_context(part, headers, stop))
        recording = record(port, part, settings=settings, stop=stop, report=report, watch=watch)
    except CaptureError as error:
        if label_thread is not None:
            label_thread.end()
        io.remove(part)  # no frame arrived, so there is nothing to keep
        # If the source of labels failed, it ended the recording, so its error is the cause.
        if label_thread is not None and label_thread.failed is not None:
            raise label_thread.failed from error
        raise
    summary = label_thread.end() if label_thread is not None else ""
    failed = label_thread.failed if label_thread is not None else None
    if isinstance(failed, OSError) and failed.errno == ENOSPC:
        recording = replace(recording, ended="not written")
    # If the disk is full, the header may not be writable. The .part folder is kept, and can be added as it is.
    if recording.ended != "not written":
        end_capture(folder, headers[-1], recording.rate)
    return CaptureResult(recording, summary, failed)


def _label_context(part: Path, headers: list[Header], stop: threading.Event) -> LabelContext:
    """Make the context of a source of labels.

    A first sync mark is written to the header. It states that the times of labels and of arrivals are from the same
    clock. If the source has a clock of its own, it calls `mark` to replace this mark.
    """
    # This offset is determined only once, so that times stay consistent if the system's clock is adjusted meanwhile.
    offset_s = time.time() - time.monotonic()
    writer = ProbeLogWriter(part)

    def unix_s() -> float:
        return offset_s + time.monotonic()

    def mark(stream_s: float, source_s: float) -> None:
        with writer.locked() as is_open:
            if is_open:  # after the writer was closed, the header must not be changed any more
                clock = headers[-1].clock.model_copy(update={"marks": ((stream_s, source_s),)})
                headers[-1] = headers[-1].model_copy(update={"clock": clock})
                io.write_text(part / HEADER_FILE, render(headers[-1]))

    now_s = unix_s()
    mark(now_s, now_s)
    return LabelContext(writer, unix_s, stop, mark)


def begin_capture(folder: Path, info: CaptureInfo, *, wire: AnyWire, chips_n: int, by: str) -> tuple[Path, Header]:
    """Create the folder `<folder>.part` and its header; return the path of this folder, and the header.

    `by` is the name of the recording program, which becomes part of the note in the header.
    """
    part = _part_of(folder)
    for path in (folder, part):
        if path.exists():
            raise CaptureError(f"{path}: the folder exists already. Choose another --out.")
    options = {"scan": info.scan} | ({"labels": info.labels.name} if info.labels is not None else {})
    header = make_header(
        f"--out {folder.name}", capture=folder.name, source=info.source, board=info.board, skin=info.skin,
        layout="native",
        wire=wire, chips_n=chips_n, options=options,
        clock=Clock(kind="arrivals", rate_hz=None, marks=()), protocol="as the probe log says",
        note=f"recorded by {by}; arrival times are unix seconds of the host",
    )  # fmt: skip
    io.make_folder(part.parent)
    part.mkdir()
    io.write_text(part / HEADER_FILE, render(header))
    return part, header


def end_capture(folder: Path, header: Header, rate: RateMeasurement) -> None:
    """Complete the header of `<folder>.part` with the rate and the hashes of the files, and rename the folder."""
    measured = None
    if rate.known:
        measured = Rate.model_validate({name: getattr(rate, name) for name in Rate.model_fields})
    seal(_part_of(folder), header.model_copy(update={"rate": measured}))
    _part_of(folder).rename(folder)


def _part_of(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.part")


def new_folder() -> Path:
    """Return the path of a new capture folder, named after the current time."""
    return CAPTURES / time.strftime("%Y%m%d-%H%M%S")


def print_progress(alarms: Callable[[], Sequence[str]]) -> Report:
    """Return a function for the argument `report` of `record_capture`.

    The function prints the frame rate, the number of lost bytes and the alarms to stderr once a second, if stderr is a
    terminal. `alarms` is a function that returns the current alarms.
    """
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
