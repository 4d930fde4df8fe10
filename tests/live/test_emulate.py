"""What is played is what is read: every byte, over a pseudo-terminal and a socket, at its rate or faster."""

import math
import threading
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from reskin.board.port import open_port, read_waiting
from reskin.board.stream import decode_all
from reskin.errors import CaptureError, ParamsError
from reskin.live.emulator import LATE_MAX_S, inject, make_port, parse_fault, play
from tests.live.boards import RATE_HZ, make_script

LONG_S = 120.0
SCRIPT = make_script(pokes_n=0)


class Times:
    """A clock that waiting moves, and nothing else; also when to stop: never."""

    def __init__(self):
        self.s = 0.0

    def monotonic(self):
        return self.s

    def is_set(self):
        return False

    def wait(self, seconds):
        self.s += max(seconds, 1e-9)  # what is less than a digit of the sum would not move it


class Taker:
    """A reader's end that notes when each frame came, and is `late_s` once, at the frame `late_i`."""

    def __init__(self, times, late_i=-1, late_s=0.0):
        self.times, self.late_i, self.late_s, self.came_s = times, late_i, late_s, []

    def send(self, data, _stop):
        self.came_s += [self.times.s] * (len(data) // 82)
        if self.late_i in range(len(self.came_s)):
            self.times.s, self.late_i = self.times.s + self.late_s, -1
        return len(data)

    def was_opened(self):
        return False


@pytest.fixture
def times(monkeypatch):
    times = Times()
    monkeypatch.setattr("reskin.live.emulator.time", times)
    return times


@pytest.mark.parametrize("port", ["pty", "tcp"])
def test_every_byte_arrives_as_fast_as_it_is_taken_and_no_reader_is_no_loss(port):
    sent = b"".join(SCRIPT.pieces)
    end, stop, told = make_port(port), threading.Event(), []
    player = threading.Thread(target=lambda: told.append(play(SCRIPT, end, stop, speed=math.inf)))
    with open_port(end.name, 115200) as device:  # a reader that opens a port throws away what waited before
        player.start()
        time.sleep(0.5)  # nobody reads
        data = b""
        while len(data) < len(sent):
            data += read_waiting(device)
    player.join(LONG_S)
    end.unplug()
    assert data == sent
    assert told == [len(sent)]


@pytest.mark.parametrize("port", ["pty", "tcp"])
def test_what_is_played_over_and_over_begins_again_when_its_port_is_opened_again(port):
    # Who opens a port throws away what waits there, so that of the first frames some may not come.
    script = make_script(pokes_n=2)
    end, stop, early = make_port(port), threading.Event(), b"".join(script.pieces[200:250])
    player = threading.Thread(target=play, args=[script, end, stop], kwargs={"loop": True})
    player.start()
    began = []
    for _ in range(2):
        with open_port(end.name, 115200) as device:
            data = b""
            while len(data) < 8 * len(early):  # the second time they would be others
                data += read_waiting(device)
        began.append(early in data)
    stop.set()
    player.join()
    end.unplug()
    assert len(script) > 800
    assert all(began)


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_a_script_is_played_at_its_own_rate_or_as_many_times_faster(times, speed):
    taker = Taker(times)
    assert play(SCRIPT, taker, times, speed=speed) == len(b"".join(SCRIPT.pieces))
    np.testing.assert_allclose(taker.came_s, SCRIPT.t_s / speed, atol=1e-8)


def test_a_reader_that_keeps_the_board_waiting_is_given_a_tenth_of_a_second_at_once_and_no_more(times):
    taker = Taker(times, late_i=100, late_s=2.0)
    play(SCRIPT, taker, times)
    late_s = np.array(taker.came_s) - SCRIPT.t_s
    np.testing.assert_allclose(late_s[:101], 0, atol=1e-8)
    np.testing.assert_allclose(late_s[-100:], 2.0 - LATE_MAX_S, atol=1 / RATE_HZ)
    assert max(Counter(taker.came_s).values()) <= LATE_MAX_S * RATE_HZ + 1


def test_a_link_keeps_its_name_when_the_board_is_unplugged_and_plugged_in_again(tmp_path):
    link, stop = tmp_path / "board", threading.Event()
    end = make_port(str(link))
    player = threading.Thread(target=play, args=[inject(SCRIPT, parse_fault("unplug@0.5+99")), end, stop])
    with pytest.raises(OSError, match="returned no data|Input/output"), open_port(str(link), 115200) as device:
        player.start()
        while True:
            read_waiting(device)
    assert not link.is_symlink()
    assert not link.exists()
    stop.set()  # which ends the time that it is away
    player.join()
    assert link.is_symlink()
    end.unplug()


def test_a_port_that_is_no_port_is_refused(tmp_path):
    (tmp_path / "file").touch()
    for port in ("usb", "tcp:x", str(tmp_path / "file")):
        with pytest.raises(ParamsError, match="--port: "):
            make_port(port)
    for url in ("loop://", "alt:///dev/null?class=VTIMESerial", "socket://nowhere"):
        with pytest.raises(CaptureError, match="the port must be one that opens"):
            open_port(url, 115200)


class TestFaults:
    def test_values_change_inside_the_fault_and_bytes_outside_stay(self):
        for name in ("failed-read", "chip-reset", "stuck", "saturated", "int16-wrap", "magnet", "too-hot", "crlf"):
            changed = inject(SCRIPT, parse_fault(f"{name}@0.5+0.25"))
            inside = (SCRIPT.t_s >= 0.5) & (SCRIPT.t_s < 0.75)
            differs = np.array([one != other for one, other in zip(changed.pieces, SCRIPT.pieces, strict=True)])
            assert not differs[~inside].any(), name
            assert differs[inside].mean() > 0.4, name
            assert [len(piece) for piece in changed.pieces] == [len(piece) for piece in SCRIPT.pieces]

    def test_dropped_repeated_and_torn_frames_are_so_many_less_or_more(self):
        def frames_n(name: str) -> int:
            return len(
                decode_all(b"".join(inject(SCRIPT, parse_fault(f"{name}@0.5+0.25")).pieces), "binary", 5, name)[0]
            )

        assert frames_n("dropped") == len(SCRIPT) - 50
        assert frames_n("repeated") == len(SCRIPT) + 100
        assert frames_n("torn") == len(SCRIPT) - 2 * 10  # with its end goes the start of the next

    def test_a_clock_can_jump_only_where_there_is_one(self):
        with pytest.raises(ParamsError, match="Take binary-clock"):
            inject(
                replace(SCRIPT, frames=replace(SCRIPT.frames, device_s=SCRIPT.frames.device_s * np.nan)),
                parse_fault("clock-jump@0.5"),
            )
        assert len(inject(make_script(pokes_n=0, wire="binary-clock"), parse_fault("clock-jump@0.5"))) == len(SCRIPT)

    @pytest.mark.parametrize("text", ["", "stick", "stuck@", "stuck@-1", "stuck@1+", "stuck@99", "stuck@1e9"])
    def test_a_fault_that_is_none_or_never_happens_is_refused(self, text):
        with pytest.raises(ParamsError, match="--fault: "):
            inject(SCRIPT, parse_fault(text))
