"""Can the chips of a recording be believed? In: all its fields, or frames block by block. Out: masks of rows.

A failed read or a stuck chip costs a row; a chip of another scale than its header or neighbours costs the recording,
as nobody knows what its numbers mean. Refuses to know layouts, time and dwells, and to mend anything.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.capture import faults
from pipeline.capture.header import Header
from pipeline.capture.readers.table import check_fields
from pipeline.capture.stream import TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC
from pipeline.capture.wire import Frames
from pipeline.core.errors import CaptureError

SCALE_FRAMES_N = 400  # real recordings show each sound chip's grid in so many frames; in 200 it may hide
GRID_ROWS_N = 1000
ORDER_OF_OTHER: Mapping[str | None, tuple[str, int]] = {
    "text-xyzt": ("text-txyz", 0),
    "text-txyz": ("text-xyzt", 2),
}  # and which field is a temperature then
SPREAD_MAX_degC = 10.0  # chips of one board, in one block
USUAL_SCALE = "that of the other chips, and not a reset chip's"


class Rows(NamedTuple):
    """What became of each row: `whole` ones hold a reading of every chip; the others failed or, if not, are stuck."""

    whole: Bool[np.ndarray, " f"]
    failed: Bool[np.ndarray, " f"]
    stuck: Bool[np.ndarray, " f"]

    def losses(self) -> dict[str, int]:
        """Count the rows that are not whole, as accounts do."""
        return {
            "dropped_failed_read_rows_n": int(self.failed.sum()),
            "dropped_stuck_chip_rows_n": int(self.stuck.sum()),
        }

    def part(self, rows: slice) -> "Rows":
        """Keep some of the rows."""
        return Rows(self.whole[rows], self.failed[rows], self.stuck[rows])


def find_whole_rows(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"], header: Header, *, where: str
) -> Rows:
    """Tell the rows that hold a reading of every chip; raise if there is none, or if a chip's scale is unknown."""
    failed = missing_reads(b_uT, temperature_degC)
    if failed.all():
        remedy = "Mend the wiring, and record again."
        raise CaptureError(where, "rows", "read from every chip", "failed I2C reads in all of them", remedy)
    rows = np.flatnonzero(~failed)
    for block in np.array_split(rows, max(1, len(rows) // GRID_ROWS_N)):
        _check_scale(b_uT[block], header, where=f"{where} from row {block[0] + 1}")
    stuck = np.asarray(faults.stuck_chips(b_uT).any(axis=1)) & ~failed
    return Rows(~failed & ~stuck, failed, stuck)


def missing_reads(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"]
) -> Bool[np.ndarray, " f"]:
    """Mark the rows in which a chip was not read: its read failed, or zeros stand in its place."""
    return np.asarray((faults.failed_reads(b_uT, temperature_degC) | faults.zero_reads(b_uT)).any(axis=1))


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


class Watch:
    """Looks at every frame once; holds back at most `SCALE_FRAMES_N` of them."""

    def __init__(self, header: Header, where: str) -> None:
        self._header, self._where = header, where
        self._stuck = faults.StuckChips(header.chips_n)
        self._held = np.zeros((0, 3 * header.chips_n), np.float32)
        self._begun = False
        self._checked_n = 0
        self._lsb_uT = np.full((header.chips_n, 2), np.nan)  # of each chip, once known

    def stuck(self, frames: Frames, failed: Bool[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
        """Mark the frames in which a chip had stopped; raise if their numbers cannot be what they are said to be."""
        finite = np.isfinite(frames.b_uT).all(axis=1) & np.isfinite(frames.temperature_degC).all(axis=1)
        sound = finite & ~failed
        if not self._begun and sound.any():
            self._begun = True
            self._check_first(frames.where(sound))
        self._check_scales(frames.b_uT[sound])
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

    def _check_scales(self, b_uT: Float[np.ndarray, "f ch"]) -> None:
        held = np.concatenate([self._held, b_uT])
        for first in range(0, len(held) - SCALE_FRAMES_N + 1, SCALE_FRAMES_N):
            self._check_scale(held[first : first + SCALE_FRAMES_N])
            self._checked_n += SCALE_FRAMES_N
        self._held = held[len(held) // SCALE_FRAMES_N * SCALE_FRAMES_N :].copy()

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
