"""Frames join dwells: which reading belongs to which indentation. In: blocks of timed frames, probe log, clock.
Out: blocks of `Readings`, the same for any blocking, and an account of every frame and indentation.
Refuses to know files and bytes; remembers only the frames of the indentation that is not over yet.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from pipeline.capture.header import Header
from pipeline.capture.probe import LABELS, ProbeLog
from pipeline.capture.wire import Frames
from pipeline.core.schema import Readings
from pipeline.dataset.clocks import ClockMap

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

BEYOND = "dropped_out_of_range_frames_n"  # counted only where there are some: it is for settings to drop them


@dataclass(frozen=True)
class TimedFrames:
    """Frames with the stream time of each (NaN: unknown, as for all that follow); masks of those that are not kept.

    Their reads failed, a chip was stuck, or, where that was decided, a reading is beyond what a board sends.
    """

    frames: Frames
    t_s: Float64[np.ndarray, " f"]
    failed: Bool[np.ndarray, " f"]
    stuck: Bool[np.ndarray, " f"]
    beyond: Bool[np.ndarray, " f"] | None = None

    @property
    def sound(self) -> Bool[np.ndarray, " f"]:
        """Mark the frames that hold a fresh reading of every chip."""
        kept = ~(self.failed | self.stuck)
        return kept if self.beyond is None else kept & ~self.beyond


@dataclass(frozen=True)
class _Held:
    """Frames that lie in a dwell, in order of time."""

    dwell_i: Int64[np.ndarray, " f"]
    t_s: Float64[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]

    def where(self, rows: Bool[np.ndarray, " f"] | slice) -> "_Held":
        return _Held(self.dwell_i[rows], self.t_s[rows], self.b_uT[rows], self.temperature_degC[rows])

    def then(self, later: "_Held") -> "_Held":
        pairs = ((getattr(self, name), getattr(later, name)) for name in self.__dataclass_fields__)
        return _Held(*map(np.concatenate, pairs))


def join(
    blocks: Iterable[TimedFrames], log: ProbeLog, clock: ClockMap, header: Header, account: dict[str, int]
) -> Iterator[Readings]:
    """Yield the readings of indentations that are over; `account` is complete once the last one was taken."""
    joiner = Joiner(log, clock, header)
    for block in blocks:
        readings = joiner.feed(block)
        if len(readings):
            yield readings
    readings = joiner.close()
    if len(readings):
        yield readings
    account.update(joiner.account())


class Joiner:
    """Sorts frames into dwells; holds back the indentation that may still grow.

    A frame counts under the first reason that fits: no time, not finite, failed read, stuck chip, between dwells. The
    no-load field of an indentation is the mean over its no-load dwell. `t_s` of a reading is the stream's time.
    """

    def __init__(self, log: ProbeLog, clock: ClockMap, header: Header) -> None:
        self._log, self._clock, self._header = log, clock, header
        opens = ~log.contact  # each indentation opens with its one no-load dwell
        self._group_i = np.cumsum(opens) - 1
        touched = np.zeros(int(opens.sum()), np.int64)
        touched[self._group_i[log.contact]] = 1
        self._before_n = header.contacts_before_n + np.cumsum(touched) - touched
        self._held = self._nothing()
        self._count: Counter[str] = Counter()

    def feed(self, block: TimedFrames) -> Readings:
        """Take the next frames; give the readings of all indentations that are now over (often none)."""
        probe_s = self._clock.probe_s(block.t_s)
        held = self._held.then(self._sort(block, probe_s))
        known_s = probe_s[np.isfinite(probe_s)]
        if not len(known_s) or not len(held.dwell_i):
            self._held = held
            return self._readings(self._nothing())
        # Times never fall, so an indentation is over once a frame belongs to a later one.
        now_i = np.searchsorted(self._log.t_start_s, known_s[-1], "right") - 1
        over_n = int(np.searchsorted(self._group_i[held.dwell_i], self._group_i[now_i], "left"))
        self._held = held.where(slice(over_n, None))
        return self._readings(held.where(slice(0, over_n)))

    def close(self) -> Readings:
        """Give the readings of the last indentation, as far as the stream went."""
        held, self._held = self._held, self._nothing()
        return self._readings(held)

    def account(self) -> dict[str, int]:
        """Count frames and indentations so far, by what became of them; each total is the sum of its parts."""
        counted = {name: self._count[name] for name in COUNTS}
        counted |= {BEYOND: self._count[BEYOND]} if self._count[BEYOND] else {}
        logged_n = int((~self._log.contact).sum())
        unseen_n = logged_n - counted["indentations_n"] - counted["dropped_no_noload_indentations_n"]
        return counted | {"logged_indentations_n": logged_n, "dropped_no_frame_indentations_n": unseen_n}

    def _sort(self, block: TimedFrames, probe_s: Float64[np.ndarray, " f"]) -> _Held:
        frames, log = block.frames, self._log
        dwell_i = np.searchsorted(log.t_start_s, probe_s, "right") - 1
        lost = {
            "dropped_no_time_frames_n": np.isnan(probe_s),
            "dropped_not_finite_frames_n": ~(
                np.isfinite(frames.b_uT).all(axis=1) & np.isfinite(frames.temperature_degC).all(axis=1)
            ),
            "dropped_failed_read_frames_n": block.failed,
            "dropped_stuck_chip_frames_n": block.stuck,
            **({} if block.beyond is None else {BEYOND: block.beyond}),
            "dropped_between_dwells_frames_n": (dwell_i < 0) | (probe_s > log.t_end_s[dwell_i]),
        }
        keep = np.ones(len(probe_s), bool)
        self._count["frames_n"] += len(keep)
        for reason, mask in lost.items():
            self._count[reason] += int((keep & mask).sum())
            keep &= ~mask
        return _Held(dwell_i[keep], block.t_s[keep], frames.b_uT[keep], frames.temperature_degC[keep])

    def _readings(self, held: _Held) -> Readings:
        """Turn the frames of whole indentations into readings, and count those that lack their other half."""
        group_i, contact = self._group_i[held.dwell_i], self._log.contact[held.dwell_i]
        with_noload, with_contact = group_i[~contact], group_i[contact]
        paired_noload, paired = np.isin(with_noload, with_contact), np.isin(with_contact, with_noload)
        rows, group_i = held.where(contact).where(paired), with_contact[paired]
        noload = held.where(~contact).where(paired_noload)
        noload_uT, row_group_i = _means(noload.b_uT, with_noload[paired_noload], group_i)
        self._count.update(
            frames_noload_n=int(paired_noload.sum()),
            frames_contact_n=len(group_i),
            dropped_no_contact_frames_n=int((~paired_noload).sum()),
            dropped_no_noload_frames_n=int((~paired).sum()),
            indentations_n=len(noload_uT),
            dropped_no_noload_indentations_n=len(np.unique(with_contact[~paired])),
        )
        return self._labelled(rows, noload_uT[row_group_i], group_i)

    def _labelled(
        self, rows: _Held, noload_uT: Float32[np.ndarray, "f ch"], group_i: Int64[np.ndarray, " f"]
    ) -> Readings:
        log, header = self._log, self._header
        return Readings(
            capture=header.capture, board=header.board, skin=header.skin, source=header.source,
            indentation=log.indentation[rows.dwell_i], pass_i=log.pass_i[rows.dwell_i], reading_i=_rank(group_i),
            **{name: getattr(log, name)[rows.dwell_i] for name in LABELS},
            b_uT=rows.b_uT, noload_uT=noload_uT, temperature_degC=rows.temperature_degC, t_s=rows.t_s,
            n_contacts=self._before_n[group_i].astype(np.int32),
        )  # fmt: skip

    def _nothing(self) -> _Held:
        k = self._header.chips_n
        empty = np.zeros((0, 4 * k), np.float32)
        return _Held(np.zeros(0, np.int64), np.zeros(0), empty[:, : 3 * k], empty[:, :k])


def _means(
    b_uT: Float32[np.ndarray, "f ch"], group_i: Int64[np.ndarray, " f"], wanted_i: Int64[np.ndarray, " g"]
) -> tuple[Float32[np.ndarray, "i ch"], Int64[np.ndarray, " g"]]:
    """Give the mean field of each run of equal `group_i`, and the run that each of `wanted_i` belongs to."""
    runs_i, first_i, run_n = np.unique(group_i, return_index=True, return_counts=True)
    if not len(runs_i):
        return b_uT, wanted_i
    sums_uT = np.add.reduceat(b_uT, first_i, axis=0, dtype=np.float64)
    return (sums_uT / run_n[:, None]).astype(np.float32), np.searchsorted(runs_i, wanted_i)


def _rank(group_i: Int64[np.ndarray, " f"]) -> Int32[np.ndarray, " f"]:
    """Number the rows of each run of equal `group_i` from 0."""
    _, first_i, run_n = np.unique(group_i, return_index=True, return_counts=True)
    return (np.arange(len(group_i)) - np.repeat(first_i, run_n)).astype(np.int32)
