"""Read and write tables; errors name the line and column.

`TableFile` reads tables of any program; `parse_csv` reads CSV files whose columns and types are known. The docstring of
`reskin.recordings.readers` says which module reads which table or log.
"""

import csv
import gzip
import io as bytes_io
import json
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from jaxtyping import Bool, Float64, Int, Shaped

from reskin.errors import CaptureError, did_you_mean
from reskin.recordings.header import Header
from reskin.schema import UNITS, Readings

NUMBER_PATTERN = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
GZIP_MARK = b"\x1f\x8b"
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
BLOCK_BYTES_N = 2**22  # bytes of a text file that are parsed at once
FIRST_ROW = 2  # the first row with values; row 1 of the file has the column names
# Arrow's message about a row with too few or too many cells
COLUMNS_N = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")


def parse_csv(source: str | Path, types: Mapping[str, pa.DataType], where: str) -> pa.Table:
    """Read the columns of `types`, in their order, from CSV text (`source` is a str) or from a CSV file."""
    text = source if isinstance(source, str) else text_of(source, where)
    text = text.rstrip("\n")
    file = TableFile(f"{text}\n" if text else "", where)
    texts = [name for name, kind in types.items() if pa.types.is_string(kind)]
    table = file.read([name for name in types if name not in texts], texts)
    columns: dict[str, Any] = {name: table[name] for name in texts}
    for name, kind in types.items():
        if name not in texts:
            values = np.asarray(table[name])
            if pa.types.is_integer(kind):
                too_large = np.abs(values) > np.iinfo(kind.to_pandas_dtype()).max
                refuse_row((values % 1 > 0) | too_large, where, name, "a whole number", values, "Correct this row.")
            columns[name] = pa.array(values, kind, from_pandas=True)  # NaN becomes null
    return pa.table({name: columns[name] for name in types})


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


# Largest magnitude of a number in a file. All readings, places, numbers of bytes and unix times in s are below it.
MAGNITUDE_MAX = 1e12
# Most bytes that a table may need in memory: more than 5 million readings of five chips, or 3.5 hours at 400 Hz. A
# compressed file of a few kB could otherwise fill the memory.
TABLE_BYTES_MAX = 2**30
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
EMPTY = pa.array(["", "nan", "none", "null"])  # cells without a value, in small letters
UNREADABLE = (  # errors of the libraries that read the formats, for damaged files
    pa.ArrowException, csv.Error, zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, TypeError, KeyError,
    AttributeError, RuntimeError, MemoryError, OverflowError,
)  # fmt: skip


