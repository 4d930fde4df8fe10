"""Read layout `table`: a recording of any rig in one CSV or Parquet file with named columns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float64, Int

from reskin.errors import CaptureError
from reskin.recordings.fault_policy import CheckedRows, FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.readers.alignment import find_passes
from reskin.recordings.tables import (
    FIRST_ROW,
    TableFile,
    contact_rows,
    count_chips_of,
    count_within,
    make_readings,
    mean_by_group,
    only_file,
    refuse_empty,
)
from reskin.recordings.units import SAME_PLACE_mm, WEAKEST_uT, check_fields, check_labels
from reskin.schema import Readings

CSV, PARQUET = "readings.csv", "readings.parquet"
FILES = (CSV,)
NEEDED = ("phase", "x_mm", "y_mm")
OPTIONAL = ("indentation", "pass", "t_s", "depth_mm", "Fx_N", "Fy_N", "Fz_N")
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


@dataclass(frozen=True)
class Rows:
    """All rows of a table, and the result of the check for faults.

    `numbers` has the columns that are not fields, by name. `press` is the number of the press to which each row
    belongs, in the order of the file; a row without contact belongs to the next press.
    """

    numbers: Mapping[str, Float64[np.ndarray, " f"]]
    contact: Bool[np.ndarray, " f"]
    b_uT: Float64[np.ndarray, "f ch"]
    temperature_degC: Float64[np.ndarray, "f k"]
    press: Int[np.ndarray, " f"]
    checked: CheckedRows
    where: str


def collect(recording: Path) -> dict[str, Path]:
    """Find the file of a recording: the CSV or Parquet file itself."""
    return {PARQUET if recording.suffix == ".parquet" else CSV: only_file(recording, "table")}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the names of the columns."""
    (file,) = files.values()
    return count_chips_of(TableFile(file, str(file)).names)


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return the contact rows as readings.

    The no-load field of a row is the mean field of the last run of no-load rows before it.
    """
    name = next(name for name in (CSV, PARQUET) if (folder / name).exists())
    where = f"{header.capture}/{name}"
    file = TableFile(folder / name, where)
    chips_n = count_chips_of(file.names)
    columns = columns_of(chips_n)
    check_columns(file.names, columns[: len(NEEDED) + 3 * chips_n], where)
    _refuse_near_names(file.names, columns, where)
    known = [column for column in columns[1:] if column in file.names]
    readings, account = to_readings(check_table(file.read(known, ["phase"]), header, policy, where), header)
    return readings, account | {"ignored_columns_n": len(set(file.names) - set(columns))}


def check_table(table: pa.Table, header: Header, policy: FaultPolicy, where: str) -> Rows:
    """Check the columns of a table: the number of chips, faults of the board, units, and signs."""
    if (chips_n := count_chips_of(table.column_names)) != header.chips_n:
        raise CaptureError(
            f"{where}: the file has {chips_n} chips, but the header says {header.chips_n}. Correct the file, or "
            "correct chips_n in header.json."
        )
    contact = contact_rows(table["phase"], where)
    fields = [f"B{axis}{chip}" for chip in range(chips_n) for axis in "xyz"]
    numbers = {name: np.asarray(table[name]) for name in table.column_names if name not in ("phase", *fields)}
    refuse_empty({name: np.asarray(table[name]) for name in fields}, np.ones(len(contact), bool), where, FIRST_ROW)
    # An optional column without any value is like no column, as in a template that was filled in partly.
    numbers = {name: of for name, of in numbers.items() if name in NEEDED or not np.isnan(of).all()}
    refuse_empty(numbers, contact, where, FIRST_ROW)
    b_uT = np.empty((len(contact), len(fields)))
    for i, name in enumerate(fields):
        b_uT[:, i] = table[name]
    del table  # 1 million rows have 120 MB of fields
    unknown = np.full(len(contact), np.nan)
    temperature_degC = np.stack([numbers.get(f"T{chip}", unknown) for chip in range(chips_n)], axis=1)
    checked = check_rows(b_uT, temperature_degC, header.expected_lsb_uT, where=where, policy=policy)
    # If no row is fault-free, the unit may be wrong, which is checked with all rows.
    judged = checked.keep if checked.keep.any() else np.ones(len(contact), bool)
    judged_uT = b_uT if judged.all() else b_uT[judged]
    _refuse_subtracted(judged_uT, contact[judged], where)
    check_fields(judged_uT, where, line_n=FIRST_ROW + np.flatnonzero(judged))
    check_labels(numbers, contact, where, first_line_n=FIRST_ROW)
    press = _number_presses(numbers, contact, where)
    return Rows(numbers, contact, b_uT, temperature_degC, press, checked, where)


def to_readings(rows: Rows, header: Header) -> tuple[Readings, Account]:
    """Return the readings of the rows in contact, and the account of all rows."""
    numbers, contact, press = rows.numbers, rows.contact, rows.press
    keep, rest = contact & rows.checked.keep, ~contact & rows.checked.keep
    # Number the blocks of rows. A block is a run of fault-free no-load rows together with the contact rows after it.
    sound = np.flatnonzero(rows.checked.keep)
    begins = np.zeros(len(contact), np.int64)
    begins[sound] = np.diff(contact[sound].astype(int), prepend=1) < 0
    block = np.cumsum(begins)
    noload_uT = mean_by_group(rows.b_uT[rest], block[rest], int(block[-1]) + 1)
    without = np.flatnonzero(keep & (block == 0))
    if len(without):
        raise CaptureError(
            f"{rows.where}: the press in line {FIRST_ROW + without[0]} has no fault-free no-load row before it. Add "
            "rows of phase noload before this press."
        )
    unknown = np.full(len(contact), np.nan)
    depth_is_zero = "depth_mm" in numbers and not numbers["depth_mm"][contact].any()
    reading_i = np.zeros(len(keep), int)
    reading_i[keep] = count_within(press[keep])
    readings = make_readings(
        header, keep, indentation=press,
        pass_i=numbers["pass"] if "pass" in numbers else _find_passes(numbers, press, contact), reading_i=reading_i,
        x_mm=numbers["x_mm"], y_mm=numbers["y_mm"],
        depth_mm=unknown if depth_is_zero else numbers.get("depth_mm", unknown),
        **{axis: numbers.get(axis, unknown) for axis in ("Fx_N", "Fy_N", "Fz_N", "t_s")},
        b_uT=rows.b_uT, noload_uT=noload_uT[block], temperature_degC=rows.temperature_degC,
        n_contacts=header.contacts_before_n + press,
    )  # fmt: skip
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(keep),
        "noload_rows_n": int(rest.sum()),
        **rows.checked.account(),
        "passes_n": len(np.unique(readings.pass_i)),
        "no_depth_rows_n": len(readings) if depth_is_zero or "depth_mm" not in numbers else 0,
    }


def check_columns(names: Sequence[str], wanted: Sequence[str], where: str) -> None:
    """Raise if one of the wanted columns is missing; suggest a remedy for other habits of naming.

    These are other capitals, and chips that are numbered from 1.
    """
    missing = [name for name in wanted if name not in names]
    if not missing:
        return
    lower = {name.lower(): name for name in names}
    if all(name.lower() in lower for name in wanted):
        remedy = f"Rename {', '.join(f'{lower[name.lower()]} to {name}' for name in missing)}."
    elif "Bx0" not in names and {"Bx1", "By1", "Bz1"} <= set(names):
        remedy = (
            "The chips seem to be numbered from 1. Number them from 0, or state it in a file for option --columns: "
            'fields: {Bx: "Bx{}", By: "By{}", Bz: "Bz{}", first: 1} (docs/add-your-data.md).'
        )
    else:
        remedy = (
            "Check that the layout is table, and that line 1 has the column names. See data/README.md. If the values "
            "have other names or units, describe them in a file for option --columns (docs/add-your-data.md)."
        )
    raise CaptureError(f"{where}: no column {', '.join(missing)}. {remedy}")


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
    """Return the number of the press to which each row belongs (see `Rows`); presses are numbered from 0.

    A press is a block of rows with equal values in column `indentation`. If there is no such column, a new press begins
    with each touch, and whenever the place changes within a touch.
    """
    if "indentation" in numbers:
        rows = np.flatnonzero(contact)  # in rows without contact, the values of column `indentation` are ignored
        begins_at = np.zeros(len(contact), bool)
        begins_at[find_blocks(numbers["indentation"], rows, where)] = True
    else:
        place = np.stack([numbers["x_mm"], numbers["y_mm"]], axis=1)
        elsewhere = np.r_[True, (np.abs(np.diff(place, axis=0)) > SAME_PLACE_mm).any(axis=1)]
        begins_at = contact & (np.r_[True, ~contact[:-1]] | elsewhere)
    return np.minimum(np.cumsum(begins_at) - contact, begins_at.sum() - 1)


def find_blocks(
    indentation: Float64[np.ndarray, " f"], rows: Int[np.ndarray, " r"], where: str
) -> Int[np.ndarray, " b"]:
    """Return those of the rows at which another indentation begins; raise if an indentation has two blocks of rows."""
    number = indentation[rows]
    begins = np.flatnonzero(np.diff(number, prepend=np.nan) != 0)
    _, first = np.unique(number[begins], return_index=True)
    again = np.setdiff1d(np.arange(len(begins)), first)
    if len(again):
        row = rows[begins[again[0]]]
        raise CaptureError(
            f"{where}: indentation {indentation[row]:g} begins again in line {FIRST_ROW + row}; its rows must be one "
            "block. Remove rows that are in the file twice."
        )
    return rows[begins]


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
