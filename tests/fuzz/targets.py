"""Fuzz targets: one function per kind of external input.

A target accepts arbitrary bytes; the only exception that it may raise is a `ReskinError`. `fuzz.py` runs the targets on
random inputs for a given time, `test_corpus.py` runs them on the committed corpus.
"""

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from itertools import zip_longest
from pathlib import Path
from typing import get_args

import numpy as np
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from reskin.board import find
from reskin.board.stream import FrameStream
from reskin.board.wire import Wire
from reskin.errors import ReskinError
from reskin.live.server import Server, receive
from reskin.live.session import Session
from reskin.models.trained import read_network
from reskin.recordings import clocks, header, probe
from reskin.recordings.header import PROBE_FILE
from reskin.recordings.labels import (
    Dwell,
    DwellBuilder,
    GaugeLines,
    ProbeLogWriter,
    Prompts,
    SampleTable,
    parse_places,
)
from reskin.recordings.readers import READERS, sd_card
from reskin.seeds import rng_for
from tests.recordings.headers import DEFAULT_POLICY, make_header

FOLDER = Path(tempfile.mkdtemp(prefix="reskin-fuzz-"))
atexit.register(shutil.rmtree, FOLDER, ignore_errors=True)
WIRES = get_args(Wire)
LIVE = Session("none", [], "no board")


def stream(data: bytes) -> None:
    """Decode a stream: every byte must be in a frame or counted as skipped, and chunks must not change the result."""
    wire, chips_n, cut_n = WIRES[data[0] % len(WIRES)], 1 + data[1] % 8, 1 + data[2]
    whole, parts = FrameStream(wire, chips_n), FrameStream(wire, chips_n)
    found = [whole.feed(data[3:]), whole.close()]
    pieces = [parts.feed(data[first : first + cut_n]) for first in range(3, len(data), cut_n)] + [parts.close()]
    account = whole.account()
    lost_n = sum(count for name, count in account.items() if name.startswith("skipped_"))
    assert account["frame_bytes_n"] + lost_n == account["bytes_n"] == max(len(data) - 3, 0)
    assert parts.account() == account
    for a, b in (("b_uT",) * 2, ("end_byte",) * 2):
        np.testing.assert_array_equal(
            np.concatenate([getattr(part, a) for part in found]), np.concatenate([getattr(part, b) for part in pieces])
        )


def page(data: bytes) -> None:
    """Receive a message from the live page. All messages except the three known commands must be ignored."""
    receive(LIVE, data.decode(errors="replace"))


def request(data: bytes) -> None:
    """Check a request's host, origin and token: only requests from this machine to this machine may be accepted."""
    host, origin, token = ([*data.decode("latin-1").split("\n"), "", "", ""])[:3]
    headers = {"Host": host} | ({"Origin": origin} if origin else {})
    mocked = make_mocked_request("GET", "/?" + token.replace(" ", "+"), headers=headers)

    try:
        Server([LIVE], "").check(mocked)
    except web.HTTPForbidden:
        return
    name, _, port = host.lower().rpartition(":") if host[-1] != "]" and ":" in host else (host.lower(), "", "")
    assert name in ("localhost", "127.0.0.1", "[::1]"), host
    assert not port or port.isdecimal()
    assert not origin or origin.endswith(host)


def card(data: bytes) -> None:
    """Read a network with an empty weights file; `data` is the content of its model card (the JSON file)."""
    (FOLDER / "m.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{}      ")
    (FOLDER / "m.json").write_bytes(data)
    read_network(FOLDER / "m.safetensors")


def _reader(layout: str, name: str) -> Callable[[bytes], None]:
    settings = make_header(layout=layout, chips_n=1, capture="fuzz")

    def read(data: bytes) -> None:
        folder = FOLDER / layout
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
        READERS[layout].read(folder, settings, DEFAULT_POLICY)

    return read


