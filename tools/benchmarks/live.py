"""Delay from the last byte of a frame to its estimate, and to the screen if RESKIN_BROWSER names a browser.

Each board is emulated by a process of its own on a pseudo-terminal; another process opens the page. `--boards 5@400
5@400` measures two boards of 5 chips at 400 Hz. For the times of docs/live.md, give the program real-time priority:
`chrt -f 5 python -m tools.benchmarks live`.
"""

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import aiohttp
import numpy as np
from aiohttp import web

from reskin.live.server import Server
from reskin.live.session import LATENCIES_N, Session
from reskin.models.trained import read_network
from tests.live.boards import make_script, write_model, write_script
from tools.benchmarks.common import ROOT

ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
PAGE = """
import asyncio, sys, aiohttp
async def look(address):
    async with aiohttp.ClientSession() as client, client.ws_connect(address) as page:
        async for said in page:
            pass
async def look_at_all():
    await asyncio.gather(*map(look, sys.argv[1:]))
asyncio.run(look_at_all())
"""
Boards = Sequence[tuple[int, float]]  # number of chips and frame rate of each board


def measure_estimates(boards: Boards, seconds: float) -> None:
    with tempfile.TemporaryDirectory() as folder, running_boards(Path(folder), boards) as (sessions, server):
        addresses = [f"{server}/live?board={i}" for i in range(len(sessions))]
        page = subprocess.Popen([sys.executable, "-c", PAGE, *addresses], env=ENVIRONMENT)
        try:
            time.sleep(min(2.0, seconds))
            with print_latency(sessions, boards):
                time.sleep(min(seconds, LATENCIES_N / boards[0][1]))
        finally:
            page.kill()
            page.wait()


def measure_screen(boards: Boards, seconds: float) -> None:
    from tests.live.test_browser import Tab, in_browser

    async def act(tab: Tab) -> None:
        await tab.until(f"boards.length === {len(boards)} && boards.every(({{last}}) => last)")
        with print_latency(sessions, boards):
            await asyncio.sleep(seconds)

    async def look(folder: Path) -> None:
        async with aiohttp.ClientSession() as client:
            await in_browser(folder, act)(server, client)

    with tempfile.TemporaryDirectory() as folder, running_boards(Path(folder), boards) as (sessions, server):
        asyncio.run(look(Path(folder)))


@contextmanager
def running_boards(folder: Path, boards: Boards) -> Iterator[tuple[list[Session], str]]:
    """Start a process per board and serve their page; yield as soon as every board has a no-load reading."""
    sessions, players = [], []
    try:
        for i, (chips_n, rate_hz) in enumerate(boards):
            capture = write_script(make_script(chips_n=chips_n, rate_hz=rate_hz), folder / f"c{i}")
            words = ["-m", "pipeline", "emulate", str(capture), "--port", str(folder / f"board{i}"), "--loop"]
            players.append(subprocess.Popen([sys.executable, *words], env=ENVIRONMENT, cwd=ROOT))
            model = read_network(write_model(folder, f"model{i}", chips_n=chips_n))
            sessions.append(Session(str(folder / f"board{i}"), [model], "benchmark", alone=len(boards) == 1))
            sessions[-1].start()
        address = serve_in_thread(sessions)
        while not all(session.traces is not None and session.skin.zeroed for session in sessions):
            time.sleep(0.1)
        yield sessions, address
    finally:
        for player in players:
            player.kill()
            player.wait()
        for session in sessions:
            session.stop()


@contextmanager
def print_latency(sessions: list[Session], boards: Boards) -> Iterator[None]:
    """Print the latency of the frames that arrive during the block, pooled over all boards."""

    def frames_n() -> int:
        return sum(session.skin.account["frames_n"] for session in sessions)

    traces = [session.traces for session in sessions if session.traces is not None]
    for trace in traces:
        trace.to_estimate_s.clear()
        trace.to_screen_s.clear()
    before_n, before_s, wall_s = frames_n(), time.process_time(), time.monotonic()
    yield
    n, cpu_s, wall_s = frames_n() - before_n, time.process_time() - before_s, time.monotonic() - wall_s
    print(f"{', '.join(f'{chips_n} chips at {rate_hz:g} Hz' for chips_n, rate_hz in boards)}: {n} frames")
    for where in ("to_estimate_s", "to_screen_s"):
        if latency_ms := [1e3 * late_s for trace in traces for late_s in list(getattr(trace, where))]:
            p50, p95, p99 = np.percentile(latency_ms, [50, 95, 99])
            print(f"  byte {where[:-2].replace('_', ' ')}: p50 {p50:.2f} ms, p95 {p95:.2f} ms, p99 {p99:.2f} ms")
    print(f"  processor time, with page and port: {1e3 * cpu_s / max(n, 1):.2f} ms per frame,", end=" ")
    print(f"{100 * cpu_s / wall_s:.0f} % of a core; load of the machine: {os.getloadavg()[0]:.1f}")


def serve_in_thread(sessions: list[Session]) -> str:
    """Serve the page from a thread; return the address of the page."""
    ready, address = threading.Event(), []

    async def serve() -> None:
        runner = web.AppRunner(Server(sessions, "").application())
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        address.append(f"http://127.0.0.1:{runner.addresses[0][1]}")
        ready.set()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
    ready.wait()
    return address[0]


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--boards", nargs="+", metavar="CHIPS@HZ", help="one page of these boards")
    parser.add_argument("--seconds", type=float, default=30.0)
    given = parser.parse_args(words)
    pages = [given.boards] if given.boards else [["5@400"], ["40@133"], ["5@400"] * 2, ["40@133"] + ["5@133"] * 7]
    for page in pages:
        boards = [(int(chips_n), float(rate_hz)) for chips_n, rate_hz in (board.split("@") for board in page)]
        measure_estimates(boards, given.seconds)
        if "RESKIN_BROWSER" in os.environ:
            measure_screen(boards, given.seconds)


if __name__ == "__main__":
    main()
