"""One board on the page of `reskin live`.

A session consists of the thread that estimates contacts, the messages to the page, and the actions of the page's
buttons.
"""

import math
import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from reskin.board.other_firmware import CustomWire
from reskin.errors import CaptureError, ParamsError, ReskinError, SchemaError
from reskin.live.emulator import EmulatedBoard
from reskin.live.health import LIVE_POLICY
from reskin.live.models import Models, SkinFolder, UniversalEstimator
from reskin.live.presses import GuidedPresses, LabelledPress, NextPress, PageRecording, Press, Presses
from reskin.live.tracker import WAITING, Estimates, Layout, LiveSkin, check_ports
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.labels import Label

POLL_S = 0.1
# If there are several boards, the frames of a board are collected for this time and then estimated together. This needs
# less computing time than estimating every frame on arrival. The delay is not visible, because pages are redrawn at
# most 30 times per second.
GATHER_S = 0.02

# Duration of the traces (the curves of force and field change over time) and width of a bin of the traces. Both must
# equal the values in page/trace.js.
WINDOW_S, BIN_S = 10.0, 0.02
BINS_N = round(WINDOW_S / BIN_S)
# Number of latest latencies from which the page's statistics are computed. At 400 Hz, these are the latencies of 10 s.
LATENCIES_N = 4000
UNCONFIRMED_MAX_N = 64  # largest number of sent messages for which a page's confirmation is expected
UNKNOWN_CONTACT = (math.nan,) * 3
# The head of a binary message: message number, number of chips, number of bins, and time of the last reading.
HEAD = struct.Struct("<IHHd")
# The head is followed by these numbers: x_mm, y_mm, F_N, the standard deviations of x, y and F, whether there is
# contact, the frame rate, the number of lost bytes, four latencies in ms, the number of dropped frames, and the true x,
# y and F of an emulated board. The last three numbers are NaN for real boards, and while nothing touches the skin.
NUMBERS_N = 17


