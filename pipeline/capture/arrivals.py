"""When the bytes came: a time for every frame. In: `arrivals.csv`, or a constant rate. Out: `t_s` of each frame.

A row says that `byte_end` bytes in all had come at `t_s` on the host's clock; a recorder that writes `0` and its
start time first makes the first chunk as well known as the others. Refuses to know what a frame holds.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float64, Int64

from pipeline.capture import columns
from pipeline.core.errors import CaptureError

TYPES = {"byte_end": pa.int64(), "t_s": pa.float64()}


@dataclass(frozen=True)
class Arrivals:
    """The chunks of a stream in order, axis c: bytes come in all, and when."""

    byte_end: Int64[np.ndarray, " c"]
    t_s: Float64[np.ndarray, " c"]

    def __len__(self) -> int:
        return len(self.byte_end)


def parse(source: str | Path, where: str) -> Arrivals:
    """Read arrivals from CSV text, or from the file at a path; raise `CaptureError` naming the first bad row."""
    table = columns.parse(source, TYPES, where)
    if len(table) < 2:
        raise CaptureError(where, "arrivals", "two rows or more", len(table), "Give a rate in the header.")
    byte_end, t_s = (table.column(name).to_numpy() for name in TYPES)
    for bad, name, rule in (
        (~np.isfinite(byte_end), "byte_end", "known"),  # Arrow gives NaN for an empty field
        (~np.isfinite(t_s), "t_s", "a finite time"),
        (byte_end < 0, "byte_end", "0 or more"),
        (np.diff(byte_end, prepend=-1) <= 0, "byte_end", "more than in the row above"),
        (np.diff(t_s, prepend=t_s[0]) < 0, "t_s", "not before the row above"),
    ):
        columns.refuse(bad, where, name, rule, {"byte_end": byte_end, "t_s": t_s}[name], "Record the capture again.")
    if t_s[-1] == t_s[0]:
        got = f"{t_s[0]} in every row"
        raise CaptureError(where, "arrivals", "spread in time", got, "Mend the recorder's clock.")
    return Arrivals(byte_end, t_s)


def render(arrivals: Arrivals) -> str:
    """Write arrivals as CSV; `parse` gives the same arrivals back."""
    return columns.render(pa.table({name: getattr(arrivals, name) for name in TYPES}))


def times_of(end_byte: Int64[np.ndarray, " f"], arrivals: Arrivals) -> Float64[np.ndarray, " f"]:
    """Give each frame the time of its last byte, on a straight line between the ends of the chunks around it.

    A byte came before its chunk was read and, but for the port's buffer, after the one before it was: the error is
    less than the time between the two. Frames of the first chunk lie on a line at the stream's mean rate. A frame
    past the last chunk has no time: NaN.
    """
    byte_end, t_s = arrivals.byte_end, arrivals.t_s
    s_per_byte = (t_s[-1] - t_s[0]) / (byte_end[-1] - byte_end[0])
    before_s = np.minimum(end_byte - byte_end[0], 0) * s_per_byte
    return np.interp(end_byte, byte_end, t_s, right=np.nan) + before_s


def constant_rate(frame: Float64[np.ndarray, " f"], rate_hz: float) -> Float64[np.ndarray, " f"]:
    """Give each frame the time of its place in a stream of constant rate; 0 at the start of the stream.

    `frame` is the place in frames: bytes up to its end over bytes a frame, where frames have one length, so that
    broken bytes keep their time; else a running count. Frames lost before the dump shift all that follow.
    """
    return frame / rate_hz
