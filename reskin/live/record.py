"""Record a board to a capture folder, with labels.

`record_board` opens the board's port; its labels are from prompts, a robot's CSV file, a force gauge or a program.
`PageRecording` records a board that `reskin live` already reads; its labels are from the page.
"""

import re
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from reskin import io
from reskin.board.find import BAUD, DetectedBoard
from reskin.board.port import check_name
from reskin.board.reader import Reader
from reskin.errors import CaptureError, ParamsError
from reskin.live.emulator import Source
from reskin.live.health import Health
from reskin.live.tracker import Estimates
from reskin.recordings.header import HEADER_FILE, Clock, render
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
from reskin.recordings.labels import Dwell, DWELL_MIN_s, Label, ProbeLogWriter
from reskin.recordings.recorder import (
    NO_INFO,
    begin_capture,
    end_capture,
    new_folder,
    print_progress,
    record_capture,
)
from reskin.recordings.stream_recorder import CaptureWriter, PortSettings
from reskin.seeds import rng_for

GAUGE_BAUD = 9600
SILENCE_S = NO_FRAME_S = 5.0


class RecordingResult(NamedTuple):
    """The folder of a finished recording, and a summary for the user."""

    folder: Path
    summary: str
    error: Exception | None  # exception from the source of labels, which ended the recording


