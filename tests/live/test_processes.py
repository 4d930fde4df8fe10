"""Tests of the commands emulate, ports, record, decode and live, each in a process of its own.

The board is emulated.
"""

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from typer.testing import CliRunner

from reskin import io
from reskin.cli import _warn_of_absent_ports, app
from reskin.errors import ReskinError
from reskin.recordings.header import HEADER_FILE, parse
from reskin.recordings.preparing import CaptureNames, native
from tests.live.boards import PLACES, make_script, write_model, write_script
from tests.live.faults import inject
from tests.live.test_server import until
from tests.stages.checkout import ROOT

LONG_S = 120.0  # This time limit is long enough to import PyTorch on a busy machine.
pytestmark = [pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals"), pytest.mark.timeout(900)]


def restore_ctrl_c() -> None:
    """Let Ctrl-C end this process.

    If a shell has started the tests in the background, Ctrl-C would otherwise be ignored.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)


class Shell:
    """An object that runs `reskin` commands in a folder. `close` stops the commands that still run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.running = folder, []

    def start(self, *arguments: object) -> subprocess.Popen:
        command = [sys.executable, "-m", "pipeline", *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            command, cwd=self.folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            preexec_fn=restore_ctrl_c,
        )  # fmt: skip
        self.running.append(process)
        return process

    def run(self, *arguments: object) -> str:
        process = self.start(*arguments)
        output, errors = process.communicate(timeout=LONG_S)
        assert process.returncode == 0, errors
        return output

    def close(self) -> None:
        for process in self.running:
            process.kill()
            process.communicate()


@pytest.fixture
def shell(tmp_path) -> Iterator[Shell]:
    with closing(Shell(tmp_path)) as shell:
        yield shell


def wait_until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def test_commands_emulate_ports_record_decode_and_live_work_together(shell, tmp_path):
    capture, link = write_script(inject(make_script(pokes_n=4), "crlf@1+1"), tmp_path / "c0"), tmp_path / "board"
    board = shell.start("emulate", capture, "--port", link, "--loop")
    wait_until(link.is_symlink)

    assert "binary, 5 chips, " in shell.run("ports", link)

    output = shell.run("record", "--port", link, "--seconds", 2.0, "--out", "run1")
    assert float(re.search(r"duration after ([0-9.]+) s", output)[1]) >= 2.0
    stream = tmp_path / "run1/stream.bin"
    assert parse((tmp_path / "run1" / HEADER_FILE).read_text(), "header").chips_n == 5
    shell.run("decode", stream, "--out", "run1.parquet")
    assert len(io.read_table(tmp_path / "run1.parquet")) >= stream.stat().st_size // 82 - 2

    board.send_signal(signal.SIGINT)
    assert board.wait(timeout=LONG_S) == 0
    assert not link.is_symlink()

    with socket.create_server(("127.0.0.1", 0)) as free:
        http_port = free.getsockname()[1]
    page = shell.start("live", "--port", link, "--model", write_model(tmp_path), "--http-port", http_port)
    assert "open http://localhost" in page.stdout.readline()  # The page waits for the board.
    assert f"skins are saved in {tmp_path / 'skins'}" in page.stdout.readline()
    board = shell.start("emulate", capture, "--port", link, "--loop")
    asyncio.run(watch_page(f"http://localhost:{http_port}/live", board))
    page.send_signal(signal.SIGINT)
    assert page.wait(timeout=LONG_S) == 0
    assert f"{link}: no such port. The page waits for it." in page.stderr.read()


async def watch_page(address: str, board: subprocess.Popen) -> None:
    """Wait for contacts at the right places; then stop and unplug the board, and wait for the alarms."""
    async with aiohttp.ClientSession() as client, connect(client, address) as page:
        await until(page, lambda message: message.get("zeroed") is True)
        for _ in range(10):
            await until(page, lambda message: message.get("contact") == 1 and is_near(message))
        for signals, alarm in (((signal.SIGSTOP,), "no data"), ((signal.SIGCONT, signal.SIGINT), "unplugged")):
            for each in signals:
                board.send_signal(each)
            await until(page, lambda message, alarm=alarm: alarm in " ".join(message.get("alarms", [])))


def is_near(message: dict) -> bool:
    """Return whether an estimate is near one of the two pokes."""
    found = np.array([message["x_mm"], message["y_mm"], message["F_N"]])
    return np.abs(found - PLACES).max(axis=1).min() < 1.0


class connect:
    """Connect to a server, which may still be starting. This is a context manager that yields a websocket."""

    def __init__(self, client: aiohttp.ClientSession, address: str) -> None:
        self._client, self._address = client, address

    async def __aenter__(self) -> aiohttp.ClientWebSocketResponse:
        end_s = time.monotonic() + LONG_S
        while True:
            try:
                self._socket = await self._client.ws_connect(self._address)
                return self._socket
            except aiohttp.ClientConnectionError:
                assert time.monotonic() < end_s
                await asyncio.sleep(0.2)

    async def __aexit__(self, *_: object) -> None:
        await self._socket.close()


def test_recording_of_a_killed_process_can_be_added(shell, tmp_path):
    capture, link = write_script(make_script(pokes_n=1), tmp_path / "c0"), tmp_path / "board"
    shell.start("emulate", capture, "--port", link, "--loop")
    wait_until(link.is_symlink)
    recorder = shell.start("record", "--port", link, "--out", "run1")
    stream = tmp_path / "run1.part/stream.bin"
    wait_until(lambda: stream.exists() and stream.stat().st_size > 8200)
    recorder.kill()
    recorder.communicate()
    (tmp_path / "probe.csv").write_text("")
    header, files = native(tmp_path / "run1.part", CaptureNames("b0", "s0", None), tmp_path / "probe.csv", ())
    assert (header.capture, header.board, header.skin) == ("run1", "b0", "s0")
    assert 0 < len(files["stream.bin"]) <= stream.stat().st_size


def test_recording_is_complete_if_the_board_is_unplugged(shell, tmp_path):
    capture, link = write_script(make_script(pokes_n=1), tmp_path / "c0"), tmp_path / "board"
    board = shell.start("emulate", capture, "--port", link, "--loop")
    wait_until(link.is_symlink)
    recorder, stream = shell.start("record", "--port", link, "--out", "run1"), tmp_path / "run1.part/stream.bin"
    wait_until(lambda: stream.exists() and stream.stat().st_size > 8200)
    board.send_signal(signal.SIGINT)
    assert "(unplugged after" in recorder.communicate(timeout=LONG_S)[0]
    assert (tmp_path / "run1" / HEADER_FILE).is_file()


def test_live_warns_only_of_serial_ports_that_do_not_exist(tmp_path, capsys):
    (tmp_path / "here").touch()
    _warn_of_absent_ports([str(tmp_path / "here"), "socket://localhost:9"])
    assert capsys.readouterr().err == ""
    _warn_of_absent_ports([str(tmp_path / "here"), "/dev/absent1", "/dev/absent2"])
    assert capsys.readouterr().err.startswith("warning: /dev/absent1, /dev/absent2: no such port. The page waits")


def test_invalid_options_are_errors_of_one_sentence(shell):
    process = shell.start("live", "--port", "x", "--replay", "y")
    _, errors = process.communicate(timeout=LONG_S)
    assert process.returncode == 2
    assert "use only one of --port, --replay" in errors
    assert "Traceback" not in errors
    for arguments, message in (
        (["nothing"], "must be the folder of a capture .*, nominal, or the YAML file of a simulated scene"),
    ):
        with pytest.raises(ReskinError, match=message):
            CliRunner().invoke(app, ["emulate", *arguments], catch_exceptions=False)
