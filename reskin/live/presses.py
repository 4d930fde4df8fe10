"""Presses that the page of `reskin live` asks for: for a calibration, at shown places, or with a label of the user.

`PageRecording` writes the byte stream and the labels of a recording that was started on the page.
"""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from reskin.board.find import DetectedBoard
from reskin.board.port import Reader
from reskin.errors import CaptureError
from reskin.live.tracker import Estimates
from reskin.recordings.header import Clock, Source, write_header
from reskin.recordings.labels import Dwell, DWELL_MIN_s, Label, ProbeLogWriter
from reskin.recordings.recorder import CaptureInfo, CaptureWriter, begin_capture, end_capture, new_folder
from reskin.seeds import rng_for
from reskin.universal.layout import BoardLayout, paper_layout

PRESSES_N = 12  # number of presses anywhere for a calibration
# The places for guided presses form a square grid. These are their coordinates along x and along y, relative to the
# board's centre and as fractions of half the width of the sensing area.
GUIDED = 0.375 * np.array([-1.5, -0.5, 0.5, 1.5])
READINGS_MIN_N = 4  # a contact with fewer readings is not counted as a press
# Each labelled press has a no-load dwell, which is a time without contact before the press. The following times are
# assumed. The dwell begins RECOVERY_S or more after the previous contact, because the skin needs time to recover. It
# ends APPROACH_S before the press, because the tip may touch the skin slowly. It lasts between REST_MIN_S and
# REST_MAX_S.
REST_MAX_S, REST_MIN_S, RECOVERY_S, APPROACH_S = 1.0, 0.2, 0.3, 0.05
# A press is considered to be held while |dB| is at least this fraction of its maximum in the press. The value is
# assumed.
PLATEAU = 0.8
# Largest number of readings that are stored for one press, to limit the use of memory. At 400 Hz, these are the
# readings of 50 s.
PRESS_READINGS_MAX_N = 20_000


@dataclass(frozen=True)
class LabelledPress:
    """A press whose place is known, and perhaps its force."""

    label: Label
    rest_s: tuple[float, float]  # start and end of the no-load dwell before the press
    held_s: tuple[float, float]  # start and end of the time in which the press was held
    db_uT: Float64[np.ndarray, " ch"]  # mean field change while the press was held


@dataclass(frozen=True)
class Press:
    """The n readings of a contact that has ended."""

    t_s: Float64[np.ndarray, " n"]
    db_uT: Float64[np.ndarray, "n ch"]
    # times of the first and the last reading without contact before the press; None if there is no such reading
    before_s: tuple[float, float] | None

    @property
    def strongest_uT(self) -> Float64[np.ndarray, " ch"]:
        """The largest field change."""
        return self.db_uT[np.linalg.norm(self.db_uT, axis=1).argmax()]

    def label(self, label: Label) -> LabelledPress:
        """Find the time in which the press was held, and the no-load dwell before it.

        Raises CaptureError with a text for the user if the press cannot be used with a label.
        """
        if self.before_s is None:
            raise CaptureError("the press had begun before the label was entered; lift, then press again")
        rest_end_s = self.before_s[1] - APPROACH_S
        rest_start_s = max(self.before_s[0] + RECOVERY_S, rest_end_s - REST_MAX_S)
        if rest_end_s - rest_start_s < REST_MIN_S:
            raise CaptureError("the skin was touched shortly before the press; lift for a second, then press again")
        size_uT = np.linalg.norm(self.db_uT, axis=1)
        held = np.flatnonzero(size_uT >= PLATEAU * size_uT.max())
        first, last = held[0], held[-1]
        if self.t_s[last] - self.t_s[first] < DWELL_MIN_s:
            raise CaptureError("the press was too short; press again, and hold the press for half a second")
        held_s = (float(self.t_s[first]), float(self.t_s[last]))
        return LabelledPress(label, (rest_start_s, rest_end_s), held_s, self.db_uT[first : last + 1].mean(axis=0))


class PressFinder:
    """Finds the presses in a stream of estimates."""

    def __init__(self) -> None:
        self._before_s: tuple[float, float] | None = None
        self._contact: list[tuple[float, Float64[np.ndarray, " ch"]]] = []  # readings of the contact in progress

    def add(self, estimates: Estimates) -> list[Press]:
        """Add the next readings; return the presses that have ended.

        Faulty readings, which are NaN, are skipped and do not end a press.
        """
        presses = []
        known = np.isfinite(estimates.db_uT).all(axis=1)
        readings = zip(estimates.t_s[known].tolist(), estimates.db_uT[known], estimates.contact[known], strict=True)
        for t_s, db_uT, contact in readings:
            if contact:
                if len(self._contact) < PRESS_READINGS_MAX_N:
                    self._contact.append((t_s, db_uT.astype(np.float64)))
            elif self._contact:
                times_s, changes_uT = zip(*self._contact, strict=True)
                presses.append(Press(np.array(times_s), np.array(changes_uT), self._before_s))
                self._before_s, self._contact = (t_s, t_s), []
            else:
                self._before_s = (self._before_s[0] if self._before_s else t_s, t_s)
        return presses


