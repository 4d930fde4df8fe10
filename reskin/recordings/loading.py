"""Load recordings: a log as arrays, or a recording of any kind as a pandas DataFrame with units.

A log is a sequence of frames without labels.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from reskin import io
from reskin.board.wire import Frames, concatenate
from reskin.errors import CaptureError, ParamsError, ReskinError, missing_package
from reskin.recordings.decode import BLOCK_BYTES_N, decode_blocks, frame_columns, read_frame_blocks
from reskin.recordings.fault_policy import STANDARD_POLICY, check_log
from reskin.recordings.header import LOG_FILE, PROBE_FILE, RATE_MAX_HZ, STREAM_FILE, Header, write_capture
from reskin.recordings.ingest import open_capture, read_header, timer
from reskin.recordings.preparing import UNNAMED, CaptureNames, foreign, layouts_of
from reskin.recordings.readers import READERS, sd_card
from reskin.recordings.tables import TableFile
from reskin.schema import LABELS, UNITS, Readings, unit_of

if TYPE_CHECKING:
    import pandas as pd

EXTRA = "learn"  # the extra of pyproject.toml that installs pandas


def read_any_log(log: Path, rate_hz: float) -> sd_card.Log:
    """Read all frames of a log; see `read_log_blocks`."""
    account: dict[str, int] = {}
    parts = list(read_log_blocks(log, rate_hz, account))
    frames = concatenate(parts, parts[0].temperature_degC.shape[1])
    return frames.device_s, frames.b_uT, frames.temperature_degC, account


def read_log_blocks(log: Path, rate_hz: float, account: dict[str, int]) -> Iterator[Frames]:
    """Yield the fault-free frames of a log, with their times in `device_s`; at the end, count all in `account`.

    A log is a capture folder, a table that `reskin decode` wrote, or the log of an SD card. `rate_hz` is the frame rate
    of a table that has no times. The parts are those of `fault_policy.check_log`.
    """
    if log.is_dir():
        header = read_header(log)
        if header.layout != "sd-card":
            return _read_capture(log, header, account)
        log /= LOG_FILE
    elif not 0 < rate_hz <= RATE_MAX_HZ:
        raise ParamsError(f"--rate-hz (rate_hz): {rate_hz:g} must be above 0 and at most {RATE_MAX_HZ:g}.")
    elif log.is_file() and io.is_parquet(log):
        return check_log(read_frame_blocks(log, rate_hz, account), str(log), account)
    return check_log(sd_card.read_blocks(log, account), str(log), account)


def _read_capture(folder: Path, header: Header, account: dict[str, int]) -> Iterator[Frames]:
    """Read the frames of a capture; drop frames after the last recorded arrival, because their times are unknown."""
    if header.wire is None:
        raise CaptureError(
            f"{folder}: cannot predict from a capture of layout {header.layout}. Use a capture that `reskin record` "
            "wrote, or the log of an SD card."
        )
    stream, untimed = folder / STREAM_FILE, "dropped_no_time_frames_n"
    blocks = decode_blocks(io.read_blocks(stream, BLOCK_BYTES_N), header.wire, header.chips_n, str(stream), account)

    def timed() -> Iterator[Frames]:
        times_of, frames_n, untimed_n = timer(folder, header), 0, 0
        for frames in blocks:
            t_s = times_of(frames, frames_n)
            known, number = np.isfinite(t_s), frames_n + 1 + np.arange(len(frames))
            yield replace(frames, device_s=t_s, end_byte=number).where(known)
            frames_n, untimed_n = frames_n + len(frames), untimed_n + int((~known).sum())
        account[untimed] = untimed_n

    return check_log(timed(), str(stream), account)


def load_recording(path: Path, *, frames: bool, rate_hz: float) -> "pd.DataFrame":
    """Load a recording as a DataFrame (see `reskin.load_recording`)."""
    try:
        import pandas as pd
    except ImportError:
        raise missing_package("pandas", "load_recording", extra=EXTRA) from None
    try:
        return _load(pd, path, frames=frames, rate_hz=rate_hz)
    except ReskinError as error:
        if hint := _hint(path, frames=frames):
            raise type(error)(f"{error} {hint}") from None
        raise


def _hint(path: Path, *, frames: bool) -> str:
    """Return a text with advice on how to load a recording that cannot be loaded; "" if there is no advice."""
    layouts = [layout for layout in layouts_of(path) if layout != "table"]
    if layouts == ["capture"]:
        return "" if frames else "To load the frames without labels, set frames=True."
    if set(layouts) <= READERS.keys():
        return (
            f"This is layout {' or '.join(layouts)}. Convert it to a capture with `reskin add`, and load this capture."
            if layouts
            else ""
        )
    return "This is a dump of a serial port. Convert it to a table with `reskin decode`, and load this table."


def _load(pd: Any, path: Path, *, frames: bool, rate_hz: float) -> "pd.DataFrame":
    names_of: Mapping[str, str] = {}  # text column -> the value that all its rows have
    if path.is_dir():
        header = read_header(path)
        is_log = header.layout == "sd-card" or (header.layout == "native" and not (path / PROBE_FILE).is_file())
        kind = "log" if is_log or (frames and header.layout == "native") else "labelled"
        names_of = {name: getattr(header, name) for name in LABELS}
    else:
        kind = kind_of(path)
    if kind != "log":
        if frames:
            raise ParamsError(
                f"{path}: only captures that `reskin record` wrote have frames. Omit the argument frames=True."
            )
        readings, counts = READ[kind](path)
        return _readings_frame(pd, readings, counts)
    t_s, b_uT, temperature_degC, counts = read_any_log(path, rate_hz)
    channels = [name for name, unit in frame_columns(temperature_degC.shape[1]).items() if unit in ("uT", "degC")]
    measured = dict(zip(channels, [*b_uT.T, *temperature_degC.T], strict=True))
    return _frame(pd, {**names_of, "t_s": t_s, **measured}, counts)


def kind_of(file: Path) -> str:
    """Return the kind of a file: `table` or `ingested` if it has the column names of this kind, and `log` otherwise."""
    if not file.is_file():
        raise CaptureError(f"{file}: file not found. Check the path.")
    names = TableFile(file, str(file)).names
    return "table" if "phase" in names else "ingested" if set(UNITS) <= set(names) else "log"


def _read_labelled(folder: Path) -> tuple[Readings, Mapping[str, int]]:
    """Return those readings of a capture that are in contact, and the account."""
    _, blocks, account = open_capture(folder, STANDARD_POLICY)
    parts = list(blocks)
    if not parts:
        raise CaptureError(
            f"{folder}: no reading can be used (counts: {dict(account)}). Check the labels of the capture and the "
            "faults in these counts."
        )
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in UNITS}
    return replace(parts[0], **joined), account


def _read_ingested(file: Path) -> tuple[Readings, Mapping[str, int]]:
    return io.read_readings(file), io.read_ingest_counts(file)


def _read_table(file: Path) -> tuple[Readings, Mapping[str, int]]:
    """Return those readings of a file of layout `table` that are in contact, and the account."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", file.stem).lstrip("_-")[:64]
    header, files = foreign(file, "table", CaptureNames(UNNAMED, UNNAMED, name or None), {})
    with TemporaryDirectory() as folder:
        copy = Path(folder) / header.capture
        write_capture(copy, header, files)
        _, (readings,), account = open_capture(copy, STANDARD_POLICY)
        return readings, account


