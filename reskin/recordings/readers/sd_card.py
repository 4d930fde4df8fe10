"""Read and write the log that a board writes to an SD card (section 6 of the paper).

A log is a CSV file with one line per frame, and without labels. A line contains the time of the board's clock in
seconds, and then T, Bx, By, Bz of each chip in degC and uT, in the same order as in wire format `text-txyz`. The
columns T may be missing; the temperatures are then unknown (NaN).
"""

from codecs import BOM_UTF8
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from reskin.board.wire import Frames, concatenate
from reskin.errors import CaptureError
from reskin.recordings import tables
from reskin.recordings.fault_policy import check_log
from reskin.recordings.tables import FIRST_ROW

TIME = "t_s"
CHIP_COLUMNS = ("T", "Bx", "By", "Bz")
HEADER_CHARACTERS_MAX = 10_000  # line 1 of a log of 64 chips has 1,500 characters
SHOWN_CHIPS_MAX = 5  # if there are more chips, the line of column names is too long for an error message
TORN_SHARE_MAX = 0.5  # assumed: with a larger share of torn lines, the log is refused
# times in s, fields in uT, temperatures in degC, and an account (counts by name)
Log = tuple[Float64[np.ndarray, " rows"], Float32[np.ndarray, "rows ch"], Float32[np.ndarray, "rows k"], dict[str, int]]


def column_names(chips_n: int, *, temperatures: bool = True) -> list[str]:
    """Return the names of a log's columns, in order."""
    of_chip = CHIP_COLUMNS if temperatures else CHIP_COLUMNS[1:]
    return [TIME, *(f"{name}{chip_i}" for chip_i in range(chips_n) for name in of_chip)]


def render(
    t_s: Float64[np.ndarray, " f"], b_uT: Float32[np.ndarray, "f ch"], temperature_degC: Float32[np.ndarray, "f k"]
) -> str:
    """Return a log as CSV text.

    Times are rounded to 0.1 ms. Readings are rounded to two decimals, as in the wire formats of text.
    """
    frames_n, chips_n = temperature_degC.shape
    chips = np.concatenate([temperature_degC[:, :, None], b_uT.reshape(frames_n, chips_n, 3)], axis=2)
    line = ",".join(["%.4f", *["%.2f"] * (4 * chips_n)])
    rows = np.column_stack([t_s, chips.reshape(frames_n, -1)]).tolist()
    return "\n".join([",".join(column_names(chips_n)), *(line % tuple(row) for row in rows)]) + "\n"


def read_log(path: Path) -> Log:
    """Read a log; return its fault-free frames, and an account.

    Temperatures are NaN if the log has none. Torn lines are dropped and counted, and so are the frames that
    `fault_policy.check_log` does not accept.
    """
    account: dict[str, int] = {}
    parts = list(check_log(read_blocks(path, account), str(path), account))
    kept = concatenate(parts, parts[0].temperature_degC.shape[1])
    return kept.device_s, kept.b_uT, kept.temperature_degC, account


