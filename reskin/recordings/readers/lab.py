"""Read layout `lab`: a robot presses a skin, and a six-axis gauge measures the force.

A recording is one CSV file for each depth, with about 100 readings per indentation. The file contains the force on the
gauge, whose Fz is negative in compression. The force on the skin has the opposite sign, so all three components are
negated; see `reskin.schema` and `ON_SKIN`. `depth_mm` is NaN, because only an index of the depth is known, which is in
the file's name. `t_s` is NaN, because the file contains no times.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int

from reskin.errors import CaptureError
from reskin.recordings.fault_policy import CheckedRows, FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.tables import (
    check_columns,
    contact_rows,
    count_chips_of,
    count_within,
    make_readings,
    mean_by_group,
    read_cells,
    to_numbers,
)
from reskin.recordings.units import check_fields, check_forces, check_places, check_touch
from reskin.schema import Readings

READINGS = "readings.csv"
FILES = (READINGS,)
FIRST_LINE_N = 2  # line number of the first row of numbers in the file
# Factor from the force in the file, which is the force on the gauge, to the force on the skin. The axes of the gauge
# may differ from those of the places, so the sign was derived separately for each axis.
# For z: Fz is negative in compression, but the force on the skin must be positive in compression.
# For x: on both public boards, indentations shift the skin by 48 um along +x (experiment `compare` fits this shift to
# the fields alone). The mean Fx is negative in all six files, so the force on the skin has the opposite sign.
# For y: the shift and the mean force are too small for a decision. However, the sign of Fz implies that the gauge's z
# axis points into the skin. If the gauge's axes are right-handed, its y axis then has the direction of the y axis of
# the places.
ON_SKIN = -1.0

Account = dict[str, int]


@dataclass(frozen=True)
class _Table:
    """The columns of one file.

    `press` is the number of the press to which each row belongs. A press is a block of rows with equal `indent`;
    presses are numbered from 0 in the order of the file.
    """

    press: Int[np.ndarray, " f"]
    contact: Bool[np.ndarray, " f"]
    place_mm: Float64[np.ndarray, "f 2"]
    temperature_degC: Float64[np.ndarray, "f k"]
    b_uT: Float64[np.ndarray, "f ch"]
    force_N: Float64[np.ndarray, "f 3"]
    ignored_columns_n: int


def collect(recording: Path) -> dict[str, Path]:
    """Find the file of a recording. A recording is one CSV file with the presses of one skin at one depth."""
    if not recording.is_file():
        raise CaptureError(
            f"{recording}: not a file. A recording of layout lab is one CSV file: add each depth's file separately."
        )
    return {READINGS: recording}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the names of the columns."""
    return count_chips_of(read_cells(files[READINGS], str(files[READINGS]), separator=",")[0])


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return the contact rows as readings.

    The no-load field of a press is the mean field of its rows with phase `noload`.
    """
    where = f"{header.capture}/{READINGS}"
    table, rows = _read_checked(folder, header, policy, where)
    keep, noload = table.contact & rows.keep, ~table.contact & rows.keep
    noload_uT = mean_by_group(table.b_uT[noload], table.press[noload], int(table.press[-1]) + 1)
    without = np.flatnonzero(np.isnan(noload_uT[:, 0]))
    if len(without):
        line_n = FIRST_LINE_N + int(np.argmax(table.press == without[0]))
        raise CaptureError(
            f"{where}: the indent from line {line_n} on has no fault-free noload row. Remove all rows of this indent, "
            "or record them again."
        )
    reading_i = np.zeros(len(keep), int)
    reading_i[keep] = count_within(table.press[keep])
    readings = make_readings(
        header,
        keep,
        indentation=table.press,
        pass_i=np.zeros(len(keep)),
        reading_i=reading_i,
        x_mm=table.place_mm[:, 0],
        y_mm=table.place_mm[:, 1],
        Fx_N=ON_SKIN * table.force_N[:, 0],
        Fy_N=ON_SKIN * table.force_N[:, 1],
        Fz_N=ON_SKIN * table.force_N[:, 2],
        b_uT=table.b_uT,
        noload_uT=noload_uT[table.press],
        temperature_degC=table.temperature_degC,
        n_contacts=header.contacts_before_n + table.press,
    )
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(keep),
        "noload_rows_n": int(noload.sum()),
        **rows.account(),
        "ignored_columns_n": table.ignored_columns_n,
    }


def read_noload(
    folder: Path, header: Header, policy: FaultPolicy
) -> tuple[Int[np.ndarray, " a"], Float64[np.ndarray, "a ch"]]:
    """Return the press number and the field of each fault-free row of phase `noload`.

    Presses have the same numbers as the indentations of the readings that `read` returns.
    """
    table, rows = _read_checked(folder, header, policy, f"{header.capture}/{READINGS}")
    noload = ~table.contact & rows.keep
    return table.press[noload], table.b_uT[noload]


def _read_checked(folder: Path, header: Header, policy: FaultPolicy, where: str) -> tuple[_Table, CheckedRows]:
    """Read the file of a capture, and find its faulty rows."""
    table = _read_table(folder / READINGS, where)
    if table.temperature_degC.shape[1] != header.chips_n:
        chips_n = table.temperature_degC.shape[1]
        raise CaptureError(
            f"{where}: the file has {chips_n} chips, but the header says {header.chips_n}. Correct the file, or "
            "correct chips_n in header.json."
        )
    return table, check_rows(table.b_uT, table.temperature_degC, header.expected_lsb_uT, where=where, policy=policy)


def _read_table(path: Path, where: str) -> _Table:
    header_cells, *cells = read_cells(path, where, separator=",")
    names = [name.strip() for name in header_cells]
    k = count_chips_of(names)
    fields = [f"{axis}{chip}" for chip in range(k) for axis in ("Bx", "By", "Bz")]
    numeric = ["indent", "x_mm", "y_mm", *(f"T{chip}" for chip in range(k)), *fields, "Fx", "Fy", "Fz"]
    check_columns(names, [numeric[0], "phase", *numeric[1:]], where, layout="lab")
    contact = contact_rows([row[names.index("phase")].strip() for row in cells], where, FIRST_LINE_N)
    columns = [names.index(name) for name in numeric]
    picked = [[row[i] for i in columns] for row in cells]
    numbers = to_numbers(picked, where, names=numeric, first_line_n=FIRST_LINE_N)
    indent, place_mm, temperature_degC, b_uT, force_N = np.split(numbers, [1, 3, 3 + k, 3 + 4 * k], axis=1)
    press, ignored_n = _number_presses(indent[:, 0], where), len(names) - len(numeric) - 1
    table = _Table(press, contact, place_mm, temperature_degC, b_uT, force_N, ignored_n)
    _check_table(table, where)
    return table


def _number_presses(indent: Float64[np.ndarray, " f"], where: str) -> Int[np.ndarray, " f"]:
    """Return the press number of each row; raise if two blocks of rows have the same `indent`."""
    begins = np.flatnonzero(np.diff(indent, prepend=np.nan) != 0)
    seen: set[float] = set()
    for row_i in begins:
        if indent[row_i] in seen:
            problem = f"indent {indent[row_i]:g} begins again in line {FIRST_LINE_N + row_i}"
            raise CaptureError(
                f"{where}: {problem}; its rows must be one block. Remove rows that are in the file twice."
            )
        seen.add(indent[row_i])
    return np.repeat(np.arange(len(begins)), np.diff(begins, append=len(indent)))


def _check_table(table: _Table, where: str) -> None:
    """Check units and signs, and that each press has one place."""
    check_fields(table.b_uT, where, first_line_n=FIRST_LINE_N)
    for axis in range(3):
        check_forces(table.force_N[:, axis], where, first_line_n=FIRST_LINE_N)
    check_touch(table.force_N[table.contact], where)
    pressed_N = float(np.median(table.force_N[table.contact, 2]))
    if pressed_N > 0:
        remedy = "In layout lab, Fz is negative in compression: reverse the sign of Fz."
        raise CaptureError(where, "the median of Fz in contact", "negative", f"{pressed_N:.4g} N", remedy)
    check_places(table.place_mm, where, first_line_n=FIRST_LINE_N)
    begins = np.flatnonzero(np.diff(table.press, prepend=-1))
    moved = np.flatnonzero((table.place_mm != table.place_mm[begins][table.press]).any(axis=1))
    if len(moved):
        problem = f"the place changes within an indent, in line {FIRST_LINE_N + moved[0]}"
        raise CaptureError(f"{where}: {problem}. Give each press an indent number of its own.")
