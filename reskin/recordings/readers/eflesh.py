"""Read layout `eflesh`: a robot arm presses an eFlesh skin; a recording is a folder with three CSV files.

Places are the robot's coordinates minus their smallest values, so the smallest x and y are 0 mm. The depth is measured
downwards from the highest z of the recording. At this z, the robot may be above the skin, so the depth has an unknown
offset. The force was measured along one axis only. If this axis is x or y, the sign of the force is unknown, because
the recorder does not state whether it is the force on the skin or the force on the gauge. The account contains the
number of rows with such a force.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32

from reskin.errors import CaptureError
from reskin.recordings.fault_policy import FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.readers.alignment import find_passes
from reskin.recordings.tables import count_columns, make_readings, read_rows
from reskin.recordings.units import DEPTH_MIN_mm, SAME_PLACE_mm, check_fields, check_labels
from reskin.schema import AXES_PER_CHIP_N, Readings

SENSOR = "sensor.csv"
CHANGES = "sensor_post_baselines.csv"
STATES = "states.csv"
FILES = (SENSOR, STATES, CHANGES)

FORCE_AXES = ("x", "y", "z")
NEWTON_PER_GRAM = 9.80665e-3  # weight of one gram in standard gravity
STATES_COLUMNS = ("time", "x", "y", "z", "weight")  # the last is missing if the force was not recorded
WEIGHT_COLUMN = 4
NO_NEW_WEIGHT = -1.0  # the recorder writes this number if the gauge has not measured since the previous row
# The recorder writes a row to each of two files in one step of its loop, so the times in these rows differ by
# milliseconds. If they differ by this value or more, the rows do not belong together.
CLOCKS_APART_MAX_s = 0.05
PLACE_DECIMALS = 3  # places are rounded, because the robot reports -84.999992 mm for -85 mm
# Two no-load fields are treated as the same if they differ by less than this value. No-load fields are computed as raw
# field minus field change, and the rounding errors of these float32 numbers are below 0.004 uT. If the recorder took a
# new no-load reading, at least one channel changes by an LSB, which is 0.15 uT or more.
SAME_NOLOAD_uT = 0.02

# If z varies by less than this fraction of its largest value, the robot is assumed to have kept a constant height. For
# a robot at constant height, the fraction is about 1e-4. In a recording of presses whose z is by mistake in m instead
# of mm, it is some hundredths.
HELD_FRACTION = 1e-3

Account = dict[str, int]


def collect(recording: Path) -> dict[str, Path]:
    """Find the three files in the folder of one recording."""
    missing = [name for name in FILES if not (recording / name).is_file()]
    if missing:
        raise CaptureError(
            f"{recording}: the folder does not contain {', '.join(missing)}. A recording of layout eflesh is a folder "
            f"with {', '.join(FILES)}. Copy the whole folder again."
        )
    return {name: recording / name for name in FILES}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the columns of `sensor.csv`: the time, then three columns per chip."""
    where = str(files[SENSOR])
    columns_n = count_columns(files[SENSOR], where)
    if columns_n < 1 + AXES_PER_CHIP_N or (columns_n - 1) % AXES_PER_CHIP_N:
        raise CaptureError(
            f"{where}: {columns_n} columns cannot be a time and three columns per chip. Check that the layout is "
            "eflesh."
        )
    return (columns_n - 1) // AXES_PER_CHIP_N


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return the readings: each row of the recording is one indentation, of which there is only this reading.

    The no-load field is the baseline that the recorder subtracted. It is computed as the raw field minus the field
    change, which are in two files.
    """
    sensor, change_uT, states = _read_files(folder, header)
    time_s, b_uT = sensor[:, 0], sensor[:, 1:]
    noload_uT = b_uT - change_uT
    temperature_degC = np.full((len(time_s), header.chips_n), np.nan, np.float32)
    rows = check_rows(b_uT, temperature_degC, header.expected_lsb_uT, where=f"{header.capture}/{SENSOR}", policy=policy)
    labels = _read_labels(states, header)
    pass_i, touches_i = _number_passes(np.stack([labels["x_mm"], labels["y_mm"]], axis=1), noload_uT)
    readings = make_readings(
        header,
        rows.keep,
        indentation=np.arange(len(time_s)),
        pass_i=pass_i,
        **labels,
        b_uT=b_uT,
        noload_uT=noload_uT,
        temperature_degC=temperature_degC,
        t_s=time_s,
        n_contacts=header.contacts_before_n + touches_i,
    )
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(time_s),
        "noload_rows_n": 0,
        **rows.account(),
        "no_new_force_rows_n": int((states[rows.keep, WEIGHT_COLUMN:] == NO_NEW_WEIGHT).sum()),
        "no_depth_rows_n": int(np.isnan(readings.depth_mm).sum()),
        "force_sign_unknown_rows_n": int(np.isfinite([readings.Fx_N, readings.Fy_N]).any(axis=0).sum()),
        "passes_n": int(pass_i.max()) + 1,
    }


def _read_files(
    folder: Path, header: Header
) -> tuple[Float64[np.ndarray, "f c"], Float64[np.ndarray, "f ch"], Float64[np.ndarray, "f s"]]:
    """Read the raw fields with their times, the field changes, and the states; check that they belong together."""
    fields = ["time", *(f"B{axis}{chip}" for chip in range(header.chips_n) for axis in "xyz")]
    states_n = count_columns(folder / STATES, f"{header.capture}/{STATES}")
    names = {SENSOR: fields, CHANGES: fields, STATES: list(STATES_COLUMNS[: max(states_n, WEIGHT_COLUMN)])}
    sensor, changes, states = (read_rows(folder / name, f"{header.capture}/{name}", of) for name, of in names.items())
    if not len(sensor) == len(changes) == len(states):
        got = f"{len(sensor)} in {SENSOR}, {len(changes)} in {CHANGES} and {len(states)} in {STATES}"
        raise CaptureError(
            f"{header.capture}: the files have different numbers of rows, {got}. If one of the files was cut, copy all "
            "files again."
        )
    for name, times_s, most_s in ((CHANGES, changes[:, 0], 0.0), (STATES, states[:, 0], CLOCKS_APART_MAX_s)):
        apart_s = np.abs(times_s - sensor[:, 0])
        if apart_s.max() > most_s:
            line_n = 1 + int((apart_s > most_s).argmax())
            raise CaptureError(
                f"{header.capture}/{name} line {line_n}: the time differs by {apart_s[line_n - 1]:.3f} s from the time "
                f"in {SENSOR}; at most {most_s:g} s are allowed. A row may be missing in one of the files: copy all "
                "files again."
            )
    back = np.flatnonzero(np.diff(sensor[:, 0]) <= 0)
    if len(back):
        raise CaptureError(
            f"{header.capture}/{SENSOR}: time does not increase in line {back[0] + 2}. If the file contains two "
            "recordings, split it into two files."
        )
    check_fields(sensor[:, 1:], f"{header.capture}/{SENSOR}")
    return sensor, changes[:, 1:], states


def _number_passes(
    place_mm: Float64[np.ndarray, "f 2"], noload_uT: Float64[np.ndarray, "f ch"]
) -> tuple[Int32[np.ndarray, " f"], Int32[np.ndarray, " f"]]:
    """Return the pass number of each row, and the number of touches before it.

    In a recording of many places, each row is a touch, and a new pass begins when the sequence of places repeats. In a
    recording of a single place, the robot strokes up and down, and the recorder takes a new baseline before each
    stroke. Therefore, a change of the no-load field marks a new stroke, which counts as a new pass with one touch.
    """
    if place_mm.any():
        everywhere = np.ones(len(place_mm), bool)
        return find_passes(place_mm, everywhere), np.arange(len(place_mm), dtype=np.int32)
    is_new = (np.abs(np.diff(noload_uT, axis=0)) > SAME_NOLOAD_uT).any(axis=1)
    pass_i = np.concatenate([[0], np.cumsum(is_new)]).astype(np.int32)
    return pass_i, pass_i


def _read_labels(states: Float64[np.ndarray, "f c"], header: Header) -> dict[str, Float64[np.ndarray, " f"]]:
    """Return the places, the depths, and the force along the axis of the gauge if there was one, by their columns.

    The depths are below the highest z. They are NaN if z was constant, or if the gauge measured a force along x or y.
    The force is NaN in rows without a new value of the gauge.
    """
    z_mm = states[:, 3]
    place_mm = np.round(states[:, 1:3], PLACE_DECIMALS)
    place_mm -= place_mm.min(axis=0)
    unknown = np.full(len(z_mm), np.nan)
    holds_height = np.ptp(z_mm) <= max(SAME_PLACE_mm, min(DEPTH_MIN_mm, HELD_FRACTION * np.abs(z_mm).max()))
    depth_mm = unknown if holds_height else z_mm.max() - z_mm
    labels = {"x_mm": place_mm[:, 0], "y_mm": place_mm[:, 1], "depth_mm": depth_mm}
    axis = "z"
    if states.shape[1] > WEIGHT_COLUMN:
        axis = header.options.get("force_axis", "none")
        if axis not in FORCE_AXES:
            remedy = "State the axis along which the gauge measured the force, with --force-axis."
            raise CaptureError(header.capture, "option force_axis", "x, y or z", axis, remedy)
        weight_g = states[:, WEIGHT_COLUMN]
        labels[f"F{axis}_N"] = np.where(weight_g == NO_NEW_WEIGHT, np.nan, weight_g * NEWTON_PER_GRAM)
    check_labels(labels, np.ones(len(z_mm), bool), f"{header.capture}/{STATES}", first_line_n=1)
    return labels if axis == "z" else labels | {"depth_mm": unknown}
