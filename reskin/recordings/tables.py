"""Read tables from text and CSV files, with errors that name the line and column.

`parse_csv` reads files that this project wrote, with known columns and types; `read_cells` and `to_numbers` read files
that other recorders wrote.
"""

import gzip
import re
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from jaxtyping import Bool, Float64, Int, Shaped

from reskin.errors import CaptureError
from reskin.recordings.header import Header
from reskin.schema import UNITS, Readings

COPY_AGAIN = "The file may have been cut or edited. Copy the file again, or correct it."
SEMICOLONS = (
    "line 1 contains semicolons. Export the file with commas between columns, and with decimal points. Or describe the "
    "file for option --columns of reskin add (docs/add-a-skin.md)."
)
NUMBER_PATTERN = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
GZIP_MARK = b"\x1f\x8b"
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
FIRST_ROW = 2  # the first row with values; row 1 of the file has the column names
# Arrow's messages about a cell that is not a number, and about a row with too few or too many cells
CONVERSION = re.compile(r"column #(\d+): Row #(\d+): CSV conversion error to (\w+): invalid value '(.*)'")
COLUMNS_N = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")


def parse_csv(source: str | Path, types: Mapping[str, pa.DataType], where: str) -> pa.Table:
    """Read a table from CSV text (`source` is a str) or from a CSV file (`source` is a path).

    The table must have exactly the columns of `types`, in any order. Errors name the row; row 1 is the line with the
    column names.
    """
    try:
        table = pacsv.read_csv(
            pa.py_buffer(source.encode()) if isinstance(source, str) else source,
            # Use one thread, because with several threads, Arrow's messages do not name the row.
            read_options=pacsv.ReadOptions(use_threads=False),
            parse_options=pacsv.ParseOptions(ignore_empty_lines=False),
            convert_options=pacsv.ConvertOptions(column_types=types, null_values=[""], strings_can_be_null=True),
        )
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        got = ascii(" ".join(str(error).split()))[1:-1][:200]  # the error may quote a long row of binary data
        if match := CONVERSION.search(got):
            name, rule = _column_names(source)[int(match[1])], "a whole number" if "int" in match[3] else "a number"
            raise CaptureError(
                f"{where} row {match[2]}", name, rule, f"'{match[4][:20]}'", "Correct or remove this row."
            ) from None
        if match := COLUMNS_N.search(got):
            what = f"the row has {match[3]} columns, but row 1 has {match[2]}"
            raise CaptureError(f"{where} row {match[1]}: {what}. {COPY_AGAIN}") from None
        raise CaptureError(
            f"{where}: not a CSV file with columns {_list(types)}: {got}. Correct the row that this message names."
        ) from None
    except FileNotFoundError:
        raise CaptureError(f"{where}: file not found. Copy the whole folder of the capture again.") from None
    _check_names(table.column_names, types, where)
    return table.select(list(types)).combine_chunks()


def parse_torn_csv(path: Path, names: Sequence[str], where: str) -> Float64[np.ndarray, "f c"]:
    """Read a CSV file of numbers that a program wrote line by line, some of whose lines may be torn.

    Cells that are empty or are no numbers are NaN, and so are all cells of lines with too few or too many of them.
    Raises CaptureError if the file is not readable text.
    """
    torn_row = []

    def skip(row: Any) -> str:
        torn_row.append(row.number - FIRST_ROW)
        return "skip"

    text = pa.string()
    try:
        table = pacsv.read_csv(
            path,
            read_options=pacsv.ReadOptions(use_threads=False),
            parse_options=pacsv.ParseOptions(invalid_row_handler=skip),
            convert_options=pacsv.ConvertOptions(column_types=dict.fromkeys(names, text)),
        ).select(list(names))
    except (pa.ArrowInvalid, UnicodeDecodeError, KeyError) as error:
        got = ascii(" ".join(str(error).split()))[1:-1][:200]
        raise CaptureError(f"{where}: not a CSV file with columns {_list(list(names))}: {got}. {COPY_AGAIN}") from None
    rows_n = len(table) + len(torn_row)
    whole = ~np.isin(np.arange(rows_n), torn_row)
    numbers = np.full((rows_n, len(names)), np.nan)
    for i, name in enumerate(names):
        cells = pc.utf8_trim_whitespace(table.column(name))
        is_sound = pc.match_substring_regex(cells, NUMBER_PATTERN)
        numbers[whole, i] = np.asarray(pc.cast(pc.if_else(is_sound, cells, None), pa.float64()))
    return numbers


def _column_names(source: str | Path) -> list[str]:
    """Return the names in row 1 of a CSV text or file."""
    if isinstance(source, str):
        return source.split("\n", 1)[0].strip().split(",")
    with source.open(encoding="utf-8-sig", errors="replace") as file:
        return file.readline().strip().split(",")


def render_csv(table: pa.Table) -> str:
    """Return a table as CSV text, in which a null is an empty field.

    Each number is written with as few digits as are needed to read the same number again.
    """
    sink = pa.BufferOutputStream()
    pacsv.write_csv(table, sink, pacsv.WriteOptions(include_header=False, quoting_style="none"))
    return ",".join(table.column_names) + "\n" + sink.getvalue().to_pybytes().decode()


