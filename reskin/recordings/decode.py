"""Decode a serial dump (the bytes that a port sent) to a table with one row per frame, and read such a table.

Both work block by block, so that a dump may be longer than the memory.
"""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from jaxtyping import Float64, Int64

from reskin import io
from reskin.board.faults import MICROS_WRAP_S, clock_resolution_s, clock_steps
from reskin.board.other_firmware import AnyWire
from reskin.board.stream import FrameStream, no_frame
from reskin.board.wire import Frames, record_type
from reskin.errors import CaptureError

BLOCK_BYTES_N = 2**24  # bytes of a dump that are decoded at once; they become one row group of a Parquet file
BLOCK_ROWS_N = 2**16  # rows of a table that are read at once


def decode_file(dump: Path, out: Path, wire: AnyWire, chips_n: int) -> dict[str, int]:
    """Decode a serial dump to a CSV file (if the name of `out` ends in .csv) or a Parquet file.

    Returns the counts of bytes and frames. Raises CaptureError if there are no frames. The unit of each column is in
    the metadata of its Arrow field.
    """
    account: dict[str, int] = {}
    fields = [
        pa.field(
            name, pa.float64() if unit == "s" else pa.int64() if unit == "1" else pa.float32(), metadata={"unit": unit}
        )
        for name, unit in frame_columns(chips_n).items()
    ]
    schema = pa.schema(fields)
    with io.replacing(out) as temporary, ExitStack() as opened:
        if out.suffix == ".csv":
            file = opened.enter_context(temporary.open("wb"))
            file.write(",".join(schema.names).encode() + b"\n")
            options = pacsv.WriteOptions(include_header=False, quoting_style="none")
            writer = opened.enter_context(pacsv.CSVWriter(file, schema, write_options=options))
        else:
            writer = opened.enter_context(
                pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True)
            )
        for frames in decode_blocks(io.read_blocks(dump, BLOCK_BYTES_N), wire, chips_n, str(dump), account):
            writer.write_table(_table(frames, schema))
    return account


def decode_blocks(
    blocks: Iterable[bytes], wire: AnyWire, chips_n: int, where: str, account: dict[str, int]
) -> Iterator[Frames]:
    """Decode the blocks of a stream; at its end, add the counts of bytes and frames to `account`.

    Raises CaptureError if the whole stream contains no frame.
    """
    stream, head = FrameStream(wire, chips_n), b""
    for block in blocks:
        head = head or block
        if len(frames := stream.feed(block)):
            yield frames
    if len(frames := stream.close()):
        yield frames
    counts = stream.account()
    if not counts["frames_n"]:
        raise no_frame(where, head, wire, chips_n, bytes_n=counts["bytes_n"])
    account.update(counts)


def _table(frames: Frames, schema: pa.Schema) -> pa.Table:
    values = [*frames.b_uT.T, *frames.temperature_degC.T, frames.device_s, frames.end_byte]
    return pa.Table.from_arrays([pa.array(np.ascontiguousarray(column)) for column in values], schema=schema)


