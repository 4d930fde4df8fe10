"""Convert tables of other recorders to layout `table`, by a map of columns that the user writes as a YAML file.

docs/add-your-data.md has an example. Tables may be text (also compressed or in UTF-16), Parquet, JSON lines or npz.
"""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float64
from pydantic import Field

from reskin.config import Strict, parse, read_yaml
from reskin.errors import CaptureError, ParamsError, did_you_mean
from reskin.recordings.header import Source
from reskin.recordings.tables import PHASES, TableFile, coded, contact_rows

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
SHOWN_N = 6  # values of a column that an error shows, at most

Names = str | tuple[str, ...]


class Column(Strict):
    """One or several columns of the file, which are added up, such as seconds and nanoseconds.

    With `format` (as of `datetime.strptime`), the columns are parts of one text with date and time, joined by spaces.
    """

    of: Names
    unit: Names | None = None
    format: str = ""
    sign: Literal[1, -1] = 1


class Phase(Strict):
    """The column that tells contact: by its values in contact, or because its number is then above or below another."""

    of: str
    contact: str | int | float | bool | tuple[str | int | float | bool, ...] | None = None
    above: float | None = None
    below: float | None = None


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
    phase: str | Phase  # a text: the name of a column with the values `noload` and `contact`
    columns: dict[str, str | Column]
    source: Source = "recorded"  # simulated: the file comes from an emulated board
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
    of_phase = found.phase
    if isinstance(of_phase, Phase) and [of_phase.contact, of_phase.above, of_phase.below].count(None) != 2:
        raise ParamsError(f"{file}: phase: state one of `contact`, `above` and `below`.")
    if found.fields.unit not in UNITS["uT"]:
        raise ParamsError(f"{file}: fields: unit {found.fields.unit} is not one of {', '.join(UNITS['uT'])}.")
    return found


