"""Record a board to a capture folder, with labels from prompts, a robot's CSV file, a force gauge or a program."""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from reskin.board.find import BAUD, DetectedBoard
from reskin.board.port import check_name
from reskin.errors import ParamsError
from reskin.live.health import Health
from reskin.recordings.header import Source
from reskin.recordings.label_sources import (
    RANDOM,
    SNAKE,
    ForceGauge,
    LabelSource,
    Prompts,
    from_gauge,
    from_table,
    parse_places,
)
from reskin.recordings.recorder import NO_INFO, new_folder, print_progress, record_capture
from reskin.recordings.stream_recorder import PortSettings
from reskin.seeds import rng_for

GAUGE_BAUD = 9600
SILENCE_S = NO_FRAME_S = 5.0


class RecordingResult(NamedTuple):
    """The folder of a finished recording, and a summary for the user."""

    folder: Path
    summary: str
    error: Exception | None  # exception of the label source that ended the recording, if any


def label_source(
    labels: str | None, gauge: str | None, scan: str | None, *, dwell_s: float, say: Callable[[str], object]
) -> LabelSource | None:
    """Create the source of labels from options of `reskin record`; return None if no labels are requested.

    Parameters
    ----------
    labels : places that the user is asked to press, such as `grid:5x5:4`, or a CSV file to which a robot appends labels
    gauge : port of a force gauge, `PORT` or `PORT@BAUD`
    scan : order of the prompts, "random" or "snake"; the default is "random"
    dwell_s : time for which a label from a prompt is valid
    say : called with the text of each prompt
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
        raise ParamsError(f"--scan: the order of prompts is {RANDOM} or {SNAKE}, not {scan}. The default is {RANDOM}.")
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
    names: Mapping[str, str] | None = None,
    source: Source = "recorded",
) -> RecordingResult:
    """Record a board until the user stops it, `seconds` have passed, the labels end, or the board is unplugged.

    Parameters
    ----------
    board : the port and its wire format
    labels : source of labels during the recording, if any
    folder : folder to create for the capture; the default is captures/DATE-TIME
    seconds : maximum duration
    baud : baud rate; USB ports ignore it
    names : values for the capture's header under the keys board and skin (names) and scan (order of the places)
    source : "simulated" if the port is an emulated board that sends a simulation
    """
    check_name(board.port)  # before a folder is created
    folder, health = folder or new_folder(), Health(board.chips_n)
    scan = {"scan": labels.scan} if labels is not None and labels.scan is not None else {}
    stated: dict[str, Any] = scan | dict(names or {})
    info = replace(NO_INFO, **stated, labels=labels, source=source)
    settings = PortSettings(
        baud, board.wire, board.chips_n, seconds, bytes_max_n=None, silence_s=SILENCE_S, no_frame_s=NO_FRAME_S
    )
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
