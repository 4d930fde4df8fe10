"""Preparing a recording to be added: somebody's files and labels -> a header and the files it will vouch for.

Nothing is written here. Refuses to know scenes, DVC and where captures are kept (`adding`).
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

from reskin import io
from reskin.board import stream
from reskin.board.wire import TEXT_WIRES
from reskin.errors import CaptureError, ReskinError
from reskin.recordings import ReaderLayout
from reskin.recordings import header as headers
from reskin.recordings.fault_policy import REFUSE_NONE
from reskin.recordings.header import Clock, Header
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import READERS

NATIVE_FILES = (headers.STREAM_FILE, headers.ARRIVALS_FILE, headers.PROBE_FILE)
UNNAMED = "unnamed"  # the board and skin of a recording that was made without their names

Marks = tuple[tuple[float, float], ...]
Prepared = tuple[Header, Mapping[str, bytes | Path]]


@dataclass(frozen=True)
class Labels:
    """What the user says of a recording; `name` None makes one from the labels."""

    board: str
    skin: str
    name: str | None


@dataclass(frozen=True)
class Dump:
    """What a bare serial dump does not say: wire format, chips, rate, where the robot was, and on which clock."""

    wire: headers.Wire
    chips_n: int
    rate_hz: float
    probe: Path | None
    marks: Marks


def parse_marks(words: list[str]) -> Marks:
    """Read `STREAM_S,PROBE_S` pairs.

    >>> parse_marks(["0,12.5"])
    ((0.0, 12.5),)
    """
    marks = []
    for word in words:
        if not re.fullmatch(r"-?[0-9.]+(e[0-9]+)?,-?[0-9.]+(e[0-9]+)?", word):
            raise CaptureError("--mark", "a mark", "STREAM_S,PROBE_S in seconds", repr(word), "Try: --mark 0,12.5")
        stream_s, probe_s = map(float, word.split(","))
        marks.append((stream_s, probe_s))
    return tuple(marks)


@contextmanager
def suggesting_layout(recording: Path, layout: str) -> Iterator[None]:
    """Let an error about a recording name the layouts that it can be read in, if `layout` is none of them."""
    try:
        yield
    except ReskinError as error:
        fitting = layouts_of(recording)
        if not fitting or layout in fitting:
            raise
        raise type(error)(
            f"{error} It can be read with {' or '.join(f'--layout {name}' for name in fitting)}."
        ) from None


def layouts_of(recording: Path) -> list[str]:
    """List the layouts that a recording can be read in."""
    if (recording / headers.HEADER_FILE).is_file():
        return ["capture"]
    if found := [layout for layout in get_args(ReaderLayout) if _reads(recording, layout)]:
        return [layout for layout in found if layout != "table"] or found  # a plain table may leave labels unread
    fits = stream.fitting(io.read_bytes(recording)) if recording.is_file() else []
    return sorted({"serial-text" if wire in TEXT_WIRES else "serial-binary" for wire, _ in fits})


def _reads(recording: Path, layout: ReaderLayout) -> bool:
    options = {"force_axis": "z"} if layout == "eflesh" else {}
    try:
        prepared = foreign(recording, layout, Labels("board", "skin", None), options)
        with TemporaryDirectory() as folder:
            copy = Path(folder) / "it"
            READERS[layout].read(copy, headers.write_capture(copy, *prepared), REFUSE_NONE)
    except ReskinError:
        return False
    return True


def foreign(recording: Path, layout: ReaderLayout, labels: Labels, options: Mapping[str, str]) -> Prepared:
    """Prepare somebody else's recording: its own files, untouched, under a header."""
    _need(recording, folder=True)
    files = READERS[layout].collect(recording)
    chips_n = READERS[layout].count_chips(files)
    return _header(labels, recording, layout=layout, chips_n=chips_n, options=dict(options)), files


def dump(recording: Path, labels: Labels, what: Dump) -> Prepared:
    """Prepare a bare dump of a port with the robot's log; frames get their time from a constant rate."""
    if what.probe is None:
        remedy = "Add --probe PROBE.csv (columns in data/README.md)."
        raise CaptureError(recording, "a serial dump", "accompanied by its probe log", "none", remedy)
    _need(recording)
    _need(what.probe)
    if not 0 < what.rate_hz <= headers.RATE_MAX_HZ:
        rule = f"above 0, at most {headers.RATE_MAX_HZ:g}"
        raise CaptureError("--rate-hz", "the rate", rule, what.rate_hz, "Count frames.")
    clock = Clock(kind="rate", rate_hz=what.rate_hz, marks=what.marks)
    header = _header(labels, recording, layout="native", chips_n=what.chips_n, wire=what.wire, clock=clock)
    return header, {headers.STREAM_FILE: recording, headers.PROBE_FILE: what.probe}


def native(recording: Path, labels: Labels, probe: Path | None, marks: Marks) -> Prepared:
    """Prepare a capture folder that `reskin record` wrote; `probe` adds the robot's log to it."""
    _need(recording, folder=True)
    found = read_header(recording)
    for what, said, written in (("board", labels.board, found.board), ("skin", labels.skin, found.skin)):
        if written not in (said, UNNAMED):
            rule = f"{written!r}, as its header says"
            raise CaptureError(recording, f"--{what}", rule, repr(said), "Which is right?")
    # A recorder that was killed has not hashed its files into the header; they are there all the same.
    files = {name: recording / name for name in NATIVE_FILES if (recording / name).exists() or name in found.files}
    marks_before = found.clock.marks
    if probe is not None:
        _need(probe)
        marks_before = () if headers.PROBE_FILE in files else marks_before  # these are of the log that was recorded
        files[headers.PROBE_FILE] = probe
    if headers.PROBE_FILE not in files:
        raise CaptureError(recording, "a capture", "labelled by a probe log", "none", "Add --probe PROBE.csv.")
    for name, file in files.items():
        _need(file)
        if file.parent == recording and found.files.get(name, io.sha256(file)) != io.sha256(file):
            raise CaptureError(file, "the file", "unchanged since it was recorded", "another hash", "Record it again.")
    _check_names(labels)
    clock = found.clock.model_copy(update={"marks": (*marks_before, *marks)})
    named = {"capture": labels.name or found.capture, "board": labels.board, "skin": labels.skin}
    return found.model_copy(update=named | {"clock": clock}), files


def _check_names(labels: Labels) -> None:
    for option, word in (("--board", labels.board), ("--skin", labels.skin), ("--name", labels.name)):
        if word is not None and not re.fullmatch(headers.NAME, word):
            raise CaptureError(option, "a name", "1 to 64 of A-Z a-z 0-9 _ -", repr(word), "Choose another.")


def _header(labels: Labels, recording: Path, *, layout: headers.Layout, chips_n: int, **fields: Any) -> Header:
    _check_names(labels)
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", recording.resolve().stem)
    return headers.recorded(
        str(recording), capture=labels.name or f"{labels.board}_{labels.skin}_{stem}"[:64], board=labels.board,
        skin=labels.skin, layout=layout, chips_n=chips_n, protocol=f"as recorded in {stem}", note="added by reskin add",
        **fields,
    )  # fmt: skip


def _need(path: Path, *, folder: bool = False) -> None:
    """Raise if there is nothing at a path, or a folder where a file is needed."""
    if not path.exists():
        raise CaptureError(path, "the file", "there", "nothing", "Check the path.")
    if path.is_dir() and not folder:
        raise CaptureError(path, "the file", "a file", "a folder", "Check the path.")
