"""The text tables of other people's recordings. In: a file. Out: its cells and numbers, or the line that is wrong.

A recording that was cut, emptied or overwritten must never become a shorter one without a word. Numbers that are known
become `Readings`, all else NaN. Refuses to know what a column of a file means.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int, Shaped

from pipeline.capture.header import Header
from pipeline.core.errors import CaptureError
from pipeline.core.schema import UNITS, Readings

# No reading, place or unix time of these recordings comes near it; float32 holds it without overflow.
MAGNITUDE_MAX = 1e10


def read_cells(path: Path, where: str, *, separator: str | None) -> list[list[str]]:
    """Split a text file into cells, one list a line and all of one length; `None` splits at any white space."""
    text = _read_text(path, where)
    cells = [line.split(separator) for line in text.removesuffix("\n").split("\n")]
    for line_i, row in enumerate(cells):
        if len(row) != len(cells[0]):
            got = f"{len(row)} in line {line_i + 1}"
            raise CaptureError(where, "columns", f"{len(cells[0])}, as in line 1", got, "Was the file cut or edited?")
    return cells


def to_numbers(
    cells: list[list[str]], where: str, *, names: Sequence[str], first_line_n: int = 1
) -> Float64[np.ndarray, "f c"]:
    """Turn cells into finite numbers; `names` are the columns', `first_line_n` the file's line of `cells[0]`."""
    if cells and len(cells[0]) != len(names):
        rule = f"{len(names)} a line ({names[0]} ... {names[-1]})"
        raise CaptureError(where, "columns", rule, len(cells[0]), "Is the layout right, and the number of chips?")
    if not cells:
        raise CaptureError(where, "the file", "at least one row of numbers", "none", "Copy the recording again.")
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
    """Make readings of the rows to keep; a column that is not given is unknown, and `reading_i` 0."""
    columns = {"reading_i": np.zeros(len(keep)), **columns}
    unknown = np.full(len(keep), np.nan)
    typed = {name: columns.get(name, unknown)[keep].astype(_dtype(name)) for name in UNITS}
    return Readings(capture=header.capture, board=header.board, skin=header.skin, source=header.source, **typed)


def mean_by_group(
    b_uT: Float64[np.ndarray, "f ch"], group_i: Int[np.ndarray, " f"], groups_n: int
) -> Float64[np.ndarray, "n ch"]:
    """Give the mean field of each group of rows; NaN for a group without rows."""
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
        text = path.read_bytes().decode("utf-8-sig")  # spreadsheets begin a file with a mark of byte order
    except UnicodeDecodeError as error:
        got = f"byte {error.object[error.start]:#04x} at {error.start}"
        raise CaptureError(where, "the file", "text", got, "Is it another file under this name?") from None
    except OSError as error:
        raise CaptureError(where, "the file", "readable", error.strerror, "Copy the recording again.") from None
    if not text.endswith("\n"):
        got = "no bytes" if not text else f"{text[-12:]!r}"
        remedy = "Copy the recording again; if it is whole, end it with an empty line."
        raise CaptureError(where, "the last line", "complete and end in a line feed", got, remedy)
    return text


def _first_fault(cells: list[list[str]], where: str, names: Sequence[str], first_line_n: int) -> CaptureError:
    for row_i, row in enumerate(cells):
        for name, cell in zip(names, row, strict=True):
            if not _is_number(cell):
                place = f"{name} in line {first_line_n + row_i}"
                rule = f"a finite number below {MAGNITUDE_MAX:g}"
                return CaptureError(where, place, rule, repr(cell[:20]), "Mend or remove this row, then add it again.")
    raise AssertionError("numbers refused, though every cell is one")


def _is_number(cell: str) -> bool:
    try:
        return abs(float(cell)) < MAGNITUDE_MAX
    except ValueError:
        return False
