"""Can a native capture be believed? In: its probe log, and its frames block by block. Out: masks, or `CaptureError`.

What the readers of whole recordings ask of their rows, asked of a stream of any length and in any portions: units,
order of values, the scale of each chip, chips that stopped. Refuses to know time, dwells and files.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float32

from pipeline.capture import faults
from pipeline.capture.bursts import TEMPERATURE_MAX_degC, TEMPERATURE_MIN_degC
from pipeline.capture.header import Header
from pipeline.capture.probe import FIRST_ROW, ProbeLog
from pipeline.capture.readers.units import check_depths, check_fields, check_forces, check_places, check_touch
from pipeline.capture.wire import Frames
from pipeline.core.errors import CaptureError

SCALE_FRAMES_N = 400  # real recordings show each sound chip's grid in so many frames; in 200 it may hide
ORDER_OF_OTHER: Mapping[str | None, tuple[str, int]] = {
    "text-xyzt": ("text-txyz", 0),
    "text-txyz": ("text-xyzt", 2),
}  # and which field is a temperature then
SPREAD_MAX_degC = 10.0  # chips of one board, in one block


def check_log(log: ProbeLog, where: str) -> None:
    """Raise if places, depths or forces of the contacts are not in mm and N, or compression is negative."""
    contact = log.contact
    force_N = np.stack([log.Fx_N, log.Fy_N, log.Fz_N], axis=1)
    for axis in range(3):
        check_forces(force_N[:, axis], where, first_line_n=FIRST_ROW)
    check_touch(force_N[contact], where)
    check_places(np.stack([log.x_mm, log.y_mm], axis=1)[contact], where)
    check_depths(log.depth_mm[contact], where)
    known_N = log.Fz_N[contact & np.isfinite(log.Fz_N)]
    if len(known_N) and np.median(known_N) < 0:
        got = f"{np.median(known_N):.4g} N"
        raise CaptureError(where, "the usual Fz_N in contact", "positive", got, "Turn its sign.")


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

    def _check_scales(self, b_uT: Float32[np.ndarray, "f ch"]) -> None:
        held = np.concatenate([self._held, b_uT])
        for first in range(0, len(held) - SCALE_FRAMES_N + 1, SCALE_FRAMES_N):
            self._check_scale(held[first : first + SCALE_FRAMES_N])
            self._checked_n += SCALE_FRAMES_N
        self._held = held[len(held) // SCALE_FRAMES_N * SCALE_FRAMES_N :].copy()

    def _check_scale(self, b_uT: Float32[np.ndarray, "f ch"]) -> None:
        lsb_uT = faults.find_lsb(b_uT, steps_min_n=faults.SURE_STEPS_MIN_N)
        firmware = self._header.firmware
        expected_uT = None if firmware is None else (firmware.lsb_xy_uT, firmware.lsb_z_uT)
        changed = np.any(np.abs(lsb_uT / self._lsb_uT - 1) > faults.LSB_TOLERANCE, axis=1)
        strange = np.flatnonzero(changed | faults.odd_scales(lsb_uT, expected_uT))
        if len(strange):
            names = f"the LSB of chip {', '.join(map(str, strange))}"
            rule = (
                "as before, that of the other chips, and not a reset chip's"
                if firmware is None
                else f"{expected_uT} uT"
            )
            got = "{:.3g} uT in x, y and {:.3g} uT in z".format(*lsb_uT[strange[0]])
            where = f"{self._where} from sound frame {self._checked_n + 1}"
            remedy = "A chip lost its settings: reset the board, record again."
            raise CaptureError(where, names, rule, got, remedy)
        self._lsb_uT = np.where(np.isnan(self._lsb_uT), lsb_uT, self._lsb_uT)


def _spread(temperature_degC: Float32[np.ndarray, "f k"]) -> float:
    low_degC, high_degC = np.percentile(temperature_degC, [5, 95])
    return float(high_degC - low_degC)


def _is_mostly_warm(temperature_degC: Float32[np.ndarray, "f k"]) -> bool:
    warm = (temperature_degC >= TEMPERATURE_MIN_degC) & (temperature_degC <= TEMPERATURE_MAX_degC)
    return bool(warm.mean() > 0.5)