def refuse_row(bad: Bool[np.ndarray, " rows"], where: str, what: str, rule: str, values: Any, remedy: str) -> None:
    """Raise `CaptureError` for the first row that `bad` marks; do nothing if it marks no row.

    `what` is the name of the wrong value, and `rule` is the rule that this value violates. `values` contains the values
    of all rows, or is a text that describes the wrong value.
    """
    if bad.any():
        row_i = int(bad.argmax())
        got = values if isinstance(values, str) else values[row_i]
        raise CaptureError(f"{where} row {row_i + FIRST_ROW}", what, rule, got, remedy)


def _check_names(names: list[str], types: Mapping[str, pa.DataType], where: str) -> None:
    missing = [name for name in types if name not in names]
    unknown = [name for name in names if name not in types]
    if missing or unknown or len(names) != len(types):
        got = f"missing {_list(missing)}, unknown {ascii(_list(unknown))[1:-1][:80]}, {len(names)} in total"
        raise CaptureError(
            where, "the column names in row 1", _list(types), got, "Correct the names, or remove unknown columns."
        )


def _list(names: Mapping[str, pa.DataType] | list[str]) -> str:
    return ",".join(names) or "none"


# Largest magnitude of a number in a file. All readings, places and unix times are below this limit, and float32 can
# represent numbers up to it.
MAGNITUDE_MAX = 1e10


def read_cells(path: Path, where: str, *, separator: str | None) -> list[list[str]]:
    """Split a text file into cells; return one list of cells per line. Tabs may take the place of commas.

    Raises `CaptureError` if the lines do not have the same number of cells. If `separator` is None, cells are separated
    by white space.
    """
    text = _read_text(path, where)
    if separator == "," and ";" in text.partition("\n")[0]:
        raise CaptureError(f"{where}: {SEMICOLONS}")
    first = text.partition("\n")[0]
    if separator == "," and "\t" in first and "," not in first:
        separator = "\t"
    cells = [line.split(separator) for line in text.removesuffix("\n").split("\n")]
    for line_i, row in enumerate(cells):
        if len(row) != len(cells[0]):
            problem = f"line {line_i + 1} has {len(row)} columns, but line 1 has {len(cells[0])}"
            raise CaptureError(f"{where}: {problem}. {COPY_AGAIN}")
    return cells


def to_numbers(
    cells: list[list[str]], where: str, *, names: Sequence[str], first_line_n: int = 1
) -> Float64[np.ndarray, "f c"]:
    """Parse cells as finite numbers.

    Errors name the column and the line of a wrong cell; `first_line_n` is the number of the line with `cells[0]`.
    """
    if cells and len(cells[0]) != len(names):
        problem = f"the file has {len(cells[0])} columns instead of {len(names)} ({names[0]} ... {names[-1]})"
        raise CaptureError(f"{where}: {problem}. Check the layout and the number of chips.")
    if not cells:
        raise CaptureError(f"{where}: the file has no row of numbers. Copy the recording again.")
    try:
        numbers = np.array(cells, dtype=np.float64)
    except ValueError:
        raise _first_fault(cells, where, names, first_line_n) from None
    if not (np.abs(numbers) < MAGNITUDE_MAX).all():
        raise _first_fault(cells, where, names, first_line_n)
    return numbers


def make_readings(
    header: Header, keep: Bool[np.ndarray, " rows"], **columns: Shaped[np.ndarray, "rows ..."]
) -> Readings:
    """Make readings from the rows that `keep` marks.

    A column that is not given becomes NaN (unknown), except `reading_i`, which becomes 0.
    """
    unknown_degC = np.full((len(keep), header.chips_n), np.nan)
    columns = {"reading_i": np.zeros(len(keep)), "temperature_degC": unknown_degC, **columns}
    unknown = np.full(len(keep), np.nan)
    typed = {name: columns.get(name, unknown)[keep].astype(_dtype(name)) for name in UNITS}
    return Readings(capture=header.capture, board=header.board, skin=header.skin, source=header.source, **typed)


def mean_by_group(
    b_uT: Float64[np.ndarray, "f ch"], group_i: Int[np.ndarray, " f"], groups_n: int
) -> Float64[np.ndarray, "n ch"]:
    """Return the mean field of each group of rows; NaN for a group without rows."""
    sums_uT = np.zeros((groups_n, b_uT.shape[1]))
    np.add.at(sums_uT, group_i, b_uT)
    rows_n = np.bincount(group_i, minlength=groups_n)[:, None]
    return np.divide(sums_uT, rows_n, out=np.full(sums_uT.shape, np.nan), where=rows_n > 0)


def _dtype(name: str) -> type[np.generic]:
    if name == "t_s":
        return np.float64
    return np.int32 if UNITS[name] == "1" else np.float32


