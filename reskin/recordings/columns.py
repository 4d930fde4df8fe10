"""A small strict CSV: a header line of known names, one type a column. In: text or a file. Out: an Arrow table.

Refuses to know what the columns mean; knows only their names, their types and that an empty field is unknown.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from jaxtyping import Bool

from reskin.errors import CaptureError

FIRST_ROW = 2  # row 1 of the file is the header


def parse(source: str | Path, types: Mapping[str, pa.DataType], where: str) -> pa.Table:
    """Read CSV text, or the file at a path, that has exactly the columns of `types`, in any order.

    Row numbers in errors count lines of the file: the header is row 1.
    """
    try:
        table = pacsv.read_csv(
            pa.py_buffer(source.encode()) if isinstance(source, str) else source,
            # One thread, because only then do Arrow's messages name the row.
            read_options=pacsv.ReadOptions(use_threads=False),
            parse_options=pacsv.ParseOptions(ignore_empty_lines=False),
            convert_options=pacsv.ConvertOptions(column_types=types, null_values=[""], strings_can_be_null=True),
        )
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        got = ascii(" ".join(str(error).split()))[1:-1][:200]  # a row of rubbish is no message
        rule = f"CSV with columns {_list(types)}"
        raise CaptureError(where, "the table", rule, got, "Mend that row.") from None
    except FileNotFoundError:
        raise CaptureError(where, "the file", "there", "nothing", "Copy the whole capture folder.") from None
    _check_names(table.column_names, types, where)
    return table.select(list(types)).combine_chunks()


def render(table: pa.Table) -> str:
    """Write a table as CSV text; numbers keep every digit that tells them apart, null is an empty field."""
    sink = pa.BufferOutputStream()
    pacsv.write_csv(table, sink, pacsv.WriteOptions(include_header=False, quoting_style="none"))
    return ",".join(table.column_names) + "\n" + sink.getvalue().to_pybytes().decode()


def refuse(bad: Bool[np.ndarray, " rows"], where: str, what: str, rule: str, values: Any, remedy: str) -> None:
    """Raise for the first row that `bad` marks, if any; `values` are those of all rows, or one word for all."""
    if bad.any():
        row_i = int(bad.argmax())
        got = values if isinstance(values, str) else values[row_i]
        raise CaptureError(f"{where} row {row_i + FIRST_ROW}", what, rule, got, remedy)


def _check_names(names: list[str], types: Mapping[str, pa.DataType], where: str) -> None:
    missing = [name for name in types if name not in names]
    unknown = [name for name in names if name not in types]
    if missing or unknown or len(names) != len(types):
        got = f"missing {_list(missing)}, unknown {ascii(_list(unknown))[1:-1][:80]}, {len(names)} in all"
        raise CaptureError(where, "row 1, the column names,", _list(types), got, "Rename or remove columns.")


def _list(names: Mapping[str, pa.DataType] | list[str]) -> str:
    return ",".join(names) or "none"