class TableFile:
    """A table in a text file (also compressed with gzip or in UTF-16), a Parquet file, JSON lines or an npz file.

    `names` has the names of the columns; without `has_names`, row 1 has values, and the names are numbers from 0. The
    delimiter of a text file is found from row 1. The array of an npz file with two axes gives the columns name0, name1,
    ... The source is a path, or the text itself. Raises CaptureError if it cannot be read.
    """

    def __init__(self, source: Path | str, where: str, *, has_names: bool = True) -> None:
        self._path, self._where = Path() if isinstance(source, str) else source, where
        self._text: bytes | None = None  # None: the text of the file
        self._parquet: pq.ParquetFile | None = None
        self._table: pa.Table | None = None
        self.first_row = FIRST_ROW if has_names else 1
        with self._explaining():
            if isinstance(source, Path):
                self._open(source, has_names)
            else:
                self._open_text(source, has_names)

    def read(self, numbers: Iterable[str], others: Iterable[str] = (), *, decimal_comma: bool = False) -> pa.Table:
        """Read columns as numbers (float64; NaN for an empty cell), and other columns as they are.

        Raises CaptureError if one of the columns is missing or has a cell that is not a number. The file is read in
        blocks, so that only these columns are in memory.
        """
        others = list(others)
        names = list(dict.fromkeys([*numbers, *others]))
        self._check_names(names)
        _check_size(8 * self._rows_n * len(names), self._where)
        parts: dict[str, list[pa.Array]] = {name: [] for name in others}
        made: dict[str, Any] = {name: np.empty(self._rows_n) for name in names if name not in others}
        start = 0
        with self._explaining():
            for batch in self._blocks(names):
                for name in names:
                    if name in others:
                        parts[name].append(batch.column(name))
                    else:
                        place, row = f"{self._where}: {name}", self.first_row + start
                        made[name][start : start + len(batch)] = _numbers(batch.column(name), place, row, decimal_comma)
                start += len(batch)
        if start != self._rows_n:
            raise CaptureError(
                f"{self._where}: {self._rows_n} lines of values, but {start} rows: a quotation mark is not closed. "
                "Remove it."
            )
        none = [pa.array([], pa.string())]
        return pa.table(made | {name: pa.chunked_array(part or none) for name, part in parts.items()})

    def read_torn(self, names: Sequence[str]) -> Iterator[Float64[np.ndarray, "f c"]]:
        """Read columns of numbers in blocks; a program wrote the file line by line, and some lines may be torn.

        Cells that are empty or are no numbers are NaN, and so are all cells of lines with too few or too many of them.
        """
        self._check_names(names)
        if self._parquet is not None or self._table is not None:
            yield np.stack([np.asarray(column) for column in self.read(names).columns], axis=1)
            return
        delimiter, between_n = self._delimiter.encode(), len(self.names) - 1
        with self._explaining(), self._stream() as file:
            file.readline()
            while block := file.read(BLOCK_BYTES_N):
                lines = (block + file.readline()).rstrip(b"\r\n").split(b"\n")
                # A line with another number of cells becomes a line of empty cells, so that it keeps its place.
                whole = [line if line.count(delimiter) == between_n else delimiter * between_n for line in lines]
                table = pacsv.read_csv(
                    pa.py_buffer(b"\n".join(whole) + b"\n"),
                    read_options=pacsv.ReadOptions(use_threads=False, column_names=self.names),
                    parse_options=pacsv.ParseOptions(
                        delimiter=self._delimiter, quote_char=False, ignore_empty_lines=False
                    ),
                    convert_options=pacsv.ConvertOptions(
                        column_types=dict.fromkeys(names, pa.string()), include_columns=names
                    ),
                )
                numbers = np.full((len(lines), len(names)), np.nan)
                for i, name in enumerate(names):
                    cells = pc.utf8_trim_whitespace(table.column(name))
                    is_sound = pc.match_substring_regex(cells, NUMBER_PATTERN)
                    numbers[:, i] = np.asarray(pc.cast(pc.if_else(is_sound, cells, None), pa.float64()))
                yield numbers

    def _check_names(self, names: Sequence[str]) -> None:
        for name in names:
            if self.names.count(name) > 1:
                raise CaptureError(f"{self._where}: two columns have the name {name}. Remove one of these columns.")
            if name not in self.names:
                have, guess = ", ".join(self.names)[:200], did_you_mean(name, self.names)
                raise CaptureError(f"{self._where}: no column {name!r}; the file has {have}.{guess} Correct the name.")

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except CaptureError:
            raise
        except UNREADABLE as error:
            problem = ascii(" ".join(str(error).split()))[1:-1][:120]
            if match := COLUMNS_N.search(problem):
                problem = f"line {match[1]} has {match[3]} columns, but line 1 has {match[2]}"
                remedy = "The file may have been cut or edited. Copy the file again, or correct it."
            else:
                problem, remedy = f"the file cannot be read as a table: {problem}", "Check the file."
            raise CaptureError(f"{self._where}: {problem}. {remedy}") from None

    def _open(self, path: Path, has_names: bool) -> None:
        with opened(path, self._where) as file:
            start = file.read(16)
        if start.startswith(b"PAR1"):
            self._parquet = pq.ParquetFile(path)
            self.names, self._rows_n = list(self._parquet.schema_arrow.names), self._parquet.metadata.num_rows
        elif start.startswith(b"PK") and all(name.endswith(".npy") for name in _members(path, self._where)):
            self._use(_arrays(path))
        else:
            for magic, (what, remedy) in OTHER_FILES.items():
                if start.startswith(magic):
                    raise CaptureError(f"{self._where}: the file is {what}. {remedy}.")
            packed = start.startswith((GZIP_MARK, *UTF16_MARKS))
            self._open_text(text_of(path, self._where) if packed else None, has_names)

    def _use(self, table: pa.Table) -> None:
        self._table, self.names, self._rows_n = table, list(table.column_names), len(table)

    def _open_text(self, text: str | None, has_names: bool) -> None:
        """Read the names of the columns, count the lines, and find the delimiter; without `text`, those of the file."""
        self._text = None if text is None else text.encode()
        with self._stream() as file:
            line = block = file.readline()
            self._rows_n = 1 - self.first_row
            while block:
                last, self._rows_n = block[-12:], self._rows_n + block.count(b"\n")
                block = file.read(BLOCK_BYTES_N)
        if not line:
            raise CaptureError(f"{self._where}: the file is empty. Copy the recording again.")
        if not last.endswith(b"\n"):
            raise CaptureError(
                f"{self._where}: the last line has no line break; it ends in {last.decode(errors='replace')!a}. If the "
                "file was cut, copy the recording again. If the last line is complete, add a line break after it."
            )
        first = _decode(line, self._where).strip("\r\n")
        if first.lstrip()[:1] == "{":
            lines = (text or text_of(self._path, self._where)).splitlines()
            self._use(pa.Table.from_pylist([json.loads(line) for line in lines]))
            return
        if re.search(r"[;\t|,]", first):
            self._delimiter = max(";\t|,", key=first.count)
        else:  # the cells are separated by any number of blanks
            self._delimiter, text = "\t", text or text_of(self._path, self._where)
            first, *others = ["\t".join(line.split()) for line in text.split("\n")]
            self._text = "\n".join([first, *others]).encode()
        cells = next(csv.reader([first], delimiter=self._delimiter))
        self.names = [cell.strip() for cell in cells] if has_names else [str(i) for i in range(len(cells))]

    def _stream(self) -> BinaryIO:
        return bytes_io.BytesIO(self._text) if self._text is not None else self._path.open("rb")

    def _blocks(self, names: list[str]) -> Iterator[pa.RecordBatch]:
        if self._parquet is not None:
            meta = self._parquet.metadata
            columns = [meta.row_group(i).column(j) for i in range(meta.num_row_groups) for j in range(meta.num_columns)]
            _check_size(8 * sum(column.num_values for column in columns), self._where)  # lists have many values a row
            texts = [name for name in names if pa.types.is_string(self._parquet.schema_arrow.field(name).type)]
            # A text that all rows share is read once, because a small file may have a long text in millions of rows.
            return pq.ParquetFile(self._path, read_dictionary=texts).iter_batches(columns=names)
        if self._table is not None:
            return iter(self._table.select(names).to_batches())
        unique = [f"{i} {name}" if self.names.count(name) > 1 else name for i, name in enumerate(self.names)]
        try:
            return pacsv.open_csv(
                self._path if self._text is None else pa.py_buffer(self._text),
                read_options=pacsv.ReadOptions(
                    use_threads=False, skip_rows=self.first_row - 1, column_names=unique, block_size=BLOCK_BYTES_N
                ),
                parse_options=pacsv.ParseOptions(delimiter=self._delimiter, ignore_empty_lines=False),
                convert_options=pacsv.ConvertOptions(
                    column_types=dict.fromkeys(names, pa.string()), include_columns=names
                ),
            )
        except pa.ArrowInvalid as error:
            if "Empty CSV" in str(error):  # a file without a row below the names
                return iter(())
            raise


