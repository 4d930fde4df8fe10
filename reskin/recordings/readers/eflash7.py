"""Read layout `eflash7`: an eFlesh pad on a six-axis force sensor is pressed; a recording is one CSV file.

In a recording, one or two places of a 3 x 3 grid are touched. The pitch of the grid is unknown, so `x_mm` and `y_mm`
are NaN. Places are identified by a number instead: the place in column i and row j of the grid, both counted from 0,
has number n = 1 + i + 3 j. The account contains the number of rows of this place as `place_<n>_rows_n`. The recorder
subtracted a baseline that the file does not contain. Therefore, each channel of `b_uT` differs from the raw field by an
unknown constant. The no-load field is the mean field of the rows before the first touch, and forces are relative to the
mean force of these rows.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64

from reskin.board.faults import zero_reads
from reskin.errors import CaptureError
from reskin.recordings.fault_policy import FaultLog, FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.tables import check_columns, count_within, make_readings, read_cells, to_numbers
from reskin.recordings.units import check_changes, check_forces, check_touch
from reskin.schema import Readings

READINGS = "readings.csv"
FILES = (READINGS,)
FIRST_LINE_N = 2  # line number of the first row of numbers in the file
SIDE_N = 3  # places per side of the grid
ONE, TWO = ("x_pos", "y_pos"), ("pos1_x", "pos1_y", "pos2_x", "pos2_y")
FORCES = ("fx", "fy", "fz")
ON_SKIN = -1.0  # factor from fz in the file, which is negative in compression, to the force on the skin
# Assumed: a touch begins when the force rises above this value. The file does not mark touches.
TOUCH_N = 0.5
# The chips measure about ten times a second. If the recorder asks for a reading before the chips have measured again,
# it writes a row of zeros. In 19 recordings, 4 to 10 % of the rows are such rows. A recording with more than this
# fraction is refused.
ZERO_FRACTION_MAX = 0.25
GAP_s = 0.5  # a time between two rows that is longer than this is counted as a gap
# The first touch begins when a channel has changed by more than this value. All 19 recordings begin with 1.4 to 17 s
# without contact, in which the field varies by 3 to 6 uT because of noise. A touch changes the field by 500 uT or more.
STILL_uT = 40.0
STILL_ROWS_MIN_N = 5

Account = dict[str, int]


@dataclass(frozen=True)
class _Table:
    """The columns of one file.

    `places` are the numbers of the touched places. `force_N` is the force on the gauge, as in the file.
    """

    time_s: Float64[np.ndarray, " f"]
    b_uT: Float64[np.ndarray, "f ch"]
    force_N: Float64[np.ndarray, "f 3"]
    places: list[int]
    ignored_columns_n: int


def collect(recording: Path) -> dict[str, Path]:
    """Return the only file of a recording, which is the CSV file that the user names."""
    if not recording.is_file():
        raise CaptureError(
            f"{recording}: not a file. A recording of layout eflash7 is one CSV file: add each file separately."
        )
    return {READINGS: recording}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the names of the columns."""
    where = str(files[READINGS])
    names = [name.strip() for name in read_cells(files[READINGS], where, separator=",")[0]]
    check_columns(names, ["timestamp", "mag0_x"], where, layout="eflash7")
    return _count_chips(names)


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return all fault-free rows from the first touch on as readings.

    The no-load field is the mean field of the rows before the first touch.
    """
    where = f"{header.capture}/{READINGS}"
    table = _read_table(folder / READINGS, where)
    if table.b_uT.shape[1] != 3 * header.chips_n:
        chips_n = table.b_uT.shape[1] // 3
        raise CaptureError(
            f"{where}: the file has {chips_n} chips, but the header says {header.chips_n}. Correct the file, or "
            "correct chips_n in header.json."
        )
    log = FaultLog(policy, where, "row")
    row = FIRST_LINE_N - 1 + np.arange(len(table.b_uT))
    # Here, the log counts the rows with zeros on all chips. Rows with zeros on only some of the chips are counted by
    # `check_rows` below.
    written = ~log.record("zeros", _zero_rows(table.b_uT, where), row)
    unknown_degC = np.full((int(written.sum()), header.chips_n), np.nan)
    b_uT = table.b_uT[written]
    rows = check_rows(b_uT, unknown_degC, header.expected_lsb_uT, where=where, policy=policy, row=row[written])
    whole = written.copy()
    whole[written] = rows.keep
    noload = _untouched(table.b_uT, whole, where)
    force_N = table.force_N - table.force_N[noload].mean(axis=0)
    _check_force(table.force_N, force_N, where)
    touch_i = _number_touches(ON_SKIN * force_N[:, 2], whole)
    keep = whole & ~noload
    readings = make_readings(
        header,
        keep,
        indentation=touch_i,
        pass_i=np.zeros(len(keep)),
        reading_i=count_within(touch_i),
        Fx_N=force_N[:, 0],
        Fy_N=force_N[:, 1],
        Fz_N=ON_SKIN * force_N[:, 2],
        b_uT=table.b_uT,
        noload_uT=np.broadcast_to(table.b_uT[noload].mean(axis=0), table.b_uT.shape),
        temperature_degC=np.full((len(keep), header.chips_n), np.nan),
        t_s=table.time_s,
        n_contacts=header.contacts_before_n + touch_i,
    )
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(keep),
        "noload_rows_n": int(noload.sum()),
        "dropped_zero_rows_n": int((~written).sum()),
        **{name.replace("zeros", "zeros_of_all_chips"): n for name, n in log.account().items()},
        **rows.account(),
        "repeated_rows_n": int((np.diff(table.b_uT[keep], axis=0) == 0).all(axis=1).sum()),
        "gap_rows_n": int((np.diff(table.time_s) > GAP_s).sum()),
        "baseline_subtracted_rows_n": len(readings),
        "force_sign_unknown_rows_n": int(np.isfinite(readings.Fx_N).sum()),
        "ignored_columns_n": table.ignored_columns_n,
        **{f"place_{place}_rows_n": len(readings) for place in table.places},
    }


def _count_chips(names: Sequence[str]) -> int:
    return max((int(match[1]) + 1 for name in names if (match := re.fullmatch(r"mag(\d{1,2})_[xyz]", name))), default=1)


def _read_table(path: Path, where: str) -> _Table:
    header_cells, *cells = read_cells(path, where, separator=",")
    names = [name.strip() for name in header_cells]
    fields = [f"mag{chip}_{axis}" for chip in range(_count_chips(names)) for axis in "xyz"]
    places = list(TWO if set(TWO) & set(names) else ONE)
    forces = list(FORCES if places == list(ONE) else FORCES[2:])
    numeric = ["timestamp", *places, *forces, *fields]
    check_columns(names, numeric, where, layout="eflash7")
    columns = [names.index(name) for name in numeric]
    picked = [[row[i] for i in columns] for row in cells]
    numbers = to_numbers(picked, where, names=numeric, first_line_n=FIRST_LINE_N)
    time_s, place, force_N, b_uT = np.split(numbers, np.cumsum([1, len(places), len(forces)]), axis=1)
    back = np.flatnonzero(np.diff(time_s[:, 0]) <= 0)
    if len(back):
        raise CaptureError(
            f"{where}: timestamp does not increase in line {FIRST_LINE_N + back[0] + 1}. If the file contains two "
            "recordings, split it into two files."
        )
    check_changes(b_uT, where, first_line_n=FIRST_LINE_N)
    known_N = np.full((len(numbers), 3), np.nan)
    known_N[:, -len(forces) :] = force_N
    return _Table(time_s[:, 0], b_uT, known_N, _number_places(place, where), len(names) - len(numeric))


def _number_places(place: Float64[np.ndarray, "f c"], where: str) -> list[int]:
    """Return the numbers of the one or two touched places, from their columns and rows in the file (1 to 3)."""
    moved = np.flatnonzero((place != place[0]).any(axis=1))
    if len(moved):
        raise CaptureError(
            f"{where}: the place changes in line {FIRST_LINE_N + moved[0]}. Write the rows of each place to a file of "
            "its own, and add each file."
        )
    pairs = place[0].reshape(-1, 2)
    if not np.isin(pairs, np.arange(1, SIDE_N + 1)).all():
        rule = f"columns and rows of a grid, numbered from 1 to {SIDE_N}"
        raise CaptureError(where, "places", rule, place[0].tolist(), "If the places are in mm, use layout table.")
    numbers = sorted(int(column + SIDE_N * (row - 1)) for column, row in pairs)
    if len(set(numbers)) < len(numbers):
        raise CaptureError(
            f"{where}: both places are the same, place {numbers[0]}. Correct the columns that contain the places."
        )
    return numbers


def _zero_rows(b_uT: Float64[np.ndarray, "f ch"], where: str) -> Bool[np.ndarray, " f"]:
    """Mark the rows with zeros for all chips, in which there was no new reading; raise if there are too many rows."""
    zero = np.asarray(zero_reads(b_uT).all(axis=1))
    if zero.mean() > ZERO_FRACTION_MAX:
        problem = (
            f"{int(zero.sum())} of {len(zero)} rows contain only zeros, but at most {ZERO_FRACTION_MAX:.0%} of the "
            "rows may do so"
        )
        raise CaptureError(f"{where}: {problem}. Check that the sensor is plugged in, and record again.")
    return zero


def _untouched(b_uT: Float64[np.ndarray, "f ch"], whole: Bool[np.ndarray, " f"], where: str) -> Bool[np.ndarray, " f"]:
    """Mark the rows before any channel has changed by more than `STILL_uT`; raise if there are too few such rows."""
    first_uT = np.median(b_uT[whole][:STILL_ROWS_MIN_N], axis=0)
    moved = whole & (np.abs(b_uT - first_uT) > STILL_uT).any(axis=1)
    untouched = whole & ~np.logical_or.accumulate(moved)
    if untouched.sum() < STILL_ROWS_MIN_N:
        line_n = FIRST_LINE_N + int(moved.argmax())
        raise CaptureError(
            f"{where}: fewer than {STILL_ROWS_MIN_N} rows come before the first touch: fields change by more than "
            f"{STILL_uT:g} uT in line {line_n}. Start the recording earlier before the first touch."
        )
    return untouched


def _check_force(gauge_N: Float64[np.ndarray, "f 3"], force_N: Float64[np.ndarray, "f 3"], where: str) -> None:
    for axis_N in gauge_N.T:
        check_forces(axis_N, where, first_line_n=FIRST_LINE_N)
    check_touch(force_N, where)
    if force_N[:, 2].max() > -force_N[:, 2].min():
        got = f"{force_N[:, 2].max():.4g} N"
        remedy = "In layout eflash7, fz is negative in compression: reverse the sign of fz."
        raise CaptureError(where, "the strongest fz", "negative", got, remedy)


def _number_touches(pressed_N: Float64[np.ndarray, " f"], whole: Bool[np.ndarray, " f"]) -> Int64[np.ndarray, " f"]:
    """Return the number of the touch to which each row belongs; touches are numbered from 0.

    A touch begins when the force on the skin, `pressed_N`, rises above `TOUCH_N`, and lasts until the next touch
    begins. Rows before the first touch also have number 0.
    """
    pressed = pressed_N >= TOUCH_N
    begins = pressed & ~np.concatenate([[False], pressed[:-1]])
    return np.maximum(np.cumsum(begins) - 1, 0)
