"""Read layout `leaphand`: magnetic pads on the fingers of a robot hand that moves without touching anything.

The text file has one row per pose of the hand. A row contains the fields of all pads, and then the positions of all
joints. A pad is a board with five chips. A capture contains the readings of one pad, which option `pad` selects. The
file contains no times, temperatures or labels. By choosing this layout, the user states that nothing touches the pads.
Therefore, places are NaN and the normal force is 0. The recorder subtracted a baseline that the file does not contain.
Therefore, each channel of `b_uT` differs from the raw field by an unknown constant.

The no-load rows are the first `NOLOAD_ROWS_N` successive rows in which the hand hardly moves, and the no-load field is
their mean field. Joint positions are not part of `Readings`; `read_motion` returns them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from reskin.errors import CaptureError
from reskin.recordings.fault_policy import CheckedRows, FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.tables import count_columns, make_readings, only_file, read_rows
from reskin.recordings.units import check_fields
from reskin.schema import AXES_PER_CHIP_N, Readings

READINGS = "readings.txt"
FILES = (READINGS,)
CHIPS_N = 5  # number of chips of a pad
CHANNELS_N = AXES_PER_CHIP_N * CHIPS_N
JOINTS_N = 4  # number of joints of a finger; each finger has one pad
PADS_MAX_N = 4
COUNTS_PER_TURN = 4096  # the hand's servos give joint positions as whole numbers (counts) from 0 to 4095
NOLOAD_ROWS_N = 5
# In the no-load rows, each joint moves by at most this many counts, which are 4.4 degrees. In recordings of four pads,
# the hand rests in the first five rows. In recordings of two pads, the hand has another pose in the first row, and the
# joints move by up to 39 counts in the next five rows. Moves below this limit do not disturb the no-load field: if a
# pad rotates by 4.4 degrees, the earth's field along an axis changes by at most 5 uT, which is about the noise.
STILL_COUNTS = 50

Account = dict[str, int]


@dataclass(frozen=True)
class Motion:
    """The motion of the hand: the positions of all joints, and the fields of the no-load rows.

    `joint_counts` has one row for each of the readings that `read` returns.
    """

    joint_counts: Int64[np.ndarray, "f j"]
    noload_uT: Float64[np.ndarray, "n ch"]


class _Pad(NamedTuple):
    """All rows of one pad, the result of the check for faults, and which rows are no-load rows and which readings."""

    b_uT: Float64[np.ndarray, "f ch"]
    joint_counts: Int64[np.ndarray, "f j"]
    rows: CheckedRows
    is_noload: Bool[np.ndarray, " f"]
    is_reading: Bool[np.ndarray, " f"]
    pads_n: int  # in the file


def collect(recording: Path) -> dict[str, Path]:
    """Find the file of a recording: the text file itself."""
    return {READINGS: only_file(recording, "leaphand")}


def count_chips(files: Mapping[str, Path]) -> int:
    """Check the number of columns, and return the number of chips of one pad, because a capture has one pad."""
    where = str(files[READINGS])
    _count_pads(files[READINGS], where)
    return CHIPS_N


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return all fault-free rows after the no-load rows as readings without contact."""
    pad = _read_pad(folder, header, policy)
    noload, keep = pad.is_noload, pad.is_reading
    zeros = np.zeros(len(keep))
    readings = make_readings(
        header,
        keep,
        indentation=zeros,
        pass_i=zeros,
        reading_i=np.cumsum(keep) - 1,
        Fz_N=zeros,
        b_uT=pad.b_uT,
        noload_uT=np.broadcast_to(pad.b_uT[noload].mean(axis=0), pad.b_uT.shape),
        n_contacts=zeros + header.contacts_before_n,
    )
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(keep),
        "noload_rows_n": int(noload.sum()),
        "dropped_before_noload_rows_n": int((pad.rows.keep & ~noload & ~keep).sum()),
        **pad.rows.account(),
        "baseline_subtracted_rows_n": len(readings),
        "ignored_pads_n": pad.pads_n - 1,
    }


def read_motion(folder: Path, header: Header, policy: FaultPolicy) -> Motion:
    """Return the joint positions in the readings that `read` returns, and the field of each no-load row."""
    pad = _read_pad(folder, header, policy)
    return Motion(pad.joint_counts[pad.is_reading], pad.b_uT[pad.is_noload])


