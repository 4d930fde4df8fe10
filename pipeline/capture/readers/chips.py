"""Can the chips of a recording be believed? In: all its fields. Out: the rows in which every chip was read.

A failed read or a stuck chip costs a row; a chip of another scale than its header or neighbours costs the recording,
as nobody knows what its numbers mean. Refuses to know layouts, and to mend anything.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from pipeline.capture import faults
from pipeline.capture.header import Header
from pipeline.core.errors import CaptureError

GRID_ROWS_N = 1000  # real recordings show each sound chip's grid in blocks of 400 rows; in 200 it may hide


class Rows(NamedTuple):
    """What became of each row: `whole` ones hold a reading of every chip; the others failed or, if not, are stuck."""

    whole: Bool[np.ndarray, " f"]
    failed: Bool[np.ndarray, " f"]
    stuck: Bool[np.ndarray, " f"]

    def losses(self) -> dict[str, int]:
        """Count the rows that are not whole, as accounts do."""
        return {
            "dropped_failed_read_rows_n": int(self.failed.sum()),
            "dropped_stuck_chip_rows_n": int(self.stuck.sum()),
        }

    def part(self, rows: slice) -> "Rows":
        """Keep some of the rows."""
        return Rows(self.whole[rows], self.failed[rows], self.stuck[rows])


def find_whole_rows(
    b_uT: Float[np.ndarray, "f ch"], temperature_degC: Float[np.ndarray, "f k"], header: Header, *, where: str
) -> Rows:
    """Tell the rows that hold a reading of every chip; raise if there is none, or if a chip's scale is unknown."""
    failed = np.asarray(faults.failed_reads(b_uT, temperature_degC).any(axis=1))
    if failed.all():
        remedy = "Mend the wiring, and record again."
        raise CaptureError(where, "rows", "read from every chip", "failed I2C reads in all of them", remedy)
    rows = np.flatnonzero(~failed)
    for block in np.array_split(rows, max(1, len(rows) // GRID_ROWS_N)):
        _check_scale(b_uT[block], header, where=f"{where} from row {block[0] + 1}")
    stuck = np.asarray(faults.stuck_chips(b_uT).any(axis=1)) & ~failed
    return Rows(~failed & ~stuck, failed, stuck)


def _check_scale(b_uT: Float[np.ndarray, "f ch"], header: Header, *, where: str) -> None:
    """Check a block of rows, as a chip may lose its settings on the way."""
    firmware = header.firmware
    expected_uT = None if firmware is None else (firmware.lsb_xy_uT, firmware.lsb_z_uT)
    lsb_uT = faults.find_lsb(b_uT)
    hidden = np.isnan(lsb_uT).any(axis=1)
    without = hidden & (not hidden.all()) & (len(b_uT) >= GRID_ROWS_N)
    strange = np.flatnonzero(faults.reset_chips(b_uT, expected_uT) | without)
    if len(strange):
        names = f"the LSB of chip {', '.join(map(str, strange))}"
        rule = "that of the other chips, and not a reset chip's" if firmware is None else f"{expected_uT} uT"
        got = (
            "no one step" if without[strange[0]] else "{:.3g} uT in x, y and {:.3g} uT in z".format(*lsb_uT[strange[0]])
        )
        raise CaptureError(where, names, rule, got, "A chip lost its settings: reset the board, record again.")