class Traces:
    """The data for the curves on the page: force and field changes over the last ten seconds.

    The time is divided into bins of 20 ms. For each bin, the minimum and the maximum of each curve are stored.
    """

    def __init__(self, layout: Layout, start_s: float) -> None:
        self._layout, self._start_s = layout, start_s
        self._chips_n = len(layout.chips_mm)
        # The bins are stored in a ring buffer. This is the number of the bin in each slot, or -1 for an empty slot.
        self._bin = np.full(BINS_N, -1)
        # The columns are the force in N, followed by |dB| of each chip in uT.
        self._low = np.full((BINS_N, 1 + self._chips_n), np.nan, np.float32)
        self._high = self._low.copy()
        self._last: Estimates | None = None
        self._message_i = 0
        self._unconfirmed: deque[tuple[int, float]] = deque(maxlen=UNCONFIRMED_MAX_N)
        self.to_estimate_s: deque[float] = deque(maxlen=LATENCIES_N)
        self.to_screen_s: deque[float] = deque(maxlen=LATENCIES_N)

    @property
    def newest_bin(self) -> int:
        return int(self._bin.max())

    def add(self, estimates: Estimates, now_s: float) -> None:
        """Add estimates to the bins of their arrival times. `now_s` is the time at which they were computed."""
        self._last = estimates
        self.to_estimate_s.extend((now_s - estimates.t_s).tolist())
        chips_uT = np.linalg.norm(estimates.db_uT.reshape(len(estimates), -1, 3), axis=2)
        values = np.column_stack([estimates.target[:, 2], chips_uT]).astype(np.float32)
        bins = ((estimates.t_s - self._start_s) / BIN_S).astype(int)
        for number in np.unique(bins):
            rows, i = values[bins == number], number % BINS_N
            if self._bin[i] != number:
                self._bin[i], self._low[i], self._high[i] = number, np.nan, np.nan
            self._low[i] = np.fmin(self._low[i], np.fmin.reduce(rows))
            self._high[i] = np.fmax(self._high[i], np.fmax.reduce(rows))

    def message(
        self,
        after_bin: int,
        *,
        rate_hz: float,
        lost_bytes_n: int,
        dropped_frames_n: int = 0,
        true_contact: Sequence[float] = UNKNOWN_CONTACT,
    ) -> bytes:
        """Return a binary message with the last reading and with all bins from `after_bin` on.

        The bin `after_bin` was already sent with the previous message. It is sent again, because readings may have been
        added to it since then. If there is no reading yet, the message is empty. `true_contact` is the true x_mm, y_mm
        and F_N of an emulated board.
        """
        last = self._last
        if last is None:
            return b""
        self._message_i += 1
        self._unconfirmed.append((self._message_i, float(last.t_s[-1])))
        newest = self.newest_bin
        numbers = np.arange(max(after_bin, newest - BINS_N + 1, 0), newest + 1)
        numbers = numbers[self._bin[numbers % BINS_N] == numbers]  # drop bins without readings
        i = numbers % BINS_N
        latencies_ms = [
            1e3 * np.percentile(times_s, [50, 99]) if times_s else np.full(2, np.nan)
            for times_s in (self.to_estimate_s, self.to_screen_s)
        ]
        now = [*last.target[-1], *last.sd_mm[-1], last.sd_F_N[-1], last.contact[-1], rate_hz, lost_bytes_n]
        change_uT = np.einsum("kij,kj->ki", self._layout.turn, last.db_uT[-1].reshape(-1, 3).astype(np.float64))
        t_s = float(last.t_s[-1]) - self._start_s
        head = HEAD.pack(self._message_i % 2**32, self._chips_n, len(i), t_s)
        parts = [
            np.array(now),
            *latencies_ms,
            np.array([dropped_frames_n, *true_contact]),
            change_uT.ravel(),
            # The times of the bins are relative to the last reading. After several days, the time since the start would
            # be so large that a float32 could not resolve 20 ms.
            numbers * BIN_S - t_s,
            self._low[i].ravel(),
            self._high[i].ravel(),
        ]
        return head + np.concatenate(parts).astype("<f4").tobytes()

    def bins_of(self, times_s: Sequence[float]) -> list[int]:
        """Return the number of the bin that contains each of the given times."""
        return [int((t_s - self._start_s) / BIN_S) for t_s in times_s]

    def confirm(self, message_i: int, now_s: float) -> None:
        """Store the latency of a message that a page has drawn.

        The latency is the time from the arrival of the last reading in the message until now.
        """
        for sent_i, t_s in self._unconfirmed:
            if sent_i == message_i:
                self.to_screen_s.append(now_s - t_s)


CHANGES_MAX_N = 4  # largest number of requested changes of the model that wait
ADAPTING = ("adapt", "places")  # names of the buttons that start the collection of presses
# Limits of the labels that the user enters. They are so large that only labels in a wrong unit exceed them.
PLACE_MAX_MM, FORCE_MAX_N = 1000.0, 1000.0


