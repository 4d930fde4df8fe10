"""Skins at work on threads of their own: polled, recorded when asked, one or several at once."""

import re
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from reskin.board.find import check_named_once
from reskin.board.port import Tape
from reskin.errors import ReskinError
from reskin.live.answering import Map, Models, check_boards
from reskin.live.calibrating import Pokes, ShownPokes
from reskin.live.health import LIVE_POLICY
from reskin.live.tracker import WAITING, Contact, Readings, Skin
from reskin.live.view import View
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header
from reskin.recordings.recorder import UNTOLD, begin_capture, end_capture, new_folder

POLL_S = 0.1
GATHER_S = (
    0.02  # for which frames of several boards are gathered: estimated together they cost less, and no page draws faster
)
ADAPTING = {"adapt": Pokes, "places": ShownPokes}  # by button


class Live:
    """A skin that is polled on a thread of its own, what pages see of it, and its recording."""

    def __init__(
        self, port: str, models: Models, what: str, fault_policy: FaultPolicy = LIVE_POLICY, *, alone: bool = True
    ) -> None:
        self.skin, self.what = Skin(port, models, fault_policy=fault_policy), what
        self._alone = alone
        self.view: View | None = None
        self.problem = ""
        self._pokes: Pokes | None = None
        self._adapted = ""
        self._recording: tuple[Path, Header] | None = None
        self._recorded = ""
        self._lock, self._buttons, self._stop = threading.Lock(), threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._poll, name="estimates", daemon=True)

    def __str__(self) -> str:
        return f"{self.what} on {self.skin.port}"

    def start(self) -> None:
        self.skin.reader.start(there=False)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.end_recording()
        self.skin.reader.stop()

    def _poll(self) -> None:
        try:
            while not self._stop.is_set():
                readings = self.skin.poll(POLL_S)
                if readings is not None:
                    now_s = self.skin.reader.unix_s()
                    self._adapt(readings)
                    with self._lock:
                        self.view = self.view or View(self.skin.layout, now_s - 1.0)
                        self.view.feed(readings, now_s)
                if not self._alone:
                    self._stop.wait(GATHER_S)
        except ReskinError as error:
            self.problem = str(error)
        except Exception as error:  # of a model: the page says that nothing is estimated any more
            self.problem = f"estimates ended: {error!r}"

    def _adapt(self, readings: Readings) -> None:
        """Let the map learn from pokes, if it was asked for; frames wait meanwhile, and none is lost."""
        pokes, answers = self._pokes, self.skin.answers
        if pokes is not None and isinstance(answers, Map):
            pokes.feed(readings)
            if pokes.enough:
                if isinstance(pokes, ShownPokes):
                    self._adapted = answers.label(pokes.place_mm, pokes.db_uT, pokes.kept)
                else:
                    self._adapted = answers.see(pokes.db_uT)
                self._pokes = None

    def message(self, after_bin: int) -> tuple[bytes, int]:
        """Give the next message of a client that has the bins before `after_bin`, and what it has then."""
        with self._lock:
            if self.view is None:
                return b"", 0
            rate_hz, lost_bytes_n = self.skin.health.rate_hz, self.skin.lost_bytes_n
            data = self.view.message(after_bin, rate_hz=rate_hz, lost_bytes_n=lost_bytes_n)
            return data, self.view.newest_bin

    def state(self) -> dict[str, Any]:
        """Say what a page shows beside the numbers."""
        skin, found = self.skin, self.skin.found
        state: dict[str, Any] = {
            "what": self.what if self._alone else str(self), "zeroed": skin.zeroed,
            "model": skin.answers.about if skin.answers else "",
            "adaptable": isinstance(skin.answers, Map),
            "adapting": pokes.words if (pokes := self._pokes) is not None else "",
            "next_mm": pokes.next_mm if pokes is not None else None,
            "adapted": self._adapted,
            "waiting": found.problem is not None, "silent": skin.silent,
            "alarms": [alarm for alarm in (self.problem, *skin.alarms()) if alarm not in ("", WAITING)],
            "recording": f"{self._recording[0]} {skin.reader.tape_problem}" if self._recording else "",
            "recorded": self._recorded,
        }  # fmt: skip
        if found.problem is None:
            layout, alarms = skin.layout, list(skin.health.alarms.values())
            state |= {
                "board": f"{found.port}: {found.format}, {found.scale}",
                "seen": [[one.name, one.count_n, round(one.last_s - one.first_s, 1), one.action] for one in alarms],
                "chips_mm": layout.chips_mm.tolist(), "places_known": layout.known, "corner_mm": layout.corner_mm,
                "skin_mm": layout.skin_mm,
            }  # fmt: skip
        return state

    def seen(self, message_i: object) -> None:
        """Note that a screen has shown a message."""
        if isinstance(message_i, int) and self.view is not None:
            with self._lock:
                self.view.seen(message_i, self.skin.reader.unix_s())

    def press(self, button: object) -> None:
        """Do what a button of the page says; what is no button does nothing."""
        with self._buttons:
            if button == "zero":
                self.skin.zero()
            elif isinstance(button, str) and button in ADAPTING and isinstance(self.skin.answers, Map):
                self._pokes = ADAPTING[button]() if self._pokes is None else None
            elif button == "record" and self._recording is not None:
                self.end_recording()
            elif button == "record" and self.skin.found.problem is None:
                self.begin_recording()

    def begin_recording(self) -> None:
        """Write the stream, as it comes from now on, into a new capture."""
        folder, found = new_folder(), self.skin.found
        if not self._alone:  # others may begin theirs in the same second
            folder = folder.with_name(f"{folder.name}-{re.sub(r'[^A-Za-z0-9]+', '-', found.port).strip('-')}")
        try:
            part, header = begin_capture(folder, UNTOLD, wire=found.wire, chips_n=found.chips_n, by="reskin live")
            self.skin.reader.set_tape(Tape(part, found.wire))
            self._recording, self._recorded = (folder, header), ""
        except (OSError, ReskinError) as error:
            self._recorded = str(error)

    def end_recording(self) -> None:
        if self._recording is not None:
            (folder, header), self._recording = self._recording, None
            self.skin.reader.set_tape(None)
            try:
                end_capture(folder, header)
                self._recorded = f"recorded {folder}"
            except OSError as error:
                self._recorded = f"{folder}.part could not be closed: {error.strerror}"


