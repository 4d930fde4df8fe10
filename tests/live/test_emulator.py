"""Tests of emulated boards: their scripts, the times at which bytes are sent, and injected faults."""

import math
import threading
import time
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from reskin.board.port import open_port, read_waiting
from reskin.board.stream import decode_all
from reskin.data.grid import points_mm
from reskin.errors import CaptureError, ParamsError, ReskinError
from reskin.live.emulator import (
    LATE_MAX_S,
    EmulatedBoard,
    RobotLog,
    TouchPrinter,
    make_port,
    play,
    read_script,
)
from reskin.recordings.header import LOG_FILE, Clock, write_capture
from reskin.recordings.labels import DwellBuilder, SampleTable
from reskin.recordings.readers.sd_card import render
from tests.live.boards import RATE_HZ, make_script, write_script
from tests.live.faults import inject
from tests.recordings.headers import make_header
from tests.stages.checkout import ROOT

LONG_S = 120.0
SCRIPT, POKE_SCRIPT = make_script(pokes_n=0), make_script(pokes_n=1)


class SimulatedClock:
    """A clock whose time advances only by waiting. It also serves as a stop event that is never set."""

    def __init__(self):
        self.s = 0.0

    def monotonic(self):
        return self.s

    def is_set(self):
        return False

    def wait(self, seconds):
        self.s += max(seconds, 1e-9)  # A smaller time step would be lost by rounding.


