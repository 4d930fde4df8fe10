"""Convert tables of other recorders to layout `table`, by a map of columns that the user writes as a YAML file.

docs/add-a-skin.md has an example. Tables may be text (also compressed or in UTF-16), Parquet, JSON lines or npz.
"""

import io as bytes_io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
from jaxtyping import Float64
from pydantic import Field

from reskin.config import Strict, parse, read_yaml
from reskin.errors import CaptureError, ParamsError, did_you_mean
from reskin.recordings.header import Source
from reskin.recordings.tables import text_of

UNITS = {  # factors to mm, uT, N and s
    "mm": {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "in": 25.4},
    "uT": {"uT": 1.0, "mT": 1e3, "T": 1e6, "nT": 1e-3, "G": 100.0, "mG": 0.1},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "g": 9.80665e-3, "kg": 9.80665},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}
NONE = "none"  # unit of numbers of presses and passes
ISO = "iso"  # unit of a time that is written as date and time
UNIT_OF = {
    "x_mm": "mm", "y_mm": "mm", "depth_mm": "mm", "Fx_N": "N", "Fy_N": "N", "Fz_N": "N", "t_s": "s",
    "indentation": NONE, "pass": NONE,
}  # fmt: skip
OTHER_FILES = {  # first bytes of a file: what it is, and how it becomes a table
    b"PK\x03\x04": ("a zip or Excel file", "Save the sheet as CSV"),
    b"\x89HDF": ("an HDF5 file", "Write its arrays to a Parquet file: pandas.DataFrame(...).to_parquet(FILE)"),
    b"\x89MCAP": ("an MCAP file", "Export its topics to CSV or Parquet"),
    b"\x93NUMPY": ("a NumPy array", "Save named arrays: numpy.savez(FILE, name=array)"),
    b"\x80\x04": ("a pickle", "Write the data frame to a Parquet file: data.to_parquet(FILE)"),
    b"\x80\x05": ("a pickle", "Write the data frame to a Parquet file: data.to_parquet(FILE)"),
    b"SQLite format": ("an SQLite database", "Export the table to CSV"),
    b"MATLAB": ("a MATLAB file", "Export the table to CSV"),
}

SHOWN_N = 6  # values of a column that an error shows, at most

Names = str | tuple[str, ...]


class Column(Strict):
    """One or several columns of the file, which are added up, such as seconds and nanoseconds."""

    of: Names
    unit: Names | None = None
    sign: Literal[1, -1] = 1


class Phase(Strict):
    """The column that tells contact: by its values in contact, or by a number that it exceeds in contact."""

    of: str
    contact: str | int | float | bool | tuple[str | int | float | bool, ...] | None = None
    above: float | None = None


class Fields(Strict):
    """Columns of the fields and temperatures: {} in a name stands for the number of the chip, which begins at `first`.

    `of` is a single column with lists of all fields of a reading. `signs` are those of x, y and z.
    """

    Bx: str = ""
    By: str = ""
    Bz: str = ""
    T: str = ""
    of: str = ""
    first: Annotated[int, Field(ge=0, le=1)] = 0
    unit: str = "uT"
    signs: tuple[Literal[1, -1], Literal[1, -1], Literal[1, -1]] = (1, 1, 1)


class ColumnMap(Strict):
    """How the columns of a file become those of layout `table`. Columns that are not named are left out."""

    fields: Fields
    phase: str | Phase
    columns: dict[str, str | Column]
    source: Source = "recorded"  # simulated: the file comes from an emulated board
    delimiter: str | None = None
    decimal_comma: bool = False


def read_map(file: Path) -> ColumnMap:
    """Read a map of columns; raise ParamsError if it is wrong."""
    found = parse(ColumnMap, read_yaml(file), str(file))
    for name, column in found.columns.items():
        if name not in UNIT_OF:
            raise ParamsError(
                f"{file}: columns: {name} is not one of {', '.join(UNIT_OF)}.{did_you_mean(name, UNIT_OF)}"
            )
        _factors(name, column, str(file))
    if isinstance(found.phase, Phase) and (found.phase.contact is None) == (found.phase.above is None):
        raise ParamsError(f"{file}: phase: state either `contact` or `above`.")
    if found.fields.unit not in UNITS["uT"]:
        raise ParamsError(f"{file}: fields: unit {found.fields.unit} is not one of {', '.join(UNITS['uT'])}.")
    return found


