"""The header of a capture, `header.json`: names, layout, units and clock.

A capture is a folder `data/raw/<scene>/<capture>/` that contains `header.json` and the files of a recording. In layout
`native`, these files are `stream.bin` (the bytes that a port sent), `arrivals.csv` (their times of arrival) and
`probe.csv` (places and forces). In other layouts, they are the unchanged files of another program's recording.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from reskin import io
from reskin.board.other_firmware import AnyWire
from reskin.config import Strict
from reskin.errors import CaptureError
from reskin.recordings import ReaderLayout

RATE_MAX_HZ = 1e5
HEADER_FILE = "header.json"
STREAM_FILE = "stream.bin"
ARRIVALS_FILE = "arrivals.csv"
PROBE_FILE = "probe.csv"
LOG_FILE = "log.csv"

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
NAME_RULE = "1 to 64 of the characters A-Z a-z 0-9 _ -, and begin with a letter or a digit"  # NAME in words

Name = Annotated[str, Field(pattern=NAME)]
Source = Literal["simulated", "recorded"]
Layout = Literal["native", ReaderLayout, "sd-card"]


class Clock(Strict):
    """The source of the times of frames.

    `kind` is `arrivals` if the times are in the file arrivals.csv, `rate` if they are computed from the constant frame
    rate `rate_hz`, and `recording` if they are in the files of a recording in another layout. `marks` are sync marks:
    pairs (stream time, probe time) in seconds of the same event, which both clocks recorded. If there are no marks, the
    clocks are aligned by the contacts when the capture is ingested.
    """

    kind: Literal["arrivals", "rate", "recording"]
    rate_hz: Annotated[float, Field(gt=0, le=RATE_MAX_HZ)] | None
    marks: tuple[tuple[float, float], ...]

    @model_validator(mode="after")
    def _check_rate(self) -> "Clock":
        if (self.kind == "rate") != (self.rate_hz is not None):
            raise ValueError("rate_hz must be given for clock kind 'rate', and only for it")
        return self


class Firmware(Strict):
    """The gain of the magnetometers, as set by the firmware, and the resulting LSB (MLX90393 data sheet, table 17)."""

    gain_sel: Annotated[int, Field(ge=0, le=7)]
    lsb_xy_uT: Annotated[float, Field(gt=0)]
    lsb_z_uT: Annotated[float, Field(gt=0)]


class Rate(Strict):
    """The frame rate and the fraction of repeated readings, as the recorder measured them.

    `sent_hz` is the rate according to the board's clock if `method` is `clock`. If `method` is `arrivals`, the board
    has no usable clock, and `sent_hz` is the rate of arrival. See `reskin.board.rates.RateMeasurement`.
    """

    sent_hz: Annotated[float, Field(gt=0)]
    method: Literal["arrivals", "clock"]
    arrived_hz: Annotated[float, Field(gt=0)]
    repeated_frames: Annotated[float, Field(ge=0, le=1)]
    repeated_readings: Annotated[float, Field(ge=0, le=1)]


class Header(Strict):
    """The header of a capture. All fields except `rate` must be present in the file.

    A capture has no `rate` if it was recorded by another program, or by a version of this program that did not measure
    rates.
    """

    format: Literal["reskin-capture/1"]
    capture: Name
    board: Name
    skin: Name
    source: Source
    layout: Layout
    wire: AnyWire | None
    chips_n: Annotated[int, Field(ge=1, le=64)]
    unit_b: Literal["uT"]
    unit_force: Literal["N"]
    unit_place: Literal["mm"]
    firmware: Firmware | None
    clock: Clock
    protocol: str
    contacts_before_n: Annotated[int, Field(ge=0)]
    options: dict[str, str]
    files: dict[str, str]  # names of all files except this header -> their SHA-256 hashes
    note: str
    rate: Rate | None = None

    @property
    def expected_lsb_uT(self) -> tuple[float, float] | None:
        """LSB along x and y, and LSB along z, from the firmware's settings; None if these are unknown."""
        return None if self.firmware is None else (self.firmware.lsb_xy_uT, self.firmware.lsb_z_uT)

    @model_validator(mode="after")
    def _check_wire(self) -> "Header":
        if (self.layout == "native") != (self.wire is not None):
            raise ValueError("wire must be given for layout 'native', and only for it")
        return self


def parse(text: str, where: str) -> Header:
    """Parse a header from JSON; if a field is wrong, raise `CaptureError`, which names the first such field."""
    try:
        return Header.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"])) or "header"
        value = "nothing" if first["type"] == "missing" else repr(first.get("input"))[:80]
        rule = first["msg"].removeprefix("Value error, ")
        raise CaptureError(
            f"{where}: {field}: {rule}; got {value}. Correct the header, or record the capture again."
        ) from None


def make_header(where: str, **fields: Any) -> Header:
    """Create and check a header.

    Fields that are not given have default values, which are right for a recording in another layout than `native`.
    """
    defaults: dict[str, Any] = {
        "format": "reskin-capture/1", "source": "recorded", "wire": None, "unit_b": "uT", "unit_force": "N",
        "unit_place": "mm", "firmware": None, "clock": Clock(kind="recording", rate_hz=None, marks=()),
        "contacts_before_n": 0, "options": {}, "files": {}, "rate": None,
    }  # fmt: skip
    values = defaults | fields
    return parse(render(Header.model_construct(**{name: values[name] for name in Header.model_fields})), where)


def render(header: Header) -> str:
    """Return a header as JSON, indented by two spaces, with keys in the order of `Header`.

    Key `rate` is omitted if the rate is None.
    """
    without = {"rate"} if header.rate is None else set()
    return json.dumps(header.model_dump(mode="json", exclude=without), indent=2) + "\n"


def write_header(folder: Path, header: Header) -> None:
    """Write the header of a capture that is being recorded; it is on the disk when the function returns."""
    with io.replacing(folder / HEADER_FILE) as temporary:
        temporary.write_text(render(header), encoding="utf-8")
        io.sync(temporary)
    io.sync(folder)


def write_capture(folder: Path, header: Header, contents: Mapping[str, bytes | Path]) -> Header:
    """Write the files of a capture, and then the header with the hashes of these files; return the written header.

    `contents` maps the name of each file to its bytes, or to the path of a file to copy.
    """
    with io.replacing(folder) as temporary:
        temporary.mkdir()
        for name, content in contents.items():
            if isinstance(content, Path):
                shutil.copyfile(content, temporary / name)
            else:
                (temporary / name).write_bytes(content)
        return seal(temporary, header)


def seal(folder: Path, header: Header) -> Header:
    """Write the header of a capture folder with the hashes of all other files in it; return the written header."""
    names = sorted(path.name for path in folder.iterdir() if path.name != HEADER_FILE)
    complete = header.model_copy(update={"files": {name: io.sha256(folder / name) for name in names}})
    io.write_text(folder / HEADER_FILE, render(complete))
    return complete