def count_columns(path: Path, where: str) -> int:
    return len(TableFile(path, where, has_names=False).names)


def read_rows(path: Path, where: str, names: Sequence[str]) -> Float64[np.ndarray, "f c"]:
    """Read all columns of a text file without a row of names as finite numbers.

    `names` are the names of the columns in errors.
    """
    file = TableFile(path, where, has_names=False)
    if len(file.names) != len(names):
        problem = f"the file has {len(file.names)} columns instead of {len(names)} ({names[0]} ... {names[-1]})"
        raise CaptureError(f"{where}: {problem}. Check the layout and the number of chips.")
    table = file.read(file.names)
    numbers = np.stack([np.asarray(column) for column in table.columns], axis=1)
    refuse_empty(dict(zip(names, numbers.T, strict=True)), np.ones(len(numbers), bool), where, 1)
    return numbers


def refuse_empty(
    columns: Mapping[str, Float64[np.ndarray, " f"]], rows: Bool[np.ndarray, " f"], where: str, first_row: int
) -> None:
    """Raise if one of the given rows lacks a number."""
    for name, values in columns.items():
        if (lacking := np.isnan(values) & rows).any():
            place = f"{name} in line {first_row + int(lacking.argmax())}"
            raise CaptureError(where, place, "a finite number", "an empty cell or nan", "Correct or remove this row.")


