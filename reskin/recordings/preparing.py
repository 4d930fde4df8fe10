"""Prepare a recording of any layout for `reskin add`: make the header of the new capture, and collect its files.

The capture itself is written by `header.write_capture`.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from reskin import io
from reskin.board import stream
from reskin.board.other_firmware import AnyWire
from reskin.board.wire import TEXT_WIRES
from reskin.errors import CaptureError, ParamsError, ReskinError
from reskin.recordings import ReaderLayout, clocks, column_map
from reskin.recordings import header as headers
from reskin.recordings import probe as probe_log
from reskin.recordings.fault_policy import REFUSE_NONE
from reskin.recordings.header import Clock, Header
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import READERS, table
from reskin.recordings.tables import count_chips_of, is_number

NATIVE_FILES = (headers.STREAM_FILE, headers.ARRIVALS_FILE, headers.PROBE_FILE)
UNNAMED = "unnamed"  # name of the board and of the skin in a recording that was made without names

Marks = tuple[tuple[float, float], ...]  # sync marks: pairs of stream time and probe time of the same event
Prepared = tuple[Header, Mapping[str, bytes | Path]]


@dataclass(frozen=True)
class CaptureNames:
    """The names of a board, a skin and a capture.

    If the name of the capture is None, its name is made from the names of the board, the skin and the recording's file.
    """

    board: str
    skin: str
    name: str | None


def parse_marks(texts: list[str]) -> Marks:
    """Parse sync marks, each of which is written as `STREAM_S,PROBE_S`.

    >>> parse_marks(["0,12.5"])
    ((0.0, 12.5),)
    """
    marks = []
    for text in texts:
        stream_s, comma, probe_s = text.partition(",")
        if not comma or not (is_number(stream_s) and is_number(probe_s)):
            raise CaptureError("--mark", "a mark", "STREAM_S,PROBE_S in seconds", repr(text), "Example: --mark 0,12.5")
        marks.append((float(stream_s), float(probe_s)))
    return tuple(marks)


@contextmanager
def suggesting_layout(recording: Path, layout: str) -> Iterator[None]:
    """Add a suggestion to the errors of a `with` block: the layouts in which the recording can be read.

    An error is not changed if the recording can be read in `layout`, because the layout is then right. A `ParamsError`
    is not changed either, because it is about names or options.
    """
    try:
        yield
    except ParamsError:
        raise
    except ReskinError as error:
        layouts = layouts_of(recording)
        if not layouts or layout in layouts:
            raise
        raise type(error)(
            f"{error} It can be read with {' or '.join(f'--layout {name}' for name in layouts)}."
        ) from None


def layouts_of(recording: Path) -> list[str]:
    """List the layouts in which a recording can be read."""
    if (recording / headers.HEADER_FILE).is_file():
        return ["capture"]
    if layouts := [layout for layout in get_args(ReaderLayout) if _is_readable(recording, layout)]:
        # A recording of another layout may also be readable in layout `table`, but would lose its labels. Therefore,
        # suggest `table` only if no other layout is possible.
        return [layout for layout in layouts if layout != "table"] or layouts
    formats = stream.matching_formats(io.read_bytes(recording)) if recording.is_file() else []
    return sorted({"serial-text" if wire in TEXT_WIRES else "serial-binary" for wire, _ in formats})


def _is_readable(recording: Path, layout: ReaderLayout) -> bool:
    required = {"eflesh": {"force_axis": "z"}, "leaphand": {"pad": "1"}}
    options = required.get(layout, {})
    try:
        prepared = foreign(recording, layout, CaptureNames("board", "skin", None), options)
        with TemporaryDirectory() as folder:
            copy = Path(folder) / "it"
            READERS[layout].read(copy, headers.write_capture(copy, *prepared), REFUSE_NONE)
    except ReskinError:
        return False
    return True


def foreign(recording: Path, layout: ReaderLayout, names: CaptureNames, options: Mapping[str, str]) -> Prepared:
    """Prepare a recording in a layout that has a reader: make a header, and find the files, which are not changed."""
    _check_exists(recording, folder=True)
    files = READERS[layout].collect(recording)
    chips_n = READERS[layout].count_chips(files)
    return _header(names, recording, layout=layout, chips_n=chips_n, options=dict(options)), files


def mapped(recording: Path, names: CaptureNames, map_file: Path) -> Prepared:
    """Prepare a table with other columns or units, converted by a map; see `column_map`."""
    _check_exists(recording)
    columns = column_map.read_map(map_file)
    converted = column_map.convert(recording, columns)
    content = pa.BufferOutputStream()
    pq.write_table(converted, content)
    header = _header(names, recording, layout="table", chips_n=count_chips_of(converted.column_names), options={})
    note = f"converted by reskin add from {recording.name} with {map_file.name}"
    header = header.model_copy(update={"note": note, "source": columns.source})
    return header, {table.PARQUET: content.getvalue().to_pybytes()}


def dump(
    recording: Path,
    names: CaptureNames,
    *,
    wire: AnyWire,
    chips_n: int,
    rate_hz: float,
    probe: Path | None,
    marks: Marks = (),
) -> Prepared:
    """Prepare a serial dump, which has only the bytes of a port; the times of frames follow from a constant rate."""
    if probe is None:
        raise CaptureError(
            f"{recording}: a serial dump needs its probe log. Add --probe PROBE.csv (columns in data/README.md)."
        )
    _check_exists(recording)
    _check_exists(probe)
    if not 0 < rate_hz <= headers.RATE_MAX_HZ:
        rule = f"above 0 and at most {headers.RATE_MAX_HZ:g}"
        raise CaptureError("--rate-hz", "the rate", rule, rate_hz, "State how many frames the board sends per second.")
    clock = Clock(kind="rate", rate_hz=rate_hz, marks=marks)
    header = _header(names, recording, layout="native", chips_n=chips_n, wire=wire, clock=clock)
    return header, {headers.STREAM_FILE: recording, headers.PROBE_FILE: probe}


def native(recording: Path, names: CaptureNames, probe: Path | None, marks: Marks) -> Prepared:
    """Prepare a capture folder that `reskin record` wrote.

    If `probe` is given, this file becomes the probe log of the capture.
    """
    _check_exists(recording, folder=True)
    header = read_header(recording)
    for option, given, in_header in (("--board", names.board, header.board), ("--skin", names.skin, header.skin)):
        if in_header not in (given, UNNAMED):
            raise CaptureError(
                f"{recording}: {option} is {given!r}, but the header says {in_header!r}. Correct the option, "
                "or correct header.json."
            )
    # The recorder lists its files in the header when it ends. If it was killed, the list is empty, so the files that
    # exist are collected too.
    files = {name: recording / name for name in NATIVE_FILES if (recording / name).exists() or name in header.files}
    marks_before = header.clock.marks
    if probe is not None:
        _check_exists(probe)
        # If the folder has a probe log, the marks in the header belong to this log. They are dropped, because `probe`
        # replaces the log.
        marks_before = () if headers.PROBE_FILE in files else marks_before
        files[headers.PROBE_FILE] = probe
    if headers.PROBE_FILE not in files:
        raise CaptureError(f"{recording}: the capture has no labels. Add --probe PROBE.csv, or record with --labels.")
    for name, file in files.items():
        _check_exists(file)
        if file.parent == recording and header.files.get(name, io.sha256(file)) != io.sha256(file):
            raise CaptureError(
                f"{file}: the file has changed since it was recorded (its hash differs). Record the capture again."
            )
    _check_names(names)
    clock = header.clock.model_copy(update={"marks": (*marks_before, *marks)})
    named = {"capture": names.name or header.capture, "board": names.board, "skin": names.skin}
    header = header.model_copy(update=named | {"clock": clock})
    return (header, files) if header.files or clock.kind != "arrivals" else _interrupted(recording, header, files)


def _interrupted(folder: Path, header: Header, files: dict[str, Path]) -> Prepared:
    """Prepare the whole part of a recording that was interrupted, for example by a power cut.

    The end of each file may be missing or filled with zeros. The stream is cut at the last chunk that is whole and has
    a time of arrival, and the recorder's probe log at the last contact before this time. The header says how much is
    lost.
    """
    stream_file, arrivals_file = folder / headers.STREAM_FILE, folder / headers.ARRIVALS_FILE
    data = io.read_bytes(stream_file)
    whole_n = len(data.rstrip(b"\0"))  # frames of all formats end in CR LF
    chunk_rows, rows_n = _whole_rows(arrivals_file)
    arrivals = clocks.parse("".join(chunk_rows), str(arrivals_file))
    chunks_n = int(np.searchsorted(arrivals.byte_end, whole_n, "right"))
    bytes_n = int(arrivals.byte_end[chunks_n - 1]) if chunks_n else 0
    contents: dict[str, bytes | Path] = {
        **files,
        headers.STREAM_FILE: data[:bytes_n],
        headers.ARRIVALS_FILE: "".join(chunk_rows[: 1 + chunks_n]).encode(),
    }
    lost = [
        f"{len(data) - bytes_n} of {len(data)} bytes of {stream_file.name}",
        f"{rows_n - chunks_n} of {rows_n} rows of {arrivals_file.name}",
    ]
    if (log_file := files[headers.PROBE_FILE]).parent == folder and header.clock.marks and bytes_n:
        dwell_rows, rows_n = _whole_rows(log_file)
        log = probe_log.parse("".join(dwell_rows), str(log_file))
        clock = clocks.from_marks(np.array(header.clock.marks), str(folder))
        recorded = log.contact & (log.t_end_s <= clock.probe_s(arrivals.t_s[[chunks_n - 1]]))
        dwells_n = int(np.flatnonzero(recorded)[-1]) + 1 if recorded.any() else 0
        contents[headers.PROBE_FILE] = "".join(dwell_rows[: 1 + dwells_n]).encode()
        lost.append(f"{rows_n - dwells_n} of {rows_n} rows of {log_file.name}")
        bytes_n *= dwells_n > 0
    if not bytes_n:
        raise CaptureError(
            f"{folder}: the recording was interrupted before a labelled contact was whole on the disk: lost "
            f"{', '.join(lost)}. Record again."
        )
    return header.model_copy(update={"options": header.options | {"lost": ", ".join(lost)}}), contents


def _whole_rows(file: Path) -> tuple[list[str], int]:
    """Return the whole lines of a CSV file, and the number of rows below the first line, with a torn one at the end."""
    content = io.read_bytes(file)
    *whole, _ = content.partition(b"\0")[0].decode(errors="replace").split("\n")
    return [f"{line}\n" for line in whole], len(whole) - 1 + (not content.endswith(b"\n"))


def _check_names(names: CaptureNames) -> None:
    for option, name in (("--board", names.board), ("--skin", names.skin), ("--name", names.name)):
        if name is not None and not re.fullmatch(headers.NAME, name):
            raise CaptureError(option, "a name", headers.NAME_RULE, repr(name), "Choose another name.")


def _header(names: CaptureNames, recording: Path, *, layout: headers.Layout, chips_n: int, **fields: Any) -> Header:
    _check_names(names)
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", recording.resolve().stem)
    return headers.make_header(
        str(recording), capture=names.name or f"{names.board}_{names.skin}_{stem}"[:64], board=names.board,
        skin=names.skin, layout=layout, chips_n=chips_n, protocol=f"as recorded in {stem}", note="added by reskin add",
        **fields,
    )  # fmt: skip


def _check_exists(path: Path, *, folder: bool = False) -> None:
    """Raise `CaptureError` if a path does not exist, or is a folder where a file is needed."""
    if not path.exists():
        raise CaptureError(f"{path}: file not found. Check the path.")
    if path.is_dir() and not folder:
        raise CaptureError(f"{path}: this is a folder, not a file. Check the path.")
