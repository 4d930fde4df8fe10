"""The probe log `probe.csv`: places, depths and forces of the rig, one row per dwell, on the rig's own clock.

Rows are in chronological order. A dwell is a time in which the robot does not move. An indentation begins with one
no-load dwell, in which the robot is lifted. One contact dwell follows or, if the robot drags the indenter over the
skin, several contact dwells.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool, Float32, Float64, Int32

from reskin.errors import CaptureError
from reskin.recordings import tables
from reskin.recordings.tables import refuse_row

NOLOAD, CONTACT = "noload", "contact"
LABELS = ("x_mm", "y_mm", "depth_mm", "Fx_N", "Fy_N", "Fz_N")
TYPES = {
    "indentation": pa.int32(),
    "pass_i": pa.int32(),
    "phase": pa.string(),
    "t_start_s": pa.float64(),
    "t_end_s": pa.float64(),
    **dict.fromkeys(LABELS, pa.float32()),
}


@dataclass(frozen=True)
class ProbeLog:
    """The dwells of one capture, as arrays with one element per dwell.

    `contact` is True for phase `contact`, and False for phase `noload`, in which the robot is lifted. Unknown places,
    depths and forces are NaN. Forces have the signs of `reskin.schema`.
    """

    indentation: Int32[np.ndarray, " d"]
    pass_i: Int32[np.ndarray, " d"]
    contact: Bool[np.ndarray, " d"]
    t_start_s: Float64[np.ndarray, " d"]
    t_end_s: Float64[np.ndarray, " d"]
    x_mm: Float32[np.ndarray, " d"]
    y_mm: Float32[np.ndarray, " d"]
    depth_mm: Float32[np.ndarray, " d"]
    Fx_N: Float32[np.ndarray, " d"]
    Fy_N: Float32[np.ndarray, " d"]
    Fz_N: Float32[np.ndarray, " d"]

    def __len__(self) -> int:
        return len(self.indentation)


def parse(source: str | Path, where: str) -> ProbeLog:
    """Parse a probe log from CSV text (`source` is a str) or from a file (`source` is a path).

    Raises `CaptureError` if a row is wrong; the error names the first such row.
    """
    table = tables.parse_csv(source, TYPES, where)
    if not len(table):
        raise CaptureError(f"{where}: the probe log has no rows. Record the capture again.")
    for name in ("indentation", "pass_i", "phase", "t_start_s", "t_end_s"):
        unknown = np.asarray(table.column(name).is_null())
        remedy = "Fill in this field: only places, depths and forces may be empty."
        refuse_row(unknown, where, name, "known", "an empty field", remedy)
    phases = table.column("phase")
    rule = f"{NOLOAD} or {CONTACT}"
    is_other = np.asarray(pc.invert(pc.is_in(phases, pa.array([NOLOAD, CONTACT]))))
    refuse_row(is_other, where, "phase", rule, phases, f"Write {rule} in this field.")
    numbers = {name: np.asarray(table.column(name)) for name in TYPES if name != "phase"}
    log = ProbeLog(contact=np.asarray(pc.equal(phases, CONTACT)), **numbers)
    _check(log, where)
    return log


def render(log: ProbeLog) -> str:
    """Return a probe log as CSV text, from which `parse` returns the same log."""
    arrays = {name: getattr(log, name) for name in TYPES if name != "phase"}
    arrays["phase"] = np.where(log.contact, CONTACT, NOLOAD)
    # With `from_pandas`, NaN becomes null, which is written as an empty field.
    fields = {name: pa.array(arrays[name], kind, from_pandas=True) for name, kind in TYPES.items()}
    return tables.render_csv(pa.table(fields))


def _check(log: ProbeLog, where: str) -> None:
    """Raise `CaptureError` for the first row with an invalid number, or in a wrong order."""
    for name in ("indentation", "pass_i"):
        values = getattr(log, name)
        refuse_row(values < 0, where, name, "0 or more", values, "Number indentations and passes from 0.")
    start_s, end_s, number = log.t_start_s, log.t_end_s, log.indentation
    rule = "later than t_start_s in the same row"
    refuse_row(end_s <= start_s, where, "t_end_s", rule, end_s, "Correct the times in this row.")
    overlaps, rule = np.append(False, start_s[1:] < end_s[:-1]), "no earlier than t_end_s in the row above"
    refuse_row(overlaps, where, "t_start_s", rule, start_s, "Sort the rows by time.")
    falls, rule = np.diff(number, prepend=number[0]) < 0, "no smaller than in the row above"
    refuse_row(falls, where, "indentation", rule, number, "Do not restart the numbering in a new pass.")
    begins = np.diff(number, prepend=-1) != 0
    remedy = "Each indentation must have one row of phase noload, followed by one or more rows of phase contact."
    refuse_row(begins & log.contact, where, "the phase of the first row of an indentation", NOLOAD, CONTACT, remedy)
    refuse_row(~begins & ~log.contact, where, "the phase of the later rows of an indentation", CONTACT, NOLOAD, remedy)