def several(ports: Sequence[str], models: Models, what: str, fault_policy: FaultPolicy = LIVE_POLICY) -> list[Live]:
    """Make one of each port; all share what the models are made of, and nothing else."""
    check_named_once(ports, "--port")
    check_boards(models, len(ports), "--model")
    return [Live(port, models, what, fault_policy, alone=len(ports) == 1) for port in ports]


class Skins:
    """Boards on ports, opened and zeroed at once. Iterate for the latest contacts, in the order of the ports."""

    def __init__(self, skins: Sequence[Skin]) -> None:
        self.skins = skins
        self._latest: list[Contact | None] = [None] * len(skins)
        self._failed: Exception | None = None
        self._news, self._came, self._stop = False, threading.Condition(), threading.Event()
        self._opened = ExitStack()
        self._threads = [
            threading.Thread(target=self._follow, args=[i], name=f"contacts of {skin.port}", daemon=True)
            for i, skin in enumerate(skins)
        ]

    def __enter__(self) -> "Skins":
        """Open all ports; nothing may touch the skins meanwhile. If one board is not there, none is left open."""
        with self._opened as opening, ThreadPoolExecutor(len(self.skins)) as pool:
            for entering in [pool.submit(opening.enter_context, skin) for skin in self.skins]:
                entering.result()
            self._opened = opening.pop_all()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._opened.close()

    def __iter__(self) -> Iterator[tuple[Contact, ...]]:
        """Give the latest contact of each board whenever one has a new one; a silent board's is NaN and says why."""
        while True:
            with self._came:
                self._came.wait_for(lambda: self._failed or (self._news and None not in self._latest))
                if self._failed is not None:
                    raise self._failed
                self._news = False
                latest = tuple(contact for contact in self._latest if contact is not None)
            yield latest

    def _follow(self, index: int) -> None:
        try:
            for contact in self.skins[index]:
                with self._came:
                    self._latest[index], self._news = contact, True
                    self._came.notify()
                if self._stop.is_set():
                    return
        except Exception as error:  # also one of a model: raised where somebody iterates
            with self._came:
                self._failed = error
                self._came.notify()
