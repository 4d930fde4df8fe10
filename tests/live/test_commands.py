"""Tests that `reskin record` and `reskin live` without options find the boards that are plugged in."""

import time
from types import SimpleNamespace

import pytest

from reskin import cli as commands
from reskin.board import find
from reskin.cli import with_default_simulation
from reskin.errors import ParamsError
from reskin.recordings.header import HEADER_FILE, STREAM_FILE, parse
from tests.live.boards import make_script, plugged_in
from tests.live.faults import inject

NO_OPTIONS = {"board": None, "skin": None, "wire": None, "chips_n": None, "baud": 115200, "scan": None}
RATE_BYTES_S = 82 * 400


@pytest.fixture(autouse=True)
def clock(tmp_path, monkeypatch):
    """Replace the clock of the recorder by one that advances with received bytes.

    Results therefore do not depend on the load of the machine.
    """

    def monotonic() -> float:
        return sum(stream.stat().st_size for stream in tmp_path.rglob(STREAM_FILE)) / RATE_BYTES_S

    monkeypatch.setattr(
        "reskin.recordings.recorder.time", SimpleNamespace(monotonic=monotonic, time=time.time, strftime=time.strftime)
    )


def test_record_without_options_finds_the_only_board(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with plugged_in(make_script(chips_n=4, wire="text-txyz"), loop=True) as name:
        monkeypatch.setattr(find, "port_names", lambda: [name])
        commands.record(None, seconds=0.5, out=None, **NO_OPTIONS)
    output = capsys.readouterr().out
    assert f"{name}: text-txyz, 4 chips" in output
    (folder,) = (tmp_path / "captures").iterdir()
    header = parse((folder / HEADER_FILE).read_text(), "header")
    assert (header.wire, header.chips_n, header.capture) == ("text-txyz", 4, folder.name)


def test_record_command_names_the_faulty_chip(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with plugged_in(inject(make_script(), "failed-read@0+99"), loop=True) as name:
        commands.record(port=name, seconds=1.5, out=tmp_path / "run1", **NO_OPTIONS)
    assert "; chip 1: failed I2C reads (" in capsys.readouterr().out


def test_record_measures_the_rate_and_the_repeated_readings(tmp_path, capsys):
    with plugged_in(inject(make_script(), "slow-chips@0+99"), loop=True, speed=5) as name:
        commands.record(port=name, seconds=3.0, out=tmp_path / "run1", **NO_OPTIONS)
    rate = parse((tmp_path / "run1" / HEADER_FILE).read_text(), "header").rate
    assert rate.arrived_hz == rate.sent_hz == pytest.approx(400, rel=0.05)
    assert rate.method == "arrivals"
    assert rate.repeated_frames < 0.01  # A frame may be repeated when the script begins again.
    assert rate.repeated_readings == pytest.approx(2 / 3, abs=0.01)
    output = capsys.readouterr().out
    assert "% of readings repeat; over 5 % of readings repeat: the board sends faster" in output


def test_recording_of_an_emulated_board_can_be_marked_as_simulated(tmp_path):
    for simulated, source in ((True, "simulated"), (False, "recorded")):
        with plugged_in(make_script(), loop=True) as name:
            commands.record(port=name, seconds=0.5, out=tmp_path / source, simulated=simulated, **NO_OPTIONS)
        assert parse((tmp_path / source / HEADER_FILE).read_text(), "header").source == source


def test_options_wire_and_chips_raise_without_a_port(tmp_path):
    for options in ({"wire": "binary"}, {"chips_n": 4}):
        with pytest.raises(ParamsError, match="--wire and --chips .* --port"):
            commands.record(None, seconds=0.5, out=tmp_path / "run1", **(NO_OPTIONS | options))


def test_live_without_options_shows_all_boards(monkeypatch):
    shown = {}
    monkeypatch.setattr(
        "reskin.live.server.serve", lambda sessions, **options: shown.update(options, sessions=sessions)
    )
    monkeypatch.setattr(
        "reskin.board.find.find_boards", lambda **_: [find.DetectedBoard(f"/dev/ttyACM{i}", None) for i in (0, 1)]
    )
    commands.live(None, None, None, None, "127.0.0.1", 8765, ["stuck=flag"])
    assert [str(session) for session in shown["sessions"]] == ["a board on /dev/ttyACM0", "a board on /dev/ttyACM1"]
    assert (shown["host"], shown["http_port"]) == ("127.0.0.1", 8765)
    policies = [session.skin.fault_policy for session in shown["sessions"]]
    assert {(one.stuck, one.zeros) for one in policies} == {("flag", "drop")}


def test_emulate_without_a_value_plays_the_nominal_simulation():
    assert with_default_simulation(["live", "--emulate"]) == ["live", "--emulate", "nominal"]
    given = ["live", "--emulate", "paper.yaml", "--host", "0.0.0.0"]
    assert with_default_simulation(given) == given
