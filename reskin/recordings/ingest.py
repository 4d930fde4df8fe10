"""Convert a capture of any layout to readings, and count all lost or dropped bytes, frames and rows in an account.

A native capture consists of the stream of bytes that a board sent, and of the probe log of the rig. The probe log lists
the dwells: the times in which the rig did not move. Stream and probe log have different clocks. Therefore, the clocks
are first aligned. Then each frame of the stream is assigned to the dwell in which it was measured. The no-load
reading is stored beside each raw reading, and is subtracted only where readings are used; see `reskin.data.baseline`.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from reskin import io
from reskin.board.chips import TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC
from reskin.board.faults import FaultDetector, find_reading_faults
from reskin.board.other_firmware import AnyWire, frame_bytes_of
from reskin.board.stream import FrameStream, no_frame
from reskin.board.wire import TEXT_WIRES, Frames
from reskin.errors import CaptureError
from reskin.recordings import clocks, probe
from reskin.recordings.clocks import Arrivals, ClockMap, from_contacts, from_marks
from reskin.recordings.fault_policy import CheckedRows, FaultLog, FaultPolicy
from reskin.recordings.header import ARRIVALS_FILE, HEADER_FILE, PROBE_FILE, STREAM_FILE, Header, parse
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.recordings.readers import READERS
from reskin.recordings.tables import count_within, make_readings
from reskin.recordings.units import check_fields, check_log
from reskin.schema import Readings

COUNTS = (
    "frames_n",
    "frames_noload_n",
    "frames_contact_n",
    "dropped_no_time_frames_n",
    "dropped_not_finite_frames_n",
    "dropped_failed_read_frames_n",
    "dropped_stuck_chip_frames_n",
    "dropped_between_dwells_frames_n",
    "dropped_no_noload_frames_n",
    "dropped_no_contact_frames_n",
    "indentations_n",
    "dropped_no_noload_indentations_n",
)

OUT_OF_RANGE = "dropped_out_of_range_frames_n"  # this key is in the account only if there are such frames


@dataclass(frozen=True)
class TimedFrames:
    """Frames with their stream times, and the result of the check for faults.

    If the time of a frame is unknown (NaN), the times of all later frames are unknown too.
    """

    frames: Frames
    t_s: Float64[np.ndarray, " f"]
    checked: CheckedRows


@dataclass(frozen=True)
class _DwellFrames:
    """Frames that were measured during dwells, in order of time; `dwell_i` is the index of each frame's dwell."""

    dwell_i: Int64[np.ndarray, " f"]
    t_s: Float64[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]

    def where(self, rows: Bool[np.ndarray, " f"] | slice) -> "_DwellFrames":
        return _DwellFrames(self.dwell_i[rows], self.t_s[rows], self.b_uT[rows], self.temperature_degC[rows])

    def then(self, later: "_DwellFrames") -> "_DwellFrames":
        """Return these frames, followed by the frames of `later`."""
        pairs = ((getattr(self, name), getattr(later, name)) for name in self.__dataclass_fields__)
        return _DwellFrames(*map(np.concatenate, pairs))


