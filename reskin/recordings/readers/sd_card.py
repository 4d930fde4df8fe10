"""Read and write the log that a board writes to an SD card (section 6 of the paper).

A log is a text file with one line per frame, and without labels. A line contains the time of the board's clock in
seconds, and T, Bx, By, Bz of each chip in degC and uT; line 1 has the names of the columns. The columns T may be
missing; the temperatures are then unknown (NaN). Other columns are ignored and counted.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from reskin.board.wire import Frames, concatenate
from reskin.errors import CaptureError
from reskin.recordings.fault_policy import check_log
from reskin.recordings.tables import FIRST_ROW, TableFile, count_chips_of

TIME = "t_s"
CHIP_COLUMNS = ("T", "Bx", "By", "Bz")
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
    file = TableFile(path, where)
    chips_n = count_chips_of(file.names)
    measured = any(re.fullmatch(r"T\d+", name) for name in file.names)  # whether temperatures were measured
    names = column_names(chips_n, temperatures=measured)
    if missing := [name for name in names if name not in file.names]:
        columns = ",".join(column_names(1))
        raise CaptureError(
            f"{where}: line 1 has no column {', '.join(missing)}. A log has the columns {columns}, then T1, Bx1 and "
            "so on for the other chips; all columns T may be missing. If line 1 has numbers, add the column names "
            "above it. To add labelled data, use reskin add."
        )
    lines_n = torn_n = 0
    for numbers in file.read_torn(names):
        whole = np.isfinite(numbers).all(axis=1)
        row_n = FIRST_ROW + lines_n + np.flatnonzero(whole)
        lines_n, torn_n = lines_n + len(whole), torn_n + int((~whole).sum())
        chips = numbers[whole, 1:].reshape(len(row_n), chips_n, (len(names) - 1) // chips_n)
        b_uT = chips[:, :, -3:].reshape(len(chips), 3 * chips_n).astype(np.float32)
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
    if ignored_n := len(file.names) - len(names):
        account["ignored_columns_n"] = ignored_n
