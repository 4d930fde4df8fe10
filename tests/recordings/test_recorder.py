"""Tests of the stream recorder, with a pseudo-terminal as the serial port."""

import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from reskin.board import stream
from reskin.board.port import open_port
from reskin.board.wire import encode
from reskin.errors import CaptureError
from reskin.recordings import clocks, recorder
from reskin.recordings.header import ARRIVALS_FILE, STREAM_FILE
from reskin.recordings.recorder import PortSettings, Recording
from tests.board.signals import make_frames

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")

ROOT = Path(__file__).resolve().parents[2]
FRAMES = make_frames(100, 5, 0)
LONG_s = 120.0  # A time limit in s, which a passing test never reaches.
SETTINGS = PortSettings(baud=115200, wire="binary", chips_n=5, duration_s=LONG_s, silence_s=LONG_s, no_frame_s=LONG_s)


@dataclass
class Board:
    """The board's end of a pseudo-terminal. The bytes that it sends arrive at the port `name`."""

    board_fd: int
    port_fd: int
    name: str

    def send(self, *chunks: bytes) -> None:
        with suppress(OSError):  # Sending fails if the port is no longer open.
            for chunk in chunks:
                os.write(self.board_fd, chunk)

    def unplug(self) -> None:
        os.close(self.board_fd)
        self.board_fd = -1


@pytest.fixture
def board() -> Iterator[Board]:
    board_fd, port_fd = os.openpty()
    tty.setraw(port_fd)
    end = Board(board_fd, port_fd, os.ttyname(port_fd))
    yield end
    for handle in (end.board_fd, end.port_fd):
        if handle >= 0:
            os.close(handle)


@dataclass
class ManualClock:
    """A clock for the recorder that only the test advances, so that results do not depend on the machine's load."""

    s: float = 0.0


@pytest.fixture
def clock(monkeypatch) -> ManualClock:
    manual = ManualClock()
    monkeypatch.setattr(recorder, "time", SimpleNamespace(monotonic=lambda: manual.s, time=time.time))
    return manual


def record(board: Board, folder: Path, act: Callable[[threading.Event], None], **changed: object) -> Recording:
    """Record from a board. `act` runs in a thread as soon as the recorder has opened the port."""

    def begin() -> None:
        assert listening.wait(LONG_s)
        act(stop)

    stop, listening, actor = threading.Event(), threading.Event(), threading.Thread(target=begin)
    actor.start()
    try:
        return recorder.record(
            board.name, folder, settings=replace(SETTINGS, **changed), stop=stop, report=lambda _: listening.set()
        )
    finally:
        actor.join()


def wait_until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LONG_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def wait_until_written(folder: Path, bytes_n: int) -> None:
    wait_until(lambda: (folder / STREAM_FILE).stat().st_size == bytes_n)


def check_files(folder: Path, recording: Recording, sent: bytes) -> None:
    data = (folder / STREAM_FILE).read_bytes()
    rows = clocks.parse(folder / ARRIVALS_FILE, "arrivals.csv")
    assert data == sent
    assert recording.account["bytes_n"] == len(data) == rows.byte_end[-1]
    assert rows.byte_end[0] == 0
    assert abs(rows.t_s[-1] - time.time()) < 60
    assert recording.account["frames_n"] == len(stream.decode_all(data, SETTINGS.wire, 5, "stream.bin")[0])


def test_recording_ends_after_its_duration(board, clock, tmp_path):
    data = encode(FRAMES, "binary")

    def act(_: threading.Event) -> None:
        board.send(*[data[i : i + 1000] for i in range(0, len(data), 1000)])
        wait_until_written(tmp_path, len(data))
        clock.s = 1.5

    recording = record(board, tmp_path, act, duration_s=1.5)
    assert recording.ended == "duration"
    assert recording.account["frames_n"] == len(FRAMES)
    assert recording.duration_s == 1.5
    check_files(tmp_path, recording, data)


def test_report_contains_the_number_of_frames(board, tmp_path):
    seen: list[int] = []
    stop = threading.Event()

    def report(account: Mapping[str, int]) -> None:
        if not seen:
            board.send(encode(FRAMES, "binary"))
        seen.append(account["frames_n"])
        if seen[-1] == len(FRAMES):
            stop.set()

    recorder.record(board.name, tmp_path, settings=SETTINGS, stop=stop, report=report)
    assert seen[0] == 0
    assert seen == sorted(seen)


