"""Record a board to a capture folder, optionally with labels.

The labels can come from prompts that ask the user to press given places, from a CSV file that a robot writes, from a
force gauge, or from a program.
"""

import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from reskin.board.find import DetectedBoard
from reskin.board.port import BAUD, check_name
from reskin.errors import ParamsError
from reskin.live.health import Health
from reskin.recordings.header import Source
from reskin.recordings.labels import (
    RANDOM,
    SNAKE,
    ForceGauge,
    LabelSource,
    Prompts,
    from_gauge,
    from_table,
    parse_places,
)
from reskin.recordings.recorder import CaptureInfo, PortSettings, new_folder, print_progress, record_capture
from reskin.seeds import rng_for

GAUGE_BAUD = 9600
SILENCE_S = NO_FRAME_S = 5.0  # a recording ends if no data, or no complete frame, arrives for this time


class RecordingResult(NamedTuple):
    """The result of a recording that has ended."""

    folder: Path
    summary: str  # text for the user
    error: Exception | None  # the exception, if the source of the labels ended the recording by raising an exception


def label_source(
    labels: str | None, gauge: str | None, scan: str | None, *, dwell_s: float, say: Callable[[str], object]
) -> LabelSource | None:
    """Create the source of labels for the options of `reskin record`; return None if no labels are requested.

    `labels` is a text such as grid:5x5:4, or the name of a CSV file to which a robot appends labels. `gauge` is PORT or
    PORT@BAUD. `say` is called with the text of each prompt.
    """
    port, _, baud = (gauge or "").partition("@")
    if baud and not baud.isdecimal():
        raise ParamsError(f"--gauge: {gauge} is not PORT or PORT@BAUD. Try: --gauge /dev/ttyUSB0@9600")
    if gauge:
        check_name(port)
    gauge_baud = int(baud or GAUGE_BAUD)
    if labels is None:
        return from_gauge(port, gauge_baud) if gauge else None
    if (places := parse_places(labels)) is None:
        if Path(labels).suffix != ".csv" or gauge:
            raise ParamsError(
                f"--labels: {labels} is not grid:NXxNY:STEP_MM, line:N:STEP_MM, or a .csv file (without --gauge). "
                "Try: --labels grid:5x5:4"
            )
        return from_table(Path(labels))
    if scan not in (None, RANDOM, SNAKE):
        raise ParamsError(f"--scan: the order of prompts must be {RANDOM} (default) or {SNAKE}, not {scan}.")
    forces = ForceGauge(port, gauge_baud) if gauge else None
    rng = rng_for(time.time_ns() % 2**31, "prompts")
    return Prompts(places, dwell_s, say, lambda: sys.stdin, forces, rng, scan or RANDOM).source()


def record_board(
    board: DetectedBoard,
    labels: LabelSource | None,
    *,
    folder: Path | None = None,
    seconds: float = float("inf"),
    baud: int = BAUD,
    names: Mapping[str, str | None] | None = None,
    source: Source = "recorded",
) -> RecordingResult:
    """Record a board until the user stops it, `seconds` have passed, the labels end, or the board is unplugged.

    Parameters
    ----------
    folder : folder that is created for the capture; captures/DATE-TIME by default
    baud : baud rate, which USB ports ignore
    names : values for the capture's header: the keys `board` and `skin` have the names of the board and the skin, and
        the key `scan` has the order of the places; None if a value is unknown
    source : "simulated" if an emulated board sends a simulation to the port
    """
    check_name(board.port)  # before a folder is created
    folder, health = folder or new_folder(), Health(board.chips_n)
    scan = {"scan": labels.scan} if labels is not None and labels.scan is not None else {}
    stated: dict[str, Any] = scan | {key: name for key, name in (names or {}).items() if name is not None}
    info = CaptureInfo(**stated, labels=labels, source=source)
    settings = PortSettings(baud, board.wire, board.chips_n, seconds, silence_s=SILENCE_S, no_frame_s=NO_FRAME_S)
    stream, labels_summary, error = record_capture(
        board.port, folder, info=info, settings=settings,
        report=print_progress(lambda: [alarm.name for alarm in health.active(time.monotonic())]),
        watch=lambda frames: health.feed(frames, time.monotonic()),
    )  # fmt: skip
    counts = ", ".join(f"{key} {count}" for key, count in stream.account.items() if count)
    alarms = [
        f"{alarm.name} ({alarm.count_n}, {alarm.last_s - alarm.first_s:.1f} s)" for alarm in health.alarms.values()
    ]
    where = str(folder)
    if stream.ended == "not written":
        folder = folder.with_name(f"{folder.name}.part")
        where = f"{folder}, which is incomplete because writing failed"
    rate = stream.rate
    measured = [f"{rate.arrived_hz:.1f} Hz, {rate.repeated_readings:.1%} of readings repeat"] if rate.known else []
    counted = "; ".join([counts, *measured, *alarms, *([labels_summary] if labels_summary else [])])
    summary = f"recorded {where} ({stream.ended} after {stream.duration_s:.1f} s): {counted}"
    return RecordingResult(folder, summary, error)