READ = {"labelled": _read_labelled, "ingested": _read_ingested, "table": _read_table}


def _readings_frame(pd: Any, readings: Readings, counts: Mapping[str, int]) -> "pd.DataFrame":
    """Convert readings to a DataFrame with one column per channel, and with the field changes."""
    columns: dict[str, Any] = {name: getattr(readings, name) for name in LABELS}
    channels = [name for name, unit in frame_columns(readings.chips_n).items() if unit == "uT"]
    for name in UNITS:
        values = getattr(readings, name)
        if name == "temperature_degC":
            columns |= {f"temperature{chip}_degC": column for chip, column in enumerate(values.T)}
        elif name == "b_uT":
            columns |= dict(zip(channels, values.T, strict=True))
        elif name == "noload_uT":
            columns |= {f"noload_{channel}": column for channel, column in zip(channels, values.T, strict=True)}
            change_uT = readings.b_uT - readings.noload_uT
            columns |= {f"d{channel}": column for channel, column in zip(channels, change_uT.T, strict=True)}
        else:
            columns[name] = values
    return _frame(pd, columns, counts)


def _frame(pd: Any, columns: Mapping[str, Any], counts: Mapping[str, int]) -> "pd.DataFrame":
    units = {name: "" if name in LABELS else unit_of(name) for name in columns}
    frame = pd.DataFrame(columns)
    frame.attrs = {"units": units, "counts": dict(counts)}
    return frame