class Joiner:
    """An object that assigns frames to dwells, and converts each indentation to readings once it has ended.

    A frame may be dropped for several reasons: no time, not finite, failed read, stuck chip, out of range, between
    dwells. It is counted under the first reason of this list that applies. The no-load field of an indentation is the
    mean field in its no-load dwell. The time `t_s` of a reading is stream time.
    """

    def __init__(self, log: ProbeLog, clock: ClockMap, header: Header) -> None:
        self._log, self._clock, self._header = log, clock, header
        begins = ~log.contact  # whether a dwell begins an indentation: each one begins with its only no-load dwell
        self._group_i = np.cumsum(begins) - 1  # index of the indentation of each dwell
        touched = np.zeros(int(begins.sum()), np.int64)
        touched[self._group_i[log.contact]] = 1
        self._before_n = header.contacts_before_n + np.cumsum(touched) - touched  # contacts before each indentation
        self._pending = self._empty()
        self._count: Counter[str] = Counter()

    def feed(self, block: TimedFrames) -> Readings:
        """Process the next frames; return the readings of all indentations that have now ended (often none)."""
        probe_s = self._clock.probe_s(block.t_s)
        pending = self._pending.then(self._assign(block, probe_s))
        known_s = probe_s[np.isfinite(probe_s)]
        if not len(known_s) or not len(pending.dwell_i):
            self._pending = pending
            return self._readings(self._empty())
        # Times never decrease, so an indentation has ended when a frame has a time in a later indentation.
        now_i = np.searchsorted(self._log.t_start_s, known_s[-1], "right") - 1
        ended_n = int(np.searchsorted(self._group_i[pending.dwell_i], self._group_i[now_i], "left"))
        self._pending = pending.where(slice(ended_n, None))
        return self._readings(pending.where(slice(0, ended_n)))

    def close(self) -> Readings:
        """Return the readings of the last indentation, which may have been recorded only in part."""
        pending, self._pending = self._pending, self._empty()
        return self._readings(pending)

    def account(self) -> dict[str, int]:
        """Return the counts of frames and indentations so far: all, those used, and those dropped for each reason."""
        counted = {name: self._count[name] for name in COUNTS}
        counted |= {OUT_OF_RANGE: self._count[OUT_OF_RANGE]} if self._count[OUT_OF_RANGE] else {}
        logged_n = int((~self._log.contact).sum())
        unseen_n = logged_n - counted["indentations_n"] - counted["dropped_no_noload_indentations_n"]
        return counted | {"logged_indentations_n": logged_n, "dropped_no_frame_indentations_n": unseen_n}

    def _assign(self, block: TimedFrames, probe_s: Float64[np.ndarray, " f"]) -> _DwellFrames:
        frames, log = block.frames, self._log
        dwell_i = np.searchsorted(log.t_start_s, probe_s, "right") - 1
        lost = {
            "dropped_no_time_frames_n": np.isnan(probe_s),
            "dropped_not_finite_frames_n": ~(
                np.isfinite(frames.b_uT).all(axis=1) & np.isfinite(frames.temperature_degC).all(axis=1)
            ),
            "dropped_failed_read_frames_n": block.checked.failed,
            "dropped_stuck_chip_frames_n": block.checked.stuck,
            OUT_OF_RANGE: block.checked.out_of_range,
            "dropped_between_dwells_frames_n": (dwell_i < 0) | (probe_s > log.t_end_s[dwell_i]),
        }
        keep = np.ones(len(probe_s), bool)
        self._count["frames_n"] += len(keep)
        for reason, mask in lost.items():
            self._count[reason] += int((keep & mask).sum())
            keep &= ~mask
        return _DwellFrames(dwell_i[keep], block.t_s[keep], frames.b_uT[keep], frames.temperature_degC[keep])

    def _readings(self, pending: _DwellFrames) -> Readings:
        """Convert the frames of whole indentations to readings.

        An indentation needs at least one frame in its no-load dwell and one frame in contact. Other indentations are
        dropped and counted.
        """
        group_i, contact = self._group_i[pending.dwell_i], self._log.contact[pending.dwell_i]
        with_noload, with_contact = group_i[~contact], group_i[contact]
        paired_noload, paired = np.isin(with_noload, with_contact), np.isin(with_contact, with_noload)
        rows, group_i = pending.where(contact).where(paired), with_contact[paired]
        noload = pending.where(~contact).where(paired_noload)
        noload_uT, row_group_i = _means(noload.b_uT, with_noload[paired_noload], group_i)
        self._count.update(
            frames_noload_n=int(paired_noload.sum()),
            frames_contact_n=len(group_i),
            dropped_no_contact_frames_n=int((~paired_noload).sum()),
            dropped_no_noload_frames_n=int((~paired).sum()),
            indentations_n=len(noload_uT),
            dropped_no_noload_indentations_n=len(np.unique(with_contact[~paired])),
        )
        labels = {name: getattr(self._log, name)[rows.dwell_i] for name in ("indentation", "pass_i", *LABELS)}
        return make_readings(
            self._header, np.ones(len(group_i), bool), **labels, reading_i=count_within(group_i), b_uT=rows.b_uT,
            noload_uT=noload_uT[row_group_i], temperature_degC=rows.temperature_degC, t_s=rows.t_s,
            n_contacts=self._before_n[group_i],
        )  # fmt: skip

    def _empty(self) -> _DwellFrames:
        k = self._header.chips_n
        empty = np.zeros((0, 4 * k), np.float32)
        return _DwellFrames(np.zeros(0, np.int64), np.zeros(0), empty[:, : 3 * k], empty[:, :k])


