"""Layout `lab`: a robot, a six-axis gauge, one CSV file a depth. In: that file. Out: readings, 100 or so a press.

Signs: the file's Fz is negative in compression and is turned; Fx and Fy are passed on as recorded, in the gauge's axes.
The file's depth is only an index in its name, so `depth_mm` is NaN; it has no clock, so `t_s` is NaN.
"""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int

from pipeline.capture.header import Header
from pipeline.capture.readers.chips import find_whole_rows
from pipeline.capture.readers.table import read_cells, to_numbers
from pipeline.capture.readers.units import check_fields, check_forces, check_places, check_touch
from pipeline.core.errors import CaptureError
from pipeline.core.schema import Readings

READINGS = "readings.csv"
FILES = (READINGS,)
PHASES = ("noload", "contact")
FIRST_LINE_N = 2  # the file's line of the first row of numbers

Account = dict[str, int]


@dataclass(frozen=True)
class _Table:
    """The columns of one file; `press` numbers the blocks of equal `indent` in the order of the file."""

    press: Int[np.ndarray, " f"]
    contact: Bool[np.ndarray, " f"]
    place_mm: Float64[np.ndarray, "f 2"]
    b_uT: Float64[np.ndarray, "f ch"]
    temperature_degC: Float64[np.ndarray, "f k"]
    force_N: Float64[np.ndarray, "f 3"]
    ignored_columns_n: int


def collect(recording: Path) -> dict[str, Path]:
    """Find the file of a recording: the CSV file itself, one depth of one skin."""
    if not recording.is_file():
        raise CaptureError(recording, "a lab recording", "one CSV file", "none", "Add each depth's file by itself.")
    return {READINGS: recording}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the names of the columns."""
    return _count_chips(read_cells(files[READINGS], str(files[READINGS]), separator=",")[0])


def read(folder: Path, header: Header) -> tuple[Readings, Account]:
    """Read contact rows as readings; the no-load field of a row is the mean over its press's `noload` rows."""
    where = f"{header.capture}/{READINGS}"
    table = _read_table(folder / READINGS, where)
    if table.temperature_degC.shape[1] != header.chips_n:
        got = table.temperature_degC.shape[1]
        raise CaptureError(where, "chips", f"{header.chips_n}, as in the header", got, "Mend header or file.")
    rows = find_whole_rows(table.b_uT, table.temperature_degC, header, where=where)
    keep, noload = table.contact & rows.whole, ~table.contact & rows.whole
    noload_uT = _noload_field(table, noload, where)
    rows_n = int(keep.sum())
    unknown = np.full(rows_n, np.nan)
    readings = Readings(
        capture=header.capture,
        board=header.board,
        skin=header.skin,
        source=header.source,
        indentation=table.press[keep].astype(np.int32),
        pass_i=np.zeros(rows_n, np.int32),
        reading_i=_count_within(table.press[keep]).astype(np.int32),
        x_mm=table.place_mm[keep, 0].astype(np.float32),
        y_mm=table.place_mm[keep, 1].astype(np.float32),
        depth_mm=unknown.astype(np.float32),
        Fx_N=table.force_N[keep, 0].astype(np.float32),
        Fy_N=table.force_N[keep, 1].astype(np.float32),
        Fz_N=-table.force_N[keep, 2].astype(np.float32),
        b_uT=table.b_uT[keep].astype(np.float32),
        noload_uT=noload_uT[table.press[keep]].astype(np.float32),
        temperature_degC=table.temperature_degC[keep].astype(np.float32),
        t_s=unknown,
        n_contacts=(header.contacts_before_n + table.press[keep]).astype(np.int32),
    )
    return readings, {
        "rows_n": rows_n,
        "rows_read_n": len(keep),
        "noload_rows_n": int(noload.sum()),
        **rows.losses(),
        "ignored_columns_n": table.ignored_columns_n,
    }


def _count_chips(names: list[str]) -> int:
    numbers = [int(match[1]) for name in names if (match := re.fullmatch(r"(?:T|Bx|By|Bz)(\d{1,3})", name))]
    return max(numbers, default=0) + 1