class FakeReader:
    """A reader that records when each frame arrives. After frame `late_i`, it pauses once, for `late_s`."""

    opened = False

    def __init__(self, times, late_i=-1, late_s=0.0):
        self.times, self.late_i, self.late_s, self.arrival_s = times, late_i, late_s, []

    def send(self, data, _stop):
        self.arrival_s += [self.times.s] * (len(data) // 82)
        if self.late_i in range(len(self.arrival_s)):
            self.times.s, self.late_i = self.times.s + self.late_s, -1
        return len(data)


@pytest.fixture
def times(monkeypatch):
    times = SimulatedClock()
    monkeypatch.setattr("reskin.live.emulator.time", times)
    return times


@pytest.mark.parametrize("port", ["pty", "tcp"])
def test_no_byte_is_lost_while_nobody_reads_from_the_open_port(port):
    sent = b"".join(SCRIPT.pieces)
    end, stop, sent_bytes_n = make_port(port), threading.Event(), []
    player = threading.Thread(target=lambda: sent_bytes_n.append(play(SCRIPT, end, stop, speed=math.inf)))
    with open_port(end.name, 115200) as device:  # When a port is opened, bytes that wait there are discarded.
        player.start()
        time.sleep(0.5)  # During this pause, nobody reads from the port.
        data = b""
        while len(data) < len(sent):
            data += read_waiting(device)
    player.join(LONG_S)
    end.unplug()
    assert data == sent
    assert sent_bytes_n == [len(sent)]


@pytest.mark.parametrize("port", ["pty", "tcp"])
def test_emulated_board_starts_again_when_its_port_is_reopened(port):
    # When a port is opened, bytes that wait there are discarded, so some of the first frames may be missing.
    script = make_script(pokes_n=2)
    end, stop, early = make_port(port), threading.Event(), b"".join(script.pieces[200:250])
    player = threading.Thread(target=play, args=[script, end, stop], kwargs={"loop": True})
    player.start()
    restarted = []
    for _ in range(2):
        with open_port(end.name, 115200) as device:
            data = b""
            # The loop reads enough bytes to distinguish a stream that begins again from one that continues.
            while len(data) < 8 * len(early):
                data += read_waiting(device)
        restarted.append(early in data)
    stop.set()
    player.join()
    end.unplug()
    assert len(script) > 800
    assert all(restarted)


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_option_speed_multiplies_the_frame_rate_of_the_script(times, speed):
    reader = FakeReader(times)
    assert play(SCRIPT, reader, times, speed=speed) == len(b"".join(SCRIPT.pieces))
    np.testing.assert_allclose(reader.arrival_s, SCRIPT.t_s / speed, atol=1e-8)


def test_reader_that_pauses_then_receives_at_most_a_tenth_of_a_second_at_once(times):
    reader = FakeReader(times, late_i=100, late_s=2.0)
    play(SCRIPT, reader, times)
    late_s = np.array(reader.arrival_s) - SCRIPT.t_s
    np.testing.assert_allclose(late_s[:101], 0, atol=1e-8)
    np.testing.assert_allclose(late_s[-100:], 2.0 - LATE_MAX_S, atol=1 / RATE_HZ)
    assert max(Counter(reader.arrival_s).values()) <= LATE_MAX_S * RATE_HZ + 1


def test_link_to_an_emulated_board_returns_with_its_name_after_unplugging(tmp_path):
    link, stop = tmp_path / "board", threading.Event()
    end = make_port(str(link))
    player = threading.Thread(target=play, args=[SCRIPT, end, stop])
    with pytest.raises(OSError, match="returned no data|Input/output"), open_port(str(link), 115200) as device:
        player.start()
        while True:
            if read_waiting(device):
                stop.set()
                player.join()
                end.unplug()
    assert not link.is_symlink()
    assert not link.exists()
    end.plug_in()
    assert link.is_symlink()
    end.unplug()


def test_make_port_raises_if_the_link_is_in_use_and_keeps_the_link(tmp_path):
    link = tmp_path / "board"
    first = make_port(str(link))
    leads_to = link.readlink()
    with pytest.raises(ParamsError, match=r"--port: .*board links to /dev/.*, which is in use"):
        make_port(str(link))
    assert link.readlink() == leads_to
    first.unplug()
    assert not link.is_symlink()
    # This link leads to no port. Such a link remains if an emulator is killed.
    link.symlink_to(leads_to.with_name("999999"))
    second = make_port(str(link))
    assert link.exists()
    second.unplug()


def test_link_that_another_emulator_has_taken_over_is_not_removed(tmp_path):
    link = tmp_path / "board"
    first = make_port(str(link))
    first.unplug()
    second = make_port(str(link))
    with pytest.raises(ParamsError, match="which is in use"):
        first.plug_in()
    first.unplug()  # `reskin emulate` does the same at its end.
    assert link.exists()
    second.unplug()
    assert not link.is_symlink()


def test_invalid_names_of_ports_are_refused(tmp_path):
    (tmp_path / "file").touch()
    for port in ("usb", "tcp:x", "tcp:99999", str(tmp_path / "file")):
        with pytest.raises(ParamsError, match="--port: "):
            make_port(port)
    for url in ("loop://", "alt:///dev/null?class=VTIMESerial", "socket://nowhere:1"):
        with pytest.raises(CaptureError, match="cannot open the port"):
            open_port(url, 115200)
    with pytest.raises(CaptureError, match="port number is missing"):
        open_port("socket://127.0.0.1", 115200)


class TestFaults:
    def test_faults_that_change_values_change_only_frames_during_the_fault(self):
        for name in (
            "failed-read",
            "chip-reset",
            "stuck",
            "slow-chips",
            "saturated",
            "int16-wrap",
            "magnet",
            "too-hot",
            "crlf",
        ):
            changed = inject(SCRIPT, f"{name}@0.5+0.25")
            inside = (SCRIPT.t_s >= 0.5) & (SCRIPT.t_s < 0.75)
            differs = np.array([one != other for one, other in zip(changed.pieces, SCRIPT.pieces, strict=True)])
            assert not differs[~inside].any(), name
            assert differs[inside].mean() > 0.4, name
            assert [len(piece) for piece in changed.pieces] == [len(piece) for piece in SCRIPT.pieces]

    def test_faults_that_drop_or_repeat_bytes_change_the_number_of_frames(self):
        def frames_n(name: str) -> int:
            return len(decode_all(b"".join(inject(SCRIPT, f"{name}@0.5+0.25").pieces), "binary", 5, name)[0])

        assert frames_n("dropped") == len(SCRIPT) - 50
        assert frames_n("repeated") == len(SCRIPT) + 100
        assert frames_n("torn") == len(SCRIPT) - 2 * 10  # The frame after each torn frame is lost, too.


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-xyzt", "text-txyz"])
def test_script_of_a_capture_has_the_bytes_and_times_of_the_capture(tmp_path, wire):
    sent = make_script(pokes_n=1, wire=wire)
    write_script(sent, tmp_path / "c0")
    script = read_script(str(tmp_path / "c0"))
    assert script.pieces == sent.pieces
    np.testing.assert_allclose(script.t_s, POKE_SCRIPT.t_s, atol=1e-6)
    assert script.duration_s == pytest.approx(len(script) / 400)


def test_script_of_an_sd_card_log_has_the_frames_of_the_log(tmp_path):
    frames = POKE_SCRIPT.frames
    log = render(1 + POKE_SCRIPT.t_s, frames.b_uT, frames.temperature_degC)
    header = make_header(capture="c0", layout="sd-card", clock=Clock(kind="recording", rate_hz=None, marks=()))
    write_capture(tmp_path / "c0", header, {LOG_FILE: log.encode()})
    script = read_script(str(tmp_path / "c0"))
    np.testing.assert_allclose(script.frames.b_uT, frames.b_uT, atol=0.006)  # Tolerance: the log has two decimals.
    np.testing.assert_allclose(script.t_s, POKE_SCRIPT.t_s, atol=1e-4)


@pytest.mark.parametrize("source", ["nominal", str(ROOT / "pipeline/scenes/ci.yaml")])
def test_script_of_a_simulation_has_contacts(source):
    script = read_script(source)
    assert script.frames.b_uT.shape == (len(script), 15)
    assert np.all(np.diff(script.t_s) >= 0)
    assert np.ptp(script.frames.b_uT, axis=0).max() > 100  # Contacts change the field by more than 100 uT.
    true = script.true_contacts
    contact = np.isfinite(true[:, 0])
    np.testing.assert_array_equal(np.isfinite(true), np.repeat(contact[:, None], 3, axis=1))
    change_uT = np.linalg.norm(script.frames.b_uT - script.frames.b_uT[~contact].mean(axis=0), axis=1)
    # The limit is 60 uT. The noise of 15 channels together is about 15 uT.
    assert change_uT[~contact].max() < 60 < np.median(change_uT[contact])
    # The true forces belong to the same times as the field changes, so a shift by a frame or more reduces their
    # correlation.
    force_N = np.nan_to_num(true[:, 2])
    correlation = [np.corrcoef(np.roll(force_N, lag), change_uT)[0, 1] for lag in range(-5, 6)]
    assert np.argmax(correlation) == 5


def test_true_contacts_of_a_capture_are_unknown(tmp_path):
    assert read_script(str(write_script(POKE_SCRIPT, tmp_path / "c0"))).true_contacts is None


def test_true_contact_belongs_to_the_last_frame_that_was_sent(times):
    true = np.arange(3.0 * len(SCRIPT)).reshape(-1, 3)
    script, found = replace(SCRIPT, true_contacts=true), []
    board = EmulatedBoard(script, SimpleNamespace(name="port"))
    reader = FakeReader(times)

    def note_sent(pieces):
        board.note_sent(pieces)
        found.append((len(reader.arrival_s), board.true_contact()))

    play(script, reader, times, on_sent=note_sent)
    assert [contact for _, contact in found] == [tuple(true[sent_n - 1]) for sent_n, _ in found]
    assert found[-1][0] == len(script)


def test_true_place_is_printed_when_a_touch_begins(times):
    true, printed = np.full((len(SCRIPT), 3), np.nan), []
    true[100:150], true[300:400] = (4.0, 12.0, 0.5), (12.0, 4.0, 1.5)
    true[320, 2] = 1.75
    script, reader = replace(SCRIPT, true_contacts=true), FakeReader(times)
    printer = TouchPrinter(script, "nominal", lambda text: printed.append((len(reader.arrival_s), text)))
    for _ in range(2):
        play(script, reader, times, on_sent=printer)
    sent_n, texts = zip(*printed, strict=True)
    assert texts == 2 * (
        "true place: x 4.0 mm, y 12.0 mm; largest force 0.50 "
            "N", "true place: x 12.0 mm, y 4.0 mm; largest force 1.75 N",
    )  # fmt: skip
    first_n = np.array([101, 301, len(script) + 101, len(script) + 301])
    assert np.all((np.array(sent_n) >= first_n) & (np.array(sent_n) < first_n + 256))
    with pytest.raises(ParamsError, match="--true-places: the true places of captures/run1 are unknown"):
        TouchPrinter(SCRIPT, "captures/run1", print)


def test_invalid_sources_are_refused(tmp_path):
    for source in (str(tmp_path), "nowhere", str(ROOT / "pipeline/scenes/lab.yaml"), "../scenes/quick"):
        with pytest.raises(ReskinError, match="must be the folder of a capture|recorded, not simulated") as error:
            read_script(source)
        assert "Traceback" not in str(error.value)


@pytest.fixture(scope="module")
def robot_script():
    return read_script("nominal", board="b1", robot=True)


class TestRobot:
    @pytest.mark.parametrize("batch_n", [1, 7])
    def test_log_of_the_emulated_robot_gives_one_labelled_touch_per_place_and_pass(
        self, robot_script, tmp_path, monkeypatch, batch_n
    ):
        clock = SimpleNamespace(s=0.0, time=lambda: clock.s)
        monkeypatch.setattr("reskin.live.emulator.time", clock)
        log = RobotLog(robot_script, tmp_path / "robot.csv")
        for i in range(batch_n - 1, len(robot_script), batch_n):  # Frames that are late are sent in batches.
            clock.s = 1e9 + robot_script.t_s[i]
            log(range(i - batch_n + 1, i + 1))
        log.close()
        dwells = list(DwellBuilder().feed(SampleTable("log").feed((tmp_path / "robot.csv").read_bytes())))
        touches = [dwell for dwell in dwells if dwell.label.contact]
        # The rows after the last touch become no dwell, because no row of another phase ends them.
        assert len(dwells) == 2 * len(touches)
        for pass_i in range(2):
            places = [touch.label[1:3] for touch in touches if touch.label.pass_i == pass_i]
            assert sorted(places) == sorted(map(tuple, points_mm().tolist()))
        for touch in touches:  # At any time during a dwell, the true contact equals the label of the dwell.
            inside = (robot_script.t_s >= touch.t_start_s - 1e9) & (robot_script.t_s <= touch.t_end_s - 1e9)
            true = robot_script.true_contacts[inside]
            assert np.isfinite(true).all()
            np.testing.assert_allclose(true[:, 2], touch.label.Fz_N, rtol=2e-3)

    def test_boards_with_different_names_have_different_skins(self, robot_script):
        other = read_script("nominal", board="b2", robot=True)
        untouched = [one.frames.b_uT[np.isnan(one.true_contacts[:, 0])].mean(axis=0) for one in (robot_script, other)]
        assert np.abs(untouched[0] - untouched[1]).max() > 50  # The two skins differ by more than this number of uT.

    @pytest.mark.parametrize("name", ["b 1", "../b1", "", "x" * 65])
    def test_invalid_names_of_boards_raise(self, name):
        with pytest.raises(ParamsError, match=r"--board: the name must be 1 to 64 .* Choose another name"):
            read_script("nominal", board=name)

    def test_options_for_the_nominal_board_raise_for_other_sources(self, tmp_path):
        write_script(SCRIPT, tmp_path / "c0")
        for options in ({"board": "b1"}, {"robot": True}):
            with pytest.raises(ParamsError, match="can only be used with source nominal"):
                read_script(str(tmp_path / "c0"), **options)
            with pytest.raises(ParamsError, match="nominl: the source must be the folder of a capture"):
                read_script("nominl", **options)
