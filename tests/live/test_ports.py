"""Tests that boards are recognised by the bytes that they send, and that other devices are not."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin import cli as commands
from reskin.board import find
from reskin.board.port import BAUD, open_port
from reskin.errors import CaptureError, ReskinError
from reskin.seeds import rng_for
from tests.live.boards import make_script, plugged_in
from tests.live.faults import inject

CHUNK_N = 3  # Each chunk has the bytes of this number of frames, and starts in the middle of a frame.


def chunks_of(script, cut_n=31):
    """Return the bytes of the script in chunks.

    The first `cut_n` bytes are missing, because the port is opened while a frame is being sent.
    """
    data = b"".join(script.pieces)[cut_n:]
    size = CHUNK_N * len(script.pieces[0])
    every_s = CHUNK_N * script.duration_s / len(script)
    return [(data[first : first + size], every_s * i) for i, first in enumerate(range(0, len(data), size))]


@pytest.mark.parametrize("wire", ["binary", "binary-clock", "text-xyzt", "text-txyz"])
@pytest.mark.parametrize(("chips_n", "rate_hz"), [(1, 400.0), (5, 400.0), (40, 133.0)])
def test_properties_of_a_board_are_detected_from_its_bytes(wire, chips_n, rate_hz):
    script = make_script(pokes_n=0, chips_n=chips_n, wire=wire, rate_hz=rate_hz)
    found = find.recognise("port", chunks_of(script))
    assert (found.problem, found.wire, found.chips_n) == (None, wire, chips_n)
    assert found.rate_hz == pytest.approx(rate_hz, rel=0.03)
    # The relative tolerance is for text frames, which have two decimals.
    np.testing.assert_allclose(found.lsb_uT, (0.15, 0.242), rtol=0.06)
    assert found.gain_sel == 7
    assert f"{chips_n} chips" in str(found)


def test_devices_that_send_other_bytes_are_not_taken_for_boards():
    script = make_script(pokes_n=0)
    wrong_baud = chunks_of(inject(script, "wrong-baud@0+99"))
    assert "Check the baud rate" in str(find.recognise("port", wrong_baud))
    assert "no bytes arrived" in str(find.recognise("port", []))
    assert "cannot open the port" in str(find.detect_board("/dev/none"))


@given(st.binary(max_size=3000), st.integers(1, 700))
def test_bytes_of_an_unknown_device_are_described_without_an_error(data, size):
    chunks = [(data[first : first + size], 0.01 * first) for first in range(0, len(data), size)]
    found = find.recognise("port", chunks)
    assert str(found).startswith("port: ")
    assert found.describe_rate().startswith("port: ")


@given(st.integers(0, 2**32), st.integers(1, 4))
def test_frames_with_random_values_are_described_without_an_error(seed, chips_n):
    rng = rng_for(seed, "numbers")
    values = rng.integers(0, 2**32, (40, 4 * chips_n), dtype=np.uint32)
    values[rng.random(values.shape) < 0.5] = np.float32(25).view(np.uint32)
    data = b"".join(row.tobytes() + b"\r\n" for row in values)
    found = find.recognise("port", [(data, 0.0), (data, 1.0)])
    assert str(found).startswith("port: ")
    assert found.describe_rate().startswith("port: ")


def test_steps_of_chips_are_unknown_if_readings_have_no_noise():
    script = make_script(pokes_n=0)
    without_noise = replace(script, pieces=[script.pieces[0]] * len(script))
    assert "steps not known yet" in str(find.recognise("port", chunks_of(without_noise)))


@pytest.mark.parametrize(
    "command",
    [
        lambda port: commands.live([port]),
        lambda port: commands.record(port, seconds=0.1),
        lambda port: commands.record("/dev/none", gauge=port, seconds=0.1),
        lambda port: commands.emulate("nominal", port),
        lambda port: commands.emulate(port),
        lambda port: commands.live(emulate=port),
        lambda port: commands.live(skins=Path(port), port=["/dev/none"]),
    ],
    ids=["live", "record", "gauge", "emulated port", "emulated source", "live --emulate", "skins"],
)
def test_file_given_as_a_port_is_an_error_of_one_sentence(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "notes.txt"
    file.write_text("not a port")
    with pytest.raises(ReskinError, match=r"notes\.txt") as error:
        command(str(file))
    assert "\n" not in str(error.value)
    assert file.read_text() == "not a port"
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_busy_port_is_an_error_of_one_sentence():
    with plugged_in(make_script(pokes_n=0), loop=True) as name, open_port(name, BAUD):
        busy = f"{name}: cannot open the port: another program uses it"
        with pytest.raises(CaptureError, match=busy) as error:
            open_port(name, BAUD)
        assert "\n" not in str(error.value)
        assert str(find.detect_board(name, 0.1)).startswith(busy)


def test_opening_a_device_that_is_not_a_serial_port_raises():
    with pytest.raises(CaptureError, match=f"{os.devnull}: cannot open the port: it is not a serial port"):
        open_port(os.devnull, BAUD)


def test_find_board_raises_unless_exactly_one_board_is_connected(monkeypatch):
    script = make_script(pokes_n=1)
    with plugged_in(script, loop=True) as name, plugged_in(script, "tcp", loop=True) as other:
        found = {board.port: board for board in find.scan_ports([name, "/dev/none", other])}
    # The result of the scan above is used again, because listening to a port takes 1.5 s.
    with monkeypatch.context() as listened:
        listened.setattr(find, "detect_board", lambda port, *_: found[port])
        assert find.find_board([name, "/dev/none"]).port == name
        with pytest.raises(CaptureError, match=r"2 boards are connected: .*5 chips.*; .*5 chips.*--port"):
            find.find_board([name, other])
        assert [found.port for found in find.find_boards([name, "/dev/none", other])] == [name, other]
    with pytest.raises(CaptureError, match="no serial port found"):
        find.find_board([])


class TestReplugging:
    def find(self, *port_lists):
        """Find the port of a board that was plugged in again.

        Each time the function looks for ports, it sees the next of the given lists. After the last list, it sees the
        last list again.
        """
        polls, printed = iter(port_lists), []
        last = [set(port_lists[-1])]

        def names():
            last[0] = set(next(polls, last[0]))
            return last[0]

        return find.find_replugged_port(printed.append, names=names, pause=lambda _: None, timeout_s=1.0), printed

    def test_board_that_is_plugged_in_again_is_found_at_its_new_port(self):
        found, printed = self.find("ab", "ab", "ab", "b", "b", "b", "bc")
        assert found == "c"  # The board may then have another port.
        assert printed == ["Unplug the board.", "a disappeared. Plug the board in again."]

    def test_waiting_for_a_board_ends_at_the_time_limit(self):
        with pytest.raises(CaptureError, match="no port disappeared within 1 s"):
            self.find("ab")
