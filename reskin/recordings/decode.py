"""Decode a serial dump (the bytes that a port sent) to a table with one row per frame, and read such a table."""

import numpy as np
import pyarrow as pa
from jaxtyping import Float32, Float64

from reskin.board.custom import AnyWire
from reskin.board.stream import decode_all
from reskin.board.wire import record_type
from reskin.errors import CaptureError
from reskin.recordings import clocks


def decode_dump(data: bytes, wire: AnyWire, chips_n: int, where: str) -> tuple[pa.Table, dict[str, int]]:
    """Decode a serial dump to a table, and count its bytes and frames; raise `CaptureError` if it has no frames.

    The unit of each column is in the metadata of its Arrow field.
    """
    frames, account = decode_all(data, wire, chips_n, where)
    values = [*frames.b_uT.T, *frames.temperature_degC.T, frames.device_s, frames.end_byte]
    fields = [
        pa.field(name, pa.from_numpy_dtype(column.dtype), metadata={"unit": unit})
        for (name, unit), column in zip(frame_columns(chips_n).items(), values, strict=True)
    ]
    arrays = [pa.array(np.ascontiguousarray(column)) for column in values]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields)), account


def read_frames(
    table: pa.Table, rate_hz: float, where: str, account: dict[str, int]
) -> tuple[Float64[np.ndarray, " f"], Float32[np.ndarray, "f ch"], Float32[np.ndarray, "f k"]]:
    """Return time in s, field in uT and temperature in degC of the frames of a decoded dump.

    If every frame has a time of the board's clock, these times are returned; `account` says if their resolution was too
    coarse. Otherwise, times are computed from the
    constant frame rate `rate_hz`. In binary formats, they are computed from the positions of the frames in the stream,
    so that lost bytes also count as time. In text formats, they are computed from the numbers of the frames.
    """
    chips_n = sum(name.startswith("temperature") for name in table.column_names)
    if table.column_names != list(frame_columns(chips_n)):
        names = ", ".join(table.column_names)[:80]
        raise CaptureError(
            f"{where}: the columns {names} are not those that `reskin decode` writes. Decode the dump again, with "
            "`reskin decode`."
        )
    values = [np.asarray(column) for column in table.columns]
    device_s, end_byte = values[-2:]
    if np.isfinite(device_s).all():
        clock = clocks.BoardClock()
        t_s = clock.times_of(device_s, end_byte)
        account.update(clock.account)
    else:
        # Text frames are longer than binary frames. If any frame has the length of a binary frame, the format is
        # binary.
        frame_bytes_n = record_type("binary", chips_n).itemsize
        is_binary = (np.diff(end_byte, prepend=0) == frame_bytes_n).any()
        t_s = clocks.constant_rate(end_byte / frame_bytes_n if is_binary else 1.0 + np.arange(len(table)), rate_hz)
    return t_s, np.stack(values[: 3 * chips_n], axis=1), np.stack(values[3 * chips_n : -2], axis=1)


def frame_columns(chips_n: int) -> dict[str, str]:
    """Return the columns of a decoded dump in order, as a mapping from the column's name to its unit."""
    names = {f"b{axis}{chip}_uT": "uT" for chip in range(chips_n) for axis in "xyz"}
    return names | {f"temperature{chip}_degC": "degC" for chip in range(chips_n)} | {"device_s": "s", "end_byte": "1"}
