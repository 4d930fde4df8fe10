"""Tests of the server of the live page: estimates, buttons, access control, and limits."""

import asyncio
import json
import math
import re
import socket as socketlib
import struct
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from aiohttp import web

from reskin.errors import CaptureError, ParamsError
from reskin.live import server
from reskin.live.emulator import playing
from reskin.live.models import Models
from reskin.live.server import PAGES_MAX_N, REQUEST_BYTES_MAX_N, Server
from reskin.live.session import BINS_N, HEAD, NUMBERS_N, open_sessions
from reskin.models.trained import read_network
from reskin.recordings.header import HEADER_FILE, parse
from tests.live.boards import PLACES, POKE_S, QUIET_S, RATE_HZ, make_script, plugged_in, write_model, zero_requests

LONG_S = 120.0
# The sockets of clients that are refused are not closed, which causes warnings.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


def serve(
    ports: str | list[str],
    models: Models,
    act: Callable[[str, aiohttp.ClientSession], Awaitable[None]],
    token="",
    **options: object,
):
    """Serve a page of one or several boards, run `act` with a client, and stop the server."""

    async def run() -> None:
        boards = open_sessions([ports] if isinstance(ports, str) else ports, models, "a board", **options)
        for board in boards:
            board.start()
        runner = web.AppRunner(Server(boards, token).application())
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        address = f"http://127.0.0.1:{site._server.sockets[0].getsockname()[1]}"
        try:
            async with aiohttp.ClientSession() as client:
                await act(address, client)
        finally:
            await runner.cleanup()
            for board in boards:
                await asyncio.to_thread(board.stop)

    asyncio.run(run())


def unpack(data: bytes) -> dict:
    """Decode a binary message as the page does."""
    number, chips_n, bins_n, t_s = HEAD.unpack_from(data)
    values = np.frombuffer(data, "<f4", offset=HEAD.size)
    first = NUMBERS_N + 3 * chips_n
    assert len(values) == first + bins_n * (1 + 2 * (1 + chips_n))
    names = ("x_mm", "y_mm", "F_N", "sd_x", "sd_y", "sd_F", "contact", "rate_hz", "lost")
    message = dict(zip(names, values[:9].tolist(), strict=True))
    message |= dict(zip(("dropped", "true_x_mm", "true_y_mm", "true_F_N"), values[13:17].tolist(), strict=True))
    return message | {"number": number, "t_s": t_s, "bins_n": bins_n, "change_uT": values[NUMBERS_N:first]}


async def until(socket, wanted: Callable[[dict], bool]) -> dict:
    """Receive messages until `wanted` accepts one. Return this message."""
    end_s = time.monotonic() + LONG_S
    while time.monotonic() < end_s:
        # aiohttp's own time limit is not used, because it begins again with every ping.
        received = await asyncio.wait_for(socket.receive(), LONG_S)
        message = unpack(received.data) if received.type == aiohttp.WSMsgType.BINARY else json.loads(received.data)
        if wanted(message):
            return message
    raise AssertionError("the message was never received")


