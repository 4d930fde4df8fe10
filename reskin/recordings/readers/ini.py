"""Read layout `ini`: a 3-D printer with a force gauge presses the skin; two text files have one row per indentation.

One file contains the readings. The other file contains the truths, which are the places and forces. Rows with a force
below 0.02 N count as rows without contact, even if the truths state a place. Their place becomes NaN, and their force
becomes 0. A pass is one visit to all places of the grid. In the first rows of a pass, the indenter is off the skin, at
a corner of the grid. The no-load field of the pass is the mean field of these corner rows. `t_s` and `depth_mm` are
unknown (NaN).

The fields may lag behind the truths: row i of the truths then belongs to a later row of the readings. The header may
state the lag in rows (option `rows_late`). Otherwise, the lag is estimated: the norm |dB| of the field change is
correlated with the force at several lags, and the lag with the highest correlation is used if this correlation is
clearly higher than without a lag. If the lag changes within a recording, a row is missing in one of the files, and the
recording is refused.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int32

from reskin.errors import CaptureError
from reskin.recordings.fault_policy import CheckedRows, FaultPolicy, check_rows
from reskin.recordings.header import Header
from reskin.recordings.readers.alignment import find_change, find_passes
from reskin.recordings.tables import count_columns, make_readings, mean_by_group, read_rows
from reskin.recordings.units import check_fields, check_labels
from reskin.schema import Readings

READINGS = "readings.txt"
TRUTHS = "truths.txt"
FILES = (READINGS, TRUTHS)
# For forces below this value, the recorder writes (x, y, F) = (10, 10, 0). The place alone does not identify these
# rows, because (10, 10) is also a real place.
CONTACT_MIN_N = 0.02
VALUES_PER_CHIP_N = 4
ROWS_LATE = ("0", "1", "2", "3", "4", "5")
# An estimated lag is used only if the recording has at least LATE_ROWS_MIN_N rows, and if the correlation with this lag
# exceeds the correlation without a lag by at least LATE_GAIN_MIN. In the public recording of 23300 rows, the lag
# increases the correlation from 0.45 to 0.65.
LATE_ROWS_MIN_N, LATE_GAIN_MIN = 100, 0.1

Account = dict[str, int]


def collect(recording: Path) -> dict[str, Path]:
    """Find the two files of a recording: the readings `b20_NAME.txt`, and `truths_NAME.txt` in the same folder."""
    if not recording.is_file() or recording.name.startswith("truths_"):
        raise CaptureError(
            f"{recording}: this is not the text file of readings. Add b20_NAME.txt instead of truths_NAME.txt."
        )
    names = [f"truths_{recording.name.partition('_')[2]}", f"truths_{recording.name}"]
    truths = [recording.with_name(name) for name in names if recording.with_name(name).is_file()]
    if not truths:
        raise CaptureError(
            f"{recording}: there is no {' or '.join(names)} in the same folder. Copy the truths file to this folder, "
            "under one of these names."
        )
    return {READINGS: recording, TRUTHS: truths[0]}


def count_chips(files: Mapping[str, Path]) -> int:
    """Count the chips from the number of columns of the readings, which has four columns (X, Y, Z, T) for each chip."""
    where = str(files[READINGS])
    columns_n = count_columns(files[READINGS], where)
    if columns_n % VALUES_PER_CHIP_N:
        raise CaptureError(
            f"{where}: {columns_n} columns cannot be X, Y, Z, T for each chip. Check that the layout is ini."
        )
    return columns_n // VALUES_PER_CHIP_N


def read(folder: Path, header: Header, policy: FaultPolicy) -> tuple[Readings, Account]:
    """Return all fault-free rows as readings.

    The no-load field of a pass is the mean field of its corner rows, which are the rows before its first contact.
    """
    given_late_n = _rows_late(header)
    b_uT, temperature_degC, truths = _read_files(folder, header)
    if len(b_uT) <= (given_late_n or 0):
        raise CaptureError(
            f"{header.capture}: the recording has {len(b_uT)} rows, but option rows_late is {given_late_n}. If the "
            "recording was cut, copy the recording again."
        )
    rows = check_rows(
        b_uT, temperature_degC, header.expected_lsb_uT, where=f"{header.capture}/{READINGS}", policy=policy
    )
    best_late_n, is_reliable = _best_rows_late(b_uT, truths[:, 2], rows)
    late_n = given_late_n if given_late_n is not None else best_late_n if is_reliable else 0
    _check_lateness(b_uT, truths, rows, header)
    truths, rows = truths[: len(truths) - late_n], rows.part(slice(late_n, None))
    b_uT, temperature_degC, keep = b_uT[late_n:], temperature_degC[late_n:], rows.keep
    contact = truths[:, 2] >= CONTACT_MIN_N
    pass_i = find_passes(truths[:, :2], contact)
    corner = _corner_rows(pass_i, contact)
    place_mm = np.where(contact[:, None], truths[:, :2], np.nan)
    readings = make_readings(
        header,
        keep,
        indentation=np.arange(len(keep)),
        pass_i=pass_i,
        x_mm=place_mm[:, 0],
        y_mm=place_mm[:, 1],
        Fz_N=np.where(contact, truths[:, 2], 0.0),
        b_uT=b_uT,
        noload_uT=_noload_field(b_uT, pass_i, corner & keep, header),
        temperature_degC=temperature_degC,
        n_contacts=header.contacts_before_n + np.cumsum(contact) - contact,
    )
    return readings, {
        "rows_n": len(readings),
        "rows_read_n": len(keep) + late_n,
        **rows.account(),
        "dropped_no_partner_rows_n": late_n,
        "noload_rows_n": 0,
        "no_contact_rows_n": int((keep & ~contact).sum()),
        "corner_rows_n": int((keep & corner).sum()),
        "passes_n": int(pass_i.max()) + 1,
        "rows_late_n": late_n,
        "best_rows_late_n": best_late_n,
    }


def _read_files(
    folder: Path, header: Header
) -> tuple[Float64[np.ndarray, "f ch"], Float64[np.ndarray, "f k"], Float64[np.ndarray, "f 3"]]:
    """Read the fields, the temperatures of the chips in degC, and the truths: x in mm, y in mm and force in N."""
    where = f"{header.capture}/{READINGS}"
    names = [f"{value}{chip}" for chip in range(header.chips_n) for value in ("Bx", "By", "Bz", "T")]
    numbers = read_rows(folder / READINGS, where, names)
    per_chip = numbers.reshape(len(numbers), header.chips_n, VALUES_PER_CHIP_N)
    b_uT = per_chip[:, :, :3].reshape(len(numbers), -1)
    check_fields(b_uT, where)
    where, names = f"{header.capture}/{TRUTHS}", ["x_mm", "y_mm", "Fz_N"]
    truths = read_rows(folder / TRUTHS, where, names)
    # In kg or kN, all forces are below CONTACT_MIN_N, so each force above 0 is checked.
    check_labels(dict(zip(names, truths.T, strict=True)), truths[:, 2] > 0, where, first_line_n=1)
    if len(b_uT) != len(truths):
        got = f"{len(b_uT)} in {READINGS} and {len(truths)} in {TRUTHS}"
        raise CaptureError(
            f"{header.capture}: the two files have different numbers of rows, {got}. Use the truths file of the same "
            "recording."
        )
    return b_uT, per_chip[:, :, 3], truths


def _rows_late(header: Header) -> int | None:
    """Return the lag of the fields in rows, as stated in the header; None if it is not stated."""
    if "rows_late" not in header.options:
        return None
    rows_late = header.options["rows_late"]
    if rows_late not in ROWS_LATE:
        remedy = "Set this option to the number of rows by which the fields lag behind the truths."
        raise CaptureError(header.capture, "option rows_late", f"0 to {ROWS_LATE[-1]}", rows_late, remedy)
    return int(rows_late)


def _best_rows_late(
    b_uT: Float64[np.ndarray, "f ch"], force_N: Float64[np.ndarray, " f"], rows: CheckedRows
) -> tuple[int, bool]:
    """Return the lag in rows at which |dB| correlates best with the force, and whether this estimate is reliable."""
    correlations = []
    for rows_late_n in range(min(len(ROWS_LATE), len(force_N) - 1)):
        whole = rows.keep[rows_late_n:]
        late_uT, pressed_N = b_uT[rows_late_n:][whole], force_N[: len(whole)][whole]
        rest = pressed_N < CONTACT_MIN_N
        if not (rest.any() and len(np.unique(pressed_N)) > 1):
            return 0, False
        change_uT = np.linalg.norm(late_uT - late_uT[rest].mean(axis=0), axis=1)
        correlations.append(np.corrcoef(change_uT, pressed_N)[0, 1] if np.ptp(change_uT) > 0 else -1.0)
    if not correlations:
        return 0, False
    gain = float(max(correlations) - correlations[0])
    return int(np.argmax(correlations)), len(force_N) >= LATE_ROWS_MIN_N and gain >= LATE_GAIN_MIN


def _check_lateness(
    b_uT: Float64[np.ndarray, "f ch"], truths: Float64[np.ndarray, "f 3"], rows: CheckedRows, header: Header
) -> None:
    """Raise if the lag between fields and truths changes within a recording."""
    change = find_change(b_uT, truths, truths[:, 2] >= CONTACT_MIN_N, rows.keep)
    if change is None:
        return
    rows_n = abs(change.after - change.before)
    lost = f"{rows_n} row{'s' if rows_n > 1 else ''} of {'readings' if change.after < change.before else 'truths'}"
    lags = f"{change.before} rows before about row {change.row + 1}, by {change.after} from there on"
    remedy = (
        f"{lost} seem to be missing there. Cut both files before that row, or restore the missing rows, and add the "
        "recording again."
    )
    raise CaptureError(f"{header.capture}/{READINGS}: the fields lag behind their truths by {lags}. {remedy}")


def _corner_rows(pass_i: Int32[np.ndarray, " f"], contact: Bool[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Mark the corner rows: the rows of each pass before its first contact, when the indenter is off the skin."""
    touches_before_n = np.cumsum(contact)
    begins = np.flatnonzero(np.diff(pass_i, prepend=-1))
    before_pass_n = (touches_before_n - contact)[begins]
    return np.asarray(touches_before_n == before_pass_n[pass_i])


def _noload_field(
    b_uT: Float64[np.ndarray, "f ch"], pass_i: Int32[np.ndarray, " f"], corner: Bool[np.ndarray, " f"], header: Header
) -> Float64[np.ndarray, "f ch"]:
    """Return the no-load field of each row: the mean field over the corner rows of the row's pass."""
    noload_uT = mean_by_group(b_uT[corner], pass_i[corner], int(pass_i.max()) + 1)
    without = np.flatnonzero(np.isnan(noload_uT[:, 0]))
    if len(without):
        where = f"{header.capture}/{TRUTHS} line {int(np.argmax(pass_i == without[0])) + 1}"
        raise CaptureError(
            f"{where}: this pass does not begin with a fault-free row without contact (F < {CONTACT_MIN_N} N). "
            "At the start of each pass, the indenter must be off the skin. Remove this pass, or record it again."
        )
    return noload_uT[pass_i]