def _read_table(path: Path, where: str) -> _Table:
    cells = read_cells(path, where, separator=",")
    names = [name.strip() for name in cells[0]]
    chips_n = _count_chips(names)
    fields = [f"{axis}{chip}" for chip in range(chips_n) for axis in ("Bx", "By", "Bz")]
    temperatures = [f"T{chip}" for chip in range(chips_n)]
    wanted = ["indent", "phase", "x_mm", "y_mm", *temperatures, *fields, "Fx", "Fy", "Fz"]
    _check_columns(names, wanted, where)
    contact = _contact_rows([row[names.index("phase")].strip() for row in cells[1:]], where)
    numeric = [name for name in wanted if name != "phase"]
    columns = [names.index(name) for name in numeric]
    picked = [[row[i] for i in columns] for row in cells[1:]]
    numbers = to_numbers(picked, where, names=numeric, first_line_n=FIRST_LINE_N)

    def pick(chosen: list[str]) -> Float64[np.ndarray, "f c"]:
        return numbers[:, [numeric.index(name) for name in chosen]]

    table = _Table(
        press=_number_presses(numbers[:, 0], where),
        contact=contact,
        place_mm=pick(["x_mm", "y_mm"]),
        b_uT=pick(fields),
        temperature_degC=pick(temperatures),
        force_N=pick(["Fx", "Fy", "Fz"]),
        ignored_columns_n=len(names) - len(wanted),
    )
    _check_table(table, where)
    return table


def _check_columns(names: list[str], wanted: list[str], where: str) -> None:
    missing = [name for name in wanted if name not in names]
    if missing:
        got = f"none named {', '.join(missing)}"
        raise CaptureError(where, "columns", "those of data/README.md", got, "Is this layout lab, line 1 its names?")
    twice = [name for name, times_n in Counter(names).items() if times_n > 1]
    if twice:
        raise CaptureError(where, "names of columns", "unique", f"{twice[0]} twice", "Remove one of the two.")


def _contact_rows(phases: list[str], where: str) -> Bool[np.ndarray, " f"]:
    for row_i, phase in enumerate(phases):
        if phase not in PHASES:
            place = f"phase in line {FIRST_LINE_N + row_i}"
            raise CaptureError(where, place, "noload or contact", repr(phase[:20]), "Mend the word.")
    if "contact" not in phases:
        raise CaptureError(where, "the file", "rows of phase contact", "none", "Was the recording cut?")
    return np.array([phase == "contact" for phase in phases])


def _number_presses(indent: Float64[np.ndarray, " f"], where: str) -> Int[np.ndarray, " f"]:
    begins = np.flatnonzero(np.diff(indent, prepend=np.nan) != 0)
    seen: set[float] = set()
    for row_i in begins:
        if indent[row_i] in seen:
            got = f"{indent[row_i]:g} once more in line {FIRST_LINE_N + row_i}"
            raise CaptureError(where, "indent", "one block of rows a number", got, "Was the file joined twice?")
        seen.add(indent[row_i])
    return np.repeat(np.arange(len(begins)), np.diff(begins, append=len(indent)))


def _check_table(table: _Table, where: str) -> None:
    """Check units and signs, and that a press has one place."""
    check_fields(table.b_uT, where, first_line_n=FIRST_LINE_N)
    for axis in range(3):
        check_forces(table.force_N[:, axis], where, first_line_n=FIRST_LINE_N)
    check_touch(table.force_N[table.contact], where)
    pressed_N = float(np.median(table.force_N[table.contact, 2]))
    if pressed_N > 0:
        remedy = "Is compression negative Fz in this file? Turn its sign."
        raise CaptureError(where, "the usual Fz in contact", "negative", f"{pressed_N:.4g} N", remedy)
    check_places(table.place_mm, where)
    begins = np.flatnonzero(np.diff(table.press, prepend=-1))
    moved = np.flatnonzero((table.place_mm != table.place_mm[begins][table.press]).any(axis=1))
    if len(moved):
        got = f"another in line {FIRST_LINE_N + moved[0]}"
        raise CaptureError(where, "an indent's place", "one x_mm, y_mm", got, "Give each press its own indent.")


def _noload_field(table: _Table, noload: Bool[np.ndarray, " f"], where: str) -> Float64[np.ndarray, "n ch"]:
    """Give each press the mean field of its no-load rows."""
    of_press = table.press[noload]
    rows_n = np.bincount(of_press, minlength=table.press[-1] + 1)
    without = np.flatnonzero(rows_n == 0)
    if len(without):
        got = f"none in the block from line {FIRST_LINE_N + int(np.argmax(table.press == without[0]))}"
        remedy = "Remove the block, or record it again."
        raise CaptureError(where, "each indent", "given noload rows that were read", got, remedy)
    sums_uT = np.zeros((len(rows_n), table.b_uT.shape[1]))
    np.add.at(sums_uT, of_press, table.b_uT[noload])
    return sums_uT / rows_n[:, None]


def _count_within(press: Int[np.ndarray, " f"]) -> Int[np.ndarray, " f"]:
    """Count 0, 1, 2 ... within each block of equal numbers."""
    begins = np.flatnonzero(np.diff(press, prepend=-1))
    return np.arange(len(press)) - np.repeat(begins, np.diff(begins, append=len(press)))