def _read_text(path: Path, where: str) -> str:
    try:
        text = text_of(path.read_bytes(), where)
    except OSError as error:
        raise CaptureError(f"{where}: cannot read the file: {error.strerror}. Copy the recording again.") from None
    if not text.endswith("\n"):
        if not text:
            raise CaptureError(f"{where}: the file is empty. Copy the recording again.")
        raise CaptureError(
            f"{where}: the last line has no line break; it ends in {text[-12:]!r}. If the file was cut, copy the "
            "recording again. If the last line is complete, add a line break after it."
        )
    return text


def text_of(content: bytes, where: str) -> str:
    """Decode a text file, which may be compressed (gzip); its byte order mark, if any, tells UTF-16 from UTF-8."""
    try:
        content = gzip.decompress(content) if content[:2] == GZIP_MARK else content
    except (OSError, EOFError, zlib.error):
        raise CaptureError(f"{where}: the gzip file is damaged. Copy the file again.") from None
    try:
        return content.decode("utf-16" if content[:2] in UTF16_MARKS else "utf-8-sig")
    except UnicodeDecodeError as error:
        byte = f"{content[error.start]:#04x} at position {error.start}"
        raise CaptureError(
            f"{where}: the file is not a text file: it contains byte {byte}. Check that this is the right file. If it "
            "has a table in another container, docs/add-a-skin.md (option --columns) says which can be read."
        ) from None


def _first_fault(cells: list[list[str]], where: str, names: Sequence[str], first_line_n: int) -> CaptureError:
    """Return the error for the first cell that is not a number, or that is too large."""
    for row_i, row in enumerate(cells):
        for name, cell in zip(names, row, strict=True):
            if not is_number(cell):
                place = f"{name} in line {first_line_n + row_i}"
                rule = f"a finite number below {MAGNITUDE_MAX:g}"
                return CaptureError(
                    where, place, rule, repr(cell[:20]), "Correct or remove this row, then add the recording again."
                )
    raise AssertionError("the numbers were refused, although every cell is a number")


def is_number(cell: str) -> bool:
    try:
        return abs(float(cell)) < MAGNITUDE_MAX
    except ValueError:
        return False


PHASES = ("noload", "contact")


def count_chips_of(names: list[str]) -> int:
    """Count the chips from the names of columns, which are `T<i>`, `Bx<i>`, `By<i>` and `Bz<i>` for chip i.

    Chips are numbered from 0, so the result is 1 plus the largest i.
    """
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"(?:T|Bx|By|Bz)(\d{1,3})", name))]
    return max(numbers, default=0) + 1


def check_columns(names: list[str], wanted: list[str], where: str, *, layout: str) -> None:
    """Raise if one of the wanted columns is missing, or if two columns have the same name."""
    missing = [name for name in wanted if name not in names]
    if missing:
        if renamed := _renaming(names, wanted):
            raise CaptureError(f"{where}: no column {', '.join(missing)}. {renamed}")
        raise CaptureError(
            f"{where}: no column {', '.join(missing)}. Check that the layout is {layout}, and that line 1 has the "
            "column names. See data/README.md. If the values have other names or units, describe them in a file for "
            "option --columns (docs/add-a-skin.md)."
        )
    twice = [name for name, times_n in Counter(names).items() if times_n > 1]
    if twice:
        raise CaptureError(f"{where}: two columns have the name {twice[0]}. Remove one of these columns.")


def _renaming(names: list[str], wanted: list[str]) -> str:
    """Return a sentence on other habits of naming: other capitals, or chips that are numbered from 1; else empty."""
    lower = {name.lower(): name for name in names}
    if all(name.lower() in lower for name in wanted):
        found = [f"{lower[name.lower()]} to {name}" for name in wanted if name not in names]
        return f"Rename {', '.join(found)}."
    if "Bx0" not in names and {"Bx1", "By1", "Bz1"} <= set(names):
        return (
            "The chips seem to be numbered from 1. Number them from 0, or state it in a file for option --columns: "
            'fields: {Bx: "Bx{}", By: "By{}", Bz: "Bz{}", first: 1} (docs/add-a-skin.md).'
        )
    return ""


def contact_rows(phases: list[str], where: str, first_line_n: int) -> Bool[np.ndarray, " f"]:
    """Mark the rows of phase `contact`.

    Raises `CaptureError` if a phase is neither `noload` nor `contact`, or if no row has phase `contact`.
    """
    for row_i, phase in enumerate(phases):
        if phase not in PHASES:
            place = f"phase in line {first_line_n + row_i}"
            raise CaptureError(where, place, "noload or contact", repr(phase[:20]), "Correct the text of this cell.")
    if "contact" not in phases:
        raise CaptureError(
            f"{where}: no row has phase contact. If the recording was cut, copy the whole recording again."
        )
    return np.array([phase == "contact" for phase in phases])


def count_within(press: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Number the rows within each block of equal press numbers: 0, 1, 2, ..."""
    begins = np.flatnonzero(np.diff(press, prepend=-1))
    return np.arange(len(press)) - np.repeat(begins, np.diff(begins, append=len(press)))