def convert(recording: Path, columns: ColumnMap, where: str = "") -> pa.Table:
    """Convert a file to the columns of layout `table`.

    Raises CaptureError if the file cannot be read, lacks a column, or has a cell that is no number in one of them.
    """
    where = where or str(recording)
    file = TableFile(recording, where)
    fields, phase = columns.fields, columns.phase
    sources = {name: _factors(name, column, where) for name, column in columns.columns.items()}
    parts = [part for source in sources.values() for part in source]
    listed = fields.of in file.names
    by_value = isinstance(phase, str) or phase.contact is not None
    of_phase = phase if isinstance(phase, str) else phase.of
    # Columns of numbers and of other values are read separately, because a column may be both, such as a load that also
    # tells contact.
    others = [of for of, factor in parts if factor is None] + [fields.of] * listed + [of_phase] * by_value
    formats = {name: column.format for name, column in columns.columns.items() if isinstance(column, Column)}
    cells = file.read([], others)
    lists = _listed(cells[fields.of], where) if listed else np.zeros((0, 0))
    channels = [] if listed else _channels(fields, file.names)
    chips = range(fields.first, fields.first + (len(lists) or len(channels)) // 3)
    temperatures = [fields.T.replace("{}", str(chip)) for chip in chips] if fields.T else []
    numbers = [*channels, *temperatures, *(of for of, factor in parts if factor is not None)]
    data = file.read(numbers + [of_phase] * (not by_value), decimal_comma=columns.decimal_comma)

    made: dict[str, Any] = {}
    for i, values in enumerate(lists if listed else (np.asarray(data[name]) for name in channels)):
        made[f"B{'xyz'[i % 3]}{i // 3}"] = UNITS["uT"][fields.unit] * fields.signs[i % 3] * values
    made |= {f"T{i}": data[name] for i, name in enumerate(temperatures)}
    for name, column in columns.columns.items():
        if format := formats.get(name):
            made[name] = _seconds([cells[of] for of, _ in sources[name]], format, where)
            continue
        total = np.zeros(len(data))
        for of, factor in sources[name]:
            total += _seconds([cells[of]], ISO, where) if factor is None else factor * np.asarray(data[of])
        made[name] = total if isinstance(column, str) else column.sign * total
    of_contact = (cells if by_value else data)[of_phase]
    contact = contact_rows(of_contact, where) if isinstance(phase, str) else _contact(of_contact, phase, where)
    made["phase"] = pa.DictionaryArray.from_arrays(contact.astype(np.int8), list(PHASES))
    return pa.table(made)


def _factors(name: str, column: str | Column, where: str) -> list[tuple[str, float | None]]:
    """Return the source columns of a column with their factors; None for times that are written as date and time."""
    column = Column(of=column) if isinstance(column, str) else column
    names, usual = (column.of,) if isinstance(column.of, str) else column.of, UNIT_OF[name]
    if column.format:
        if usual != "s" or column.unit is not None:
            raise ParamsError(f"{where}: {name}: `format` is for t_s, and without a unit.")
        return [(of, None) for of in names]
    units = column.unit if isinstance(column.unit, tuple) else (column.unit or usual,) * len(names)
    if len(units) != len(names):
        raise ParamsError(f"{where}: {name}: {len(names)} columns, but {len(units)} units. State a unit for each.")
    known: dict[str, float | None] = {NONE: 1.0} if usual == NONE else dict(UNITS[usual])
    known |= {ISO: None} if usual == "s" else {}
    for unit in units:
        if unit not in known:
            raise ParamsError(f"{where}: {name}: unit {unit} is not one of {', '.join(known)}.")
    return [(of, known[unit]) for of, unit in zip(names, units, strict=True)]


def _count_chips(fields: Fields, names: Sequence[str]) -> int:
    """Count the chips from the names of the columns of their fields."""
    if not all("{}" in pattern for pattern in (fields.Bx, fields.By, fields.Bz)):
        return 1
    patterns = "|".join(re.escape(p).replace(r"\{\}", r"(\d{1,3})") for p in (fields.Bx, fields.By, fields.Bz))
    numbers = [int(next(filter(None, match.groups()))) for name in names if (match := re.fullmatch(patterns, name))]
    return max(numbers, default=fields.first) + 1 - fields.first


def _channels(fields: Fields, names: Sequence[str]) -> list[str]:
    """Return the columns of the fields in the order x, y, z of the first chip, and so on."""
    if fields.of:
        numbered = [name for name in names if re.fullmatch(re.escape(fields.of) + r"\d+", name)]
        return numbered if numbered and not len(numbered) % 3 else [fields.of]
    chips = range(fields.first, fields.first + _count_chips(fields, names))
    return [name.replace("{}", str(chip)) for chip in chips for name in (fields.Bx, fields.By, fields.Bz)]


def _listed(lists: pa.ChunkedArray, where: str) -> Float64[np.ndarray, "ch f"]:
    """Return the fields in a column of lists."""
    try:
        rows = [np.ravel(np.asarray(row, float)) for row in lists.to_pylist()]
    except (TypeError, ValueError):
        rows = []
    if not rows or {len(row) for row in rows} != {len(rows[0])} or not len(rows[0]) or len(rows[0]) % 3:
        raise CaptureError(
            f"{where}: the lists of fields must have equal lengths, three numbers for each chip. Correct the file."
        )
    return np.stack(rows, axis=1)


def _contact(column: pa.ChunkedArray, phase: Phase, where: str) -> Bool[np.ndarray, " f"]:
    """Mark the rows in contact by the column that tells contact."""
    if phase.above is not None:
        contact = np.asarray(column) > phase.above
    elif phase.below is not None:
        contact = np.asarray(column) < phase.below
    else:
        wanted = {_plain(value) for value in (phase.contact if isinstance(phase.contact, tuple) else (phase.contact,))}
        values, code = coded(column)
        contact = np.array([_plain(value) in wanted for value in values])[code]
    if not contact.any():
        shown = ", ".join(map(str, column.unique().to_pylist()[:SHOWN_N]))
        raise CaptureError(
            f"{where}: no row is in contact by column {phase.of}, which has {shown}. Correct `phase` in the map."
        )
    return contact


def _plain(value: object) -> str:
    """Return the text of a cell, so that 1, 1.0 and " 1" are equal."""
    return re.sub(r"\.0$", "", str(value).strip().lower())


def _seconds(columns: Sequence[pa.ChunkedArray], format: str, where: str) -> Float64[np.ndarray, " f"]:
    """Return times that are written as date and time, in one or several columns, in s since the first."""
    texts = [" ".join(map(str, row)).strip() for row in zip(*(column.to_pylist() for column in columns), strict=True)]
    try:
        times = [datetime.fromisoformat(text) if format == ISO else datetime.strptime(text, format) for text in texts]
    except ValueError as error:
        raise CaptureError(
            f"{where}: {str(error)[:100]}. Write t_s as YYYY-MM-DDTHH:MM:SS, or state its columns and their format in "
            'the map, such as t_s: {of: [date, time], format: "%d.%m.%Y %H:%M:%S,%f"}, or leave t_s out.'
        ) from None
    times = [time if time.tzinfo else time.replace(tzinfo=UTC) for time in times]
    return np.array([(time - times[0]).total_seconds() for time in times])