def read_blocks(path: Path, account: dict[str, int]) -> Iterator[Frames]:
    """Yield the whole lines of a log with their times and row numbers; at the end, count the torn lines."""
    where = str(path)
    names = _read_names(path, where)
    chips_n = sum(name.startswith("Bx") for name in names)
    lines_n = torn_n = 0
    for numbers in tables.parse_torn_csv(path, names, where):
        whole = np.isfinite(numbers).all(axis=1)
        row_n = FIRST_ROW + lines_n + np.flatnonzero(whole)
        lines_n, torn_n = lines_n + len(whole), torn_n + int((~whole).sum())
        chips = numbers[whole, 1:].reshape(len(row_n), chips_n, (len(names) - 1) // chips_n)
        b_uT = chips[:, :, -3:].reshape(len(chips), 3 * chips_n).astype(np.float32)
        measured = chips.shape[2] == len(CHIP_COLUMNS)
        temperature_degC = (chips[:, :, 0] if measured else np.full(chips.shape[:2], np.nan)).astype(np.float32)
        yield Frames(b_uT, temperature_degC, numbers[whole, 0], row_n)
    if not lines_n:
        raise CaptureError(f"{where}: the log has no lines below the column names. Copy the log again.")
    if torn_n > TORN_SHARE_MAX * lines_n:
        raise CaptureError(
            f"{where}: {torn_n} of {lines_n} lines are torn: cells are missing or are no numbers. Check the "
            "program that wrote the log, and log again."
        )
    if torn_n:
        account["dropped_torn_lines_n"] = torn_n


def _read_names(path: Path, where: str) -> list[str]:
    """Read the column names in line 1.

    Raises `CaptureError` if the names are wrong, or if the last line does not end with a line break, because the file
    was then cut.
    """
    try:
        with path.open("rb") as file:
            first = file.readline(HEADER_CHARACTERS_MAX)
            file.seek(-1, 2)
            last = file.read(1)
    except FileNotFoundError:
        raise CaptureError(f"{where}: file not found. Check the path.") from None
    except OSError as error:
        reason = "the file is empty" if path.is_file() and not path.stat().st_size else error.strerror
        raise CaptureError(f"{where}: cannot read the log: {reason}. Check the path.") from None
    if not first.removeprefix(BOM_UTF8).rstrip().isascii() or b"\0" in first:
        raise CaptureError(
            f"{where}: the file is not text. If it has the raw bytes of a port, decode them first: reskin decode "
            f"{path.name} --out frames.parquet"
        )
    # If the log was saved by a text editor or a spreadsheet, it may begin with a byte order mark, so remove this mark.
    names = first.removeprefix(BOM_UTF8).decode("ascii", errors="replace").strip().split(",")
    temperatures = _has_temperatures(names)
    chips_n = (len(names) - 1) // (4 if temperatures else 3)
    if chips_n < 1 or names != column_names(chips_n, temperatures=temperatures):
        raise CaptureError(f"{where}: {_header_fault(names)}")
    if last != b"\n":
        raise CaptureError(
            f"{where}: the last line is incomplete: it does not end with a line feed. If the board was switched off "
            "while it wrote this line, remove the line."
        )
    return names


def _has_temperatures(names: list[str]) -> bool:
    return names[1:2] != ["Bx0"]


def _header_fault(names: list[str]) -> str:
    """Return a text that says what is wrong with the column names in line 1, and what to do."""
    wanted = column_names(len(names), temperatures=_has_temperatures(names))
    rule = f"{','.join(column_names(1))}, then T1, Bx1 and so on for the other chips (all columns T may be missing)"
    if tables.is_number(names[0]):
        chips_n, left_n = divmod(len(names) - 1, len(CHIP_COLUMNS))
        whole = f": {','.join(column_names(chips_n))}" if not left_n and 0 < chips_n <= SHOWN_CHIPS_MAX else ""
        return (
            f"line 1 has numbers, not the column names {rule}. If a board wrote this log, add a line with the column "
            f"names at the top{whole}"
        )
    if ";" in names[0]:
        return "line 1 contains semicolons. Export the file with commas between columns, and with decimal points."
    if {"phase", "x_mm", "y_mm"} & set(names):
        return (
            f"line 1 has columns of labels or estimates, but a log has only {rule}. To add labelled data, use reskin "
            "add."
        )
    wrong_i = next((i for i, (name, right) in enumerate(zip(names, wanted, strict=False)) if name != right), len(names))
    if wrong_i == len(names):
        return (
            f"line 1: column {wrong_i + 1} must be {wanted[wrong_i]}; the line ends at {names[-1]}. Complete this line."
        )
    got = ascii(names[wrong_i][:20])[1:-1]
    return f"line 1: column {wrong_i + 1} is {got!r}; it must be {wanted[wrong_i]} (columns: {rule}). Correct line 1."
