"""Estimate contacts on a running board.

The bytes from the board's port are decoded to frames, a no-load reading is subtracted from the frames to obtain field
changes, and a model estimates the place and the force of the contact from each field change.

The function `reskin.open` returns a `LiveSkin` for one port, and a `LiveSkins` for several ports. One thread per port
does nothing but read bytes, so that no bytes are lost if the program that uses the contacts (the controller) is slow.
For a `LiveSkin`, the bytes are decoded and the contacts are estimated in the controller's own thread.
"""

import threading
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial.transform import Rotation

from reskin.board import find
from reskin.board.faults import GARBAGE_FRAMES_N
from reskin.board.other_firmware import CustomWire
from reskin.board.port import BAUD, PLUGGED_IN, Chunk, Reader, check_name
from reskin.board.stream import FrameStream
from reskin.board.wire import Frames, concatenate
from reskin.config import parse
from reskin.data.contact import contact_threshold_uT, magnitudes_uT, noise_uT
from reskin.data.grid import CENTRE_MM, SKIN_MM
from reskin.errors import CaptureError, ParamsError, SchemaError
from reskin.live.health import LIVE_POLICY, Health
from reskin.live.models import Models, NetworkEstimator, UniversalEstimator
from reskin.logs import quiet_start
from reskin.physics.board import BoardDesign
from reskin.recordings.fault_policy import FaultPolicy
from reskin.simulation.defaults import nominal
from reskin.universal.layout import BoardLayout
from reskin.universal.model import Universal

NOLOAD_S = 1.0  # the no-load reading is the mean of the readings in this time, during which nothing touches the skin
NOLOAD_FRAMES_MAX_N = 10_000  # the no-load reading ends earlier if this number of frames has arrived
# The wire format is detected as soon as data for `HEAD_S` seconds, or `HEAD_BYTES_MAX_N` bytes, have arrived.
HEAD_S, HEAD_BYTES_MAX_N = 0.5, 2**18
SILENT_S = 0.3  # if no data arrive for this time, a controller receives a contact whose values are NaN
OPENING_S = 10.0  # longest time after opening a port for the detection of the wire format and the no-load reading
# Number of latest chunks whose end and arrival time are stored. Earlier chunks are needed because a frame may have
# ended in an earlier chunk than the latest one.
ENDS_KEPT_N = 256
FRAME_BYTES_MIN_N = 16  # smallest number of bytes per chip in a frame, among all wire formats
SPACING_MM = 5.0  # distance between chips on the page if their positions are unknown
ZEROINGS_KEPT_N = 16  # number of latest no-load readings whose times are stored, to mark them on the page

WAITING = "waiting for data"
TAKING_NOLOAD = "taking the no-load reading: do not touch, do not move"
UNKNOWN_SKIN = "unknown skin: the model was not trained on such field changes"


def check_ports(ports: Sequence[str], models: Models, where: str) -> None:
    """Raise ParamsError if the name of a port is invalid or occurs twice, or if the model cannot be used for all."""
    find.check_named_once(ports, where)
    for port in ports:  # only the name is checked; the port need not exist yet, because a board may be plugged in later
        check_name(port)
    if len(ports) > 1 and isinstance(models, Universal) and models.presses_n:
        raise ParamsError(
            f"{where}: the model is calibrated to one skin ({models.presses_n} presses) and cannot be used for "
            f"{len(ports)} boards. Open only the board with this skin, or omit the model."
        )


@dataclass(frozen=True)
class Layout:
    """The positions of a board's k chips and of its skin, in the coordinate system of the labels x_mm and y_mm."""

    known: bool  # whether the positions are known; otherwise, the chips are displayed in a row
    chips_mm: Float64[np.ndarray, "k 2"]
    turn: Float64[np.ndarray, "k 3 3"]  # rotation from each chip's axes to the board's axes
    corner_mm: tuple[float, float]  # lower left corner of the skin
    skin_mm: tuple[float, float]  # sides of the skin along x and y