def test_arrival_times_show_a_pause_of_the_board(board, clock, tmp_path):
    data, pause_s = encode(FRAMES, "binary"), 0.4

    def act(stop: threading.Event) -> None:
        board.send(data[:4100])
        wait_until_written(tmp_path, 4100)
        clock.s += pause_s
        board.send(data[4100:])
        wait_until_written(tmp_path, len(data))
        stop.set()

    record(board, tmp_path, act)
    rows = clocks.parse(tmp_path / ARRIVALS_FILE, "arrivals.csv")
    arrived_s = clocks.times_of(np.array([4100, 8200]), rows)
    assert arrived_s[1] - arrived_s[0] == pytest.approx(pause_s, abs=1e-5)


def test_received_bytes_are_kept_when_the_board_is_unplugged(board, tmp_path):
    data = encode(FRAMES, "binary")

    def act(_: threading.Event) -> None:
        board.send(data[:-7])
        wait_until_written(tmp_path, len(data) - 7)
        board.unplug()

    recording = record(board, tmp_path, act)
    assert recording.ended == "unplugged"
    assert recording.account["frames_n"] == len(FRAMES) - 1
    check_files(tmp_path, recording, data[:-7])


def test_received_bytes_are_kept_when_the_recording_is_stopped(board, tmp_path):
    data = encode(FRAMES, "binary")

    def act(stop: threading.Event) -> None:
        board.send(data)
        wait_until_written(tmp_path, len(data))
        stop.set()

    recording = record(board, tmp_path, act)
    assert recording.ended == "stopped"
    check_files(tmp_path, recording, data)


def test_recording_ends_when_the_board_is_silent(board, clock, tmp_path):
    data = encode(FRAMES, "binary")

    def act(_: threading.Event) -> None:
        board.send(data)
        wait_until_written(tmp_path, len(data))
        clock.s = 0.9

    recording = record(board, tmp_path, act, silence_s=0.8)
    assert recording.ended == "silent"
    check_files(tmp_path, recording, data)


RECORD = """
import sys, threading
from pathlib import Path
from reskin.recordings import recorder
settings = recorder.PortSettings(115200, "binary", 5, float("inf"), 120.0, 120.0)
print(recorder.record(sys.argv[1], Path(sys.argv[2]), settings=settings, stop=threading.Event()).ended)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_received_bytes_are_kept_when_a_signal_ends_the_process(board, tmp_path, number):
    data = encode(FRAMES, "binary")
    command = [sys.executable, "-c", RECORD, board.name, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        written = tmp_path / STREAM_FILE
        wait_until(written.exists)
        board.send(data)
        wait_until(lambda: written.stat().st_size == len(data))
        process.send_signal(number)
        output, _ = process.communicate(timeout=LONG_s)
    assert process.returncode == 0
    assert output == "stopped\n"
    assert clocks.parse(tmp_path / ARRIVALS_FILE, "arrivals.csv").byte_end[-1] == len(data)


def test_killed_process_loses_no_byte_that_it_has_read(board, tmp_path):
    data = encode(FRAMES, "binary")
    with subprocess.Popen([sys.executable, "-c", RECORD, board.name, str(tmp_path)], cwd=ROOT) as process:
        written = tmp_path / STREAM_FILE
        wait_until(written.exists)
        board.send(data)
        wait_until(lambda: written.stat().st_size == len(data))
        process.kill()
    assert clocks.parse(tmp_path / ARRIVALS_FILE, "arrivals.csv").byte_end[-1] <= len(data)


def test_recorder_uses_no_processor_time_while_it_waits(board, tmp_path):
    before_s = time.process_time()
    with pytest.raises(CaptureError):
        record(board, tmp_path, lambda _: None, silence_s=1.0)
    assert time.process_time() - before_s < 0.3  # A busy wait would use the whole second.


def test_incomplete_first_line_is_dropped(board, clock, tmp_path):
    data = encode(FRAMES, "text-xyzt")
    first_n = data.index(b"\n") + 1

    def act(_: threading.Event) -> None:
        board.send(data[3:2000])
        wait_until_written(tmp_path, 2000 - first_n)
        clock.s = 0.9

    recording = record(board, tmp_path, act, wire="text-xyzt", silence_s=0.8)
    assert recording.partial_line_bytes_n == first_n - 3
    assert (tmp_path / STREAM_FILE).read_bytes() == data[first_n:2000]


def test_network_socket_is_recorded_like_a_serial_port(tmp_path):
    data = encode(FRAMES, "binary")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def send() -> None:
            with server.accept()[0] as end:
                # Bytes that were sent before the port is opened are discarded.
                wait_until((tmp_path / STREAM_FILE).exists)
                end.sendall(data)

        sender = threading.Thread(target=send)
        sender.start()
        name = f"socket://127.0.0.1:{server.getsockname()[1]}"
        recording = recorder.record(name, tmp_path, settings=SETTINGS, stop=threading.Event())
        sender.join()
    assert recording.ended == "unplugged"
    check_files(tmp_path, recording, data)


FULL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # writing more fails, as on a full disk
"""


