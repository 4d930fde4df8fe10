"""`reskin record` put together: a board, what the user wants, a source of labels -> a capture and a sentence about it.

Refuses to know words of the command line.
"""

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from reskin.board import find
from reskin.board.find import Found
from reskin.board.port import PortSettings
from reskin.errors import ParamsError
from reskin.live.health import Health
from reskin.recordings.header import Wire
from reskin.recordings.label_sources import RANDOM, SNAKE, Forces, Prompts, Source, from_gauge, from_table, parse_places
from reskin.recordings.recorder import UNTOLD, new_folder, print_progress, record_capture
from reskin.seeds import rng_for

GAUGE_BAUD = 9600
SILENCE_S = NO_FRAME_S = 5.0


class Wanted(NamedTuple):
    """Where to, for how long, at which rate; and what is said of the recording, as names of `Told`."""

    folder: Path | None
    seconds: float
    baud: int
    told: Mapping[str, str]


class Taped(NamedTuple):
    """The capture's folder, a sentence about it, and the error that ended its labels, if one did."""

    folder: Path
    said: str
    failed: Exception | None


def board_of(port: str | None, wire: Wire | None, chips_n: int | None, *, say: Callable[[str], object]) -> Found:
    """Take what was said of a board; without a port, find the one that is there."""
    if port is None:
        found = find.the_board()
        say(str(found))
        return found
    return Found(port, None, wire or "binary", chips_n or 5)


def source_of(
    labels: str | None, gauge: str | None, scan: str | None, *, dwell_s: float, say: Callable[[str], object]
) -> Source | None:
    """Choose where labels come from by what was asked for, if anything was."""
    port, _, baud = (gauge or "").partition("@")
    if baud and not baud.isdecimal():
        raise ParamsError("--gauge", "the gauge", "PORT or PORT@BAUD", gauge, "Try: --gauge /dev/ttyUSB0@9600")
    if labels is None:
        return from_gauge(port, int(baud or GAUGE_BAUD)) if gauge else None
    if (places := parse_places(labels)) is None:
        if Path(labels).suffix != ".csv" or gauge:
            rule = "grid:NXxNY:STEP_MM, line:N:STEP_MM, or a .csv file (without --gauge)"
            raise ParamsError("--labels", "labels", rule, labels, "Try: --labels grid:5x5:4")
        return from_table(Path(labels))
    if scan not in (None, RANDOM, SNAKE):
        raise ParamsError("--scan", "the order of prompts", f"{RANDOM} or {SNAKE}", scan, "Leave it out: random.")
    forces = Forces(port, int(baud or GAUGE_BAUD)) if gauge else None
    rng = rng_for(time.time_ns() % 2**31, "prompts")
    return Prompts(places, dwell_s, say, _keys, forces, rng, scan or RANDOM).source()


def _keys() -> Iterator[str]:
    yield from sys.stdin


def record_board(board: Found, wanted: Wanted, labels: Source | None) -> Taped:
    """Record until told to stop, the labels end, or the board is gone."""
    folder, health = wanted.folder or new_folder(), Health(board.chips_n)
    scan = {"scan": labels.scan} if labels is not None and labels.scan is not None else {}
    told = replace(UNTOLD, **(scan | dict(wanted.told)), labels=labels)
    settings = PortSettings(
        wanted.baud, board.wire, board.chips_n, wanted.seconds, bytes_max_n=None, silence_s=SILENCE_S,
        no_frame_s=NO_FRAME_S,
    )  # fmt: skip
    done, of_labels, failed = record_capture(
        board.port, folder, told=told, settings=settings,
        report=print_progress(lambda: [alarm.name for alarm in health.active(time.monotonic())]),
        watch=lambda frames: health.feed(frames, time.monotonic()),
    )  # fmt: skip
    counts = [", ".join(f"{key} {count}" for key, count in done.account.items() if count)]
    counts += [f"{one.name} ({one.count_n}, {one.last_s - one.first_s:.1f} s)" for one in health.alarms.values()]
    words, where = "; ".join([*counts, *([of_labels] if of_labels else [])]), str(folder)
    if done.ended == "not written":
        folder = folder.with_name(f"{folder.name}.part")
        where = f"{folder}: no more could be written"
    return Taped(folder, f"recorded {where} ({done.ended} after {done.duration_s:.1f} s): {words}", failed)
