"""The header of a capture, `header.json`: names, layout, units and clock.

A capture is a folder `data/raw/<scene>/<capture>/` with `header.json` and either the byte stream of a port
(`stream.bin`, `arrivals.csv`, `probe.csv`) or the unchanged files of a recording in another layout.
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from reskin import io
from reskin.board.wire import Wire
from reskin.errors import CaptureError
from reskin.recordings import ReaderLayout

RATE_MAX_HZ = 1e5
HEADER_FILE = "header.json"
STREAM_FILE = "stream.bin"
ARRIVALS_FILE = "arrivals.csv"
PROBE_FILE = "probe.csv"
LOG_FILE = "log.csv"

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"

Name = Annotated[str, Field(pattern=NAME)]
Source = Literal["simulated", "recorded"]
Layout = Literal["native", ReaderLayout, "sd-card"]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Clock(_Frozen):
    """Source of frame times: the file arrivals.csv, a constant rate, or the recording's own files (`recording`).

    `marks` are pairs (stream time, probe time) in seconds; each pair belongs to one event that both clocks recorded.
    Without marks, ingestion aligns the clocks by the contacts.
    """

    kind: Literal["arrivals", "rate", "recording"]
    rate_hz: Annotated[float, Field(gt=0, le=RATE_MAX_HZ)] | None
    marks: tuple[tuple[float, float], ...]

    @model_validator(mode="after")
    def _check_rate(self) -> "Clock":
        if (self.kind == "rate") != (self.rate_hz is not None):
            raise ValueError("rate_hz must be given for clock kind 'rate', and only for it")
        return self


class Firmware(_Frozen):
    """Gain and LSB of the magnetometers, as set by the firmware (MLX90393 data sheet, table 17)."""

    gain_sel: Annotated[int, Field(ge=0, le=7)]
    lsb_xy_uT: Annotated[float, Field(gt=0)]
    lsb_z_uT: Annotated[float, Field(gt=0)]


class Rate(_Frozen):
    """Frame rate and repeated readings, as the recorder measured them; see `reskin.board.rates.RateMeasurement`.

    `sent_hz` is the rate according to the board's clock (`method` is `clock`) or, if the board sends no time, the rate
    of arrival.
    """

    sent_hz: Annotated[float, Field(gt=0)]
    method: Literal["arrivals", "clock"]
    arrived_hz: Annotated[float, Field(gt=0)]
    repeated_frames: Annotated[float, Field(ge=0, le=1)]
    repeated_readings: Annotated[float, Field(ge=0, le=1)]


class Header(_Frozen):
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
    wire: Wire | None
    chips_n: Annotated[int, Field(ge=1, le=64)]
    unit_b: Literal["uT"]
    unit_force: Literal["N"]
    unit_place: Literal["mm"]
    firmware: Firmware | None
    clock: Clock
    protocol: str
    contacts_before_n: Annotated[int, Field(ge=0)]
    options: dict[str, str]
    files: dict[str, str]  # name -> sha256 of each file except this header
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
    """Parse a header from JSON; raise `CaptureError` naming the first field that is wrong."""
    try:
        return Header.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"])) or "header"
        value = "nothing" if first["type"] == "missing" else repr(first.get("input"))[:80]
        rule = first["msg"].removeprefix("Value error, ")
        raise CaptureError(f"{where}: {field}: {rule}; got {value}. Correct the header or record again.") from None


def make_header(where: str, **fields: Any) -> Header:
    """Create and check a header; by default, its fields suit a recording in another layout than `native`."""
    defaults: dict[str, Any] = {
        "format": "reskin-capture/1", "source": "recorded", "wire": None, "unit_b": "uT", "unit_force": "N",
        "unit_place": "mm", "firmware": None, "clock": Clock(kind="recording", rate_hz=None, marks=()),
        "contacts_before_n": 0, "options": {}, "files": {}, "rate": None,
    }  # fmt: skip
    values = defaults | fields
    return parse(render(Header.model_construct(**{name: values[name] for name in Header.model_fields})), where)


def render(header: Header) -> str:
    """Write a header as JSON, indented by two spaces, with keys in the order of `Header`; omit a rate of None."""
    without = {"rate"} if header.rate is None else set()
    return json.dumps(header.model_dump(mode="json", exclude=without), indent=2) + "\n"


def check_same_capture(header: Header, folder: str) -> None:
    """Raise if a capture folder has another name than its header states, for example after it was renamed."""
    if header.capture != folder:
        rule = f"the folder's name {folder!r}"
        raise CaptureError(f"{folder}/{HEADER_FILE}", "capture", rule, repr(header.capture), "Rename the folder.")


def write_capture(folder: Path, header: Header, contents: Mapping[str, bytes | Path]) -> Header:
    """Write the files of a capture (bytes, or paths to copy), and then the header with the hashes of these files.

    Returns the header that was written.
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
    """Write the header of a capture folder, with the hashes of the other files, and return it."""
    names = sorted(path.name for path in folder.iterdir() if path.name != HEADER_FILE)
    complete = header.model_copy(update={"files": {name: io.sha256(folder / name) for name in names}})
    io.write_text(folder / HEADER_FILE, render(complete))
    return complete