def coded(column: pa.ChunkedArray) -> tuple[list[Any], Int[np.ndarray, " f"]]:
    """Return the different values of a column, and the index of each row's value among them."""
    column = column if pa.types.is_dictionary(column.type) else column.dictionary_encode(null_encoding="encode")
    whole = column.unify_dictionaries().combine_chunks()
    values = whole.dictionary.to_pylist()
    return [*values, None], np.asarray(whole.indices.fill_null(len(values)))


def _numbers(column: pa.Array, place: str, row: int, decimal_comma: bool) -> Float64[np.ndarray, " f"]:
    """Convert a part of a column, whose first cell is in the given row, to numbers."""
    column = column.dictionary_decode() if pa.types.is_dictionary(column.type) else column
    cells = column
    if is_text := pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        cells = pc.utf8_trim_whitespace(column)
        cells = pc.replace_substring(cells, ",", ".") if decimal_comma else cells
        cells = pc.if_else(pc.is_in(pc.utf8_lower(cells), EMPTY), None, cells)
    try:
        numbers = np.asarray(pc.cast(cells, pa.float64()).to_numpy(zero_copy_only=False))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
        if not is_text:
            raise CaptureError(f"{place}: values of type {column.type} are no numbers. Correct the column.") from None
        numbers = np.full(len(cells), np.inf)
    if not (wrong := np.abs(numbers) >= MAGNITUDE_MAX).any():
        return numbers
    texts = cells.to_pylist()
    i = next(i for i, bad in enumerate(wrong) if bad and texts[i] is not None and not is_number(str(texts[i])))
    got = str(column[i].as_py())[:20]
    remedy = (
        "State `decimal_comma: true` in a map of columns, or correct this row." if "," in got else "Correct this row."
    )
    raise CaptureError(f"{place} in line {row + i} must be a number below {MAGNITUDE_MAX:g}; got {got!r}. {remedy}")


def is_number(cell: str) -> bool:
    return re.fullmatch(NUMBER_PATTERN, cell, re.ASCII) is not None and abs(float(cell)) < MAGNITUDE_MAX


def _check_size(bytes_n: int, where: str) -> None:
    if bytes_n > TABLE_BYTES_MAX:
        raise CaptureError(
            f"{where}: the table needs {bytes_n / 2**30:.1f} GiB or more in memory, but at most "
            f"{TABLE_BYTES_MAX / 2**30:g} GiB are allowed. Split it into several files."
        )


