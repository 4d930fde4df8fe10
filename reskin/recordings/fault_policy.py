"""Decide what happens to the faults of a recording, according to a policy with one action for each kind of fault.

There are three actions: drop the faulty readings; flag them, which means to keep and count them; or refuse the whole
recording. `FaultLog` applies the policy to a stream, which may be passed in several parts of any length. `check_log`
applies it to a log, and `check_rows` to a table of presses. All count the faults.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from reskin.board.faults import (
    GRID_ROWS_N,
    SCALE_FRAMES_N,
    STUCK_FRAMES_MIN_N,
    ConstantChannels,
    FaultDetector,
    Faults,
    ReadingFaults,
    StuckChips,
    find_lsb,
    find_reading_faults,
    reset_chips,
)
from reskin.board.wire import Frames, concatenate
from reskin.config import Strict
from reskin.errors import CaptureError, ParamsError, did_you_mean
from reskin.recordings.units import check_fields

# Statistics of a log (rate, LSB of the chips) are those of its first frames, so that a log of any length can be read in
# blocks. At 400 Hz, these are 11 minutes.
LOG_HEAD_FRAMES_N, LOG_BLOCK_FRAMES_N = 2**18, 2**16
# Assumed limits of the frame rate: no board logs at a lower rate, and no chip measures at a higher rate.
RATE_MIN_HZ, RATE_MAX_HZ = 1.0, 10_000.0
KEPT_SHARE_MIN = 0.5  # assumed: if a smaller share of the frames is fault-free, contacts of the log would be missed
GAP_FRAMES = 1.5  # frames are missing if the time between two frames exceeds the median time by this factor
USUAL_LSB = "the LSB of the other chips, and not the LSB of a chip with its power-on settings"

Action = Literal["drop", "flag", "refuse"]
DropOrRefuse = Literal["drop", "refuse"]  # actions for stray bytes between frames, which cannot be kept as readings
# Actions for faults that affect many readings. It would be of no use to drop single readings.
FlagOrRefuse = Literal["flag", "refuse"]


class FaultPolicy(Strict):
    """The action that is taken for each kind of fault; section `faults` of `params.yaml` contains these actions."""

    failed_read: Action  # the I2C read of a chip failed
    zeros: Action  # a chip's reading consists of zeros
    stuck: Action  # the readings of a chip stay the same while others change
    constant_channel: FlagOrRefuse  # Bx, By or Bz of a chip never changes while its other channels do
    chip_reset: FlagOrRefuse  # a chip's LSB changes, or differs from the LSB of the other chips
    too_hot: Action  # a chip's temperature is out of range: too hot or too cold
    saturated: Action  # a field is at the end of the chip's range
    int16_wrap: Action  # a field changes between two frames by more LSBs than an int16 can represent
    repeated: Action  # many frames equal the previous frame; a few are normal if the firmware is faster than the chips
    dropped: FlagOrRefuse  # frames are missing, according to the board's clock
    clock_jump: FlagOrRefuse  # the board's clock goes backwards, or jumps
    unplug: FlagOrRefuse  # no data arrives for a second or more
    torn: DropOrRefuse  # stray bytes between two frames
    wrong_baud: DropOrRefuse  # very many stray bytes between two frames


# A policy that never refuses a recording. It is used to test whether a recording can be read. For each fault, it has
# the first of the possible actions, which is never "refuse".
REFUSE_NONE = FaultPolicy.model_validate(
    {name: get_args(field.annotation)[0] for name, field in FaultPolicy.model_fields.items()}
)

# The policy of `reskin.load_recording`. It is the same as in `params.yaml`; a test compares the two.
STANDARD_POLICY = FaultPolicy(
    failed_read="drop", zeros="drop", stuck="drop", torn="drop", wrong_baud="drop",
    constant_channel="refuse", chip_reset="refuse",
    too_hot="flag", saturated="flag", int16_wrap="flag", repeated="flag", dropped="flag", clock_jump="flag",
    unplug="flag",
)  # fmt: skip


def override(policy: FaultPolicy, overrides: Iterable[str], where: str) -> FaultPolicy:
    """Return a policy with other actions for some faults, which are given as texts `NAME=ACTION`.

    `where` is the command-line option that contains these texts; error messages name it.

    >>> override(STANDARD_POLICY, ["too-hot=drop"], "--on-fault").too_hot
    'drop'
    """
    changes: dict[str, Any] = {}
    for text in overrides:
        name, _, action = text.replace("-", "_").partition("=")
        kind = FaultPolicy.model_fields[name].annotation if name in FaultPolicy.model_fields else None
        allowed = get_args(kind)
        if action not in allowed:
            if allowed:
                raise ParamsError(where, name, " or ".join(allowed), repr(action)[:40], f"Try: {name}={allowed[0]}")
            guess = did_you_mean(name, FaultPolicy.model_fields).replace("?", f"={action}?")
            names = ", ".join(FaultPolicy.model_fields)
            raise ParamsError(
                f"{where}: {repr(text)[:40]} must be NAME=ACTION, where ACTION is drop, flag or refuse.{guess} The "
                f"possible NAMEs are: {names}"
            )
        changes[name] = action
    return policy.model_copy(update=changes)


def reading_faults_of_table(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"], where: str
) -> ReadingFaults:
    """Mark the faults of single readings of a whole table, from whose sound rows the LSB of the chips is found.

    Raises CaptureError if all readings that did not fail are equal.
    """
    sound = ~find_reading_faults(b_uT, temperature_degC).faulty_rows
    found = find_reading_faults(b_uT, temperature_degC, find_lsb(b_uT[sound]))
    read_uT = b_uT[~found.failed_rows]
    if len(read_uT) >= STUCK_FRAMES_MIN_N and (read_uT == read_uT[0]).all():
        raise CaptureError(
            f"{where}: every reading is the same, so the board or the library that reads it repeats one value. Check "
            "that the library is started and that the chips answer, and record again."
        )
    return found


@dataclass
class FaultRecord:
    """How often one kind of fault occurred, the positions of its first and last occurrence, and the action taken.

    In a stream, a position is the stream time in s; in a table, it is the number of a row. The positions are NaN if no
    faulty frame has a known time. This is possible if the recorder was killed, because the time of the last bytes may
    not have been written.
    """

    count_n: int
    first: float
    last: float
    action: Action


class CheckedRows(NamedTuple):
    """The rows (or frames) to keep, and the rows to drop, as masks.

    Each dropped row is marked in one of the masks `failed`, `stuck` and `out_of_range`. If several of these reasons
    apply, it is marked in the first of these masks. `counts` is the result of `FaultLog.account`.
    """

    keep: Bool[np.ndarray, " f"]
    failed: Bool[np.ndarray, " f"]
    stuck: Bool[np.ndarray, " f"]
    out_of_range: Bool[np.ndarray, " f"]
    counts: Mapping[str, int]

    def account(self) -> dict[str, int]:
        """Return the number of dropped rows for each reason, together with `counts`."""
        out_of_range_n = int(self.out_of_range.sum())
        return {
            "dropped_failed_read_rows_n": int(self.failed.sum()),
            "dropped_stuck_chip_rows_n": int(self.stuck.sum()),
            **({"dropped_out_of_range_rows_n": out_of_range_n} if out_of_range_n else {}),
            **self.counts,
        }

    def part(self, rows: slice) -> "CheckedRows":
        """Return the masks for a slice of the rows; `counts` stays the same, although it counts all rows."""
        return CheckedRows(self.keep[rows], self.failed[rows], self.stuck[rows], self.out_of_range[rows], self.counts)


class FaultLog:
    """A log of the faults of one recording, to which a policy is applied.

    `where` is the name of the recording in errors. `unit` is the unit in which the position of a fault is reported.
    """

    def __init__(self, policy: FaultPolicy, where: str, unit: Literal["ms", "row"]) -> None:
        self.records: dict[str, FaultRecord] = {}
        self._policy, self._where, self._unit = policy, where, unit
        self._per_unit = {"ms": 1000, "row": 1}[unit]  # factor from the unit of positions (s, or rows) to `unit`
        self._span: tuple[float, float] | None = None  # first and last time of the stream in s

    def record(
        self,
        fault: str,
        mask: Bool[np.ndarray, " f"],
        position: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"],
        count_n: int | None = None,
    ) -> Bool[np.ndarray, " f"]:
        """Record the rows (or frames) that `mask` marks as faulty; return the mask of the rows that the policy drops.

        `position` is the time in s, or the number, of each row. The fault is counted `count_n` times; if `count_n` is
        None, it is counted once per marked row. Raises `CaptureError` if the policy refuses recordings with this fault.
        """
        action: Action = getattr(self._policy, fault)
        if mask.any():
            known = position[mask & np.isfinite(position)]
            first, last = (float(known[0]), float(known[-1])) if len(known) else (math.nan, math.nan)
            count_n = int(mask.sum()) if count_n is None else count_n
            if action == "refuse":
                place = f"{self._unit} {first * self._per_unit:.0f}" if len(known) else "an unknown time"
                raise CaptureError(
                    f"{self._where}: found fault {fault.replace('_', ' ')} (count {count_n}, first at {place}). Repair "
                    f"the board and record again, or choose another action for faults.{fault} in params.yaml."
                )
            record = self.records.setdefault(fault, FaultRecord(0, first, last, action))
            record.count_n += count_n
            record.first, record.last = float(np.fmin(record.first, first)), float(np.fmax(record.last, last))
        return mask if action == "drop" else np.zeros_like(mask)

    def apply(self, faults: Faults, t_s: Float64[np.ndarray, " f"]) -> CheckedRows:
        """Record the faults of the next frames of a stream; return which frames to keep.

        Raises `CaptureError` for a fault that the policy refuses.
        """
        failed, out_of_range = self.record_readings(faults.readings, t_s)
        for window in faults.scale:
            where = f"{self._where} from frame {window.first_frame} on (counted without failed reads)"
            wrong, rule = window.unusual | window.changed, f"the same as before, {USUAL_LSB}"
            self.record_scale(wrong, window.lsb_uT, window.expected_lsb_uT, where, rule, window.t_s)
        stuck = self.record("stuck", np.asarray(faults.stuck.any(axis=1)), t_s)
        self.record("clock_jump", faults.clock_jump, t_s)
        self.record("dropped", faults.missing_frames_n > 0, t_s, int(faults.missing_frames_n.sum()))
        self.record("unplug", faults.unplug, t_s)
        self.record("wrong_baud", faults.garbage_bytes_n > 0, t_s, int(faults.garbage_bytes_n.sum()))
        self.record("torn", faults.torn_bytes_n > 0, t_s, int(faults.torn_bytes_n.sum()))
        out_of_range |= self.record("int16_wrap", np.asarray(faults.int16_wrap.any(axis=1)), t_s)
        out_of_range |= self.record("repeated", faults.repeated, t_s)
        out_of_range &= ~stuck
        if len(t_s):
            self._span = (self._span[0] if self._span else float(t_s[0])), float(t_s[-1])
        return CheckedRows(~(failed | stuck | out_of_range), failed, stuck, out_of_range, {})

    def record_readings(
        self, readings: ReadingFaults, position: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"]
    ) -> tuple[Bool[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
        """Record the faults that can be detected from a single reading.

        Returns two masks of rows to drop. The first marks the rows with a failed read or with zeros; the second marks
        those other rows that have a temperature or field out of range.
        """
        failed, zeros = np.asarray(readings.failed_read.any(axis=1)), np.asarray(readings.zeros.any(axis=1))
        dropped = self.record("failed_read", failed, position) | self.record("zeros", zeros & ~failed, position)
        read = ~readings.failed_rows
        too_hot, saturated = readings.too_hot.any(axis=1) & read, readings.saturated.any(axis=1) & read
        out_of_range = self.record("too_hot", too_hot, position) | self.record("saturated", saturated, position)
        return dropped, out_of_range & ~dropped

    def record_scale(
        self,
        wrong: Bool[np.ndarray, " k"],
        lsb_uT: Float[np.ndarray, "k 2"],
        expected_lsb_uT: tuple[float, float] | None,
        where: str,
        rule: str,
        position: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"],
    ) -> None:
        """Record fault `chip_reset` for a block of frames, if the LSB of any chip in this block is wrong.

        `wrong` marks the chips with a wrong LSB, and `lsb_uT` is the LSB of each chip. `rule` describes the right LSB
        in words; the error message quotes it if `expected_lsb_uT` is None. `position` is the time or row of each frame
        of the block. Raises `CaptureError` if the policy refuses recordings with this fault.
        """
        if wrong.any() and self._policy.chip_reset == "refuse":
            chips = np.flatnonzero(wrong)
            xy_uT, z_uT = lsb_uT[chips[0]]
            known = np.isfinite([xy_uT, z_uT]).any()
            got = f"{xy_uT:.3g} uT in x, y and {z_uT:.3g} uT in z" if known else "values without a common step"
            rule = rule if expected_lsb_uT is None else f"{expected_lsb_uT} uT"
            remedy = (
                "A chip has probably lost its settings. Reset the board, so that its firmware configures the chips "
                "again, and record again; or keep the rows with faults: chip_reset: flag in params.yaml."
            )
            raise CaptureError(where, f"the LSB of chip {', '.join(map(str, chips))}", rule, got, remedy)
        if wrong.any():
            self.record("chip_reset", np.ones(len(position), bool), position)

    def record_constant(
        self, channels: list[str], position: Float64[np.ndarray, " f"] | Int[np.ndarray, " f"] | None = None
    ) -> None:
        """Record channels that never changed in a whole recording.

        `position` is the time or row of each reading. If it is None, the first and the last time of the stream are
        used. Raises `CaptureError` if the policy refuses recordings with constant channels.
        """
        if channels and self._policy.constant_channel == "refuse":
            raise CaptureError(
                f"{self._where}: {', '.join(channels)} never changed in the whole recording. Check the wiring, the "
                "chip and the columns, and record again. To accept such channels, set faults.constant_channel to flag "
                "in params.yaml."
            )
        if channels:
            position = np.array(self._span) if position is None else position
            self.record("constant_channel", np.ones(len(position), bool), position)

    def account(self) -> dict[str, int]:
        """Return the count of each fault that was found and, if they are known, its first and last position.

        The keys of the counts contain the action that was taken, as in `fault_stuck_dropped_n`.
        """
        account: dict[str, int] = {}
        participles = {"drop": "dropped", "flag": "flagged", "refuse": "refused"}
        for fault, record in self.records.items():
            account[f"fault_{fault}_{participles[record.action]}_n"] = record.count_n
            if not math.isnan(record.last):
                account[f"fault_{fault}_first_{self._unit}"] = round(record.first * self._per_unit)
                account[f"fault_{fault}_last_{self._unit}"] = round(record.last * self._per_unit)
        return account


def check_rows(
    b_uT: Float[np.ndarray, "f ch"],
    temperature_degC: Float[np.ndarray, "f k"],
    expected_lsb_uT: tuple[float, float] | None,
    *,
    where: str,
    policy: FaultPolicy,
    row: Int[np.ndarray, " f"] | None = None,
) -> CheckedRows:
    """Find the faults of a whole table of readings, and decide which rows to keep.

    The LSB of the chips is checked in all rows without a failed read. These include rows that are dropped for another
    reason.

    Parameters
    ----------
    row : the number of each row in its file, needed if the table lacks some rows of the file. If it is None, the rows
        are numbered from 1.

    Raises
    ------
    CaptureError
        If no row has a reading of every chip, or for a fault that the policy refuses.
    """
    log = FaultLog(policy, where, "row")
    row = 1 + np.arange(len(b_uT)) if row is None else row
    readings = reading_faults_of_table(b_uT, temperature_degC, where)
    failed, out_of_range = log.record_readings(readings, row)
    read = ~readings.failed_rows
    if not read.any():
        raise CaptureError(f"{where}: in every row, the I2C read of a chip failed. Check the wiring, and record again.")
    rows = np.flatnonzero(read)
    for block in np.array_split(rows, max(1, len(rows) // GRID_ROWS_N)):
        lsb_uT = find_lsb(b_uT[block])
        without_grid = np.isnan(lsb_uT).any(axis=1)
        without_grid &= (not without_grid.all()) & (len(block) >= GRID_ROWS_N)
        log.record_scale(
            reset_chips(lsb_uT, expected_lsb_uT) | without_grid, np.where(without_grid[:, None], np.nan, lsb_uT),
            expected_lsb_uT, f"{where} from row {row[block[0]]}", USUAL_LSB, row[block],
        )  # fmt: skip
    chips_n = temperature_degC.shape[1]
    constant = ConstantChannels(chips_n)
    constant.feed(b_uT[read])
    log.record_constant(constant.describe(), row)
    stuck = log.record("stuck", StuckChips(chips_n).feed(b_uT).any(axis=1) & read, row) & ~failed
    out_of_range &= ~stuck
    return CheckedRows(~(failed | stuck | out_of_range), failed, stuck, out_of_range, log.account())


def check_log(blocks: Iterable[Frames], where: str, account: dict[str, int]) -> Iterator[Frames]:
    """Yield the fault-free frames of a log, and count the others in `account`.

    A log is checked like a stream of text. In `blocks`, `device_s` is the time of each frame, and `end_byte` is the
    number of its row, which errors name. The first part that is yielded consists of the frames among the first
    `LOG_HEAD_FRAMES_N`. Statistics of the log are those of these frames. The result does not depend on the sizes of the
    blocks. In the account, `gaps_n` is the number of times between two frames that are so long that frames must be
    missing, and `gap_frames_n` is the number of these frames.

    Raises
    ------
    CaptureError
        If times do not increase, if less than half of the frames is fault-free, if the fields are not in uT, or for a
        fault that `STANDARD_POLICY` refuses.
    """
    parts = _divide(blocks, LOG_HEAD_FRAMES_N, LOG_BLOCK_FRAMES_N)
    head = next(parts, None)
    if head is None or len(head) < 2:
        raise CaptureError(f"{where}: the log has fewer than two lines below the column names. Copy the log again.")
    _check_order(np.nan, head, where)
    step_s = float(np.median(np.diff(head.device_s)))
    if not RATE_MIN_HZ <= 1 / step_s <= RATE_MAX_HZ:
        rule = f"{RATE_MIN_HZ:g} to {RATE_MAX_HZ:g} lines per second"
        remedy = "t_s must be in seconds. If it is in milliseconds, convert it."
        raise CaptureError(where, "the rate", rule, f"{1 / step_s:.3g}", remedy)
    failed = reading_faults_of_table(head.b_uT, head.temperature_degC, where).failed_rows
    if failed.all():
        raise CaptureError(f"{where}: in every line, the I2C read of a chip failed. Check the wiring, and log again.")
    lsb_uT = find_lsb(head.b_uT[~failed])
    detector = FaultDetector(head.temperature_degC.shape[1], lsb_uT=lsb_uT)
    log, last_s = FaultLog(STANDARD_POLICY, where, "ms"), np.nan
    if len(head) < SCALE_FRAMES_N:  # the detector checks the LSB of longer logs
        log.record_scale(reset_chips(lsb_uT, None), lsb_uT, None, where, USUAL_LSB, head.device_s)
    counts = dict.fromkeys(
        ("gaps_n", "gap_frames_n", "rows_read_n", "dropped_failed_read_rows_n", "dropped_stuck_chip_rows_n", "rows_n"),
        0,
    )
    for block in chain([head], parts):
        first_n = counts["rows_read_n"]
        checked_parts = []
        for part in block.divide(LOG_BLOCK_FRAMES_N):
            t_s, unknown = part.device_s, np.full(len(part), np.nan)
            _check_order(last_s, part, where)
            steps = np.diff(t_s, prepend=last_s) / step_s
            number = counts["rows_read_n"] + 1 + np.arange(len(part))
            checked = log.apply(detector.feed(replace(part, device_s=unknown, end_byte=number), t_s), t_s)
            found = {
                "gaps_n": int((steps > GAP_FRAMES).sum()),
                "gap_frames_n": int((np.round(steps[steps > GAP_FRAMES]) - 1).sum()),
                "rows_read_n": len(part),
                "dropped_failed_read_rows_n": int(checked.failed.sum()),
                "dropped_stuck_chip_rows_n": int(checked.stuck.sum()),
                "rows_n": int(checked.keep.sum()),
            }
            counts, last_s = {name: n + found[name] for name, n in counts.items()}, float(t_s[-1])
            checked_parts.append(part.where(checked.keep))
        kept = concatenate(checked_parts, 0)
        if not first_n:
            _check_kept(counts, where)
            check_fields(kept.b_uT, where, line_n=kept.end_byte)
        yield kept
    _check_kept(counts, where)
    log.record_constant(detector.constant_channels())
    account.update(counts | log.account())


def _divide(blocks: Iterable[Frames], first_n: int, then_n: int) -> Iterator[Frames]:
    """Join and cut blocks of frames to a first block of `first_n` frames, and further blocks of `then_n` frames."""
    pending: list[Frames] = []
    wanted_n = first_n
    for block in blocks:
        pending.append(block)
        if sum(map(len, pending)) >= wanted_n:
            whole, start = concatenate(pending, 0), 0
            while len(whole) - start >= wanted_n:
                yield whole.where(slice(start, start + wanted_n))
                start, wanted_n = start + wanted_n, then_n
            pending = [whole.where(slice(start, None))]
    if sum(map(len, pending)):
        yield concatenate(pending, 0)


def _check_order(last_s: float, frames: Frames, where: str) -> None:
    """Raise unless each time is later than the one before; `last_s` is the time before the first (NaN if none)."""
    before_s = np.concatenate([[last_s], frames.device_s[:-1]])
    back = frames.device_s <= before_s
    if back.any():
        i = int(back.argmax())
        got = f"{frames.device_s[i]:.4f} after {before_s[i]:.4f}"
        remedy = "If the board was reset here, split the log into two files before this line."
        raise CaptureError(f"{where} row {frames.end_byte[i]}", "t_s", "later than the line above", got, remedy)


def _check_kept(counts: Mapping[str, int], where: str) -> None:
    read_n, kept_n = counts["rows_read_n"], counts["rows_n"]
    if kept_n < max(2, KEPT_SHARE_MIN * read_n):
        failed_n, stuck_n = counts["dropped_failed_read_rows_n"], counts["dropped_stuck_chip_rows_n"]
        raise CaptureError(
            f"{where}: only {kept_n} of {read_n} lines are fault-free: {failed_n} had failed I2C reads, and {stuck_n} "
            f"had stuck chips. At least {100 * KEPT_SHARE_MIN:g} % must be fault-free. Check the wiring, and log again."
        )
