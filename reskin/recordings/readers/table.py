"""Read layout `table`: a recording of any rig in one CSV or Parquet file with named columns."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Float64, Int

from reskin.errors import CaptureError
from reskin.recordings.fault_policy import FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.readers.alignment import find_passes
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
from reskin.recordings.units import (
    SAME_PLACE_mm,
    WEAKEST_uT,
    check_depths,
    check_fields,
    check_forces,
    check_places,
    check_touch,
)
from reskin.schema import Readings

CSV, PARQUET = "readings.csv", "readings.parquet"
FILES = (CSV,)
NEEDED = ("phase", "x_mm", "y_mm")
OPTIONAL = ("indentation", "pass", "t_s", "depth_mm", "Fx_N", "Fy_N", "Fz_N")
FIRST_LINE_N = 2  # line number of the first row of numbers in a CSV file
EMPTY = ("", "nan", "NaN")
# If the name of an unknown column begins with one of these words, it is probably the misspelt name of a known column.
STEMS = {"f", "fx", "fy", "fz", "force", "depth", "x", "y", "t", "time", "indent", "indentation", "press", "pass"}

# Assumed: the recorder subtracted a baseline if all fields are weak, and if the fields without contact are below this
# fraction of the fields in contact.
SUBTRACTED_RATIO = 0.5

Account = dict[str, int]


def columns_of(chips_n: int) -> list[str]:
    """Return the names of all columns that a file of this layout may have, in the order of a template file."""
    fields = [f"{axis}{chip}" for chip in range(chips_n) for axis in ("Bx", "By", "Bz")]
    return [*NEEDED, *fields, *OPTIONAL, *(f"T{chip}" for chip in range(chips_n))]


def collect(recording: Path) -> dict[str, Path]:
    """Find the file of a recording: the CSV or Parquet file itself."""
    if not recording.is_file():
        raise CaptureError(f"{recording}: not a file. A table is one CSV or Parquet file: add each file separately.")
    return {PARQUET if recording.suffix == ".parquet" else CSV: recording}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the names of the columns."""
    (file,) = files.values()
    return count_chips_of(_read_cells(file, str(file))[0])


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return the contact rows as readings.

    The no-load field of a row is the mean field of the last run of no-load rows before it.
    """
    name = next(name for name in (CSV, PARQUET) if (folder / name).exists())
    where = f"{header.capture}/{name}"
    names, cells = _read_cells(folder / name, where)
    if (chips_n := count_chips_of(names)) != header.chips_n:
        raise CaptureError(
            f"{where}: the file has {chips_n} chips, but the header says {header.chips_n}. Correct the file, or "
            "correct chips_n in header.json."
        )
    columns = columns_of(header.chips_n)
    check_columns(names, columns[: -len(OPTIONAL) - header.chips_n], where, layout="table")
    contact = contact_rows([row[names.index("phase")].strip() for row in cells], where, FIRST_LINE_N)
    _refuse_near_names(names, columns, where)
    known = [column for column in columns[1:] if column in names and not _is_empty(column, names, cells)]
    numbers = dict(zip(known, _to_numbers(names, cells, known, contact, where).T, strict=True))
    b_uT = np.stack([numbers[column] for column in columns[len(NEEDED) : len(NEEDED) + 3 * header.chips_n]], axis=1)
    unknown = np.full(len(contact), np.nan)
    temperature_degC = np.stack([numbers.get(f"T{chip}", unknown) for chip in range(header.chips_n)], axis=1)
    rows = check_rows(b_uT, temperature_degC, header.expected_lsb_uT, where=where, policy=policy)
    _check(numbers, b_uT, contact, rows.keep, where)
    press = _number_presses(numbers, contact, where)
    # Number the blocks of rows. A block is a run of no-load rows together with the contact rows after it.
    block = np.cumsum(np.diff(contact.astype(int), prepend=1) < 0)
    rest = ~contact & rows.keep
    noload_uT = mean_by_group(b_uT[rest], block[rest], int(block[-1]) + 1)[block]
    keep = contact & rows.keep
    without = np.flatnonzero(keep & np.isnan(noload_uT[:, 0]))
    if len(without):
        line_n = FIRST_LINE_N + without[0]
        raise CaptureError(
            f"{where}: the press in line {line_n} has no fault-free no-load row before it. Add rows of phase noload "
            "before this press."
        )
    depth_is_zero = "depth_mm" in numbers and not numbers["depth_mm"][contact].any()
    pass_i = numbers["pass"] if "pass" in numbers else _find_passes(numbers, press, contact)
    reading_i = np.zeros(len(keep), int)
    reading_i[keep] = count_within(press[keep])
    readings = make_readings(
        header, keep, indentation=press, pass_i=pass_i, reading_i=reading_i,
        x_mm=numbers["x_mm"], y_mm=numbers["y_mm"],
        depth_mm=unknown if depth_is_zero else numbers.get("depth_mm", unknown),
        **{axis: numbers.get(axis, unknown) for axis in ("Fx_N", "Fy_N", "Fz_N", "t_s")},
        b_uT=b_uT, noload_uT=noload_uT, temperature_degC=temperature_degC, n_contacts=header.contacts_before_n + press,
    )  # fmt: skip
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(keep),
        "noload_rows_n": int(rest.sum()),
        **rows.account(),
        "ignored_columns_n": len(set(names) - set(columns)),
        "passes_n": len(np.unique(readings.pass_i)),
        "no_depth_rows_n": len(readings) if depth_is_zero or "depth_mm" not in numbers else 0,
    }


def _read_cells(path: Path, where: str) -> tuple[list[str], list[list[str]]]:
    if path.suffix != ".parquet":
        head, *cells = read_cells(path, where, separator=",")
        return [name.strip() for name in head], cells
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise CaptureError(
            f"{where}: the file cannot be read as a Parquet file: {str(error)[:60]}. Write the file again."
        ) from None
    columns = [["" if value is None else str(value) for value in column.to_pylist()] for column in table.columns]
    return list(table.column_names), [list(row) for row in zip(*columns, strict=True)]


def _refuse_near_names(names: Sequence[str], columns: Sequence[str], where: str) -> None:
    """Raise if the name of an unknown column resembles a known name, as `Fz` resembles `Fz_N`.

    Otherwise, the column would be ignored without notice.
    """
    for name in names:
        if name not in columns and name.lower().split("_")[0] in STEMS:
            known = ", ".join((*NEEDED, *OPTIONAL))
            raise CaptureError(
                f"{where}: column {name!r} is not known, but its name resembles one of {known}. Rename the column, or "
                "remove the column."
            )


def _is_empty(column: str, names: Sequence[str], cells: Sequence[Sequence[str]]) -> bool:
    """Return whether a column is optional and all its cells are empty, as in a template that was filled in partly."""
    column_i = names.index(column)
    return (column in OPTIONAL or column[0] == "T") and all(row[column_i].strip() in EMPTY for row in cells)


def _to_numbers(
    names: list[str], cells: list[list[str]], known: Sequence[str], contact: Bool[np.ndarray, " f"], where: str
) -> Float64[np.ndarray, "f c"]:
    """Parse the known columns as numbers.

    In rows without contact, all cells except those of the field may be empty; an empty cell becomes NaN.
    """
    column_i = [names.index(column) for column in known]
    may_lack = {column for column in known if column[0] != "B"}
    picked = [[row[i].strip() for i in column_i] for row in cells]
    lacking = np.array([[cell in EMPTY for cell in row] for row in picked], bool).reshape(len(picked), len(known))
    lacking &= ~contact[:, None] & np.isin(known, sorted(may_lack))
    filled = [
        ["0" if lack else cell for cell, lack in zip(*row, strict=True)] for row in zip(picked, lacking, strict=True)
    ]
    numbers = to_numbers(filled, where, names=known, first_line_n=FIRST_LINE_N)
    return np.where(lacking, np.nan, numbers)


def _check(
    numbers: Mapping[str, Float64[np.ndarray, " f"]],
    b_uT: Float64[np.ndarray, "f ch"],
    contact: Bool[np.ndarray, " f"],
    keep: Bool[np.ndarray, " f"],
    where: str,
) -> None:
    _refuse_subtracted(b_uT[keep], contact[keep], where)
    check_fields(b_uT[keep], where, line_n=FIRST_LINE_N + np.flatnonzero(keep))
    place_mm = np.where(contact[:, None], np.stack([numbers["x_mm"], numbers["y_mm"]], axis=1), np.nan)
    check_places(place_mm, where, first_line_n=FIRST_LINE_N)
    if "depth_mm" in numbers:
        check_depths(numbers["depth_mm"][contact], where)
    for axis in ("Fx_N", "Fy_N", "Fz_N"):
        if axis in numbers:
            check_forces(numbers[axis], where, first_line_n=FIRST_LINE_N)
            check_touch(numbers[axis][contact], where)
    if "Fz_N" in numbers and np.median(numbers["Fz_N"][contact]) < 0:
        got = f"{np.median(numbers['Fz_N'][contact]):.4g} N"
        raise CaptureError(where, "the median of Fz_N in contact", "positive", got, "Reverse the sign of Fz_N.")


def _refuse_subtracted(b_uT: Float64[np.ndarray, "f ch"], contact: Bool[np.ndarray, " f"], where: str) -> None:
    """Raise if the recorder seems to have subtracted a baseline from the fields.

    The signs are that the fields are weak, and that they are much weaker without contact than in contact. Raw fields
    without contact are not: they are larger than the changes of the field in contact. Fields in a wrong unit may also
    be weak, but the unit does not affect the ratio of the fields with and without contact.
    """
    chips_uT = np.linalg.norm(b_uT.reshape(len(b_uT), -1, 3), axis=2)
    if np.median(chips_uT) >= WEAKEST_uT or contact.all() or not contact.any():
        return
    rest_uT, pressed_uT = (float(np.median(chips_uT[rows].max(axis=1))) for rows in (~contact, contact))
    if rest_uT < SUBTRACTED_RATIO * pressed_uT:
        problem = (
            f"the strongest field of a row is {rest_uT:.3g} uT without contact and {pressed_uT:.3g} uT in contact "
            "(medians)"
        )
        raise CaptureError(
            f"{where}: {problem}. A baseline seems to have been subtracted. Write raw fields to the file, in rows of "
            "both phases."
        )


def _number_presses(
    numbers: Mapping[str, Float64[np.ndarray, " f"]], contact: Bool[np.ndarray, " f"], where: str
) -> Int[np.ndarray, " f"]:
    """Return the number of the press to which each row belongs; presses are numbered from 0.

    A press is a block of rows with equal values in column `indentation`. If there is no such column, a new press begins
    with each touch, and whenever the place changes within a touch.
    """
    if "indentation" in numbers:
        rows = np.flatnonzero(contact)  # in rows without contact, the values of column `indentation` are ignored
        number = numbers["indentation"][rows]
        begins = np.flatnonzero(np.diff(number, prepend=np.nan) != 0)
        firsts, counts = np.unique(number[begins], return_counts=True)
        if (counts > 1).any():
            twice = firsts[counts > 1][0]
            line_n = FIRST_LINE_N + rows[begins[np.flatnonzero(number[begins] == twice)[1]]]
            problem = f"indentation {twice:g} begins again in line {line_n}"
            raise CaptureError(
                f"{where}: {problem}; its rows must be one block. Remove rows that are in the file twice."
            )
        begins_at = np.zeros(len(contact), bool)
        begins_at[rows[begins]] = True
        return np.maximum(np.cumsum(begins_at) - 1, 0)
    place = np.stack([numbers["x_mm"], numbers["y_mm"]], axis=1)
    elsewhere = np.r_[True, (np.abs(np.diff(place, axis=0)) > SAME_PLACE_mm).any(axis=1)]
    begins_at = contact & (np.r_[True, ~contact[:-1]] | elsewhere)
    return np.maximum(np.cumsum(begins_at) - 1, 0)


def _find_passes(
    numbers: Mapping[str, Float64[np.ndarray, " f"]], press: Int[np.ndarray, " f"], contact: Bool[np.ndarray, " f"]
) -> Int[np.ndarray, " f"]:
    """Return the number of the pass to which each row belongs; passes are numbered from 0.

    A new pass begins when the sequence of presses repeats. Two presses are the same if they have the same place and the
    same greatest depth.
    """
    begins = np.flatnonzero(np.diff(press[contact])) + 1
    of_press = [
        np.array([values.max() for values in np.split(numbers[name][contact], begins)])
        for name in ("x_mm", "y_mm", "depth_mm")
        if name in numbers
    ]
    _, target_i = np.unique(np.round(np.stack(of_press, axis=1), 3), axis=0, return_inverse=True)
    pass_of_press = find_passes(np.stack([target_i, target_i], axis=1).astype(float), np.ones(len(target_i), bool))
    return pass_of_press.astype(int)[press]
