"""Tests that labelled recordings can be added to a scene, even if the recorder was killed or the disk was full."""

import os
import signal
import time
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest

import reskin
from reskin.board.find import DetectedBoard
from reskin.board.stream import decode_all
from reskin.errors import ParamsError
from reskin.live.record import label_source, record_board
from reskin.recordings import clocks, probe
from reskin.recordings.header import ARRIVALS_FILE, HEADER_FILE, PROBE_FILE, STREAM_FILE, parse
from reskin.recordings.ingest import open_capture
from reskin.recordings.labels import Dwell, LabelContext
from reskin.recordings.preparing import CaptureNames, native
from tests.live.boards import make_script, plugged_in
from tests.recordings.headers import DEFAULT_POLICY

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")
PLACES = [(4.0, 8.0), (12.0, 4.0)]
FRAME_BYTES_N, DWELL_FRAMES_N, LONG_S = 82, 40, 120.0


def frames_written_n(part):
    """Return the number of frames that a recorder has written so far."""
    stream = part / STREAM_FILE
    return stream.stat().st_size // FRAME_BYTES_N if stream.exists() else 0


@pytest.fixture
def hold_until_frames(monkeypatch, tmp_path):
    """Make every label last until enough frames have been recorded, instead of a fixed time."""

    def hold(self, label, dwell_s):
        start_s, before_n = self.unix_s(), frames_written_n(tmp_path / "run1.part")
        self.stop.wait(dwell_s)
        while frames_written_n(tmp_path / "run1.part") < before_n + DWELL_FRAMES_N and not self.stop.wait(0.01):
            pass
        return Dwell(label, start_s, self.unix_s())

    monkeypatch.setattr(LabelContext, "hold", hold)


def pokes():
    for x_mm, y_mm in PLACES:
        yield reskin.lifted()
        yield reskin.touch(x_mm, y_mm, Fz_N=0.5)


def read(folder):
    """Read the folder of a capture as `reskin add` does."""
    from reskin.recordings.header import write_capture

    header, files = native(folder, CaptureNames("b0", "s0", None), None, ())
    into = folder.parent / "added" / header.capture
    _, blocks, account = open_capture(write_capture(into, header, files) and into, DEFAULT_POLICY)
    return list(blocks), account


def places_of(blocks):
    return {(float(x), float(y)) for block in blocks for x, y in zip(block.x_mm, block.y_mm, strict=True)}


def test_recording_labelled_by_a_program_can_be_added(tmp_path, hold_until_frames, capsys):
    with plugged_in(make_script(pokes_n=2), loop=True) as port:
        folder = reskin.record(pokes(), port=port, out=tmp_path / "run1", dwell_s=0.3, board="b0", scan="random")
    assert "2 touches labelled" in capsys.readouterr().err
    header = parse((folder / HEADER_FILE).read_text(), "header")
    assert header.options == {"scan": "random", "labels": "program"}
    blocks, account = read(folder)
    assert places_of(blocks) == set(PLACES)
    assert account["indentations_n"] == 2
    assert account["clock_residual_us"] == 0
    log = probe.parse(folder / PROBE_FILE, "log")
    frames, _ = decode_all((folder / STREAM_FILE).read_bytes(), "binary", 5, "stream")
    t_s = clocks.times_of(frames.end_byte, clocks.parse(folder / ARRIVALS_FILE, "arrivals"))
    dwells_s = zip(log.t_start_s[log.contact], log.t_end_s[log.contact], strict=True)
    arrived_n = sum(int(((t_s > start_s) & (t_s < end_s)).sum()) for start_s, end_s in dwells_s)
    assert arrived_n >= 2 * DWELL_FRAMES_N
    assert account["frames_contact_n"] == pytest.approx(arrived_n, abs=2)


# Python 3.12 warns if a program with threads forks.
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_killed_recording_keeps_its_labels(tmp_path):
    """The recorder runs in a forked process, which starts faster than a new interpreter."""
    robot = tmp_path / "robot.csv"
    with plugged_in(make_script(pokes_n=1), loop=True) as port:
        source = label_source(str(robot), None, None, dwell_s=1.0, say=print)
        child = os.fork()
        if child == 0:
            record_board(DetectedBoard(port, None, "binary", 5), source, folder=tmp_path / "run1", seconds=60.0)
            os._exit(0)
        write_robot_log(robot, tmp_path / "run1.part")
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    blocks, account = read(tmp_path / "run1.part")
    assert places_of(blocks) == {(4.0, 8.0)}
    assert account["dropped_no_frame_indentations_n"] == 0


def write_robot_log(robot, part):
    """Write the log of a robot that touches the skin at (4, 8) mm, until two touches are recorded.

    Each touch lasts until frames arrive.
    """
    end_s = time.monotonic() + LONG_S
    with robot.open("w", buffering=1) as stream:
        stream.write("unix_s,phase,x_mm,y_mm,Fz_N\n")
        for phase in cycle(["noload", "contact"]):
            before_n, holds = frames_written_n(part), True
            while holds:  # The row that ends a phase is written after the frames have arrived.
                holds = frames_written_n(part) < before_n + DWELL_FRAMES_N
                stream.write(f"{time.time():.4f},{phase},4,8,0.5\n")
                time.sleep(0.02)
                assert time.monotonic() < end_s, "no labels were written"
            if (part / PROBE_FILE).exists() and len((part / PROBE_FILE).read_text().splitlines()) > 4:
                return


def test_recording_on_a_full_disk_can_be_added(tmp_path, monkeypatch, hold_until_frames):
    from errno import ENOSPC

    from reskin.recordings import labels

    taken = []

    def append(file, data):
        taken.append(data)
        if len(taken) > 2:  # The disk becomes full after the header of the log and one touch are written.
            raise OSError(ENOSPC, "No space left on device")
        file.write(data)

    # Only writing the labels fails. The stream is still written.
    monkeypatch.setattr(labels, "io", SimpleNamespace(append=append))
    with plugged_in(make_script(pokes_n=1), loop=True) as port, pytest.raises(OSError, match="No space left"):
        reskin.record(pokes(), port=port, out=tmp_path / "run1", dwell_s=0.2)
    assert not (tmp_path / "run1").exists()
    blocks, _ = read(tmp_path / "run1.part")
    assert places_of(blocks) == {PLACES[0]}
    assert all(np.isfinite(block.b_uT).all() for block in blocks)


@pytest.mark.parametrize(
    ("labels", "gauge", "scan", "message"),
    [("robot.txt", None, None, "--labels: robot.txt is not grid"), ("grid:2x2:4", None, "spiral", "--scan: the order"),
     (None, "/dev/x@fast", None, "--gauge: /dev/x@fast is not PORT"), ("robot.csv", "/dev/x", None, "--labels")],
)  # fmt: skip
def test_invalid_label_sources_are_refused(labels, gauge, scan, message):
    with pytest.raises(ParamsError, match=message):
        label_source(labels, gauge, scan, dwell_s=1.0, say=print)


def test_places_are_prompted_in_random_order_by_default():
    assert label_source("grid:2x2:4", None, None, dwell_s=1.0, say=print).scan == "random"
    assert label_source("line:5:2", "/dev/x@9600", "snake", dwell_s=1.0, say=print).scan == "snake"
    assert label_source(None, "/dev/x", None, dwell_s=1.0, say=print).name == "gauge"
    assert label_source(None, None, None, dwell_s=1.0, say=print) is None
