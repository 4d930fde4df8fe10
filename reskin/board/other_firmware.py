"""Formats of other firmware: lines of numbers, or binary frames with a header, a counter or a checksum.

A user describes such a format on the command line (`text:Bx0,By0,Bz0,...`) or in a YAML file; docs/live.md has
examples.
"""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from pydantic import Field, model_validator

from reskin.board.wire import LF, TEXT_WIRES, Frames, Wire, record_type
from reskin.config import Strict, parse, read_yaml
from reskin.errors import ParamsError, did_you_mean

IGNORED = "-"  # name of columns that are not used
COLUMN = re.compile(r"(?:B[xyz]|T)(\d{1,2})|t_s|-")
NUMBER = {
    point: re.compile(rb"(?<![A-Za-z_\d.])[-+]?\d+(?:[" + point + rb"]\d*)?(?:[eE][-+]?\d+)?") for point in (b".", b",")
}
NUMBERS = {"float32": "f4", "float64": "f8", "int16": "i2", "int32": "i4"}
LINE_BYTES_MAX_N = 4096  # longer lines are no frames
PREFIX = "text:"

Hex = Annotated[str, Field(pattern=r"^(?:[0-9A-Fa-f]{2})*$", max_length=32)]


class CustomWire(Strict):
    """The format of the frames of one firmware.

    - kind: `text`, lines of numbers with any separator, or `binary`, frames of a fixed number of bytes
    - columns: names of the numbers in order: Bx0, By0, Bz0, ... (fields), T0, ... (temperatures, which may be missing),
      t_s (time of the board) or - (ignored)
    - uT: what a field of 1 is in uT
    - decimal_comma: whether numbers in a text have commas in place of points
    - header, end: bytes at the start and at the end of a binary frame, in hexadecimal digits
    - skipped_n: number of bytes after the header that are not used, such as a counter
    - number, big_endian: how numbers are stored in a binary frame
    - checksum: one byte before `end`, computed from all bytes before it: `none`, `sum8` or `xor8`
    """

    kind: Literal["text", "binary"]
    columns: Annotated[tuple[str, ...], Field(min_length=3, max_length=4 * 64 + 8)]
    uT: Annotated[float, Field(gt=0)] = 1.0
    decimal_comma: bool = False
    header: Hex = ""
    skipped_n: Annotated[int, Field(ge=0, le=64)] = 0
    number: Literal["float32", "float64", "int16", "int32"] = "float32"
    big_endian: bool = False
    checksum: Literal["none", "sum8", "xor8"] = "none"
    end: Hex = ""

    @model_validator(mode="after")
    def _check(self) -> "CustomWire":
        for name in self.columns:
            if not COLUMN.fullmatch(name):
                raise ValueError(f"columns: {name} is not Bx0, By0, Bz0, T0, ..., t_s or -")
        named = [name for name in self.columns if name != IGNORED]
        if len(set(named)) < len(named):
            raise ValueError("columns: a name occurs twice")
        fields = [f"B{axis}{chip}" for chip in range(self.chips_n) for axis in "xyz"]
        if missing := [name for name in fields if name not in named]:
            raise ValueError(f"columns: {', '.join(missing)} is missing; each chip needs Bx, By and Bz")
        if self.kind == "binary" and not (self.header or self.end or self.checksum != "none"):
            raise ValueError("a binary frame needs a header, an end or a checksum, by which it is found")
        return self

    @property
    def chips_n(self) -> int:
        """Number of chips of the board."""
        return 1 + max((int(match[1]) for name in self.columns if (match := re.fullmatch(r"Bx(\d+)", name))), default=0)

    @property
    def frame_bytes_n(self) -> int:
        """Number of bytes of a binary frame."""
        ends = len(self.header + self.end) // 2 + self.skipped_n + (self.checksum != "none")
        return ends + len(self.columns) * self._dtype.itemsize

    @property
    def _dtype(self) -> np.dtype[np.generic]:
        return np.dtype((">" if self.big_endian else "<") + NUMBERS[self.number])

    def __str__(self) -> str:
        return f"{self.kind} of {len(self.columns)} columns"

    def scan(self, octets: UInt8[np.ndarray, " bytes"]) -> tuple[Frames, Counter[str], int]:
        """Find the frames in a buffer of bytes that begins after the previous frame or line.

        Returns the frames, counts of bytes and frames as in `reskin.board.stream.ACCOUNT`, and the number of settled
        bytes: those that need not be scanned again when more bytes arrive.
        """
        find = self._lines if self.kind == "text" else self._records
        values, end_byte, length_n, settled_n = find(octets)
        frames = self._frames(values, end_byte)
        finite = np.isfinite(frames.b_uT).all(axis=1)
        count = Counter(
            frame_bytes_n=int(length_n[finite].sum()),
            not_finite_frames_n=int((~finite).sum()),
            skipped_not_finite_bytes_n=int(length_n[~finite].sum()),
        )
        return frames.where(finite), count, settled_n

    def _lines(
        self, octets: UInt8[np.ndarray, " bytes"]
    ) -> tuple[Float64[np.ndarray, "f c"], Int64[np.ndarray, " f"], Int64[np.ndarray, " f"], int]:
        ends = np.flatnonzero(octets == LF) + 1
        point = b"," if self.decimal_comma else b"."
        rows, end_byte, length_n, start = [], [], [], 0
        for end in ends.tolist():
            numbers = NUMBER[point].findall(octets[start:end].tobytes())
            if len(numbers) == len(self.columns):
                rows.append([float(number.replace(b",", b".")) for number in numbers])
                end_byte.append(end)
                length_n.append(end - start)
            start = end
        too_long = len(octets) - start > LINE_BYTES_MAX_N
        values = np.array(rows, float).reshape(-1, len(self.columns))
        return values, np.array(end_byte, int), np.array(length_n, int), len(octets) if too_long else start

    def _records(
        self, octets: UInt8[np.ndarray, " bytes"]
    ) -> tuple[Float64[np.ndarray, "f c"], Int64[np.ndarray, " f"], Int64[np.ndarray, " f"], int]:
        n = self.frame_bytes_n
        starts = self._starts(octets)
        chosen, position = [], 0
        for start in np.flatnonzero(starts).tolist():
            if start >= position:
                chosen.append(start)
                position = start + n
        first = np.array(chosen, int)
        body = len(self.header) // 2 + self.skipped_n
        rows = octets[first[:, None] + body + np.arange(len(self.columns) * self._dtype.itemsize)]
        values = np.ascontiguousarray(rows).view(self._dtype).reshape(len(first), len(self.columns)).astype(float)
        # The last bytes may be the start of a frame whose other bytes have not arrived yet.
        return values, first + n, np.full(len(first), n), max(position, len(octets) - n + 1)

    def _starts(self, octets: UInt8[np.ndarray, " bytes"]) -> Bool[np.ndarray, " starts"]:
        """Mark the positions at which a whole frame begins."""
        n = self.frame_bytes_n
        count_n = max(len(octets) - n + 1, 0)
        if not count_n:
            return np.zeros(0, bool)
        windows = np.lib.stride_tricks.sliding_window_view(octets, n)
        marked = np.ones(count_n, bool)
        for text, at in ((self.header, 0), (self.end, n - len(self.end) // 2)):
            for i, value in enumerate(bytes.fromhex(text)):
                marked &= windows[:, at + i] == value
        if self.checksum != "none":
            at = n - len(self.end) // 2 - 1
            rows = windows[marked]
            add = np.bitwise_xor if self.checksum == "xor8" else np.add
            marked[marked] = add.reduce(rows[:, :at], axis=1, dtype=np.uint8) == rows[:, at]
        return marked

    def _frames(self, values: Float64[np.ndarray, "f c"], end_byte: Int64[np.ndarray, " f"]) -> Frames:
        at = {name: i for i, name in enumerate(self.columns)}
        unknown = np.full(len(values), np.nan)

        def column(name: str) -> np.ndarray:
            return values[:, at[name]] if name in at else unknown

        fields = [self.uT * column(f"B{axis}{chip}") for chip in range(self.chips_n) for axis in "xyz"]
        temperatures = [column(f"T{chip}") for chip in range(self.chips_n)]
        b_uT, temperature_degC = (np.stack(parts, axis=1).astype(np.float32) for parts in (fields, temperatures))
        return Frames(b_uT, temperature_degC, column("t_s"), end_byte)


AnyWire = Wire | CustomWire


def is_line(wire: AnyWire) -> bool:
    """Return whether the frames of a format are lines of text."""
    return wire.kind == "text" if isinstance(wire, CustomWire) else wire in TEXT_WIRES


def frame_bytes_of(wire: AnyWire, chips_n: int) -> int | None:
    """Return the number of bytes of a frame; None for lines of text, whose lengths vary."""
    if is_line(wire):
        return None
    return wire.frame_bytes_n if isinstance(wire, CustomWire) else record_type(wire, chips_n).itemsize


def read_wire(text: str, where: str = "--wire") -> AnyWire:
    """Read a format: the name of a known one, `text:` with the names of columns, or the name of a YAML file.

    Raises ParamsError, whose message begins with `where`, if the text is none of these.
    """
    known = {name: name for name in get_args(Wire)}
    if text in known:
        return known[text]
    if text.startswith(PREFIX):
        columns = [name.strip() for name in text.removeprefix(PREFIX).split(",")]
        return parse(CustomWire, {"kind": "text", "columns": columns}, where)
    if Path(text).suffix in (".yaml", ".yml"):
        return parse(CustomWire, read_yaml(Path(text)), text)
    names: Sequence[str] = (*known, f"{PREFIX}Bx0,By0,Bz0,...", "FILE.yaml")
    raise ParamsError(f"{where}: {text!r} is no format. Use {', '.join(names)}.{did_you_mean(text, known)}")


def custom_wire(text: str | None, where: str = "--wire") -> CustomWire | None:
    """Return the format of other firmware; None for no text and for known formats, because those are detected."""
    wire = None if text is None else read_wire(text, where)
    return wire if isinstance(wire, CustomWire) else None
