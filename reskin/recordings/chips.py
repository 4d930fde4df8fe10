"""Can the chips of a recording be believed? In: all its fields, or frames block by block. Out: masks of rows.

A failed read or a stuck chip costs a row; a chip of another scale than its header or neighbours costs the recording,
as nobody knows what its numbers mean. Refuses to know layouts, time and dwells, and to mend anything.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int

from reskin.board import faults
from reskin.board import faults as limits
from reskin.board.stream import TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC
from reskin.board.wire import TEXT_WIRES, Frames, record_type
from reskin.errors import CaptureError
from reskin.recordings.fault_policy import Decisions, Ledger
from reskin.recordings.header import Header
from reskin.recordings.text import check_fields

SCALE_FRAMES_N = 400  # real recordings show each sound chip's grid in so many frames; in 200 it may hide
GRID_ROWS_N = 1000
ORDER_OF_OTHER: Mapping[str | None, tuple[str, int]] = {
    "text-xyzt": ("text-txyz", 0),
    "text-txyz": ("text-xyzt", 2),
}  # and which field is a temperature then
SPREAD_MAX_degC = 10.0  # chips of one board, in one block
USUAL_SCALE = "that of the other chips, and not a reset chip's"

Marks = Bool[np.ndarray, " f"]


class Rows(NamedTuple):
    """What became of each row: `whole` ones are kept; the others failed or, if not, are stuck or, if not, no reading.

    `found` tells of each fault how often, from where to where, and what was decided.
    """

    whole: Bool[np.ndarray, " f"]
    failed: Bool[np.ndarray, " f"]
    stuck: Bool[np.ndarray, " f"]
    beyond: Bool[np.ndarray, " f"]
    found: Mapping[str, int]

    def losses(self) -> dict[str, int]:
        """Count the rows that are not whole, as accounts do; faults that are decided anew stand there if there are."""
        beyond_n = int(self.beyond.sum())
        return {
            "dropped_failed_read_rows_n": int(self.failed.sum()),
            "dropped_stuck_chip_rows_n": int(self.stuck.sum()),
            **({"dropped_out_of_range_rows_n": beyond_n} if beyond_n else {}),
            **self.found,
        }

    def part(self, rows: slice) -> "Rows":
        """Keep some of the rows; what was found is of all."""
        return Rows(self.whole[rows], self.failed[rows], self.stuck[rows], self.beyond[rows], self.found)


def find_whole_rows(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"], header: Header, *, where: str,
    decisions: Decisions, row: Int[np.ndarray, " f"] | None = None,
) -> Rows:  # fmt: skip
    """Tell the rows to keep; raise if no row holds a reading of every chip, or for a fault that is refused.

    A chip of another scale shows among all rows that did not fail, kept or not. `row` numbers the rows as the file
    does, if some were left out before; else they count from 1.
    """
    ledger = Ledger(decisions, where, "row")
    row = 1 + np.arange(len(b_uT)) if row is None else row
    drop, beyond, failed, _ = _note_readings(ledger, b_uT, temperature_degC, row)
    if failed.all():
        remedy = "Mend the wiring, and record again."
        raise CaptureError(where, "rows", "read from every chip", "failed I2C reads in all of them", remedy)
    rows = np.flatnonzero(~failed)
    for block in np.array_split(rows, max(1, len(rows) // GRID_ROWS_N)):
        with noting_reset(ledger, decisions, row[block]):
            _check_scale(b_uT[block], header, where=f"{where} from row {row[block[0]]}")
    channels = faults.ConstantChannels(header.chips_n)
    channels.feed(b_uT[~failed])
    note_constant(channels, ledger, decisions, where, row)
    stuck = ledger.note("stuck", np.asarray(faults.stuck_chips(b_uT).any(axis=1)) & ~failed, row) & ~drop
    beyond &= ~stuck
    return Rows(~(drop | stuck | beyond), drop, stuck, beyond, ledger.account())


def _note_readings(
    ledger: Ledger, b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"],
    at: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"],
) -> tuple[Marks, Marks, Marks, Marks]:  # fmt: skip
    """Note what readings show by themselves; mark what to drop (not read, out of range), all not read, all untrue."""
    failed = np.asarray(faults.failed_reads(b_uT, temperature_degC).any(axis=1))
    zero = np.asarray(faults.zero_reads(b_uT).any(axis=1)) & ~failed
    hot = np.asarray(limits.too_hot(temperature_degC).any(axis=1)) & ~failed & ~zero
    full = limits.saturated(b_uT).any(axis=1) & ~failed & ~zero
    drop = ledger.note("failed_read", failed, at) | ledger.note("zeros", zero, at)
    beyond = ledger.note("too_hot", hot, at) | ledger.note("saturated", full, at)
    return drop, beyond & ~drop, failed | zero, failed | zero | hot | full


@contextmanager
def noting_reset(
    ledger: Ledger, decisions: Decisions, at: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"]
) -> Iterator[None]:
    """Let a chip of another scale be noted in place of refused, if so decided; the sentence says more of a refusal."""
    try:
        yield
    except CaptureError:
        if decisions.chip_reset == "refuse":
            raise
        ledger.note("chip_reset", np.ones(len(at), bool), at)


def note_constant(
    channels: faults.ConstantChannels, ledger: Ledger, decisions: Decisions, where: str,
    at: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"],
) -> None:  # fmt: skip
    """Note or refuse channels that never changed in the whole recording; the error names them."""
    found = channels.found()
    if found and decisions.constant_channel == "refuse":
        remedy = (
            "Check the wiring, the chip and the columns, and record again; or accept it by faults: constant_channel: "
            "flag in params.yaml."
        )
        got = f"one value throughout for {', '.join(found)}"
        raise CaptureError(where, "each channel", "one that changes", got, remedy)
    if found:
        ledger.note("constant_channel", np.ones(len(at), bool), at)


def _check_scale(b_uT: Float[np.ndarray, "f ch"], header: Header, *, where: str) -> None:
    """Check a block of rows, as a chip may lose its settings on the way."""
    lsb_uT = faults.find_lsb(b_uT)
    hidden = np.isnan(lsb_uT).any(axis=1)
    without = hidden & (not hidden.all()) & (len(b_uT) >= GRID_ROWS_N)
    odd = faults.odd_scales(lsb_uT, _expected_uT(header))
    shown_uT = np.where(without[:, None], np.nan, lsb_uT)
    _refuse_scales(odd | without, shown_uT, header, where, rule=USUAL_SCALE)


def _expected_uT(header: Header) -> tuple[float, float] | None:
    return None if header.firmware is None else (header.firmware.lsb_xy_uT, header.firmware.lsb_z_uT)


def _refuse_scales(
    strange: Bool[np.ndarray, " k"], lsb_uT: Float[np.ndarray, "k 2"], header: Header, where: str, *, rule: str
) -> None:
    if strange.any():
        chips = np.flatnonzero(strange)
        xy_uT, z_uT = lsb_uT[chips[0]]
        got = f"{xy_uT:.3g} uT in x, y and {z_uT:.3g} uT in z" if np.isfinite([xy_uT, z_uT]).any() else "no one step"
        if header.firmware is not None:
            rule = f"{_expected_uT(header)} uT"
        remedy = "A chip lost its settings: reset the board, record again."
        raise CaptureError(where, f"the LSB of chip {', '.join(map(str, chips))}", rule, got, remedy)


class _Edge(NamedTuple):
    """What is remembered of the last frame of a block: its time, the board's time, its last byte."""

    t_s: float
    device_s: float
    end_byte: int