class Session:
    """One board on the page.

    A session has a thread that polls the board (reads the new data and estimates contacts). It stores the traces, the
    current recording and the current calibration of the board.

    Parameters
    ----------
    source : description of the board, which is displayed on the page
    alone : whether this is the only board on the page
    model_name : name of the model's file; empty for the model that is shipped with the package
    emulated : the emulated board at the port; None for a real board, whose true contacts are unknown
    wire : format of the board, if it is none of those that are detected
    """

    def __init__(
        self,
        port: str,
        models: Models,
        source: str,
        fault_policy: FaultPolicy = LIVE_POLICY,
        *,
        alone: bool = True,
        skins: SkinFolder | None = None,
        model_name: str = "",
        emulated: EmulatedBoard | None = None,
        wire: CustomWire | None = None,
    ) -> None:
        self.skin, self.source = LiveSkin(port, models, fault_policy=fault_policy, wire=wire), source
        self._model_name, self._alone, self._emulated, self._skins = model_name, alone, emulated, skins or SkinFolder()
        self.traces: Traces | None = None
        self._error = ""
        self._task: Presses | NextPress | None = None  # what the user is asked to press now
        self._doubtful_press: LabelledPress | None = None  # contradicts the model; the user may keep or discard it
        self._adapted = self._labelled = ""  # texts for the user about the last calibration and the last labelled press
        self._recording: PageRecording | None = None
        self._recorded = ""
        # Changes of the model that the page has requested. They are made by the thread that polls the board, because
        # this thread also uses the model for estimates.
        self._changes: deque[Callable[[UniversalEstimator], str]] = deque()
        self._lock, self._button_lock, self._stop = threading.Lock(), threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="estimates", daemon=True)

    def __str__(self) -> str:
        return f"{self.source} on {self.skin.port}"

    def start(self) -> None:
        self.skin.reader.start(must_exist=False)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self._end_recording()
        self.skin.reader.stop()

    def _run(self) -> None:
        """Poll the board until `stop` is called.

        An error ends the thread. Its text is then displayed as an alarm.
        """
        try:
            while not self._stop.is_set():
                estimates = self.skin.poll(POLL_S)
                self._change_model()
                if estimates is not None:
                    now_s = self.skin.reader.unix_s()
                    task = self._task
                    if isinstance(task, Presses):
                        self._collect(task, estimates)
                    elif task is not None:
                        for press in task.add(estimates):
                            self._label(task, press)
                    with self._lock:
                        self.traces = self.traces or Traces(self.skin.layout, now_s - 1.0)
                        self.traces.add(estimates, now_s)
                if not self._alone:
                    self._stop.wait(GATHER_S)
        except ReskinError as error:
            self._error = str(error)
        except Exception as error:  # an unexpected error, for example in the code of a model
            self._error = f"estimation stopped: {error!r}"

    def _change_model(self) -> None:
        """Make a change of the model that the page has requested, such as loading a saved skin."""
        if self._changes:
            change, estimator = self._changes.popleft(), self.skin.estimator
            try:
                if not isinstance(estimator, UniversalEstimator):
                    raise ParamsError(
                        "only the universal model can be calibrated on this page, but another model is in use."
                    )
                if not self.skin.zeroed:
                    raise ParamsError("there is no no-load reading yet; wait for it, then try again.")
                self._adapted = change(estimator)
            except (ReskinError, OSError) as error:
                self._adapted = str(error)

    def _collect(self, presses: Presses, estimates: Estimates) -> None:
        """Add readings to the presses that are being collected.

        If there is a recording, the labels of guided presses are also written to the recording. When there are enough
        presses, the universal model is calibrated. Bytes that arrive during the calibration are not lost, because they
        stay in the reader's buffer.
        """
        estimator, before_n = self.skin.estimator, len(presses)
        if not isinstance(estimator, UniversalEstimator):
            return
        for i, press in enumerate(presses.add(estimates), start=before_n):
            if isinstance(presses, GuidedPresses):
                self._record_guided(presses, i, press)
        if presses.complete:
            try:
                if isinstance(presses, GuidedPresses):
                    self._adapted = estimator.label(presses.place_mm, presses.db_uT, presses.held_out)
                else:
                    self._adapted = estimator.adapt(presses.db_uT)
            except SchemaError as error:  # raised if no press changed the field
                self._adapted = str(error)
            with self._button_lock:  # the user may have started another collection during the calibration
                if self._task is presses:
                    self._task = None

    def _record_guided(self, presses: GuidedPresses, i: int, press: Press) -> None:
        """Write the label of the i-th guided press to the recording, if there is one."""
        with self._button_lock:
            if self._recording is not None:
                x_mm, y_mm = presses.place_mm[i].tolist()
                try:
                    self._recording.add(press.label(Label(True, x_mm=x_mm, y_mm=y_mm)))
                    self._labelled = ""
                except (ReskinError, OSError) as error:
                    self._labelled = f"press {i + 1} of {presses.presses_n} has no label in the recording: {error}"

    def _label(self, task: NextPress, press: Press) -> None:
        """Use a press for the label that the user has entered, or state why the press cannot be used.

        The label is written to the recording, if there is one, and the model is calibrated to the press, if the user
        has requested this.
        """
        try:
            labelled = press.label(task.label)
        except CaptureError as error:
            task.problem = str(error)
            return
        estimator, doubt = self.skin.estimator, ""
        if task.learn and isinstance(estimator, UniversalEstimator):
            doubt = estimator.contradiction((task.label.x_mm, task.label.y_mm), labelled.db_uT)
        with self._button_lock:
            if self._task is not task:  # the user has cancelled the label, or an earlier press was used for it
                return
            self._task, self._doubtful_press = None, labelled if doubt else None
            if doubt:
                self._labelled = f"press {_place(task.label)}: {doubt}"
                return
        self._use_label(labelled, learn=task.learn)

    def _use_label(self, press: LabelledPress, *, learn: bool) -> None:
        """Write a label to the recording, if there is one; calibrate the model to the press if `learn` is set."""
        done, estimator = [], self.skin.estimator
        with self._button_lock:
            try:
                if self._recording is not None:
                    self._recording.add(press)
                    done.append(f"recorded as labelled press {self._recording.touches_n}")
            except (ReskinError, OSError) as error:
                done.append(str(error))
        if learn and isinstance(estimator, UniversalEstimator):
            try:
                done.append(estimator.add_label((press.label.x_mm, press.label.y_mm), press.label.Fz_N, press.db_uT))
            except ReskinError as error:
                done.append(f"not used for calibration: {error}")
        self._labelled = f"press {_place(press.label)}: {'; '.join(done) or 'neither recorded nor used'}"

    def _use_doubtful_label(self, _: UniversalEstimator) -> str:
        press, self._doubtful_press = self._doubtful_press, None
        if press is not None:
            self._use_label(press, learn=True)
        return self._adapted

    def message(self, after_bin: int) -> tuple[bytes, int]:
        """Return the next binary message for the page, and the number of the newest bin.

        A bin is a short interval of time; the page draws one point per bin. The message contains the bins from
        `after_bin` on. It is empty if no data have arrived yet.
        """
        with self._lock:
            if self.traces is None:
                return b"", 0
            data = self.traces.message(
                after_bin,
                rate_hz=self.skin.health.rate_hz,
                lost_bytes_n=self.skin.lost_bytes_n,
                dropped_frames_n=self.skin.dropped_frames_n,
                true_contact=UNKNOWN_CONTACT if self._emulated is None else self._emulated.true_contact(),
            )
            return data, self.traces.newest_bin

    def state(self) -> dict[str, Any]:
        """Return the state of the board as the JSON message that `page/live.js` displays.

        The message contains the texts on the page, the alarms, and the layout of the board.
        """
        skin, detected, recording, traces = self.skin, self.skin.detected, self._recording, self.traces
        task = self._task
        presses, labelling = task if isinstance(task, Presses) else None, task if isinstance(task, NextPress) else None
        alarms = [self._error, *skin.alarms()]
        if self._doubtful_press is not None:
            alarms.append(self._labelled)
        if recording is not None and skin.reader.writer_problem:
            alarms.append(f"recording {recording.folder} {skin.reader.writer_problem}")
        state: dict[str, Any] = {
            "what": self.source if self._alone else str(self), "zeroed": skin.zeroed,
            "adaptable": isinstance(skin.estimator, UniversalEstimator),
            "adapting": presses.instruction if presses is not None else "",
            "next_mm": presses.next_mm if presses is not None else None,
            "adapted": self._adapted,
            "waiting": detected.problem is not None, "silent": skin.silent,
            "alarms": [alarm for alarm in alarms if alarm not in ("", WAITING)],
            "recording": str(recording.folder) if recording else "",
            "recorded": self._recorded,
            "labelling": "" if labelling is None else _waiting_for(labelling),
            "label_mm": None if labelling is None else [labelling.label.x_mm, labelling.label.y_mm],
            "labelled": self._labelled, "doubtful": self._doubtful_press is not None,
            "skins": self._skins.names(), "skins_folder": str(self._skins.folder),
            "true_places": self._emulated is not None and self._emulated.has_true_contacts,
            "zeroings_n": skin.zeroings_n,
            "zero_bins": [] if traces is None else traces.bins_of(tuple(skin.zeroings_s)),
            **({} if skin.estimator is None else skin.estimator.describe(self._model_name)),
        }  # fmt: skip
        if recording:
            state["recording_n"] = recording.touches_n
        if detected.problem is None:
            layout = skin.layout
            state |= {
                "board": skin.description,
                "seen": [
                    [alarm.name, alarm.count_n, round(alarm.last_s - alarm.first_s, 1), alarm.action]
                    for alarm in list(skin.health.alarms.values())
                ],
                "chips_mm": layout.chips_mm.tolist(), "places_known": layout.known, "corner_mm": layout.corner_mm,
                "skin_mm": layout.skin_mm,
            }  # fmt: skip
        return state

    def confirm(self, message_i: object) -> None:
        """Store the latency of the message with the number `message_i`, which a page has drawn.

        The number comes from the page. If it is not an integer, it is ignored.
        """
        if isinstance(message_i, int) and self.traces is not None:
            with self._lock:
                self.traces.confirm(message_i, self.skin.reader.unix_s())

    def request(self, message: Mapping[str, Any]) -> None:
        """Handle a message from a page, which is a dict with one or more of the following keys.

        - `press`: the name of a button that the user has pressed
        - `seen`: the number of the message that the page has drawn last
        - `save`, `load`: the name of a skin whose calibration is saved or loaded
        - `label`: the place and the force of the next press, or None to cancel a label

        Other keys are ignored.
        """
        self.press(message.get("press"))
        self.confirm(message.get("seen"))
        if "save" in message:
            self._request_change(partial(self._save, name=message["save"]))
        if "load" in message:
            self._request_change(partial(self._load, name=message["load"]))
        if "label" in message:
            with self._button_lock:
                try:
                    self._request_label(message["label"])
                except ReskinError as error:
                    self._labelled = str(error)

    def press(self, button: object) -> None:
        """Perform the action of a button on the page. Names of buttons that do not exist are ignored."""
        with self._button_lock:
            if button == "zero":
                self.skin.zero()
            elif button == "undo":
                self._request_change(UniversalEstimator.undo)
            elif button == "refine":
                self._request_change(UniversalEstimator.refine)
            elif button == "keep":
                self._request_change(self._use_doubtful_label)
            elif button == "discard" and self._doubtful_press is not None:
                self._labelled = f"discarded: press {_place(self._doubtful_press.label)}"
                self._doubtful_press = None
            elif button in ADAPTING and isinstance(estimator := self.skin.estimator, UniversalEstimator):
                requested = Presses() if button == "adapt" else GuidedPresses(estimator.board)
                self._task = None if isinstance(self._task, Presses) else requested
                self._doubtful_press = None
            elif button == "record" and self._recording is not None:
                self._end_recording()
            elif button == "record" and self.skin.detected.problem is None:
                self._begin_recording()

    def _request_change(self, change: Callable[[UniversalEstimator], str]) -> None:
        """Let the thread that polls the board change the model, unless too many changes are waiting."""
        if len(self._changes) < CHANGES_MAX_N:
            self._changes.append(change)
        else:
            self._adapted = f"not done, because {CHANGES_MAX_N} changes of the model are waiting already; try again"

    def _save(self, estimator: UniversalEstimator, *, name: object) -> str:
        return self._skins.save(name, estimator.model)

    def _load(self, estimator: UniversalEstimator, *, name: object) -> str:
        return estimator.load(self._skins.file(name))

    def _request_label(self, label: object) -> None:
        """Use a label for the next press, or cancel the label for the next press if `label` is None.

        A label is a dict with the keys `x_mm` and `y_mm` (the place), `force_N` (the force, or None if it is unknown)
        and `learn` (whether the model is calibrated to the press). Raises ParamsError if it cannot be used.
        """
        if isinstance(self._task, Presses):
            raise ParamsError(
                "label: presses for button Adapt or Places are being collected. Finish or cancel this first."
            )
        self._task, self._doubtful_press, self._labelled = None, None, ""
        if label is None:
            return
        if not isinstance(label, dict):
            raise ParamsError("label: the place and the force are missing. Enter x and y in mm.")
        estimator, learn = self.skin.estimator, False
        limits_mm = np.array([[-PLACE_MAX_MM] * 2, [PLACE_MAX_MM] * 2])
        if label.get("learn") is True and isinstance(estimator, UniversalEstimator):
            learn, limits_mm = True, estimator.model.reach_mm  # the model can learn only places on the skin
        least_mm, most_mm = limits_mm
        x_mm = _number(label.get("x_mm"), "x", least_mm[0], most_mm[0], "mm")
        y_mm = _number(label.get("y_mm"), "y", least_mm[1], most_mm[1], "mm")
        force_N = label.get("force_N")
        force_N = math.nan if force_N is None else _number(force_N, "the force", 0.0, FORCE_MAX_N, "N")
        if not learn and self._recording is None:
            raise ParamsError(
                "label: the label would be neither recorded nor used for calibration. Start a recording (key r), or "
                "tick the box to calibrate the model to the press."
            )
        self._task = NextPress(Label(True, x_mm, y_mm, Fz_N=force_N), learn=learn)

    def _begin_recording(self) -> None:
        """Start to write the byte stream to a new capture."""
        try:
            source = "recorded" if self._emulated is None else self._emulated.source
            self._recording = PageRecording(
                self.skin.detected, self.skin.reader, port_in_name=not self._alone, source=source
            )
            self._recorded = ""
        except (OSError, ReskinError) as error:
            self._recorded = str(error)

    def _end_recording(self) -> None:
        if self._recording is not None:
            recording, self._recording = self._recording, None
            try:
                self._recorded = recording.end()
            except OSError as error:
                self._recorded = f"cannot close {recording.folder}.part: {error.strerror}"