def layout_of(chips_n: int) -> Layout:
    """Return the layout of a board with this number of chips.

    The byte stream does not state which board it comes from. A board with five chips is therefore assumed to be the
    paper's board, and a board with forty chips is assumed to be the paper's sleeve. If no nominal board has this number
    of chips, the layout is unknown, and the result has all chips in one row.
    """
    for name, settings in nominal("boards").items():
        design = parse(BoardDesign, settings["design"], f"nominal board {name}")
        if len(design.places_mm) == chips_n:
            along_x_mm, along_y_mm = settings["skin_mm"]
            skin_mm = (float(along_x_mm), float(along_y_mm))
            half_mm = np.array(skin_mm) / 2
            centre_mm = np.full(2, CENTRE_MM) if skin_mm == SKIN_MM else half_mm
            turn = Rotation.from_euler("z", np.array(design.turns_deg)[:, None], degrees=True).as_matrix()
            corner_mm = centre_mm - half_mm
            chips_mm = centre_mm + np.array(design.places_mm)
            return Layout(True, chips_mm, turn, (float(corner_mm[0]), float(corner_mm[1])), skin_mm)
    chips_mm = np.column_stack([SPACING_MM * (0.5 + np.arange(chips_n)), np.full(chips_n, SPACING_MM)])
    skin_mm = (SPACING_MM * chips_n, 2 * SPACING_MM)
    return Layout(False, chips_mm, np.tile(np.eye(3), (chips_n, 1, 1)), (0.0, 0.0), skin_mm)


def layout_of_board(board: BoardLayout) -> Layout:
    """Return the layout of the board for which a universal model was made."""
    centre_mm, size_mm = np.array(board.centre_mm), np.array(board.skin.size_mm)
    turn = Rotation.from_euler("z", np.array(board.turns_deg)[:, None], degrees=True).as_matrix()
    x_mm, y_mm = (centre_mm - size_mm / 2).tolist()
    return Layout(True, centre_mm + board.chips_mm, turn, (x_mm, y_mm), board.skin.size_mm)


class Contact(NamedTuple):
    """One reading of a board, and the place and the force that a model estimated from the reading.

    If nothing touches the skin, the place is NaN and the force is 0. If the reading is not usable, the place and the
    force are NaN, and `alarms` contains the reason. For example, the read of a chip failed, or the board is unplugged.
    """

    t_s: float  # unix time at which the last byte of the reading arrived
    x_mm: float
    y_mm: float
    F_N: float
    # Standard deviations of x and y. For trained networks, these are the standard deviations between the networks, and
    # NaN for a single network.
    sd_mm: tuple[float, float]
    b_uT: Float32[np.ndarray, " ch"]
    alarms: tuple[str, ...]  # texts of the current alarms of the board
    sd_F_N: float = np.nan  # standard deviation of the force, defined as for `sd_mm`
    usable: bool = True  # False if a chip is faulty, if no data arrive, or if there is no no-load reading yet


