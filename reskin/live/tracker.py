"""A skin at work: reads a board's port and estimates contacts as they happen. `reskin.open` returns its `Skin`.

A thread reads; the caller decodes and estimates, so that a slow controller loses no bytes.
"""

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from types import TracebackType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.spatial.transform import Rotation

from reskin.board import find
from reskin.board.faults import GARBAGE_FRAMES_N
from reskin.board.find import Chunk
from reskin.board.reader import PLUGGED_IN, Reader
from reskin.board.stream import FrameStream
from reskin.board.wire import Frames, concatenate
from reskin.config import parse
from reskin.data.grid import CENTRE_MM
from reskin.errors import CaptureError, SchemaError
from reskin.live.answering import Map, Models, Networks, answering
from reskin.live.contacts import CONTACT_SDS, quiet_start
from reskin.live.health import LIVE_POLICY, Health
from reskin.recordings.fault_policy import FaultPolicy
from reskin.simulation.defaults import nominal
from reskin.simulation.protocols import SKIN_MM
from reskin.simulation.settings import BoardKind

ASIDE_MM = 5.0  # between chips whose places nobody knows, so that they can be drawn


@dataclass(frozen=True)
class Layout:
    """Places in the frame of labels, in mm; `turn` holds the chips' axes in the board's frame."""

    known: bool
    chips_mm: Float64[np.ndarray, "k 2"]
    turn: Float64[np.ndarray, "k 3 3"]
    corner_mm: tuple[float, float]
    skin_mm: tuple[float, float]


def layout_of(chips_n: int) -> Layout:
    """Find the nominal board with this number of chips; chips of an unknown board are drawn in a row.

    The bytes do not say which board it is: five chips are taken for the paper's board, forty for its sleeve.
    """
    for name, words in nominal("boards").items():
        kind = parse(BoardKind, words, f"nominal board {name}")
        if len(kind.design.places_mm) == chips_n:
            half_mm = np.array(kind.skin_mm) / 2
            centre_mm = np.full(2, CENTRE_MM) if kind.skin_mm == SKIN_MM else half_mm
            turn = Rotation.from_euler("z", np.array(kind.design.turns_deg)[:, None], degrees=True).as_matrix()
            corner_mm = centre_mm - half_mm
            chips_mm = centre_mm + np.array(kind.design.places_mm)
            return Layout(True, chips_mm, turn, (float(corner_mm[0]), float(corner_mm[1])), kind.skin_mm)
    chips_mm = np.column_stack([ASIDE_MM * (0.5 + np.arange(chips_n)), np.full(chips_n, ASIDE_MM)])
    return Layout(False, chips_mm, np.tile(np.eye(3), (chips_n, 1, 1)), (0.0, 0.0), (ASIDE_MM * chips_n, 2 * ASIDE_MM))


ZERO_S = 1.0  # without contact, from which the no-load reading is taken
ZERO_FRAMES_MAX_N = 10_000
HEAD_S, HEAD_BYTES_MAX_N = 0.5, 2**18  # from which a format is recognised
SILENT_S = 0.3  # a controller is told when nothing comes
OPENING_S = 10.0
ENDS_KEPT_N = 256  # chunks, to time frames that were settled late
WAITING = "waiting for data"
ZEROING = "taking the no-load reading: do not touch, do not move"
UNLIKE = "not a skin that the model knows: a change of field like none of its own"


class Contact(NamedTuple):
    """One reading: off contact the place is NaN and the force 0; all three are NaN where nothing is known."""

    t_s: float  # unix, when its last byte came
    x_mm: float
    y_mm: float
    F_N: float
    sd_mm: tuple[float, float]  # of the place along x and y: the map's, or that between networks; NaN of a single one
    b_uT: Float32[np.ndarray, " ch"]
    alarms: tuple[str, ...]  # what is wrong with the board; empty when all is well