def label_source(
    labels: str | None, gauge: str | None, scan: str | None, *, dwell_s: float, say: Callable[[str], object]
) -> LabelSource | None:
    """Create the source of labels from options of `reskin record`; return None if no labels are requested.

    Parameters
    ----------
    labels : places for which the user is prompted, such as `grid:5x5:4`, or a CSV file to which a robot appends labels
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
) -> RecordingResult:
    """Record a board until the user stops it, `seconds` have passed, the labels end, or the board is unplugged.

    Parameters
    ----------
    board : the port and its wire format
    labels : source of labels during the recording, if any
    folder : folder to create for the capture; the default is captures/DATE-TIME
    seconds : maximum duration
    baud : baud rate; USB ports ignore it
    names : values for the capture's header: names of the board and the skin, and the order of places, under the keys
        board, skin and scan
    """
    check_name(board.port)  # before a folder is created
    folder, health = folder or new_folder(), Health(board.chips_n)
    scan = {"scan": labels.scan} if labels is not None and labels.scan is not None else {}
    settings = PortSettings(
        baud, board.wire, board.chips_n, seconds, bytes_max_n=None, silence_s=SILENCE_S, no_frame_s=NO_FRAME_S
    )
    stream, labels_summary, error = record_capture(
        board.port, folder, info=replace(NO_INFO, **(scan | dict(names or {})), labels=labels), settings=settings,
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
    counted = "; ".join([counts, *alarms, *([labels_summary] if labels_summary else [])])
    summary = f"recorded {where} ({stream.ended} after {stream.duration_s:.1f} s): {counted}"
    return RecordingResult(folder, summary, error)


# --- Recordings from the page of `reskin live` ---

# Assumed times of a labelled press. The no-load dwell ends before the contact, because the tip may approach slowly, and
# begins some time after the contact before, because the skin recovers.
REST_MAX_S, REST_MIN_S, RECOVERY_S, APPROACH_S = 1.0, 0.2, 0.3, 0.05
PLATEAU = 0.8  # assumed: the press is held while |dB| is at least this fraction of its maximum
PRESS_READINGS_MAX_N = 20_000  # readings of a press that are kept, to limit memory; 50 s at 400 Hz


class LabelledPress:
    """Finds the next press in a stream of estimates: the time in which it is held, and the rest before it.

    Parameters
    ----------
    label : place and force of the press
    learn : whether the model is calibrated to the press
    """

    def __init__(self, label: Label, *, learn: bool) -> None:
        self.label, self.learn = label, learn
        self.problem = ""  # why the latest press did not count
        self.rest_s: tuple[float, float] | None = None  # start and end of the no-load dwell before the press
        self.held_s: tuple[float, float] | None = None  # start and end of the time in which the press was held
        self.db_uT: Float64[np.ndarray, " ch"] | None = None  # mean field change while the press was held
        self._rest: tuple[float, float] | None = None  # first and last reading without contact before the press
        self._press: list[tuple[float, Float64[np.ndarray, " ch"]]] = []

    @property
    def complete(self) -> bool:
        return self.held_s is not None

    def add(self, estimates: Estimates) -> None:
        """Add the next readings. Faulty readings (NaN) are skipped and do not end a press."""
        known = np.isfinite(estimates.db_uT).all(axis=1)
        readings = zip(estimates.t_s[known].tolist(), estimates.db_uT[known], estimates.contact[known], strict=True)
        for t_s, db_uT, contact in readings:
            if self.complete:
                return
            if contact:
                if len(self._press) < PRESS_READINGS_MAX_N:
                    self._press.append((t_s, db_uT.astype(np.float64)))
            elif self._press:
                self._end_press()
                self._rest, self._press = (t_s, t_s), []
            else:
                self._rest = (self._rest[0] if self._rest else t_s, t_s)

    def _end_press(self) -> None:
        t_s = np.array([time_s for time_s, _ in self._press])
        db_uT = np.array([change_uT for _, change_uT in self._press])
        size_uT = np.linalg.norm(db_uT, axis=1)
        held = np.flatnonzero(size_uT >= PLATEAU * size_uT.max())
        first_s, last_s = float(t_s[held[0]]), float(t_s[held[-1]])
        if self._rest is None:
            self.problem = "the press had already begun; press again"
            return
        rest_end_s = self._rest[1] - APPROACH_S
        rest_start_s = max(self._rest[0] + RECOVERY_S, rest_end_s - REST_MAX_S)
        if rest_end_s - rest_start_s < REST_MIN_S:
            self.problem = "the skin had no rest before the press; lift for a second, then press again"
        elif last_s - first_s < DWELL_MIN_s:
            self.problem = "the press was too short; hold it for half a second"
        else:
            self.rest_s, self.held_s = (rest_start_s, rest_end_s), (first_s, last_s)
            self.db_uT = db_uT[held[0] : held[-1] + 1].mean(axis=0)


class PageRecording:
    """A recording of a board that `reskin live` reads, with labels from the page.

    `source` tells whether the board is emulated from a simulation. Raises `ReskinError` or `OSError` if the folder
    cannot be created.
    """

    def __init__(
        self, board: DetectedBoard, reader: Reader, *, port_in_name: bool, source: Source = "recorded"
    ) -> None:
        self.folder = new_folder()
        if port_in_name:  # two boards may start recording in the same second
            port = re.sub(r"[^A-Za-z0-9]+", "-", board.port).strip("-")
            self.folder = self.folder.with_name(f"{self.folder.name}-{port}")
        self._part, self._header = begin_capture(
            self.folder, NO_INFO, wire=board.wire, chips_n=board.chips_n, by="reskin live"
        )
        if source != self._header.source:
            self._change_header(source=source)
        self._reader = reader
        self._labels: ProbeLogWriter | None = None
        self._begun_s = reader.unix_s()
        reader.write_to(CaptureWriter(self._part, board.wire))

    @property
    def touches_n(self) -> int:
        """Number of labelled presses."""
        return self._labels.touches_n if self._labels is not None else 0

    @property
    def seconds(self) -> float:
        return self._reader.unix_s() - self._begun_s

    def add(self, press: LabelledPress) -> None:
        """Write the label of a press to the probe log.

        Raises
        ------
        CaptureError
            If the rest before the press is not in the recording.
        OSError
            If the log cannot be written.
        """
        if press.rest_s is None or press.held_s is None or press.rest_s[0] < self._begun_s:
            raise CaptureError("not recorded: the recording began after the rest before this press. Press again.")
        if self._labels is None:  # a capture without labels has no probe log
            self._labels = ProbeLogWriter(self._part)
            # Labels and arrivals are on the same clock, so one mark with equal times aligns them.
            clock = Clock(kind="arrivals", rate_hz=None, marks=((self._begun_s, self._begun_s),))
            options = self._header.options | {"labels": "page"}
            self._change_header(clock=clock, options=options)
        self._labels.write_all([Dwell(Label(False), *press.rest_s), Dwell(press.label, *press.held_s)])

    def _change_header(self, **changes: object) -> None:
        self._header = self._header.model_copy(update=changes)
        io.write_text(self._part / HEADER_FILE, render(self._header))

    def end(self) -> str:
        """Finish the capture; return a text for the user. Raises `OSError` if the header cannot be written."""
        self._reader.write_to(None)
        if self._labels is not None:
            self._labels.close()
        end_capture(self.folder, self._header)
        return f"recorded {self.folder}" + (f", labelled presses: {self.touches_n}" if self._labels else "")