class Watch:
    """Looks at every frame once; holds back at most `SCALE_FRAMES_N` of them."""

    def __init__(self, header: Header, where: str, decisions: Decisions) -> None:
        self.ledger = Ledger(decisions, where, "ms")
        self._decisions = decisions
        self._header, self._where = header, where
        self._stuck = faults.StuckChips(header.chips_n)
        self._channels = faults.ConstantChannels(header.chips_n)
        self._span_s: list[float] = []  # first and last time
        self._held = np.zeros((0, 3 * header.chips_n), np.float32)
        self._held_s = np.zeros(0)
        self._begun = False
        self._checked_n = 0
        self._lsb_uT = np.full((header.chips_n, 2), np.nan)  # of each chip, once known
        self._before_uT: Float32[np.ndarray, "1 ch"] | None = None  # the field of the last sound frame
        self._edge: _Edge | None = None

    def look(self, frames: Frames, t_s: Float64[np.ndarray, " f"]) -> Rows:
        """Note every fault of the next frames, and tell the frames to keep; raise for what is refused."""
        drop, beyond, failed, untrue = _note_readings(self.ledger, frames.b_uT, frames.temperature_degC, t_s)
        stuck = self.ledger.note("stuck", self.stuck(frames, failed, t_s) & ~untrue, t_s)
        self._look_at_bytes(frames, t_s)
        beyond[~untrue] |= self._look_at_steps(frames.where(~untrue), t_s[~untrue])
        beyond &= ~stuck
        self._channels.feed(frames.b_uT[~untrue])
        if len(t_s):
            self._span_s = [*(self._span_s or [float(t_s[0])])[:1], float(t_s[-1])]
        return Rows(~(drop | stuck | beyond), drop, stuck, beyond, {})

    def close(self) -> None:
        """Note what only the whole stream shows; raise for what is refused."""
        note_constant(self._channels, self.ledger, self._decisions, self._where, np.array(self._span_s))

    def _look_at_steps(self, frames: Frames, t_s: Float64[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
        """Note what shows from one sound frame to the next, also from the last one before; mark what to drop."""
        if not len(frames):
            return np.zeros(0, bool)
        before_uT = frames.b_uT[:1] + 1 if self._before_uT is None else self._before_uT  # a first frame repeats none
        self._before_uT = frames.b_uT[-1:]
        step_uT = np.diff(frames.b_uT, axis=0, prepend=before_uT)
        wrapped = np.asarray(limits.wrapped(step_uT, self._lsb_uT).any(axis=1))
        note = self.ledger.note
        return note("int16_wrap", wrapped, t_s) | note("repeated", limits.repeated(step_uT), t_s)

    def _look_at_bytes(self, frames: Frames, t_s: Float64[np.ndarray, " f"]) -> None:
        """Note what the clocks and the places of frames among the bytes say, the last frame before included."""
        if not len(frames):
            return
        first = _Edge(float(t_s[0]), float(frames.device_s[0]), 0)
        before, note, wire = self._edge or first, self.ledger.note, self._header.wire
        self._edge = _Edge(float(t_s[-1]), float(frames.device_s[-1]), int(frames.end_byte[-1]))
        device_step_s = np.diff(frames.device_s, prepend=before.device_s)
        missing_n = limits.missing(device_step_s)
        note("clock_jump", limits.clock_jumps(device_step_s), t_s)
        note("dropped", missing_n > 0, t_s, int(missing_n.sum()))
        note("unplug", limits.silences(np.diff(t_s, prepend=before.t_s)), t_s)
        frame_n = None if wire is None or wire in TEXT_WIRES else record_type(wire, self._header.chips_n).itemsize
        lost_n = limits.lost_before(frames.end_byte, before.end_byte, frame_n)
        usual_n = frame_n or int(np.median(np.diff(frames.end_byte, prepend=before.end_byte)))
        garbage = lost_n > limits.GARBAGE_FRAMES_N * usual_n
        note("wrong_baud", garbage, t_s, int(lost_n[garbage].sum()))
        note("torn", (lost_n > 0) & ~garbage, t_s, int(lost_n[~garbage].sum()))

    def stuck(
        self, frames: Frames, failed: Bool[np.ndarray, " f"], t_s: Float64[np.ndarray, " f"] | None = None
    ) -> Bool[np.ndarray, " f"]:
        """Mark the frames in which a chip had stopped; raise if their numbers cannot be what they are said to be."""
        finite = np.isfinite(frames.b_uT).all(axis=1) & np.isfinite(frames.temperature_degC).all(axis=1)
        sound = finite & ~failed
        if not self._begun and sound.any():
            self._begun = True
            self._check_first(frames.where(sound))
        self._check_scales(frames.b_uT[sound], np.zeros(int(sound.sum())) if t_s is None else t_s[sound])
        stuck = np.zeros(len(frames), bool)
        stuck[sound] = self._stuck.feed(frames.b_uT[sound]).any(axis=1)
        return stuck

    def _check_first(self, frames: Frames) -> None:
        wire = self._header.wire
        if wire in ORDER_OF_OTHER:
            other, axis = ORDER_OF_OTHER[wire]
            swapped_degC = frames.b_uT[:, axis::3]
            here, there = _spread(frames.temperature_degC), _spread(swapped_degC)
            nonsense = not _is_mostly_warm(frames.temperature_degC)
            if nonsense or (there < SPREAD_MAX_degC < here and _is_mostly_warm(swapped_degC)):
                low, high = np.percentile(frames.temperature_degC, [5, 95])
                rule = f"{TEMPERATURE_MIN_degC:g} to {TEMPERATURE_MAX_degC:g} degC, and alike on all chips"
                remedy = f"Is the wire format {other}?"
                raise CaptureError(self._where, f"temperatures of {wire}", rule, f"{low:.4g} to {high:.4g}", remedy)
        check_fields(frames.b_uT, self._where, first_line_n=1)

    def _check_scales(self, b_uT: Float[np.ndarray, "f ch"], t_s: Float64[np.ndarray, " f"]) -> None:
        held, held_s = np.concatenate([self._held, b_uT]), np.concatenate([self._held_s, t_s])
        for first in range(0, len(held) - SCALE_FRAMES_N + 1, SCALE_FRAMES_N):
            with noting_reset(self.ledger, self._decisions, held_s[first : first + SCALE_FRAMES_N]):
                self._check_scale(held[first : first + SCALE_FRAMES_N])
            self._checked_n += SCALE_FRAMES_N
        done_n = len(held) // SCALE_FRAMES_N * SCALE_FRAMES_N
        self._held, self._held_s = held[done_n:].copy(), held_s[done_n:].copy()

    def _check_scale(self, b_uT: Float[np.ndarray, "f ch"]) -> None:
        lsb_uT = faults.find_lsb(b_uT, steps_min_n=faults.SURE_STEPS_MIN_N)
        changed = np.any(np.abs(lsb_uT / self._lsb_uT - 1) > faults.LSB_TOLERANCE, axis=1)
        strange = changed | faults.odd_scales(lsb_uT, _expected_uT(self._header))
        where = f"{self._where} from sound frame {self._checked_n + 1}"
        _refuse_scales(strange, lsb_uT, self._header, where, rule=f"as before, {USUAL_SCALE}")
        self._lsb_uT = np.where(np.isnan(self._lsb_uT), lsb_uT, self._lsb_uT)


def _spread(temperature_degC: Float32[np.ndarray, "f k"]) -> float:
    low_degC, high_degC = np.percentile(temperature_degC, [5, 95])
    return float(high_degC - low_degC)


def _is_mostly_warm(temperature_degC: Float32[np.ndarray, "f k"]) -> bool:
    warm = (temperature_degC >= TEMPERATURE_MIN_degC) & (temperature_degC <= TEMPERATURE_MAX_degC)
    return bool(warm.mean() > 0.5)