@dataclass(frozen=True)
class Estimates:
    """The f frames from one call of `LiveSkin.poll`, in the order of their arrival, with the estimates for them."""

    t_s: Float64[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    db_uT: Float32[np.ndarray, "f ch"]  # NaN for faulty frames, and as long as there is no no-load reading
    target: Float64[np.ndarray, "f 3"]  # x_mm, y_mm and F_N, as in `Contact`; NaN if there is no model
    sd_mm: Float64[np.ndarray, "f 2"]
    sd_F_N: Float64[np.ndarray, " f"]
    contact: Bool[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.t_s)


class LiveSkin:
    """The skin at one port, whose contacts are estimated while the board is running. `reskin.open` returns it.

    Use a `LiveSkin` in a `with` statement, which opens the port and takes the no-load reading. Iteration over a
    `LiveSkin` yields the latest contact and skips older ones. Iteration over `every()` yields the contact of every
    reading.
    """

    def __init__(
        self, port: str, models: Models = (), *, baud: int = BAUD, fault_policy: FaultPolicy = LIVE_POLICY,
        wire: CustomWire | None = None,
    ) -> None:  # fmt: skip
        self.port, self.fault_policy, self.wire = port, fault_policy, wire
        self.detected = find.DetectedBoard(port, WAITING)
        self.description = port  # the port; after the wire format was detected, also the format and the scale
        self.account: Counter[str] = Counter()  # sums of the counts of all `FrameStream` objects since the start
        self.reader = Reader(port, baud)
        self.estimator: NetworkEstimator | UniversalEstimator | None = None
        if isinstance(models, Universal):
            self.estimator = UniversalEstimator(models)
        elif models:
            self.estimator = NetworkEstimator(models)
        self._model_problem = ""
        self._head: list[Chunk] = []
        # number of bytes that belong to incomplete frames, because the port was opened in the middle of these frames
        self._partial_first_bytes_n = 0
        self.dropped_frames_n = 0  # number of frames that have no estimate because of a fault
        self.zeroings_n = 0
        self.zeroings_s: deque[float] = deque(maxlen=ZEROINGS_KEPT_N)  # times of the latest no-load readings
        self._restart_noload()

    def __enter__(self) -> "LiveSkin":
        """Open the port, detect the wire format, and take the no-load reading.

        Nothing may touch the skin during this time.
        """
        self.reader.start(must_exist=True)
        try:
            end_s = self.reader.unix_s() + OPENING_S
            while not self.zeroed:
                if self.reader.unix_s() > end_s:
                    raise CaptureError(
                        f"{self.port}: could not take a no-load reading within {OPENING_S:g} s: "
                        f"{'; '.join(self.alarms()) or 'no data'}. Run `reskin ports` to see what the port sends."
                    )
                self.poll(SILENT_S)
        except BaseException:
            self.reader.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.stop()

    def __iter__(self) -> Iterator[Contact]:
        """Yield the contact of the latest reading.

        Older readings that have not been yielded are skipped, and no reading is yielded twice. If no data arrive for
        `SILENT_S`, or if the board is unplugged, a contact whose values are NaN is yielded.
        """
        while True:
            yield self._contact(self.poll(SILENT_S, latest=True), -1)

    def every(self) -> Iterator[Contact]:
        """Yield the contact of every reading.

        The bytes of readings that the caller has not yet processed are stored. If the caller is more than two minutes
        late, the oldest bytes are discarded and counted in `reader.missed_bytes_n`.
        """
        while True:
            estimates = self.poll(SILENT_S)
            for i in range(max(len(estimates) if estimates else 0, 1)):
                yield self._contact(estimates, i)

    def zero(self) -> None:
        """Request a new no-load reading, which is taken in the next second without contact.

        This method may be called from any thread.
        """
        # The thread that calls `poll` takes the no-load reading, because this thread collects the frames.
        self._noload_requested = True

    @property
    def zeroed(self) -> bool:
        """Whether there is a no-load reading, and no new no-load reading has been requested."""
        return self.noload_uT is not None and not self._noload_requested

    @property
    def silent(self) -> bool:
        """Whether no data have arrived for `SILENT_S`, so that the last reading is outdated."""
        return not self.detected.problem and self.reader.unix_s() - self._ends[-1][1] > SILENT_S

    @property
    def lost_bytes_n(self) -> int:
        """Number of bytes that were discarded or that do not belong to a complete frame.

        If the board was in the middle of a frame when the port was opened, the rest of this frame is not counted.
        """
        skipped_n = sum(count for name, count in self.account.items() if name.startswith("skipped_"))
        return skipped_n + self.reader.missed_bytes_n - self._partial_first_bytes_n

    def alarms(self) -> tuple[str, ...]:
        """Return the texts of all current alarms of the port, the model and the board."""
        alarms = []
        if self.reader.problem and not self.reader.plugged_in:
            alarms.append(f"{'unplugged' if self.reader.was_plugged_in else 'not open'}: {self.reader.problem}")
        if self.detected.problem:
            alarms.append(self.detected.problem)
        if self._model_problem:
            alarms.append(self._model_problem)
        if not self.detected.problem:
            alarms += [] if self.zeroed else [TAKING_NOLOAD]
            if self.zeroed and isinstance(self.estimator, UniversalEstimator):
                alarms += self.estimator.warnings
            alarms += [alarm.name for alarm in self.health.active(self.reader.unix_s())]
        return tuple(alarms)

    def poll(self, wait_s: float, *, latest: bool = False) -> Estimates | None:
        """Decode all bytes that have arrived, and estimate the place and the force for each frame.

        Wait for data for `wait_s` at most. With `latest`, only the last frame gets an estimate. Return None if no
        complete frame has arrived.
        """
        chunks = self.reader.take(wait_s)
        if not chunks:
            if self.silent:
                self.health.note("no data", 1, self.reader.unix_s(), "unplug")
            return None
        if self.detected.problem:
            chunks = self._detect(chunks)
        if not chunks:
            return None
        frames, t_s = self._decode(chunks)
        if not len(frames):
            return None
        sound = self.health.feed(frames, t_s[-1])
        self.dropped_frames_n += int(len(sound) - sound.sum())
        if not self.zeroed:
            self._take_noload(frames.where(sound), t_s)
        if latest:
            last = np.arange(len(frames)) == len(frames) - 1
            frames, t_s, sound = frames.where(last), t_s[-1:], sound[-1:]
        return self._estimate(frames, t_s, sound)

    def _detect(self, chunks: list[Chunk]) -> list[Chunk]:
        """Detect the wire format of the board.

        The method collects chunks and returns an empty list until the wire format can be detected. It then returns all
        collected chunks.
        """
        self._head += chunks
        bytes_n = sum(len(chunk) for chunk, _ in self._head)
        if self._head[-1][1] - self._head[0][1] < HEAD_S and bytes_n < HEAD_BYTES_MAX_N:
            return []
        chunks, self._head = self._head, []
        detected = find.recognise(self.port, chunks, self.wire)
        if detected.problem:
            self.detected = detected
            return []
        if self.estimator is not None and self.estimator.channels_n != 3 * detected.chips_n:
            self._reject_model(self.estimator, detected.chips_n)
        self.description = f"{detected.port}: {detected.format}, {detected.scale}"
        self.health, self.layout = Health(detected.chips_n, self.fault_policy), layout_of(detected.chips_n)
        if isinstance(self.estimator, UniversalEstimator):
            self.layout = layout_of_board(self.estimator.board)
        self._start_stream(detected)
        # This attribute is set last, because other threads use the attributes above as soon as this attribute is set.
        self.detected = detected
        return chunks

    def _reject_model(self, estimator: NetworkEstimator | UniversalEstimator, chips_n: int) -> None:
        """Handle a model that is not for the board's number of chips.

        If the model consists of networks, `SchemaError` is raised, because the user chose the wrong networks. A
        universal model, however, may be used only because it is the default. It is therefore disabled without an error,
        and an alarm is raised.
        """
        if isinstance(estimator, NetworkEstimator):
            raise SchemaError(
                f"{self.port}: the board has {3 * chips_n} channels, but the model has {estimator.channels_n}. "
                "Use a model for boards with this number of channels."
            )
        self.estimator = None
        chips = f"{estimator.channels_n // 3} chips"
        self._model_problem = (
            f"no place or force is estimated: the {estimator.name} is for boards with {chips}. Use a model for this "
            "board."
        )

    def _start_stream(self, detected: find.DetectedBoard) -> None:
        self._stream = FrameStream(detected.wire, detected.chips_n)
        self._counted: Counter[str] = Counter()
        self._garbage_bytes_n = self._first_bytes_n = 0
        self._ends: deque[tuple[int, float]] = deque([(0, self.reader.unix_s())], maxlen=ENDS_KEPT_N)

    def _decode(self, chunks: list[Chunk]) -> tuple[Frames, Float64[np.ndarray, " f"]]:
        """Return the frames in the chunks, and the arrival time of each frame.

        Wherever the chunks show that the board was plugged in again, a new stream is started.
        """
        starts = [i for i, (chunk, _) in enumerate(chunks) if chunk == PLUGGED_IN]
        parts = []
        for first, last in pairwise([0, *starts, len(chunks)]):
            if first in starts:
                self._stream.close()
                self._count_bytes(chunks[first][1])
                self._start_stream(self.detected)
            parts.append(self._decode_stream(chunks[first:last]))
        frames = concatenate([part for part, _ in parts], self.detected.chips_n)
        return frames, np.concatenate([t_s for _, t_s in parts])

    def _decode_stream(self, chunks: list[Chunk]) -> tuple[Frames, Float64[np.ndarray, " f"]]:
        """Decode chunks of one stream; return the frames, and the arrival time of each frame.

        The arrival time of a frame is the arrival time of the chunk that contains the frame's last byte.
        """
        for chunk, arrival_s in chunks:
            self._ends.append((self._ends[-1][0] + len(chunk), arrival_s))
        frames = self._stream.feed(b"".join(chunk for chunk, _ in chunks))
        self._count_bytes(self._ends[-1][1])
        last = len(self._ends) - 1
        chunk_i = (min(bisect_left(self._ends, end, key=itemgetter(0)), last) for end in frames.end_byte.tolist())
        return frames, np.fromiter((self._ends[i][1] for i in chunk_i), np.float64, len(frames))

    def _count_bytes(self, now_s: float) -> None:
        """Update `account` with the stream's counts since the last call, and raise alarms for lost bytes."""
        frame_min_n = FRAME_BYTES_MIN_N * self.detected.chips_n
        counted = Counter(self._stream.account())
        new, at_start, self._counted = counted - self._counted, not self._counted["frames_n"], counted
        self.account += new
        lost_n = sum(count for name, count in new.items() if name.startswith("skipped_"))
        frame_n = new["frame_bytes_n"] / new["frames_n"] if new["frames_n"] else frame_min_n
        # If the port was opened in the middle of a frame, the rest of this frame is not counted as lost. The limit is
        # one byte more than a frame: if only one byte of the first frame arrives, the decoder cannot recognise the
        # start of the next frame, and skips this frame too.
        if at_start and self._first_bytes_n + lost_n <= frame_n + 1:
            self._first_bytes_n += lost_n
            self._partial_first_bytes_n += lost_n
            return
        self.health.note("bytes lost between frames", lost_n, now_s, "torn")
        self._garbage_bytes_n = 0 if new["frames_n"] else self._garbage_bytes_n + lost_n
        if self._garbage_bytes_n > GARBAGE_FRAMES_N * frame_min_n:
            self.health.note("no frames in the data: wrong baud rate?", lost_n, now_s, "wrong_baud")

    def _restart_noload(self) -> None:
        self.noload_uT: Float64[np.ndarray, " ch"] | None = None
        # A reading is in contact if its |dB| is larger than this value. External fields are removed from dB before, if
        # they are expected.
        self._contact_uT = np.inf
        self._suppressor: Float64[np.ndarray, "ch ch"] | None = None  # the matrix that removes external fields
        self._quiet: list[Frames] = []
        self._quiet_from_s = np.inf
        # This attribute is set last. If another thread requests a no-load reading during this call, the no-load reading
        # that starts now also fulfils this request.
        self._noload_requested = False

    def _take_noload(self, frames: Frames, t_s: Float64[np.ndarray, " f"]) -> None:
        """Collect the frames of one second, and take the no-load reading.

        If the field did not change in this second, the mean of the frames becomes the no-load reading. Otherwise,
        something may have touched the skin, and the frames of the next second are collected.
        """
        if self._noload_requested:
            self._restart_noload()
        self._quiet.append(frames)
        self._quiet_from_s = min(self._quiet_from_s, t_s[0])
        duration_s = t_s[-1] - self._quiet_from_s
        b_uT = np.concatenate([part.b_uT for part in self._quiet])
        if len(b_uT) < 2 or (duration_s < NOLOAD_S and len(b_uT) < NOLOAD_FRAMES_MAX_N):
            return
        self._quiet, self._quiet_from_s = [], np.inf
        with suppress(CaptureError):  # `quiet_start` raises this error if the field changed
            # The times of the frames are assumed to be evenly spaced. Their arrival times cannot be used, because all
            # frames of a chunk have the same arrival time.
            b_uT = b_uT[: quiet_start(np.linspace(0, duration_s, len(b_uT)), b_uT, where=self.port)]
            noload_uT = b_uT.mean(axis=0, dtype=np.float64)
            if self.estimator is not None:
                self.estimator.set_noload(noload_uT)
            db_uT = b_uT - noload_uT
            if isinstance(self.estimator, UniversalEstimator):
                self._suppressor = self.estimator.model.suppressor(noise_uT(db_uT))
            self._contact_uT = contact_threshold_uT(db_uT, self._suppressor)
            self.noload_uT = noload_uT
            self.zeroings_n += 1
            self.zeroings_s.append(float(t_s[-1]))

    def _estimate(self, frames: Frames, t_s: Float64[np.ndarray, " f"], sound: Bool[np.ndarray, " f"]) -> Estimates:
        target, sd_mm, sd_F_N = (np.full((len(frames), *shape), np.nan) for shape in ((3,), (2,), ()))
        if self.noload_uT is None:
            unknown_uT, contact = np.full_like(frames.b_uT, np.nan), np.zeros(len(t_s), bool)
            return Estimates(t_s, frames.b_uT, unknown_uT, target, sd_mm, sd_F_N, contact)
        db_uT = (np.where(sound[:, None], frames.b_uT, np.nan) - self.noload_uT).astype(np.float32)
        contact = magnitudes_uT(db_uT, self._suppressor) > self._contact_uT  # False for NaN
        if self.estimator is not None:
            target[sound & ~contact, 2] = 0.0
            if contact.any():
                target[contact], sd_mm[contact], sd_F_N[contact], unknown = self.estimator(db_uT[contact])
                self.health.note(UNKNOWN_SKIN, int(unknown.sum()), t_s[-1])
                failed = contact & ~np.isfinite(target).all(axis=1)
                target[failed] = sd_mm[failed] = sd_F_N[failed] = np.nan
                self.health.note("the estimate is not a finite number", int(failed.sum()), t_s[-1])
        if sound[-1] and self.layout.known:
            expected_uT = self.estimator.model.external_uT if isinstance(self.estimator, UniversalEstimator) else 0.0
            self.health.feed_change(db_uT[-1], self.layout.turn, t_s[-1], expected_uT)
        return Estimates(t_s, frames.b_uT, db_uT, target, sd_mm, sd_F_N, contact)

    def usable(self, estimates: Estimates) -> Bool[np.ndarray, " f"]:
        """Return for each frame whether it is sound and, if there is a model, its estimate is finite."""
        usable = np.isfinite(estimates.db_uT).all(axis=1)
        if self.estimator is not None:
            usable &= np.isfinite(estimates.target[:, 2])
        return usable

    def _contact(self, estimates: Estimates | None, i: int) -> Contact:
        if estimates is None:
            unknown_uT = np.full(3 * self.detected.chips_n, np.nan, np.float32)
            no_place_mm = np.nan, np.nan
            return Contact(
                self.reader.taken_s, *no_place_mm, np.nan, no_place_mm, unknown_uT, self.alarms(), usable=False
            )
        (x_mm, y_mm, force_N), (sd_x_mm, sd_y_mm) = estimates.target[i].tolist(), estimates.sd_mm[i].tolist()
        t_s, sd_mm, sd_F_N = float(estimates.t_s[i]), (sd_x_mm, sd_y_mm), float(estimates.sd_F_N[i])
        usable = bool(self.usable(estimates)[i])
        return Contact(t_s, x_mm, y_mm, force_N, sd_mm, estimates.b_uT[i], self.alarms(), sd_F_N, usable)


class LiveSkins:
    """The skins at several ports, whose contacts are estimated while the boards are running.

    Iteration yields tuples of the latest contacts of all skins, in the order of the ports.
    """

    def __init__(self, skins: Sequence[LiveSkin]) -> None:
        self.skins = skins
        self._latest: list[Contact | None] = [None] * len(skins)
        self._error: Exception | None = None
        self._new, self._changed, self._stop = False, threading.Condition(), threading.Event()
        self._open_ports = ExitStack()
        self._threads = [
            threading.Thread(target=self._follow, args=[i], name=f"contacts of {skin.port}", daemon=True)
            for i, skin in enumerate(skins)
        ]

    def __enter__(self) -> "LiveSkins":
        """Open all ports at the same time, and take the no-load readings of all skins.

        If one of the ports cannot be opened, all ports are closed.
        """
        with self._open_ports as ports, ThreadPoolExecutor(len(self.skins)) as pool:
            for opening in [pool.submit(ports.enter_context, skin) for skin in self.skins]:
                opening.result()
            self._open_ports = ports.pop_all()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._open_ports.close()

    def __iter__(self) -> Iterator[tuple[Contact, ...]]:
        """Yield the latest contacts of all boards whenever there is a new contact of one board.

        If a board sends no data, the values of its contact are NaN.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._error or (self._new and None not in self._latest))
                if self._error is not None:
                    raise self._error
                self._new = False
                latest = tuple(contact for contact in self._latest if contact is not None)
            yield latest

    def _follow(self, index: int) -> None:
        try:
            for contact in self.skins[index]:
                with self._changed:
                    self._latest[index], self._new = contact, True
                    self._changed.notify()
                if self._stop.is_set():
                    return
        except Exception as error:  # this error is raised again in `__iter__`, in the thread of the caller
            with self._changed:
                self._error = error
                self._changed.notify()