class NextPress(PressFinder):
    """Waits for the next press, for which the user has entered a label.

    If `learn` is set, the model is calibrated to the press.
    """

    def __init__(self, label: Label, *, learn: bool) -> None:
        super().__init__()
        self.label, self.learn = label, learn
        self.problem = ""  # text for the user that states why the latest press was not accepted


class Presses(PressFinder):
    """Collects presses for a calibration. For each press, the largest field change is stored."""

    def __init__(self, presses_n: int = PRESSES_N) -> None:
        super().__init__()
        self.presses_n = presses_n
        self._strongest_uT: list[Float64[np.ndarray, " ch"]] = []

    def __len__(self) -> int:
        return len(self._strongest_uT)

    @property
    def complete(self) -> bool:
        return len(self) >= self.presses_n

    @property
    def instruction(self) -> str:
        """The text that tells the user which press is next, and where."""
        return f"press {len(self) + 1} of {self.presses_n}, anywhere"

    @property
    def next_mm(self) -> list[float] | None:
        """x and y in mm of the place that the user should press next; None if the user may press anywhere."""
        return None

    @property
    def db_uT(self) -> Float64[np.ndarray, "n ch"]:
        return np.array(self._strongest_uT)

    def add(self, estimates: Estimates) -> list[Press]:
        """Add the next readings; return the presses that were collected."""
        presses = [press for press in super().add(estimates) if len(press.t_s) >= READINGS_MIN_N]
        presses = presses[: self.presses_n - len(self)]
        self._strongest_uT += [press.strongest_uT for press in presses]
        return presses


class GuidedPresses(Presses):
    """Collects presses at places of a grid. The page shows these places one by one in random order.

    Every second press is held out: it is not used for the calibration, but to measure the error of the calibrated
    model.
    """

    def __init__(self, board: BoardLayout | None = None) -> None:
        board = board or paper_layout()
        grid_mm = (
            np.array(board.centre_mm) + np.stack(np.meshgrid(GUIDED, GUIDED), axis=-1).reshape(-1, 2) * board.half_mm
        )
        self.place_mm = rng_for(0, "shown places").permutation(grid_mm)
        super().__init__(len(self.place_mm))

    @property
    def instruction(self) -> str:
        return f"press {len(self) + 1} of {self.presses_n}, at the cross"

    @property
    def next_mm(self) -> list[float] | None:
        return None if self.complete else self.place_mm[len(self)].tolist()

    @property
    def held_out(self) -> Bool[np.ndarray, " n"]:
        return np.arange(self.presses_n) % 2 == 1


class PageRecording:
    """A recording that the user has started on the page of `reskin live`, with labels that are entered on the page.

    With several boards, the name of the folder must contain the port (`port_in_name`). Raises ReskinError or OSError if
    the folder cannot be created.
    """

    def __init__(
        self, board: DetectedBoard, reader: Reader, *, port_in_name: bool, source: Source = "recorded"
    ) -> None:
        self.folder = new_folder()
        if port_in_name:  # without the port, two recordings that start in the same second would have the same name
            port = re.sub(r"[^A-Za-z0-9]+", "-", board.port).strip("-")
            self.folder = self.folder.with_name(f"{self.folder.name}-{port}")
        self._part, self._header = begin_capture(
            self.folder, CaptureInfo(source=source), wire=board.wire, chips_n=board.chips_n, by="reskin live"
        )
        self._reader = reader
        self._labels: ProbeLogWriter | None = None
        self._begun_s = reader.unix_s()
        self._writer = CaptureWriter(self._part, board.wire, board.chips_n)
        reader.write_to(self._writer)

    @property
    def touches_n(self) -> int:
        """Number of labelled presses."""
        return self._labels.touches_n if self._labels is not None else 0

    def add(self, press: LabelledPress) -> None:
        """Write the label of a press to the probe log, which is the file of the recording's labels.

        Raises CaptureError if the time without contact before the press is not in the recording.
        """
        if press.rest_s[0] < self._begun_s:
            raise CaptureError(
                "not recorded: the recording has no reading without contact before this press. Press again."
            )
        if self._labels is None:  # a capture without labels has no probe log
            self._labels = ProbeLogWriter(self._part)
            # The times of the labels and of the arriving bytes are from the same clock. To align them, it is therefore
            # enough to state for one moment that both clocks show the same time.
            clock = Clock(kind="arrivals", rate_hz=None, marks=((self._begun_s, self._begun_s),))
            options = self._header.options | {"labels": "page"}
            self._change_header(clock=clock, options=options)
        self._labels.write_all([Dwell(Label(False), *press.rest_s), Dwell(press.label, *press.held_s)])

    def _change_header(self, **changes: object) -> None:
        self._header = self._header.model_copy(update=changes)
        write_header(self._part, self._header)

    def end(self) -> str:
        """Finish the recording; return a text for the user. Raises OSError if the header cannot be written."""
        problem = self._reader.writer_problem
        self._reader.write_to(None)
        if self._labels is not None:
            self._labels.close()
        end_capture(self.folder, self._header, self._writer.rate())
        text = f"recorded {self.folder}" + (f", labelled presses: {self.touches_n}" if self._labels else "")
        return f"{text}; the recording ends early: it {problem}" if problem else text