def _means(
    b_uT: Float32[np.ndarray, "f ch"], group_i: Int64[np.ndarray, " f"], wanted_i: Int64[np.ndarray, " g"]
) -> tuple[Float32[np.ndarray, "i ch"], Int64[np.ndarray, " g"]]:
    """Return the mean field of each group of rows, and the index of the mean for each group number in `wanted_i`.

    `group_i` is the group number of each row of `b_uT`; it never decreases from one row to the next.
    """
    runs_i, first_i, run_n = np.unique(group_i, return_index=True, return_counts=True)
    if not len(runs_i):
        return b_uT, wanted_i
    sums_uT = np.add.reduceat(b_uT, first_i, axis=0, dtype=np.float64)
    return (sums_uT / run_n[:, None]).astype(np.float32), np.searchsorted(runs_i, wanted_i)


BLOCK_BYTES_N = 2**22
# In a block of frames, the temperatures of all chips at all times differ by less than this value. Larger differences
# show that the numbers are not temperatures.
SPREAD_MAX_degC = 10.0
# the key of a total in an account, and prefix and suffix of the keys that count its losses
LOSSES = (
    ("bytes_n", "skipped_", "_bytes_n"),
    ("frames_n", "dropped_", "_frames_n"),
    ("rows_read_n", "dropped_", "_rows_n"),
    ("logged_indentations_n", "dropped_", "_indentations_n"),
)
# Keys with such a prefix and suffix that do not count as losses: frames between dwells, and frames of an indentation
# without a no-load reading or without a contact.
NO_LOSS = (
    "dropped_between_dwells_frames_n",
    "dropped_no_noload_frames_n",
    "dropped_no_contact_frames_n",
)

# returns the stream time of each frame; the arguments are the frames, and the number of earlier frames
Timer = Callable[[Frames, int], Float64[np.ndarray, "_"]]


class OpenedCapture(NamedTuple):
    """A capture that is being read; `account` is complete once all `blocks` have been read."""

    header: Header
    blocks: Iterable[Readings]
    account: Mapping[str, int]


def open_capture(folder: Path, policy: FaultPolicy) -> OpenedCapture:
    """Check a capture's header and files, and begin to read the capture; `policy` decides what happens to faults."""
    header = read_header(folder)
    if header.capture != folder.name:
        raise CaptureError(
            folder / HEADER_FILE, "capture", f"the name of the folder, {folder.name!r}", repr(header.capture),
            "Rename the folder to the name in the header.",
        )  # fmt: skip
    for name, digest in header.files.items():
        if not (folder / name).is_file():
            raise CaptureError(
                f"{folder / name}: file not found, although the header lists this file. Add the recording again."
            )
        if io.sha256(folder / name) != digest:
            raise CaptureError(
                f"{folder / name}: the file has changed since it was added (its hash differs). Remove the capture, and "
                "add the recording again."
            )
    if header.layout == "native":
        return OpenedCapture(header, *read_native(folder, header, policy))
    if header.layout not in READERS:
        remedy = "The log of an SD card has no labels from which a model could learn. Use: reskin predict."
        raise CaptureError(folder, "layout", f"native or one of {sorted(READERS)}", header.layout, remedy)
    readings, account = READERS[header.layout].read(folder, header, policy)
    times = FaultLog(policy, str(folder), "row")
    times.record("clock_jump", np.diff(readings.t_s, prepend=-np.inf) < 0, 1 + np.arange(len(readings)))
    return OpenedCapture(header, [readings], {**account, **times.account()})


