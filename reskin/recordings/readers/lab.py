"""Read layout `lab`: a robot presses a skin, and a six-axis gauge measures the force.

A recording is one CSV file for each depth, with about 100 readings per indentation. It is a table whose columns `LAB`
converts. `depth_mm` is NaN, because only an index of the depth is known, which is in the file's name. `t_s` is NaN,
because the file contains no times.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int

from reskin.errors import CaptureError
from reskin.recordings.column_map import Column, ColumnMap, Fields, convert
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.header import Header
from reskin.recordings.readers import table
from reskin.recordings.tables import FIRST_ROW, TableFile, count_chips_of, only_file
from reskin.schema import Readings

READINGS = "readings.csv"
FILES = (READINGS,)
# The file contains the force on the gauge, so the signs of all three components are reversed. The axes of the gauge may
# differ from those of the places, so the sign was derived separately for each axis.
# For z: Fz is negative in compression, but the force on the skin must be positive in compression.
# For x: on both public boards, indentations shift the skin by 48 um along +x (experiment `compare` fits this shift to
# the fields alone). The mean Fx is negative in all six files, so the force on the skin has the opposite sign.
# For y: the shift and the mean force are too small for a decision. However, the sign of Fz implies that the gauge's z
# axis points into the skin. If the gauge's axes are right-handed, its y axis then has the direction of the y axis of
# the places.
LAB = ColumnMap(
    fields=Fields(Bx="Bx{}", By="By{}", Bz="Bz{}", T="T{}"),
    phase="phase",
    columns={
        "indentation": "indent", "x_mm": "x_mm", "y_mm": "y_mm",
        "Fx_N": Column(of="Fx", sign=-1), "Fy_N": Column(of="Fy", sign=-1), "Fz_N": Column(of="Fz", sign=-1),
    },
)  # fmt: skip


def collect(recording: Path) -> dict[str, Path]:
    """Find the file of a recording. A recording is one CSV file with the presses of one skin at one depth."""
    return {READINGS: only_file(recording, "lab")}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the names of the columns."""
    return count_chips_of(TableFile(files[READINGS], str(files[READINGS])).names)


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, dict[str, int]]:
    """Return the contact rows as readings.

    The no-load field of a press is the mean field of its rows with phase `noload`.
    """
    rows = _read_rows(folder, header, policy)
    readings, account = table.to_readings(rows, header)
    del account["passes_n"], account["no_depth_rows_n"]  # a file has one pass, and its depth is never known
    columns_n = len(TableFile(folder / READINGS, rows.where).names)
    return readings, account | {"ignored_columns_n": columns_n - (1 + len(LAB.columns) + 4 * header.chips_n)}


def read_noload(
    folder: Path, header: Header, policy: FaultPolicy
) -> tuple[Int[np.ndarray, " a"], Float64[np.ndarray, "a ch"]]:
    """Return the press number and the field of each fault-free row of phase `noload`.

    Presses have the same numbers as the indentations of the readings that `read` returns.
    """
    rows = _read_rows(folder, header, policy)
    noload = ~rows.contact & rows.checked.keep
    return rows.press[noload], rows.b_uT[noload]


def _read_rows(folder: Path, header: Header, policy: FaultPolicy) -> table.Rows:
    """Read the file of a capture; check that each press has one block of rows, one place and no-load rows."""
    where = f"{header.capture}/{READINGS}"
    rows = table.check_table(convert(folder / READINGS, LAB, where), header, policy, where)
    numbers, sound = rows.numbers, ~rows.contact & rows.checked.keep
    begins = table.find_blocks(numbers["indentation"], np.arange(len(sound)), where)
    first = np.repeat(begins, np.diff(begins, append=len(sound)))  # the first row of each row's indent
    without = begins[~np.isin(begins, first[sound])]
    if len(without):
        raise CaptureError(
            f"{where}: the indent from line {FIRST_ROW + without[0]} on has no fault-free noload row. Remove all "
            "rows of this indent, or record them again."
        )
    moved = (numbers["x_mm"] != numbers["x_mm"][first]) | (numbers["y_mm"] != numbers["y_mm"][first])
    if moved.any():
        raise CaptureError(
            f"{where}: the place changes within an indent, in line {FIRST_ROW + int(moved.argmax())}. Give each "
            "press an indent number of its own."
        )
    return rows
