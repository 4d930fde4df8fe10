"""What is played is what is read: every byte, over a pseudo-terminal and a socket, at its rate or faster."""

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from pipeline.capture.port import open_port, read_waiting
from pipeline.capture.stream import decode_all
from pipeline.core.errors import CaptureError, ParamsError
from pipeline.live.emulate import open_far_end, play
from pipeline.live.inject import inject, parse
from tests.live.boards import RATE_HZ, make_script, plugged_in

LONG_S = 30.0
SCRIPT = make_script(pokes_n=0)


def read(name: str, bytes_n: int) -> tuple[bytes, float]:
    """Read so many bytes; say how long it took after the first."""
    data, start_s, end_s = b"", math.inf, time.monotonic() + LONG_S
    with open_port(name, 115200) as device:
        while len(data) < bytes_n and time.monotonic() < end_s:
            data += read_waiting(device)
            start_s = min(start_s, time.monotonic()) if data else start_s
    return data, time.monotonic() - start_s


@pytest.mark.parametrize("port", ["pty", "tcp"])
def test_every_byte_arrives_as_fast_as_it_is_taken_and_no_reader_is_no_loss(port):
    sent = b"".join(SCRIPT.pieces)
    end, stop, told = open_far_end(port), threading.Event(), []
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


def test_a_script_is_played_at_its_own_rate_or_as_many_times_faster():
    for speed in (1.0, 3.0):
        with plugged_in(SCRIPT, speed=speed, loop=True) as name:
            _, took_s = read(name, round(RATE_HZ) * 82)
            assert took_s * speed == pytest.approx(1.0, abs=0.4)  # two cores, shared with other work


def test_a_link_keeps_its_name_when_the_board_is_unplugged_and_plugged_in_again(tmp_path):
    link = tmp_path / "board"
    script = inject(SCRIPT, parse("unplug@0.5+0.5"))
    with (
        plugged_in(script, str(link)) as name,
        pytest.raises(OSError, match="returned no data|Input/output"),
        open_port(name, 115200) as device,
    ):
        while True:
            read_waiting(device)
    assert not link.is_symlink()
    assert not link.exists()


def test_a_port_that_is_no_port_is_refused(tmp_path):
    (tmp_path / "file").touch()
    for port in ("usb", "tcp:x", str(tmp_path / "file")):
        with pytest.raises(ParamsError, match="must be"):
            open_far_end(port)
    for url in ("loop://", "alt:///dev/null?class=VTIMESerial", "socket://nowhere"):
        with pytest.raises(CaptureError, match="the port must be one that opens"):
            open_port(url, 115200)


class TestFaults:
    def test_values_change_inside_the_fault_and_bytes_outside_stay(self):
        for name in ("failed-read", "chip-reset", "stuck", "saturated", "int16-wrap", "magnet", "too-hot", "crlf"):
            changed = inject(SCRIPT, parse(f"{name}@0.5+0.25"))
            inside = (SCRIPT.t_s >= 0.5) & (SCRIPT.t_s < 0.75)
            differs = np.array([one != other for one, other in zip(changed.pieces, SCRIPT.pieces, strict=True)])
            assert not differs[~inside].any(), name
            assert differs[inside].mean() > 0.4, name
            assert [len(piece) for piece in changed.pieces] == [len(piece) for piece in SCRIPT.pieces]

    def test_dropped_repeated_and_torn_frames_are_so_many_less_or_more(self):
        def frames_n(name: str) -> int:
            return len(decode_all(b"".join(inject(SCRIPT, parse(f"{name}@0.5+0.25")).pieces), "binary", 5, name)[0])

        assert frames_n("dropped") == len(SCRIPT) - 50
        assert frames_n("repeated") == len(SCRIPT) + 100
        assert frames_n("torn") == len(SCRIPT) - 2 * 10  # with its end goes the start of the next

    def test_a_clock_can_jump_only_where_there_is_one(self):
        with pytest.raises(ParamsError, match="Take binary-clock"):
            inject(
                replace(SCRIPT, frames=replace(SCRIPT.frames, device_s=SCRIPT.frames.device_s * np.nan)),
                parse("clock-jump@0.5"),
            )
        assert len(inject(make_script(pokes_n=0, wire="binary-clock"), parse("clock-jump@0.5"))) == len(SCRIPT)

    @pytest.mark.parametrize("text", ["", "stick", "stuck@", "stuck@-1", "stuck@1+", "stuck@99", "stuck@1e9"])
    def test_a_fault_that_is_none_or_never_happens_is_refused(self, text):
        with pytest.raises(ParamsError, match="must be"):
            inject(SCRIPT, parse(text))
