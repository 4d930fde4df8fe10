"""Tests of how a recording by `reskin record` can end, with a pseudo-terminal as the serial port."""

import os
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from reskin.board.wire import encode
from reskin.errors import CaptureError, SchemaError
from reskin.recordings.header import HEADER_FILE, parse
from reskin.recordings.labels import LabelSource
from reskin.recordings.preparing import CaptureNames, native
from reskin.recordings.recorder import (
    CaptureInfo,
    PortSettings,
    _label_context,
    begin_capture,
    print_progress,
    record_capture,
)
from tests.board.signals import make_frames
from tests.stages.checkout import PROGRAMS

FRAMES = make_frames(200, 5, seed=0)
LONG_S = 120.0  # time limit, long enough for a busy machine


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    board_fd, port_fd = os.openpty()
    tty.setraw(port_fd)
    yield board_fd, os.ttyname(port_fd)
    os.close(board_fd)
    os.close(port_fd)


def start(name: str, out: Path, *options: str) -> subprocess.Popen:
    labels = ["--port", name, "--board", "b0", "--skin", "s0", "--out", out]
    command = [PROGRAMS / "reskin", "record", *labels, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def send_until_recorded(board_fd: int, part: Path) -> None:
    stream = part / "stream.bin"
    end_s = time.monotonic() + LONG_S
    while time.monotonic() < end_s:
        if stream.exists():
            os.write(board_fd, encode(FRAMES, "binary")[:1640])
            if stream.stat().st_size:
                return
        time.sleep(0.05)
    raise AssertionError("nothing was recorded")


def test_ctrl_c_ends_a_recording_that_can_be_added(terminal, tmp_path):
    board_fd, name = terminal
    recorder = start(name, tmp_path / "run1", "--scan", "random")
    send_until_recorded(board_fd, tmp_path / "run1.part")
    recorder.send_signal(signal.SIGINT)
    stdout, stderr = recorder.communicate(timeout=LONG_S)
    assert recorder.returncode == 0, stderr
    assert stderr == ""
    assert "stopped" in stdout
    header = parse((tmp_path / "run1" / HEADER_FILE).read_text(), "header")
    assert set(header.files) == {"stream.bin", "arrivals.csv"}
    assert header.options == {"scan": "random"}
    probe = tmp_path / "probe.csv"
    probe.write_text("")
    added, files = native(tmp_path / "run1", CaptureNames("b0", "s0", None), probe, ())
    assert added.options == header.options
    assert set(files) == {"stream.bin", "arrivals.csv", "probe.csv"}


def test_progress_on_a_terminal_shows_the_rate_lost_bytes_and_faults(monkeypatch, capsys):
    now_s = iter([0.0, 0.5, 1.0, 1.5, 3.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(now_s))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    report = print_progress(lambda: ["chip 1: stuck"])
    for frames_n in (200, 400, 600, 1200):
        report({"bytes_n": 1, "frames_n": frames_n, "skipped_resync_bytes_n": frames_n // 10})
    lines = ["1 s: 400.0 frames/s, 400 frames, 40 bytes lost", "3 s: 400.0 frames/s, 1200 frames, 120 bytes lost"]
    lines = [f"{line}; chip 1: stuck" for line in lines]
    assert capsys.readouterr().err.splitlines() == lines


def test_killed_recording_can_be_added(terminal, tmp_path):
    board_fd, name = terminal
    recorder = start(name, tmp_path / "run1")
    send_until_recorded(board_fd, tmp_path / "run1.part")
    recorder.kill()
    recorder.communicate()
    probe = tmp_path / "probe.csv"
    probe.write_text("")
    header, files = native(tmp_path / "run1.part", CaptureNames("b0", "s0", None), probe, ())
    assert header.capture == "run1"
    assert len(files["stream.bin"]) > 0


def test_missing_port_leaves_no_files(tmp_path):
    recorder = start(str(tmp_path / "none"), tmp_path / "run1")
    _, stderr = recorder.communicate(timeout=LONG_S)
    assert recorder.returncode == 2
    assert "cannot open the port" in stderr
    assert "Traceback" not in stderr
    assert list(tmp_path.iterdir()) == []


def test_error_of_a_label_source_ends_the_recording(terminal, tmp_path):
    def fail_to_open(_):
        raise CaptureError("the gauge: cannot open the port. Plug it in.")

    info = CaptureInfo("b0", "s0", "random", LabelSource("gauge", None, fail_to_open))
    settings = PortSettings(115200, "binary", 5, LONG_S, silence_s=LONG_S, no_frame_s=LONG_S)
    with pytest.raises(CaptureError, match="the gauge: cannot open the port") as raised:
        record_capture(terminal[1], tmp_path / "run1", info=info, settings=settings, report=len, watch=len)
    assert "no bytes arrived" in str(raised.value.__cause__)
    assert list(tmp_path.iterdir()) == []


def test_marks_set_after_the_label_file_was_closed_are_not_written_to_the_header(tmp_path):
    part, header = begin_capture(tmp_path / "run1", CaptureInfo(), wire="binary", chips_n=5, by="a test")
    headers = [header]
    context = _label_context(part, headers, threading.Event())
    context.mark(5.0, 6.0)
    assert headers[0].clock.marks == ((5.0, 6.0),)
    context.writer.close()
    context.mark(7.0, 8.0)
    assert headers[0].clock.marks == ((5.0, 6.0),)
    assert parse((part / HEADER_FILE).read_text(), "header").clock.marks == ((5.0, 6.0),)


def test_folder_that_cannot_be_created_is_an_error():
    with pytest.raises(SchemaError, match="^/proc/nowhere: cannot create"):
        begin_capture(Path("/proc/nowhere/run1"), CaptureInfo(), wire="binary", chips_n=5, by="a test")


def test_existing_folder_is_not_overwritten(tmp_path):
    (tmp_path / "run1").mkdir()
    recorder = start("/dev/null", tmp_path / "run1")
    _, stderr = recorder.communicate(timeout=LONG_S)
    assert recorder.returncode == 2
    assert "the folder exists already" in stderr