def _waiting_for(task: NextPress) -> str:
    return f"press {_place(task.label)}. {task.problem[:1].upper()}{task.problem[1:]}".strip()


def _place(label: Label) -> str:
    force = "" if math.isnan(label.Fz_N) else f" with {label.Fz_N:g} N"
    return f"at x {label.x_mm:g} mm, y {label.y_mm:g} mm{force}"


def _number(value: object, name: str, least: float, most: float, unit: str) -> float:
    """Return a number from the page as a float; raise ParamsError if it is not above `least` and below `most`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not least < value < most:  # False for NaN
        got = "nothing" if value is None else repr(value)[:40]
        raise ParamsError(f"label: {name} must be a number above {least:g} and below {most:g} {unit}; got {got}.")
    return float(value)


def open_sessions(
    ports: Sequence[str],
    models: Models,
    source: str,
    fault_policy: FaultPolicy = LIVE_POLICY,
    *,
    skins: SkinFolder | None = None,
    model_name: str = "",
    emulated: EmulatedBoard | None = None,
    wire: CustomWire | None = None,
) -> list[Session]:
    """Create one session per port (see `Session`); each has its own calibration, and all save skins in one folder."""
    check_ports(ports, models, "--port")
    skins, alone = skins or SkinFolder(), len(ports) == 1
    return [
        Session(
            port, models, source, fault_policy, alone=alone, skins=skins, model_name=model_name, emulated=emulated,
            wire=wire,
        )
        for port in ports
    ]  # fmt: skip