def _log(data: bytes) -> None:
    (FOLDER / "log.csv").write_bytes(data)
    sd_card.read_log(FOLDER / "log.csv")


def labels(data: bytes) -> None:
    """Read the rows of a robot's table in chunks; if a probe log is written from the rows, it must be valid."""
    table, dwells, cut_n = SampleTable("labels"), DwellBuilder(), 1 + data[0]
    _write_log(
        dwell
        for first in range(1, len(data), cut_n)
        for dwell in dwells.feed(table.feed(data[first : first + cut_n]))
    )  # fmt: skip


def gauge(data: bytes) -> None:
    """Read the output of a force gauge, a few bytes every 10 ms."""
    lines, dwells, cut_n = GaugeLines("gauge"), DwellBuilder(), 1 + data[0]
    _write_log(
        dwell
        for i, first in enumerate(range(1, len(data), cut_n))
        for dwell in dwells.feed(lines.feed(data[first : first + cut_n], 0.01 * i))
    )  # fmt: skip


def _write_log(dwells: Iterator[Dwell]) -> None:
    folder = FOLDER / "labels"
    folder.mkdir(exist_ok=True)
    (folder / PROBE_FILE).unlink(missing_ok=True)
    writer = ProbeLogWriter(folder)
    try:
        writer.write_all(dwells)
    finally:
        writer.close()
        if writer.touches_n:
            assert len(probe.parse(folder / PROBE_FILE, "log")) >= 2 * writer.touches_n


def typed(data: bytes) -> None:
    """Read keyboard input at a prompt for a place and a force; the resulting label must have an existing place."""
    first, *lines = data.decode(errors="replace").split("\n")
    if (places := parse_places(first)) is None:
        return
    prompts = Prompts(places, 0.0, lambda _: None, list, None, rng_for(0, "fuzz"))
    label = prompts._read_label(iter(lines), 0)
    assert label is None or not label.contact or (label.x_mm, label.y_mm) in places.xy_mm


def _files(layout: str, names: tuple[str, ...], **options: str) -> Callable[[bytes], None]:
    """Return a target that reads a recording of several files; a line of dashes in the data separates the files."""
    settings = make_header(layout=layout, chips_n=1, capture="fuzz", options=options)

    def read(data: bytes) -> None:
        folder = FOLDER / layout
        folder.mkdir(exist_ok=True)
        for name, content in zip_longest(names, data.split(b"----\n")[: len(names)], fillvalue=b""):
            (folder / name).write_bytes(content)
        READERS[layout].read(folder, settings, DEFAULT_POLICY)

    return read


TARGETS: Mapping[str, Callable[[bytes], None]] = {
    "stream": stream,
    "recognise": lambda data: str(find.recognise("port", [(data, 0.0), (b"", 1.0)])) and None,
    "header": lambda data: header.parse(data.decode(errors="replace"), "header") and None,
    "arrivals": lambda data: clocks.parse(data.decode(errors="replace"), "arrivals") and None,
    "probe": lambda data: probe.parse(data.decode(errors="replace"), "probe") and None,
    "log": _log,
    "table": _reader("table", "readings.csv"),
    "lab": _reader("lab", "readings.csv"),
    "ini": _files("ini", ("readings.txt", "truths.txt")),
    "eflesh": _files("eflesh", ("sensor.csv", "sensor_post_baselines.csv", "states.csv"), force_axis="z"),
    "labels": labels,
    "gauge": gauge,
    "typed": typed,
    "page": page,
    "request": request,
    "card": card,
}  # fmt: skip


HEADS_N = {"stream": 3, "labels": 1, "gauge": 1}  # number of leading bytes of the input that configure the target


def feed(name: str, data: bytes) -> None:
    """Run a target on bytes; a `ReskinError` is a valid result."""
    with suppress(ReskinError):
        TARGETS[name](data.ljust(HEADS_N[name], b"\0") if name in HEADS_N else data)
