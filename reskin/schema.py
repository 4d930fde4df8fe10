"""The tables of readings in `data/indentations`: their columns, types, units and Arrow schema.

The annotations of arrays in this library use letters for the axes of an array. Usually, they have these meanings:

- n: indentations
- f: readings (frames)
- k: chips
- ch: channels. There are 3 k of them: Bx, By, Bz of chip 0, then of chip 1, and so on.
- s: sources of a field
- o: points at which a field is computed
- b: rows of a batch
- d: dwells (stops of a robot at one place)
- c: chunks of a stream
- g: steps of a time grid
"""

from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Float64, Int32

from reskin.errors import SchemaError

# In version 1, Fx_N and Fy_N of recordings in layout `lab` were the forces on the force gauge, and not on the skin.
SCHEMA_VERSION = "2"
FORCE_SIGNS = (
    "Force on the skin, in newtons: Fx_N and Fy_N positive along the axes of the labels x_mm and y_mm, "
    "Fz_N positive in compression."
)
AXES_PER_CHIP_N = 3
INGEST_AGAIN = "Run the ingestion stage again, which converts the capture to this file."


@dataclass(frozen=True)
class Readings:
    """The readings of one capture (a recording of one skin on one board), one row for each reading.

    Unknown values are NaN. The signs of forces are explained in `FORCE_SIGNS`.

    indentation: the number of the indentation to which the reading belongs.
    pass_i: the number of the pass. A robot visits all places once in each pass.
    reading_i: the number of the reading in its indentation.
    x_mm, y_mm: the place of the contact. It is NaN in rows without contact.
    b_uT: the measured field.
    noload_uT: the mean field without contact before the indentation.
    temperature_degC: the temperature of each chip.
    n_contacts: the number of earlier contacts of the skin.
    """

    capture: str
    board: str
    skin: str
    source: str  # "simulated" or "recorded"
    indentation: Int32[np.ndarray, " f"]
    pass_i: Int32[np.ndarray, " f"]
    reading_i: Int32[np.ndarray, " f"]
    x_mm: Float32[np.ndarray, " f"]
    y_mm: Float32[np.ndarray, " f"]
    depth_mm: Float32[np.ndarray, " f"]
    Fx_N: Float32[np.ndarray, " f"]
    Fy_N: Float32[np.ndarray, " f"]
    Fz_N: Float32[np.ndarray, " f"]
    b_uT: Float32[np.ndarray, "f ch"]
    noload_uT: Float32[np.ndarray, "f ch"]
    temperature_degC: Float32[np.ndarray, "f k"]
    t_s: Float64[np.ndarray, " f"]
    n_contacts: Int32[np.ndarray, " f"]

    def __len__(self) -> int:
        return len(self.indentation)

    @property
    def chips_n(self) -> int:
        return self.b_uT.shape[1] // AXES_PER_CHIP_N

    @property
    def db_uT(self) -> Float32[np.ndarray, "f ch"]:
        """The field change relative to the no-load reading (paper section 4)."""
        return self.b_uT - self.noload_uT


LABELS = ("capture", "board", "skin", "source")


def unit_of(column: str) -> str:
    """Return the unit of a numeric column.

    The unit is the suffix of the column's name. If the suffix is not a unit, the column has no unit, and the result is
    "1".
    """
    suffix = column.rpartition("_")[2]
    return suffix if suffix in ("mm", "N", "uT", "degC", "s") else "1"


UNITS = {field.name: unit_of(field.name) for field in fields(Readings) if field.name not in LABELS}  # column -> unit
_INTEGERS = ("indentation", "pass_i", "reading_i", "n_contacts")
_PER_CHIP_N = {"b_uT": AXES_PER_CHIP_N, "noload_uT": AXES_PER_CHIP_N, "temperature_degC": 1}


def arrow_schema(chips_n: int) -> pa.Schema:
    """Return the Arrow schema of a table of readings. The unit of each column is in the metadata of the column."""
    columns = [pa.field(name, pa.string(), False, {"unit": ""}) for name in LABELS]
    for name, unit in UNITS.items():
        columns.append(pa.field(name, _arrow_type(name, chips_n), True, {"unit": unit}))
    return pa.schema(columns, metadata={"reskin.schema": SCHEMA_VERSION, "reskin.force": FORCE_SIGNS})


def _arrow_type(name: str, chips_n: int) -> pa.DataType:
    if name in _PER_CHIP_N:
        return pa.list_(pa.float32(), _PER_CHIP_N[name] * chips_n)
    if name in _INTEGERS:
        return pa.int32()
    return pa.float64() if name == "t_s" else pa.float32()


def to_table(readings: Readings) -> pa.Table:
    """Convert readings to an Arrow table, with units in the metadata of the columns."""
    schema = arrow_schema(readings.chips_n)
    columns = []
    for field in schema:
        value = getattr(readings, field.name)
        if field.name in LABELS:
            columns.append(pa.array([value] * len(readings), pa.string()))
        elif field.name in _PER_CHIP_N:
            columns.append(pa.FixedSizeListArray.from_arrays(pa.array(value.ravel()), field.type.list_size))
        else:
            columns.append(pa.array(value, field.type))
    return pa.Table.from_arrays(columns, schema=schema)


def from_table(table: pa.Table, where: str) -> Readings:
    """Convert the Arrow table of one capture to readings.

    Raises `SchemaError` if the columns, types or units of the table differ from `arrow_schema`.
    """
    chips_n = check_schema(table.schema, where)
    values: dict[str, object] = {}
    for name in LABELS:
        distinct = table.column(name).unique().to_pylist()
        if len(distinct) != 1:
            raise SchemaError(
                f"{where}: column {name} has several values, {distinct[:3]}. Write each capture to a file of its own."
            )
        values[name] = distinct[0]
    for name in UNITS:
        column = table.column(name).combine_chunks()
        if name in _PER_CHIP_N:
            values[name] = np.asarray(column.flatten()).reshape(len(table), _PER_CHIP_N[name] * chips_n)
        else:
            values[name] = np.asarray(column)
    return Readings(**values)  # type: ignore[arg-type]


def check_schema(schema: pa.Schema, where: str) -> int:
    """Check that a table has the columns, types and units of `arrow_schema`, and return the number of its chips."""
    missing = [field.name for field in fields(Readings) if field.name not in schema.names]
    if missing:
        raise SchemaError(f"{where}: column {', '.join(missing)} is missing. {INGEST_AGAIN}")
    b_type = schema.field("b_uT").type
    if not pa.types.is_fixed_size_list(b_type) or b_type.list_size % AXES_PER_CHIP_N:
        raise SchemaError(where, "b_uT", "a list of fixed length with 3 values per chip", b_type, INGEST_AGAIN)
    chips_n = b_type.list_size // AXES_PER_CHIP_N
    for expected in arrow_schema(chips_n):
        actual = schema.field(expected.name)
        if actual.type != expected.type:
            raise SchemaError(where, f"column {expected.name}", expected.type, actual.type, INGEST_AGAIN)
        actual_unit, expected_unit = (actual.metadata or {}).get(b"unit"), (expected.metadata or {})[b"unit"]
        if actual_unit != expected_unit:
            got = "no unit" if actual_unit is None else actual_unit.decode()
            remedy = "Convert the values of the column to this unit, and write the unit to the metadata of the column."
            raise SchemaError(where, f"unit of {expected.name}", repr(expected_unit.decode()), got, remedy)
    return chips_n