class BoardClock:
    """The times of frames on the board's clock, continued where micros() starts again from 0 (after 71.6 minutes).

    The board sends the time in s as float32. After hours, the resolution of this number is coarser than the time
    between two frames. The frames are then spread evenly, in proportion to their positions in the stream, between the
    first and the last time. Frames may be passed in several parts. `account` counts the frames whose times are spread,
    and states the resolution.
    """

    def __init__(self) -> None:
        self.account: dict[str, int] = {}
        self._offset_s = 0.0
        self._last: tuple[float, float, int] | None = None  # device time, time and position of the last frame

    def times_of(
        self, device_s: Float64[np.ndarray, " f"], end_byte: Int64[np.ndarray, " f"]
    ) -> Float64[np.ndarray, " f"]:
        """Return the times in s of the next frames; `end_byte` is the position of their ends in the stream."""
        if not len(device_s):
            return device_s
        device_s = device_s.astype(np.float64)
        last_device_s, begin_s, begin_byte = self._last or (device_s[0], device_s[0], end_byte[0])
        wraps = clock_steps(device_s, last_device_s) != np.diff(device_s, prepend=last_device_s)
        t_s = device_s + self._offset_s + MICROS_WRAP_S * np.cumsum(wraps)
        self._offset_s += MICROS_WRAP_S * int(wraps.sum())
        resolution_s, lasts_s = clock_resolution_s(device_s), t_s[-1] - begin_s
        if lasts_s > 0 and resolution_s > lasts_s / len(t_s) / 2:
            t_s = begin_s + (end_byte - begin_byte) * (lasts_s / (end_byte[-1] - begin_byte))
            self.account["coarse_clock_frames_n"] = self.account.get("coarse_clock_frames_n", 0) + len(t_s)
            self.account["clock_resolution_us"] = round(1e6 * resolution_s)
        self._last = float(device_s[-1]), float(t_s[-1]), int(end_byte[-1])
        return t_s


def read_frame_blocks(file: Path, rate_hz: float, account: dict[str, int]) -> Iterator[Frames]:
    """Yield the frames of a decoded dump; `device_s` is their time in s, and `end_byte` the number of their row.

    If the frames have times of the board's clock, these times are used; at the end, `account` says if their resolution
    was too coarse. Otherwise, times are computed from the constant frame rate `rate_hz`. In binary formats, they are
    computed from the positions of the frames in the stream, so that lost bytes also count as time. In text formats,
    they are computed from the numbers of the frames.
    """
    where = str(file)
    clock, rows_n, last_byte, has_clock, is_binary = BoardClock(), 0, 0, None, None
    for table in io.read_batches(file, BLOCK_ROWS_N):
        chips_n = sum(name.startswith("temperature") for name in table.column_names)
        if table.column_names != list(frame_columns(chips_n)):
            names = ", ".join(table.column_names)[:80]
            raise CaptureError(
                f"{where}: the columns {names} are not those that `reskin decode` writes. Decode the dump again, with "
                "`reskin decode`."
            )
        *columns, device_s, end_byte = (np.asarray(column) for column in table.columns)
        b_uT, temperature_degC = (
            np.stack(part, axis=1, dtype=np.float32, casting="same_kind")
            for part in (columns[: 3 * chips_n], columns[3 * chips_n :])
        )
        end_byte = end_byte.astype(np.int64)
        row_n = rows_n + 1 + np.arange(len(table))
        timed = np.isfinite(device_s)
        if has_clock is None:
            has_clock = bool(timed.all())
            # Text frames are longer than binary frames. If any frame has the length of a binary frame, the format is
            # binary.
            is_binary = bool((np.diff(end_byte, prepend=last_byte) == record_type("binary", chips_n).itemsize).any())
        if has_clock and not timed.all():
            row = row_n[timed.argmin()]
            raise CaptureError(
                f"{where} row {row}: device_s is missing, but earlier rows have it. Decode the dump again."
            )
        if has_clock:
            t_s = clock.times_of(device_s, end_byte)
        else:
            frame = end_byte / record_type("binary", chips_n).itemsize if is_binary else row_n.astype(np.float64)
            t_s = frame / rate_hz
        yield Frames(b_uT, temperature_degC, t_s, row_n)
        rows_n, last_byte = rows_n + len(table), int(end_byte[-1]) if len(table) else last_byte
    account.update(clock.account)


def frame_columns(chips_n: int) -> dict[str, str]:
    """Return the columns of a decoded dump in order, as a mapping from the column's name to its unit."""
    names = {f"b{axis}{chip}_uT": "uT" for chip in range(chips_n) for axis in "xyz"}
    return names | {f"temperature{chip}_degC": "degC" for chip in range(chips_n)} | {"device_s": "s", "end_byte": "1"}