@dataclass(frozen=True)
class Readings:
    """Estimates of frames in order, as far as there are models and a no-load reading."""

    t_s: Float64[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    db_uT: Float32[np.ndarray, "f ch"]  # NaN before the no-load reading is taken, and where a chip was not read
    answer: Float64[np.ndarray, "f 3"]  # x_mm, y_mm, F_N
    sd_mm: Float64[np.ndarray, "f 2"]
    contact: Bool[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.t_s)


class Zero(NamedTuple):
    """The field without contact, and the length of a change of field from which on there is one."""

    noload_uT: Float64[np.ndarray, " ch"]
    contact_uT: float

    @classmethod
    def of(cls, b_uT: Float[np.ndarray, "f ch"]) -> "Zero":
        """Take it from readings without contact; the threshold is that of a log (`experiments.logs`)."""
        noload_uT = b_uT.mean(axis=0, dtype=np.float64)
        noise_uT = b_uT - noload_uT
        usual_uT = np.median(np.linalg.norm(noise_uT, axis=1))
        return cls(noload_uT, float(usual_uT + CONTACT_SDS * np.sqrt((noise_uT**2).mean())))


class Skin:
    """A board on a port. Iterate over it for the latest contact, or over `every()` for all."""

    def __init__(
        self, port: str, models: Models = (), *, baud: int = find.BAUD, fault_policy: FaultPolicy = LIVE_POLICY
    ) -> None:
        self.fault_policy = fault_policy
        self.port, self.found = port, find.Found(port, WAITING)
        self.account: Counter[str] = Counter()  # of all streams since the start, as a `FrameStream` counts
        self.reader = Reader(port, baud)
        self.answers = answering(models)
        self.problem = ""  # of the model with this board
        self._head: list[Chunk] = []
        self._opening_bytes_n = 0
        self._begin_zero()

    def __enter__(self) -> "Skin":
        """Open the port, learn what it sends, and take the no-load reading: nothing may touch the skin meanwhile."""
        self.reader.start(there=True)
        try:
            self._wait_until_zeroed()
        except BaseException:
            self.reader.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.reader.stop()

    def __iter__(self) -> Iterator[Contact]:
        """Give the latest reading, again and again, each once; what came in between is decoded and left out.

        When nothing comes for `SILENT_S`, or the board is unplugged, that is said in a reading of NaN.
        """
        while True:
            yield self._contact(self.poll(SILENT_S, latest=True), -1)

    def every(self) -> Iterator[Contact]:
        """Give every reading; who is two minutes late loses the oldest, and `reader.missed_bytes_n` counts them."""
        while True:
            readings = self.poll(SILENT_S)
            for i in range(max(len(readings) if readings else 0, 1)):
                yield self._contact(readings, i)

    def zero(self) -> None:
        """Take the no-load reading from the next second in which nothing touches the skin; any thread may ask."""
        self._zero_asked = True  # `poll` begins anew: what it gathers, its thread alone changes

    @property
    def zeroed(self) -> bool:
        return self._zero is not None and not self._zero_asked

    @property
    def silent(self) -> bool:
        """Say whether nothing comes: what was read last is no more so."""
        return not self.found.problem and self.reader.unix_s() - self._ends[-1][1] > SILENT_S

    @property
    def lost_bytes_n(self) -> int:
        """Count bytes that came too late or were no frame's; the end of a frame that was on its way is not lost."""
        skipped_n = sum(count for name, count in self.account.items() if name.startswith("skipped_"))
        return skipped_n + self.reader.missed_bytes_n - self._opening_bytes_n

    def alarms(self) -> tuple[str, ...]:
        """Say what is wrong now."""
        gone = [f"{'unplugged' if self.reader.was_plugged_in else 'not open'}: {self.reader.problem}"]
        own = gone if self.reader.problem and not self.reader.plugged_in else []
        own += [self.found.problem] if self.found.problem else []
        own += [self.problem] if self.problem else []
        own += [ZEROING] if not self.found.problem and not self.zeroed else []
        health = [] if self.found.problem else self.health.active(self.reader.unix_s())
        return (*own, *(alarm.name for alarm in health))

    def poll(self, wait_s: float, *, latest: bool = False) -> Readings | None:
        """Decode what came, wait for it at most so long, and estimate; `latest` estimates the last frame alone."""
        chunks = self.reader.take(wait_s)
        if not chunks:
            if self.silent:
                self.health.note("nothing comes", 1, self.reader.unix_s(), "unplug")
            return None
        if self.found.problem:
            chunks = self._recognise(chunks)
        if not chunks:
            return None
        frames, t_s = self._decode(chunks)
        if not len(frames):
            return None
        sound = self.health.feed(frames, t_s[-1])
        if not self.zeroed:
            self._take_zero(frames.where(sound), t_s)
        if latest:
            last = np.arange(len(frames)) == len(frames) - 1
            frames, t_s, sound = frames.where(last), t_s[-1:], sound[-1:]
        return self._estimate(frames, t_s, sound)

    def _wait_until_zeroed(self) -> None:
        end_s = self.reader.unix_s() + OPENING_S
        while not self.zeroed:
            if self.reader.unix_s() > end_s:
                got, remedy = "; ".join(self.alarms()) or "nothing", "See what `reskin ports` says of it."
                raise CaptureError(self.port, "the skin", f"heard and zeroed within {OPENING_S:g} s", got, remedy)
            self.poll(SILENT_S)

    def _recognise(self, chunks: list[Chunk]) -> list[Chunk]:
        """Gather bytes until a format shows; give all of them then."""
        self._head += chunks
        bytes_n = sum(len(chunk) for chunk, _ in self._head)
        if self._head[-1][1] - self._head[0][1] < HEAD_S and bytes_n < HEAD_BYTES_MAX_N:
            return []
        chunks, self._head = self._head, []
        found = find.recognise(self.port, chunks)
        if found.problem:
            self.found = found
            return []
        if self.answers is not None and self.answers.channels_n != 3 * found.chips_n:
            self._refuse_model(self.answers, found.chips_n)
        self.health, self.layout = Health(found.chips_n, self.fault_policy), layout_of(found.chips_n)
        self._begin_stream(found)
        self.found = found  # last: another thread that sees it asks for the rest
        return chunks

    def _refuse_model(self, answers: Networks | Map, chips_n: int) -> None:
        """Do without the map, which nobody asked for, on a board that it is not of; raise for networks."""
        if isinstance(answers, Networks):
            remedy = "Take a model of such boards."
            raise SchemaError(self.port, "channels", f"the {answers.channels_n} of the model", 3 * chips_n, remedy)
        self.answers, self.problem = None, f"no place, no force: the {answers.about} is for five chips; name a model"

    def _begin_stream(self, found: find.Found) -> None:
        self._stream = FrameStream(found.wire, found.chips_n)
        self._counted: Counter[str] = Counter()
        self._lost_in_row_n = self._opening_n = 0
        self._ends: deque[tuple[int, float]] = deque([(0, self.reader.unix_s())], maxlen=ENDS_KEPT_N)

    def _decode(self, chunks: list[Chunk]) -> tuple[Frames, Float64[np.ndarray, " f"]]:
        """Decode chunks; a board that was plugged in again begins a stream anew."""
        anew = [i for i, (chunk, _) in enumerate(chunks) if chunk == PLUGGED_IN]
        parts = []
        for first, last in pairwise([0, *anew, len(chunks)]):
            if first in anew:
                self._stream.close()
                self._count(chunks[first][1])
                self._begin_stream(self.found)
            parts.append(self._feed(chunks[first:last]))
        frames = concatenate([part for part, _ in parts], self.found.chips_n)
        return frames, np.concatenate([t_s for _, t_s in parts])

    def _feed(self, chunks: list[Chunk]) -> tuple[Frames, Float64[np.ndarray, " f"]]:
        """Decode chunks of one stream; a frame came when the chunk that ends it did."""
        for chunk, came_s in chunks:
            self._ends.append((self._ends[-1][0] + len(chunk), came_s))
        frames = self._stream.feed(b"".join(chunk for chunk, _ in chunks))
        self._count(self._ends[-1][1])
        last = len(self._ends) - 1
        chunk_i = (min(bisect_left(self._ends, end, key=itemgetter(0)), last) for end in frames.end_byte.tolist())
        return frames, np.fromiter((self._ends[i][1] for i in chunk_i), np.float64, len(frames))

    def _count(self, now_s: float) -> None:
        counted = Counter(self._stream.account())
        more, first, self._counted = counted - self._counted, not self._counted["frames_n"], counted
        self.account += more
        lost_n = sum(count for name, count in more.items() if name.startswith("skipped_"))
        frame_n = more["frame_bytes_n"] / more["frames_n"] if more["frames_n"] else 16 * self.found.chips_n  # at least
        if first and self._opening_n + lost_n <= frame_n + 1:  # behind a last byte alone, one is not sure
            self._opening_n, self._opening_bytes_n = self._opening_n + lost_n, self._opening_bytes_n + lost_n
            return  # the port was opened in a frame
        self.health.note("bytes lost between frames", lost_n, now_s, "torn")
        self._lost_in_row_n = 0 if more["frames_n"] else self._lost_in_row_n + lost_n
        if self._lost_in_row_n > GARBAGE_FRAMES_N * 16 * self.found.chips_n:  # no format has less than 16 bytes a chip
            self.health.note("no frames in what comes: wrong baud rate?", lost_n, now_s, "wrong_baud")

    def _begin_zero(self) -> None:
        self._zero: Zero | None = None
        self._quiet: list[Frames] = []
        self._quiet_from_s = np.inf
        self._zero_asked = False  # last: who asks from here on is heard by the next `poll`

    def _take_zero(self, frames: Frames, t_s: Float64[np.ndarray, " f"]) -> None:
        if self._zero_asked:
            self._begin_zero()
        self._quiet.append(frames)
        self._quiet_from_s = min(self._quiet_from_s, t_s[0])
        lasted_s = t_s[-1] - self._quiet_from_s
        b_uT = np.concatenate([part.b_uT for part in self._quiet])
        if len(b_uT) < 2 or (lasted_s < ZERO_S and len(b_uT) < ZERO_FRAMES_MAX_N):
            return
        self._quiet, self._quiet_from_s = [], np.inf
        with suppress(CaptureError):  # it moved: the next second may be quiet; frames of one chunk came at once
            quiet_n = quiet_start(np.linspace(0, lasted_s, len(b_uT)), b_uT, where=self.port)
            if self.answers is not None:
                self.answers.zero(b_uT[:quiet_n])
            self._zero = Zero.of(b_uT[:quiet_n])

    def _estimate(self, frames: Frames, t_s: Float64[np.ndarray, " f"], sound: Bool[np.ndarray, " f"]) -> Readings:
        answer, sd_mm = np.full((len(frames), 3), np.nan), np.full((len(frames), 2), np.nan)
        zero = self._zero
        if zero is None:
            unknown_uT, contact = np.full_like(frames.b_uT, np.nan), np.zeros(len(t_s), bool)
            return Readings(t_s, frames.b_uT, unknown_uT, answer, sd_mm, contact)
        db_uT = (np.where(sound[:, None], frames.b_uT, np.nan) - zero.noload_uT).astype(np.float32)
        contact = np.linalg.norm(db_uT, axis=1) > zero.contact_uT  # of NaN, nothing is more
        if self.answers is not None:
            answer[sound & ~contact, 2] = 0.0
            if contact.any():
                answer[contact], sd_mm[contact], unlike = self.answers(db_uT[contact])
                self.health.note(UNLIKE, int(unlike.sum()), t_s[-1])
        if sound[-1] and self.layout.known:
            self.health.feed_change(db_uT[-1], self.layout.turn, t_s[-1])
        return Readings(t_s, frames.b_uT, db_uT, answer, sd_mm, contact)

    def _contact(self, readings: Readings | None, i: int) -> Contact:
        if readings is None:
            nothing = np.full(3 * self.found.chips_n, np.nan, np.float32)
            return Contact(self.reader.taken_s, np.nan, np.nan, np.nan, (np.nan, np.nan), nothing, self.alarms())
        (x_mm, y_mm, force_N), (sd_x_mm, sd_y_mm) = readings.answer[i].tolist(), readings.sd_mm[i].tolist()
        return Contact(float(readings.t_s[i]), x_mm, y_mm, force_N, (sd_x_mm, sd_y_mm), readings.b_uT[i], self.alarms())