def read_header(folder: Path) -> Header:
    file = folder / HEADER_FILE
    if not file.is_file():
        fault = "it is a file" if folder.is_file() else f"there is no {HEADER_FILE} in it"
        raise CaptureError(f"{folder}: this is not a capture folder: {fault}. Use a folder that `reskin record` wrote.")
    return parse(file.read_text(encoding="utf-8", errors="replace"), str(file))


def check_losses(account: Mapping[str, int], limit: float, where: str) -> None:
    """Raise if a capture lost more than the fraction `limit` of its bytes, frames, rows or indentations."""
    for total, prefix, suffix in LOSSES:
        lost = [key for key in account if key.startswith(prefix) and key.endswith(suffix) and key not in NO_LOSS]
        lost_n = sum(account[key] for key in lost)
        if lost_n > limit * account.get(total, 0):
            reasons = ", ".join(f"{account[key]} {key.removesuffix('_n')}" for key in lost if account[key])
            problem = f"more than {limit:.0%} of {account[total]} {total.removesuffix('_n')} are lost: {reasons}"
            raise CaptureError(
                f"{where}: {problem}. Record the capture again, or increase lost_fraction_max in params.yaml."
            )


def read_native(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Iterator[Readings], dict[str, int]]:
    """Return an iterator over the readings of a native capture, and its account.

    The account is complete after the iteration. If the header has no sync marks, the stream is read twice: first to
    align the clocks, then to yield the readings.
    """
    stream = folder / STREAM_FILE
    if not stream.is_file():
        raise CaptureError(f"{stream}: file not found. Copy the whole folder of the capture again.")
    log = probe.parse(folder / PROBE_FILE, str(folder / PROBE_FILE))
    check_log(log, str(folder / PROBE_FILE))
    times_of = timer(folder, header)
    clock = _clock(folder, header, log, _timed_frames(folder, header, times_of, {}, policy))
    account = {
        "clock_residual_us": round(1e6 * clock.residual_s),
        "clock_explained_pct": round(100 * clock.explained),
    }

    def read() -> Iterator[Readings]:
        joiner = Joiner(log, clock, header)
        for block in _timed_frames(folder, header, times_of, account, policy):
            if len(readings := joiner.feed(block)):
                yield readings
        if len(readings := joiner.close()):
            yield readings
        account.update(joiner.account())

    return read(), account


def _clock(folder: Path, header: Header, log: ProbeLog, blocks: Iterator[TimedFrames]) -> ClockMap:
    """Return the map from stream time to probe time.

    It follows from the sync marks in the header or, if there are none, from the contacts that the fields show.
    """
    if header.clock.marks:
        return from_marks(np.array(header.clock.marks), str(folder))
    pairs = ((block.t_s[block.checked.keep], block.frames.b_uT[block.checked.keep]) for block in blocks)
    return from_contacts(pairs, log, str(folder))


def _timed_frames(
    folder: Path, header: Header, times_of: Timer, account: dict[str, int], policy: FaultPolicy
) -> Iterator[TimedFrames]:
    """Decode the stream in blocks; after the last block, add the counts of bytes, frames and faults to `account`."""
    wire, where = _wire(header), str(folder / STREAM_FILE)
    stream, log = FrameStream(wire, header.chips_n), FaultLog(policy, where, "ms")
    frame_bytes_n = frame_bytes_of(wire, header.chips_n)
    detector = FaultDetector(header.chips_n, frame_bytes_n=frame_bytes_n, expected_lsb_uT=header.expected_lsb_uT)
    frames_n, units_checked = 0, False
    with (folder / STREAM_FILE).open("rb") as file:
        head = data = file.read(BLOCK_BYTES_N)
        while True:
            frames = stream.feed(data) if data else stream.close()
            units_checked = units_checked or _check_units(frames, wire, where)
            t_s = times_of(frames, frames_n)
            checked = log.apply(detector.feed(frames, t_s), t_s)
            yield TimedFrames(frames, t_s, checked)
            frames_n += len(frames)
            if not data:
                break
            data = file.read(BLOCK_BYTES_N)
    if not frames_n:
        raise no_frame(where, head, wire, header.chips_n)
    log.record_constant(detector.constant_channels())
    account.update(stream.account() | log.account())