def _read_pad(folder: Path, header: Header, policy: FaultPolicy) -> _Pad:
    """Read the file of a capture, select the pad, and find the faulty rows and the no-load rows."""
    where = f"{header.capture}/{READINGS}"
    pads_n = _count_pads(folder / READINGS, where)
    if header.chips_n != CHIPS_N:
        raise CaptureError(
            f"{where}: the header says {header.chips_n} chips, but a pad has {CHIPS_N}. Correct the header."
        )
    first = CHANNELS_N * (_pad_number(header, pads_n) - 1)
    fields = [f"B{axis}{chip} of pad {pad + 1}" for pad in range(pads_n) for chip in range(CHIPS_N) for axis in "xyz"]
    joints = [f"joint {joint + 1}" for joint in range(JOINTS_N * pads_n)]
    numbers = read_rows(folder / READINGS, where, [*fields, *joints])
    b_uT, joint_counts = numbers[:, first : first + CHANNELS_N], numbers[:, len(fields) :]
    check_fields(b_uT, where, subtracted=True)
    wrong = (joint_counts != np.rint(joint_counts)) | (joint_counts < 0) | (joint_counts >= COUNTS_PER_TURN)
    if wrong.any():
        row_i, joint_i = np.argwhere(wrong)[0]
        rule, got = f"whole numbers from 0 to {COUNTS_PER_TURN - 1}", f"{joint_counts[row_i, joint_i]:.6g}"
        place = f"{joints[joint_i]} in line {row_i + 1}, in counts of its servo,"
        remedy = "The last columns must be joint positions. If they are angles, convert them to counts."
        raise CaptureError(where, place, rule, got, remedy)
    unknown_degC = np.full((len(b_uT), CHIPS_N), np.nan)
    rows = check_rows(b_uT, unknown_degC, header.expected_lsb_uT, where=where, policy=policy)
    after_rest = np.arange(len(b_uT)) - _find_rest(joint_counts, where)
    is_noload = (after_rest >= 0) & (after_rest < NOLOAD_ROWS_N) & rows.keep
    is_reading = (after_rest >= NOLOAD_ROWS_N) & rows.keep
    if not is_noload.any() or not is_reading.any():
        what = "all rows after the no-load rows" if is_noload.any() else "all no-load rows"
        raise CaptureError(f"{where}: {what} have faults. Check the pad, and record again.")
    return _Pad(b_uT, joint_counts.astype(np.int64), rows, is_noload, is_reading, pads_n)


def _count_pads(file: Path, where: str) -> int:
    """Return the number of pads, from the number of columns."""
    columns_n, per_pad_n = count_columns(file, where), CHANNELS_N + JOINTS_N
    if columns_n % per_pad_n or not 1 <= columns_n // per_pad_n <= PADS_MAX_N:
        rule = f"{CHANNELS_N} fields and {JOINTS_N} joint positions for each of 1 to {PADS_MAX_N} pads"
        raise CaptureError(where, "the number of columns", rule, columns_n, "Check that the layout is leaphand.")
    return columns_n // per_pad_n


def _pad_number(header: Header, pads_n: int) -> int:
    got = header.options.get("pad", "none")
    if got not in {str(pad) for pad in range(1, pads_n + 1)}:
        rule = f"1 to {pads_n}, the number of pads in the file"
        remedy = "Add each pad as a separate capture, and state the number of the pad with --pad."
        raise CaptureError(header.capture, "option pad", rule, got, remedy)
    return int(got)


def _find_rest(joint_counts: Float64[np.ndarray, "f j"], where: str) -> int:
    """Return the index of the first no-load row.

    The no-load rows are the first `NOLOAD_ROWS_N` successive rows in which the hand is at rest, which means that no
    joint moves by more than `STILL_COUNTS`. Raises `CaptureError` if there are no such rows, or no row after them.
    """
    for first_i in range(len(joint_counts) - NOLOAD_ROWS_N):
        if np.ptp(joint_counts[first_i : first_i + NOLOAD_ROWS_N], axis=0).max() <= STILL_COUNTS:
            return first_i
    raise CaptureError(
        f"{where}: no {NOLOAD_ROWS_N} successive rows, followed by others, in which every joint stays within "
        f"{STILL_COUNTS} counts. Begin the recording with the hand at rest."
    )