def test_full_disk_keeps_a_readable_recording(board, tmp_path):
    # Without option -B, Python would write truncated .pyc files on the full disk.
    command = [sys.executable, "-B", "-c", FULL_DISK + RECORD, board.name, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        wait_until((tmp_path / STREAM_FILE).exists)
        os.set_blocking(board.board_fd, False)  # Otherwise, writing would block after the recorder has ended.

        def ended() -> bool:
            board.send(encode(FRAMES, "binary")[:820])
            return process.poll() is not None

        wait_until(ended)
        output, _ = process.communicate(timeout=LONG_s)
    assert (process.returncode, output) == (0, "not written\n")
    written_n = (tmp_path / STREAM_FILE).stat().st_size
    assert 10_000 < written_n <= 20_000
    assert clocks.parse(tmp_path / ARRIVALS_FILE, "arrivals.csv").byte_end[-1] == written_n


class TestErrors:
    def test_missing_port_is_reported(self, tmp_path):
        with pytest.raises(CaptureError, match="/dev/tty-none: cannot open the port: .*orts?.*found"):
            recorder.record("/dev/tty-none", tmp_path, settings=SETTINGS, stop=threading.Event())
        assert list(tmp_path.iterdir()) == []

    def test_path_of_a_file_is_not_accepted_as_a_port(self, tmp_path):
        file = tmp_path / "no_port"
        file.touch()
        for name, reason in {file: "it is a file.* reskin predict", tmp_path: "it is a folder"}.items():
            with pytest.raises(CaptureError, match=f"{name}: cannot open the port: {reason}"):
                recorder.record(str(name), tmp_path, settings=SETTINGS, stop=threading.Event())

    def test_port_that_another_program_uses_is_reported(self, board, tmp_path):
        other = "another program uses it"
        with open_port(board.name, 115200), pytest.raises(CaptureError, match=f"cannot open the port: {other}"):
            recorder.record(board.name, tmp_path, settings=SETTINGS, stop=threading.Event())

    def test_port_that_sends_nothing_is_reported(self, board, clock, tmp_path):
        with pytest.raises(CaptureError, match=f"{board.name}: no bytes arrived in 0.7 s. Check that the"):
            record(board, tmp_path, lambda _: setattr(clock, "s", 0.7), silence_s=0.6)

    def test_port_unplugged_before_the_first_byte_is_reported(self, board, tmp_path):
        with pytest.raises(CaptureError, match="no bytes arrived"):
            record(board, tmp_path, lambda _: board.unplug())

    def test_error_suggests_a_wrong_baud_rate_if_no_frame_is_found(self, board, tmp_path):
        noise = bytes(range(128)) * 4
        os.set_blocking(board.board_fd, False)  # Otherwise, writing would block while the error message is prepared.

        def act(stop: threading.Event) -> None:
            while not stop.wait(0.05) and board.board_fd >= 0:
                board.send(noise)

        stop = threading.Event()
        actor = threading.Thread(target=act, args=[stop])
        actor.start()
        try:
            with pytest.raises(CaptureError, match="no frame found in .* Check the baud rate"):
                recorder.record(
                    board.name, tmp_path, settings=replace(SETTINGS, no_frame_s=0.7), stop=threading.Event()
                )
        finally:
            stop.set()
            actor.join()

    def test_error_suggests_a_smaller_number_of_chips(self, board, clock, tmp_path):
        data = encode(make_frames(30, 4, 0), "binary")

        def act(_: threading.Event) -> None:
            board.send(data)
            wait_until_written(tmp_path, len(data))
            clock.s = 0.6

        with pytest.raises(CaptureError, match="The bytes fit binary with 4 chips"):
            record(board, tmp_path, act, no_frame_s=0.5)

    def test_existing_recording_is_not_overwritten(self, board, tmp_path):
        (tmp_path / STREAM_FILE).write_bytes(b"old")
        with pytest.raises(FileExistsError):
            recorder.record(
                board.name, tmp_path, settings=replace(SETTINGS, duration_s=math.inf), stop=threading.Event()
            )
        assert (tmp_path / STREAM_FILE).read_bytes() == b"old"