def _check_units(frames: Frames, wire: AnyWire, where: str) -> bool:
    """Raise if the fields of the fault-free frames are not in uT, or if the header states the wrong text format.

    Returns False if there are no fault-free frames, so that nothing was checked.
    """
    temperatures = np.isfinite(frames.temperature_degC)
    read = np.isfinite(frames.b_uT).all(axis=1) & (temperatures.all(axis=1) | ~temperatures.any())
    read &= ~find_reading_faults(frames.b_uT, frames.temperature_degC).failed_rows
    if not read.any():
        return False
    b_uT, temperature_degC = frames.b_uT[read], frames.temperature_degC[read]
    if wire in TEXT_WIRES:
        other, axis = ("text-txyz", 0) if wire == "text-xyzt" else ("text-xyzt", 2)
        # if the numbers have the order of the other text format, these are the temperatures
        swapped_degC = b_uT[:, axis::3]
        (low, high), swapped = np.percentile(temperature_degC, [5, 95]), np.percentile(swapped_degC, [5, 95])
        is_swapped = float(swapped[1] - swapped[0]) < SPREAD_MAX_degC < float(high - low)
        if not _mostly_possible(temperature_degC) or (is_swapped and _mostly_possible(swapped_degC)):
            rule = f"{TEMPERATURE_MIN_degC:g} to {TEMPERATURE_MAX_degC:g} degC, and similar for all chips"
            remedy = f"If the board sends wire format {other}, state this format in header.json."
            raise CaptureError(where, f"temperatures of {wire}", rule, f"{low:.4g} to {high:.4g}", remedy)
    check_fields(b_uT, where)
    return True


def _mostly_possible(temperature_degC: Float32[np.ndarray, "f k"]) -> bool:
    possible = (temperature_degC >= TEMPERATURE_MIN_degC) & (temperature_degC <= TEMPERATURE_MAX_degC)
    return bool(possible.mean() > 0.5)


def timer(folder: Path, header: Header) -> Timer:
    """Return a function that computes the stream times of frames; the header states which kind of clock to use."""
    rate_hz = header.clock.rate_hz
    if header.clock.kind == "arrivals":
        table = _arrivals(folder)
        return lambda frames, _: clocks.times_of(frames.end_byte, table)
    if rate_hz is None:
        got = repr(header.clock.kind)
        raise CaptureError(
            folder, "clock.kind", "'arrivals' or 'rate', if a port was recorded", got, "Correct header.json."
        )
    # The rate is constant. If all frames have the same length, damaged bytes also count as time; lines of text vary.
    if (frame_bytes_n := frame_bytes_of(_wire(header), header.chips_n)) is None:
        return lambda frames, before_n: (before_n + 1.0 + np.arange(len(frames))) / rate_hz
    return lambda frames, _: frames.end_byte / frame_bytes_n / rate_hz


def _arrivals(folder: Path) -> Arrivals:
    """Read the times of arrival; raise if more bytes arrived than the file of the stream contains."""
    table = clocks.parse(folder / ARRIVALS_FILE, str(folder / ARRIVALS_FILE))
    bytes_n, arrived_n = (folder / STREAM_FILE).stat().st_size, int(table.byte_end[-1])
    if bytes_n < arrived_n:
        raise CaptureError(
            f"{folder / STREAM_FILE}: the file has {bytes_n} bytes, but {ARRIVALS_FILE} lists {arrived_n}. Copy the "
            "whole folder of the capture again."
        )
    return table


def _wire(header: Header) -> AnyWire:
    assert header.wire is not None, "checked by `Header`: a native capture has a wire format"
    return header.wire