def test_page_receives_estimates_and_can_zero_and_record(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    zeroed = zero_requests(monkeypatch)
    models = [read_network(write_model(tmp_path))]

    async def act(address: str, client: aiohttp.ClientSession) -> None:
        async with client.ws_connect(f"{address}/live") as socket:
            state = await until(socket, lambda message: message.get("zeroed") is True)
            assert len(state["chips_mm"]) == 5
            poke = await until(
                socket, lambda message: message.get("contact") == 1 and 0 < message["rate_hz"] < 1.3 * RATE_HZ
            )
            assert np.abs(np.array([poke["x_mm"], poke["y_mm"], poke["F_N"]]) - PLACES).max(axis=1).min() < 0.5
            assert poke["bins_n"] <= BINS_N
            assert poke["dropped"] == 0
            # The true place of a contact on a real board is unknown, so the page offers no switch to show it.
            assert not state["true_places"]
            assert math.isnan(poke["true_x_mm"])
            assert (state["zeroings_n"], len(state["zero_bins"])) == (1, 1)
            assert state["model"] == "trained network"
            assert (state["expected"], state["least_force"]) == ("not measured for this network", "not measured")
            await socket.send_json({"save": "s1"})
            refused = await until(socket, lambda message: bool(message.get("adapted")))
            assert "only the universal model can be calibrated on this page" in refused["adapted"]
            await socket.send_json({"seen": poke["number"]})
            await socket.send_json({"press": "record"})
            recording = await until(socket, lambda message: bool(message.get("recording")))
            part = Path(recording["recording"].strip() + ".part")
            assert (part / HEADER_FILE).is_file()
            while (part / "stream.bin").stat().st_size <= 82 * 50:
                await asyncio.sleep(0.02)
            await socket.send_json({"press": "record"})
            done = await until(socket, lambda message: str(message.get("recorded", "")).startswith("recorded"))
            folder = Path(done["recorded"].removeprefix("recorded "))
            header = parse((folder / HEADER_FILE).read_text(), "header")
            assert set(header.files) == {"stream.bin", "arrivals.csv"}
            assert (header.rate.method, header.rate.repeated_readings) == ("arrivals", 0.0)
            assert (folder / "stream.bin").stat().st_size > 82 * 50
            await socket.send_json({"press": "zero"})
            while not zeroed:
                await asyncio.sleep(0.02)
            await until(socket, lambda message: message.get("zeroings_n") == 2)

    with plugged_in(make_script(pokes_n=4), loop=True) as name:
        serve(name, models, act)


def test_page_of_an_emulated_board_receives_the_true_contact(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    script = make_script(pokes_n=1, rate_hz=100.0)
    poked = (script.t_s >= QUIET_S) & (script.t_s < QUIET_S + POKE_S)
    true = np.where(poked[:, None], PLACES[0], np.nan)

    async def act(address: str, client: aiohttp.ClientSession) -> None:
        async with client.ws_connect(f"{address}/live") as socket:
            state = await until(socket, lambda message: "true_places" in message and not message["waiting"])
            assert state["true_places"]
            before = await until(socket, lambda message: "true_x_mm" in message)
            poke = await until(socket, lambda message: message.get("contact") == 1)
            assert math.isnan(before["true_x_mm"])
            np.testing.assert_allclose([poke[f"true_{name}"] for name in ("x_mm", "y_mm", "F_N")], PLACES[0])
            await socket.send_json({"press": "record"})
            recording = await until(socket, lambda message: bool(message.get("recording")))
            header = parse(Path(f"{recording['recording']}.part", HEADER_FILE).read_text(), "header")
            # The recording is marked as simulated, so that it is not added to a recorded scene.
            assert header.source == "simulated"

    with playing(replace(script, source="simulated", true_contacts=true)) as board:
        serve(board.port, [], act, emulated=board)


def test_address_that_cannot_be_used_raises_before_it_is_printed():
    printed: list[str] = []
    with socketlib.create_server(("127.0.0.1", 0)) as busy:
        number = busy.getsockname()[1]
        for host, message in {
            "127.0.0.1": f"--http-port: cannot listen on {number}: another program uses it",
            # This address is reserved for documentation.
            "192.0.2.1": "--host: 192.0.2.1 is not an address of this machine",
            "no such host": "--host: no such host is not an address of this machine",
        }.items():
            with pytest.raises(ParamsError, match=message):
                server.serve([], host=host, http_port=number, say=printed.append)
    assert printed == []


def test_address_for_other_machines_is_printed_as_soon_as_the_page_is_served():
    printed: list[str] = []

    def say(text: str) -> None:
        printed.append(text)
        with socketlib.create_connection(("127.0.0.1", number)):
            raise KeyboardInterrupt

    with socketlib.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    server.serve([], host="0.0.0.0", http_port=number, say=say)
    # Another machine can open neither 0.0.0.0 nor localhost.
    address, token = re.search(rf"open http://(\S+):{number}/\?token=(.+); press Ctrl-C", printed[0]).groups()
    assert address not in ("0.0.0.0", "localhost")
    assert token


def test_connections_without_a_request_are_closed(monkeypatch):
    monkeypatch.setattr(server, "CHECK_S", 0.05)
    monkeypatch.setattr(server, "REQUEST_S", 0.2)
    with socketlib.create_server(("127.0.0.1", 0)) as free:
        address = free.getsockname()

    async def act() -> None:
        idle, half_sent = await asyncio.open_connection(*address), await asyncio.open_connection(*address)
        half_sent[1].write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        async with aiohttp.ClientSession() as client, client.get(f"http://127.0.0.1:{address[1]}/") as page:
            assert page.status == 200
            assert await asyncio.wait_for(asyncio.gather(idle[0].read(), half_sent[0].read()), LONG_S) == [b"", b""]
        monkeypatch.setattr(server, "REQUEST_S", LONG_S)
        monkeypatch.setattr(server, "CONNECTIONS_MAX_N", 3)
        crowd = [await asyncio.open_connection(*address) for _ in range(10)]
        await asyncio.wait_for(asyncio.gather(*(reader.read() for reader, _ in crowd[:6])), LONG_S)
        assert not crowd[-1][0].at_eof()

    async def run() -> None:
        listening = asyncio.Event()
        serving = asyncio.create_task(Server([], "").run(*address, listening.set))
        await listening.wait()
        await act()
        serving.cancel()

    asyncio.run(run())


def test_file_given_as_a_port_is_an_error(tmp_path):
    (tmp_path / "log.csv").touch()
    with pytest.raises(CaptureError, match="log.csv: cannot open the port: it is a file"):
        open_sessions([str(tmp_path / "log.csv")], [], "a board")


def test_page_waits_for_a_board_that_is_not_plugged_in(tmp_path):
    async def act(address: str, client: aiohttp.ClientSession) -> None:
        async with client.ws_connect(f"{address}/live") as socket:
            state = await until(socket, lambda message: "not open" in " ".join(message.get("alarms", [])))
            assert state["waiting"]
        for path, kind in (
            ("/", "text/html"),
            ("/live.js", "javascript"),
            ("/skin.js", "javascript"),
            ("/trace.js", "javascript"),
            ("/live.css", "text/css"),
        ):
            async with client.get(address + path) as page:
                assert page.status == 200
                assert kind in page.headers["Content-Type"]
                assert "default-src 'self'" in page.headers["Content-Security-Policy"]
                # The page loads nothing from other servers.
                assert "://" not in (await page.text()).replace("http://www.w3.org", "")

    serve(str(tmp_path / "none"), [], act)


def test_requests_with_other_host_or_origin_headers_are_forbidden(tmp_path):
    async def act(address: str, client: aiohttp.ClientSession) -> None:
        host = address.removeprefix("http://")
        for headers, status in (
            ({"Host": "evil.example"}, 403), ({"Host": "127.0.0.1.evil.example"}, 403), ({"Host": "[::1"}, 403),
            ({"Host": "lohost[::1]::8786"}, 403),
            ({"Host": "localhost:9000"}, 200),  # This is a request through an SSH tunnel.
            ({"Origin": "http://evil.example"}, 403), ({"Origin": "null"}, 403), ({"Origin": f"http://{host}"}, 200),
        ):  # fmt: skip
            async with client.get(f"{address}/", headers=headers) as page:
                assert page.status == status, headers
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await client.ws_connect(f"{address}/live", headers={"Origin": "http://evil.example"})
        for path in ("/../server.py", "/%2e%2e/server.py", "/page", "/live.js/", "/index.html"):
            async with client.get(address + path) as page:
                assert page.status in (400, 404)

    serve(str(tmp_path / "none"), [], act)


def test_requests_from_other_machines_need_the_token(tmp_path):
    async def act(address: str, client: aiohttp.ClientSession) -> None:
        for query, status in (("", 403), ("?token=guess", 403), ("?token=\u00e9", 403), ("?token=secret", 200)):
            async with client.get(f"{address}/{query}", headers={"Host": "lab-pc:8765"}) as page:
                assert page.status == status
                assert ("reskin-token" in page.headers.get("Set-Cookie", "")) == (status == 200)
        async with aiohttp.ClientSession() as other:
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await other.ws_connect(f"{address}/live")

    serve(str(tmp_path / "none"), [], act, token="secret")


def test_server_ignores_invalid_messages_and_limits_their_size_and_the_number_of_pages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    async def act(address: str, client: aiohttp.ClientSession) -> None:
        async with client.ws_connect(f"{address}/live") as socket:
            for junk in ("", "{", "[]", "null", '{"press": ["record"]}', '{"press": {}}', '{"seen": 1e999}', "[" * 900):
                await socket.send_str(junk)
            await socket.send_bytes(struct.pack("<4d", 1, 2, 3, 4))
            await until(socket, lambda message: "alarms" in message)
            await socket.send_str("x" * (REQUEST_BYTES_MAX_N + 1))
            while not socket.closed:
                await socket.receive(timeout=LONG_S)
            assert socket.close_code == aiohttp.WSCloseCode.MESSAGE_TOO_BIG
        crowd = [await client.ws_connect(f"{address}/live") for _ in range(PAGES_MAX_N)]
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            await client.ws_connect(f"{address}/live")
        for socket in crowd:
            await socket.close()

    serve(str(tmp_path / "none"), [], act)
    assert list(tmp_path.iterdir()) == []
