"""Check that the fields, places, depths and forces of a recording are in uT, mm and N.

The checks raise `CaptureError` if the values are not plausible in these units, and suggest a conversion.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int

from reskin.board import chips, faults
from reskin.errors import CaptureError
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.recordings.tables import FIRST_ROW

# If the median field is below this number, the fields are not in uT but in a larger unit, such as mT or G. In uT, even
# the earth's field is 25 to 65, and a chip under a skin reads 200 to 9000.
WEAKEST_uT = 20.0
# Values in gauss are recognised by two conditions. The median field is below this number: the field of the strongest
# known skin is 13000 uT, which is 130 G. And the steps between values are smaller than the steps of any chip in uT.
GAUSS_MAX = 200.0
# If the steps between values are larger than this number, the values are in nT. The steps of the chip are 0.150 uT to
# 9.68 uT, which are 150 or more in nT.
NANO_STEP_MIN = 100.0
# Whole numbers are raw counts if there are at least this many readings, and this share of the steps between them is 1.
COUNTS_MIN_N, COUNTS_SHARE_MIN = 100, 0.5
# Skins are a few mm thick, and forces on them are smaller than this number of N. In grams, a force of 1 N would be 102.
FORCE_MAX_N = 100.0
FORCE_MIN_N = 0.05  # every recording has a touch with a larger force in N; in kg, a force of 0.4 N would be 0.04
SAME_PLACE_mm = 0.002  # two places are the same if they differ by less: the place of a robot at rest varies by a few um
EXTENT_MIN_mm, EXTENT_MAX_mm = 1.0, 200.0  # limits of the extent of all places, unless there is only one place
# Some places may be too far from the others. If they are at most this fraction of all places, these places are assumed
# to be wrong. If they are a larger fraction, the unit is assumed to be wrong.
FAR_SHARE_MAX = 0.1
DEPTH_MIN_mm, DEPTH_MAX_mm = 0.05, 100.0  # limits of the greatest depth of a recording
STEP_RULE = "0.1 to 100 uT, or that of a chip in reskin/board/chips.py"


def check_fields(
    b_uT: Float[np.ndarray, "f ch"],
    where: str,
    *,
    line_n: Int[np.ndarray, " f"] | None = None,
    subtracted: bool = False,
) -> None:
    """Raise if fields are probably not in uT. `line_n` has the line of each row, if they are not 1, 2, 3, ...

    There are four signs of another unit: the fields exceed the chip's full scale; they are weaker than the earth's
    field; they are raw counts; or the steps between their values are not possible for the chip in uT. The steps can be
    detected only if the values were neither averaged nor rounded to a few decimals. If a no-load field was subtracted
    from the fields, they may be weak, so the second and third sign are not used.
    """
    _check_full_scale(b_uT, where, line_n)
    usual_uT = float(np.median(np.linalg.norm(b_uT.reshape(len(b_uT), -1, 3).astype(np.float64), axis=2)))
    if not subtracted:
        if usual_uT < WEAKEST_uT:
            rule = f"{WEAKEST_uT:g} uT or more on most chips, because the earth's field alone is stronger"
            remedy = "If the unit of the file is mT or G, convert the fields to uT."
            raise CaptureError(where, "field", rule, f"{usual_uT:.4g}", remedy)
        _refuse_counts(b_uT, where)
    step_uT = _find_step(b_uT)
    if chips.is_step(step_uT):
        return
    may_be_gauss = subtracted or usual_uT < GAUSS_MAX
    if step_uT > NANO_STEP_MIN or (may_be_gauss and step_uT < chips.STEP_MIN_uT):
        unit = "nT" if step_uT > NANO_STEP_MIN else "mT or G" if subtracted else "G"
        remedy = (
            f"The unit is probably {unit}. Convert the fields to uT. If they are in uT, add the steps of the chip to "
            "reskin/board/chips.py."
        )
        raise CaptureError(where, "the step between values of the field", STEP_RULE, f"{step_uT:.3g}", remedy)


def check_labels(
    labels: Mapping[str, Float[np.ndarray, " f"]], contact: Bool[np.ndarray, " f"], where: str, *, first_line_n: int
) -> None:
    """Raise if places, depths or forces, by the name of their column, are probably not in mm and N.

    Columns may be missing, and values may be unknown (NaN). Also raises if the force Fz is negative in compression.
    """
    forces = [labels[axis] for axis in ("Fx_N", "Fy_N", "Fz_N") if axis in labels]
    for force_N in forces:
        too_strong = np.flatnonzero(np.abs(force_N) > FORCE_MAX_N)
        if len(too_strong):
            got = f"{force_N[too_strong[0]]:.6g} in line {first_line_n + int(too_strong[0])}"
            remedy = "If the unit of the file is g or mN, convert the forces to N."
            raise CaptureError(where, "force", f"below {FORCE_MAX_N:g} N", got, remedy)
    strongest_N = max(
        (np.abs(force_N[contact & np.isfinite(force_N)]).max(initial=0.0) for force_N in forces), default=0.0
    )
    if 0 < strongest_N < FORCE_MIN_N:
        rule = f"at least {FORCE_MIN_N:g} N in one or more rows with contact"
        remedy = "If the unit is kg or kN, convert the forces to N; otherwise, press harder."
        raise CaptureError(where, "force", rule, f"{strongest_N:.3g} N at most", remedy)
    place_mm = np.stack([labels["x_mm"], labels["y_mm"]], axis=1)
    _check_places(np.where(contact[:, None], place_mm, np.nan), where, first_line_n)
    depth_mm = labels["depth_mm"][contact] if "depth_mm" in labels else np.zeros(0)
    deepest_mm = np.abs(depth_mm[np.isfinite(depth_mm)]).max(initial=0.0)
    if deepest_mm and not DEPTH_MIN_mm <= deepest_mm <= DEPTH_MAX_mm:
        rule = f"{DEPTH_MIN_mm:g} to {DEPTH_MAX_mm:g} mm"
        remedy = "If the unit of the file is m or um, convert the depths to mm."
        raise CaptureError(where, "the greatest depth", rule, f"{deepest_mm:.4g}", remedy)
    pressed_N = labels["Fz_N"][contact & np.isfinite(labels["Fz_N"])] if "Fz_N" in labels else np.zeros(0)
    if len(pressed_N) and np.median(pressed_N) < 0:
        got = f"{np.median(pressed_N):.4g} N"
        remedy = "Reverse the sign of Fz_N in the file or in the map of columns."
        raise CaptureError(where, "the median of Fz_N in contact", "positive", got, remedy)


def check_log(log: ProbeLog, where: str) -> None:
    """Check the labels of a probe log; see `check_labels`."""
    check_labels({name: getattr(log, name) for name in LABELS}, log.contact, where, first_line_n=FIRST_ROW)


def _check_places(place_mm: Float[np.ndarray, "f axes"], where: str, first_line_n: int) -> None:
    """Raise if the extent of the places is too small or too large for a skin, which suggests another unit than mm.

    Unknown places (NaN) are ignored. A recording with a single place is accepted.
    """
    known = np.isfinite(place_mm).all(axis=1)
    known_mm = place_mm[known]
    extent_mm = float(np.ptp(known_mm, axis=0).max()) if len(known_mm) else 0.0
    if extent_mm > SAME_PLACE_mm and not EXTENT_MIN_mm <= extent_mm <= EXTENT_MAX_mm:
        rule = f"all equal, or spread over a range of {EXTENT_MIN_mm:g} to {EXTENT_MAX_mm:g} mm"
        got, remedy = f"a range of {extent_mm:.4g}", "If the unit of the file is m or um, convert the places to mm."
        is_far = (np.abs(known_mm - np.median(known_mm, axis=0)) > EXTENT_MAX_mm).any(axis=1)
        if 0 < is_far.sum() <= FAR_SHARE_MAX * len(is_far):
            i = int(is_far.argmax())
            line_n = first_line_n + int(np.flatnonzero(known)[i])
            place = ", ".join(f"{value:g}" for value in known_mm[i])
            got += f", because the place in line {line_n} ({place} mm) is far from the other places"
            remedy = "Correct that place, or convert its unit to mm."
        raise CaptureError(where, "places", rule, got, remedy)


def _refuse_counts(b_uT: Float[np.ndarray, "f ch"], where: str) -> None:
    """Raise if all values are whole numbers in steps of 1, because these are the raw counts of a chip."""
    values = b_uT[np.isfinite(b_uT).all(axis=1)]
    if len(values) < COUNTS_MIN_N or not (values == np.rint(values)).all():
        return
    gaps = np.concatenate([np.diff(np.unique(column)) for column in values.T])
    if len(gaps) and (gaps == 1).mean() > COUNTS_SHARE_MIN:
        raise CaptureError(
            f"{where}: all fields are whole numbers in steps of 1, so they are probably raw counts. Multiply them by "
            "the step of the chip in uT (reskin/board/chips.py lists the steps of some chips)."
        )


def _check_full_scale(b_uT: Float[np.ndarray, "f ch"], where: str, line_n: Int[np.ndarray, " f"] | None) -> None:
    b_max_uT = np.abs(b_uT).max(axis=1)
    if b_max_uT.max() > chips.FULL_SCALE_uT:
        row_i = int(b_max_uT.argmax())
        place = f"line {row_i + 1 if line_n is None else line_n[row_i]}"
        rule = f"below the full scale of the chip, {chips.FULL_SCALE_uT:.0f} uT"
        got = f"{b_max_uT.max():.6g} in {place}"
        raise CaptureError(
            where, "field", rule, got, "Check that the columns have the right order, and that the unit is uT."
        )


def _find_step(b_uT: Float[np.ndarray, "f ch"]) -> float:
    """Return the median over chips of the step between values along x and y.

    The result is NaN if no step is detected, or if the step is a power of ten below that of any chip, because the
    values were then rounded to decimals.
    """
    steps_uT = faults.find_lsb(b_uT, step_min_uT=0.0, steps_min_n=faults.SURE_STEPS_MIN_N)[:, 0]
    steps_uT = steps_uT[np.isfinite(steps_uT)]
    if not len(steps_uT):
        return np.nan
    step_uT = float(np.median(steps_uT))
    decimals = np.log10(step_uT)
    rounded = step_uT < chips.STEP_MIN_uT and abs(decimals - round(decimals)) < 0.01
    return np.nan if rounded else step_uT