@contextmanager
def opened(path: Path, where: str) -> Iterator[BinaryIO]:
    """Open a file; raise `CaptureError` if that is impossible."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        raise CaptureError(f"{where}: file not found. Check the path, or copy the whole recording again.") from None
    except OSError as error:
        raise CaptureError(f"{where}: cannot read the file: {error.strerror}. Check the path.") from None
    with file:
        yield file


def _members(path: Path, where: str) -> list[str]:
    """Return the names of the files in a zip file, which must not be too large."""
    try:
        with zipfile.ZipFile(path) as archive:
            _check_size(sum(info.file_size for info in archive.infolist()), where)
            return archive.namelist() or [""]
    except zipfile.BadZipFile:
        return [""]


def _arrays(path: Path) -> pa.Table:
    """Return the arrays of an npz file as columns."""
    columns: dict[str, np.ndarray] = {}
    with np.load(path, allow_pickle=False) as arrays:
        for name in arrays.files:
            array = np.atleast_1d(arrays[name])
            flat = array.reshape(len(array), -1)
            numbered = {f"{name}{i}": flat[:, i] for i in range(flat.shape[1])}
            columns |= {name: array} if array.ndim == 1 else numbered
    return pa.table(columns)


def text_of(path: Path, where: str) -> str:
    """Return the text of a file, which may be compressed with gzip; its byte order mark tells UTF-16 from UTF-8."""
    with opened(path, where) as file:
        content = file.read()
    if content.startswith(GZIP_MARK):
        try:
            with gzip.open(path) as packed:
                content = packed.read(TABLE_BYTES_MAX + 1)
        except (OSError, EOFError, zlib.error):
            raise CaptureError(f"{where}: the gzip file is damaged. Copy the file again.") from None
        _check_size(len(content), where)
    return _decode(content, where)


def _decode(content: bytes, where: str) -> str:
    try:
        return content.decode("utf-16" if content[:2] in UTF16_MARKS else "utf-8-sig")
    except UnicodeDecodeError as error:
        byte = f"{content[error.start]:#04x} at position {error.start}"
        raise CaptureError(
            f"{where}: the file is not a text file: it contains byte {byte}. Check that this is the right file. If it "
            "has the raw bytes of a port, decode them with `reskin decode`. If it has a table in another container, "
            "docs/add-your-data.md (option --columns) says which can be read."
        ) from None


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


PHASES = ("noload", "contact")


def only_file(recording: Path, layout: str) -> Path:
    """Return the file of a recording; raise if it is a folder or does not exist."""
    if not recording.is_file():
        raise CaptureError(
            f"{recording}: not a file. A recording of layout {layout} is one file: add each file separately."
        )
    return recording


def count_chips_of(names: list[str]) -> int:
    """Count the chips from the names of columns, which are `T<i>`, `Bx<i>`, `By<i>` and `Bz<i>` for chip i.

    Chips are numbered from 0, so the result is 1 plus the largest i.
    """
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"(?:T|Bx|By|Bz)(\d{1,3})", name))]
    return max(numbers, default=0) + 1


def contact_rows(phases: pa.ChunkedArray, where: str) -> Bool[np.ndarray, " f"]:
    """Mark the rows of phase `contact`.

    Raises `CaptureError` if a phase is neither `noload` nor `contact`, or if no row has phase `contact`.
    """
    values, code = coded(phases)
    names = [str(value).strip() for value in values]
    known = np.isin(names, PHASES)[code]
    if not known.all():
        row_i = int(np.argmin(known))
        got = repr(names[code[row_i]][:20])
        raise CaptureError(
            where, f"phase in line {FIRST_ROW + row_i}", "noload or contact", got, "Correct the text of this cell."
        )
    contact = (np.array(names) == "contact")[code]
    if not contact.any():
        raise CaptureError(
            f"{where}: no row has phase contact. If the recording was cut, copy the whole recording again."
        )
    return contact


def count_within(press: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Number the rows within each block of equal press numbers: 0, 1, 2, ..."""
    begins = np.flatnonzero(np.diff(press, prepend=-1))
    return np.arange(len(press)) - np.repeat(begins, np.diff(begins, append=len(press)))