def convert(recording: Path, columns: ColumnMap) -> pa.Table:
    """Convert a file to the columns of layout `table`.

    Raises CaptureError if the file cannot be read, lacks a column, or has a cell that is no number in one of them.
    """
    where, data = str(recording), _read(recording, columns)
    made: dict[str, np.ndarray | list[str]] = {}

    def column_of(name: str) -> pd.Series:
        if name not in data:
            have = ", ".join(map(str, data.columns))[:200]
            guess = did_you_mean(name, map(str, data.columns))
            raise CaptureError(f"{where}: no column {name!r}; the file has {have}.{guess} Correct the map of columns.")
        return data[name]

    def numbers(name: str) -> Float64[np.ndarray, " f"]:
        return _numbers(column_of(name), name, columns, where)

    of_fields = columns.fields
    fields = _listed(data, of_fields.of, column_of, where) if of_fields.of else _numbered(of_fields, numbers, data)
    factor = UNITS["uT"][of_fields.unit] * np.tile(of_fields.signs, fields.shape[1] // 3)
    for i, values in enumerate((fields * factor).T):
        made[f"B{'xyz'[i % 3]}{i // 3}"] = values
    if of_fields.T:
        for chip in range(fields.shape[1] // 3):
            made[f"T{chip}"] = numbers(of_fields.T.replace("{}", str(chip + of_fields.first)))
    for name, column in columns.columns.items():
        total = np.zeros(len(data))
        for of, times in _factors(name, column, where):
            total += _seconds(column_of(of), where) if times is None else times * numbers(of)
        made[name] = total if isinstance(column, str) else column.sign * total
    phase = columns.phase if isinstance(columns.phase, Phase) else Phase(of=columns.phase, contact=("contact",))
    of_phase = column_of(phase.of) if phase.above is None else numbers(phase.of)
    made["phase"] = _phases(of_phase, phase, where)
    return pa.table(made)


def _factors(name: str, column: str | Column, where: str) -> list[tuple[str, float | None]]:
    """Return the source columns of a column with their factors; None for times that are written as date and time."""
    column = Column(of=column) if isinstance(column, str) else column
    names, usual = (column.of,) if isinstance(column.of, str) else column.of, UNIT_OF[name]
    units = column.unit if isinstance(column.unit, tuple) else (column.unit or usual,) * len(names)
    if len(units) != len(names):
        raise ParamsError(f"{where}: {name}: {len(names)} columns, but {len(units)} units. State a unit for each.")
    known: dict[str, float | None] = {NONE: 1.0} if usual == NONE else dict(UNITS[usual])
    known |= {ISO: None} if usual == "s" else {}
    for unit in units:
        if unit not in known:
            raise ParamsError(f"{where}: {name}: unit {unit} is not one of {', '.join(known)}.")
    return [(of, known[unit]) for of, unit in zip(names, units, strict=True)]


def _read(path: Path, columns: ColumnMap) -> pd.DataFrame:
    """Read a file as a data frame; the cells of text files are texts."""
    where = str(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{where}: cannot read the file: {error.strerror}. Check the path.") from None
    suffixes = [suffix.lower() for suffix in path.suffixes]
    try:
        if content[:4] == b"PAR1":
            return pd.read_parquet(bytes_io.BytesIO(content))
        if ".npz" in suffixes:
            return _arrays(content)
        for start, (what, remedy) in OTHER_FILES.items():
            if content.startswith(start):
                raise CaptureError(f"{where}: the file is {what}. {remedy}.")
        text = text_of(content, where)
        if text.lstrip()[:1] == "{":
            return pd.read_json(bytes_io.StringIO(text), lines=True)
        return pd.read_csv(
            bytes_io.StringIO(text), sep=columns.delimiter or _delimiter(text), dtype=str, keep_default_na=False,
            skipinitialspace=True,
        ).rename(columns=str.strip)  # fmt: skip
    except (ValueError, zipfile.BadZipFile, pa.ArrowException) as error:
        problem = f"the file cannot be read as a table: {str(error)[:120]}"
        raise CaptureError(f"{where}: {problem}. Check the file.") from None


def _delimiter(text: str) -> str:
    line = text.partition("\n")[0]
    return max(";\t|,", key=line.count) if any(mark in line for mark in ";\t|,") else r"\s+"


def _arrays(content: bytes) -> pd.DataFrame:
    """Return the arrays of an npz file as columns; those of an array with two axes are numbered from 0: name0, ..."""
    with np.load(bytes_io.BytesIO(content), allow_pickle=False) as arrays:
        columns: dict[str, np.ndarray] = {}
        for name in arrays.files:
            flat = arrays[name].reshape(len(arrays[name]), -1)
            numbered = {f"{name}{i}": flat[:, i] for i in range(flat.shape[1])}
            columns |= {name: flat[:, 0]} if arrays[name].ndim == 1 else numbered
    return pd.DataFrame(columns)


def _numbers(values: pd.Series, name: str, columns: ColumnMap, where: str) -> Float64[np.ndarray, " f"]:
    """Parse cells as numbers; empty cells become NaN."""
    if values.dtype == object or isinstance(values.dtype, pd.StringDtype):
        cells = values.astype(str).str.strip()
        if columns.decimal_comma:
            cells = cells.str.replace(",", ".")
        values = pd.to_numeric(cells.where(cells != "", "nan"), errors="coerce")
        wrong = np.flatnonzero(values.isna() & ~cells.str.lower().isin(["", "nan", "none", "null"]))
        if len(wrong):
            remedy = "State `decimal_comma: true` in the map of columns, or correct this row."
            place = f"{name} in line {wrong[0] + 2}"
            raise CaptureError(where, place, "a number", repr(cells.iloc[int(wrong[0])][:20]), remedy)
    return values.to_numpy(dtype=float, na_value=np.nan)


def _listed(
    data: pd.DataFrame, name: str, column_of: Callable[[str], pd.Series], where: str
) -> Float64[np.ndarray, "f ch"]:
    """Return the fields in a column of lists, or in the numbered columns of an array."""
    numbered = [column for column in data if re.fullmatch(re.escape(name) + r"\d+", str(column))]
    lists = data[numbered].to_numpy(float) if name not in data and numbered else column_of(name)
    rows = [np.ravel(np.asarray(row, float)) for row in lists]
    if not rows or {len(row) for row in rows} != {len(rows[0])} or len(rows[0]) % 3:
        raise CaptureError(f"{where}: the lists in column {name} must have equal lengths, three values for each chip.")
    return np.stack(rows)


def _numbered(
    fields: Fields, numbers: Callable[[str], Float64[np.ndarray, " f"]], data: pd.DataFrame
) -> Float64[np.ndarray, "f ch"]:
    chip, parts = fields.first, []
    while chip == fields.first or fields.Bx.replace("{}", str(chip)) in data:
        parts += [numbers(name.replace("{}", str(chip))) for name in (fields.Bx, fields.By, fields.Bz)]
        chip += 1
        if "{}" not in fields.Bx:
            break
    return np.stack(parts, axis=1)


def _phases(values: pd.Series | Float64[np.ndarray, " f"], phase: Phase, where: str) -> list[str]:
    """Return the phases of rows from the values of the column that tells contact."""
    if phase.above is not None:
        contact = np.asarray(values) > phase.above
    else:
        wanted = {_plain(value) for value in np.atleast_1d(np.array(phase.contact, object))}
        contact = np.array([_plain(value) in wanted for value in values], bool)
    if not contact.any():
        shown = ", ".join(map(str, pd.unique(pd.Series(values))[:SHOWN_N]))
        problem = f"no row is in contact by column {phase.of}, which has {shown}"
        raise CaptureError(f"{where}: {problem}. Correct `phase` in the map.")
    return ["contact" if touching else "noload" for touching in contact]


def _plain(value: object) -> str:
    """Return the text of a cell, so that 1, 1.0 and " 1" are equal."""
    return re.sub(r"\.0$", "", str(value).strip().lower())


def _seconds(values: pd.Series, where: str) -> Float64[np.ndarray, " f"]:
    """Return times that are written as date and time in s since the first."""
    try:
        times = pd.to_datetime(values, format="ISO8601", utc=True)
    except ValueError as error:
        raise CaptureError(f"{where}: {str(error)[:100]}. State times as YYYY-MM-DDTHH:MM:SS.") from None
    return np.asarray((times - times.iloc[0]).dt.total_seconds(), float)
