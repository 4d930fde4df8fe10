"""Latency from the last byte of a frame to its estimate and to the screen, and memory use over a day of frames.

Run `RESKIN_BENCHMARKS=full pytest -s tests/benchmarks/test_live_benchmark.py`. Each board is emulated by a separate
process on a pseudo-terminal; another process opens the page. The tests assert only that frames arrive.
"""

import asyncio
import os
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from aiohttp import web

from reskin.live.server import Server
from reskin.live.session import LATENCIES_N, Session, Traces
from reskin.live.tracker import Estimates, LiveSkin, layout_of
from reskin.models.trained import read_network
from tests.benchmarks import size
from tests.live.boards import make_script, write_model, write_script
from tests.live.test_browser import BROWSER, Tab, in_browser
from tests.stages.checkout import ROOT

SECONDS = size(30.0, 0.5)
QUARTER_S = 0.25
STATM = Path("/proc/self/statm")
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
FIVE, SLEEVE = (5, 400.0), (40, 133.0)
BOARDS = {
    "two boards": [FIVE] * 2,
    "5 chips": [FIVE],
    "40 chips": [SLEEVE],
    "eight boards": [SLEEVE] + [(5, 133.0)] * 7,
}
BOARDS = size(BOARDS, dict([*BOARDS.items()][:1]))
for_all_boards = pytest.mark.parametrize("boards", BOARDS.values(), ids=BOARDS.keys())


@for_all_boards
def test_latency_from_last_byte_to_estimate(tmp_path, boards):
    with running_boards(tmp_path, boards) as (sessions, server):
        addresses = [f"{server}/live?board={i}" for i in range(len(sessions))]
        page = subprocess.Popen([sys.executable, "-c", PAGE, *addresses], env=ENVIRONMENT)
        try:
            time.sleep(size(2.0, 0.1))
            with print_latency(sessions, boards):
                time.sleep(min(SECONDS, LATENCIES_N / boards[0][1]))
        finally:
            page.kill()
            page.wait()


@pytest.mark.skipif(BROWSER is None, reason="no browser was found: see tests/live/test_browser.py")
@for_all_boards
def test_latency_from_last_byte_to_screen(tmp_path, boards):
    async def act(tab: Tab) -> None:
        await tab.until(f"boards.length === {len(boards)} && boards.every(({{last}}) => last)")
        with print_latency(sessions, boards):
            await asyncio.sleep(SECONDS)

    async def look() -> None:
        async with aiohttp.ClientSession() as client:
            await in_browser(tmp_path, act)(server, client)

    with running_boards(tmp_path, boards) as (sessions, server):
        asyncio.run(look())


@contextmanager
def running_boards(folder: Path, boards: list[tuple[int, float]]) -> Iterator[tuple[list[Session], str]]:
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
def print_latency(sessions: list[Session], boards: list[tuple[int, float]]) -> Iterator[None]:
    """Print the latency of the frames that arrive during the block, pooled over all boards."""
    for session in sessions:
        session.traces.to_estimate_s.clear()
        session.traces.to_screen_s.clear()
    before_s, wall_s, before_n = time.process_time(), time.monotonic(), count_frames(sessions)
    yield
    took_s, wall_s, frames_n = (
        time.process_time() - before_s,
        time.monotonic() - wall_s,
        count_frames(sessions) - before_n,
    )
    assert frames_n
    print(f"\n{', '.join(f'{chips_n} chips at {rate_hz:g} Hz' for chips_n, rate_hz in boards)}: {frames_n} frames")
    for where in ("to_estimate_s", "to_screen_s"):
        if latency_ms := [1e3 * late_s for session in sessions for late_s in list(getattr(session.traces, where))]:
            p50, p95, p99 = np.percentile(latency_ms, [50, 95, 99])
            print(f"  byte {where[:-2].replace('_', ' ')}: p50 {p50:.2f} ms, p95 {p95:.2f} ms, p99 {p99:.2f} ms")
    print(f"  processor time, including the page and the port: {1e3 * took_s / frames_n:.2f} ms per frame,", end=" ")
    print(f"{100 * took_s / wall_s:.0f} % of a core")
    print(f"  load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def count_frames(sessions: list[Session]) -> int:
    return sum(session.skin.account["frames_n"] for session in sessions)


def serve_in_thread(sessions: list[Session]) -> str:
    """Serve the page from a thread; return the address of the page."""
    ready, address = threading.Event(), []

    async def run() -> None:
        runner = web.AppRunner(Server(sessions, "").application())
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        address.append(f"http://127.0.0.1:{site._server.sockets[0].getsockname()[1]}")
        ready.set()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(run()), daemon=True).start()
    ready.wait()
    return address[0]


@pytest.mark.timeout(3600)
def test_memory_used_by_the_traces_of_a_day():
    traces, made_n = Traces(layout_of(5), 0.0), 400
    rng = np.random.Generator(np.random.PCG64(0))
    db_uT = rng.standard_normal((made_n, 15)).astype(np.float32)
    target, sd_mm = rng.standard_normal((made_n, 3)), np.full((made_n, 2), np.nan)
    tracemalloc.start()
    for second in range(size(86_400, 60)):
        t_s = second + np.arange(made_n) / made_n
        traces.add(Estimates(t_s, db_uT, db_uT, target, sd_mm, sd_mm[:, 0], target[:, 2] > 0), t_s[-1])
        if second in size((600, 86_399), (30, 59)):
            print(f"\n  after {second} s: {tracemalloc.get_traced_memory()[0] / 1e6:.3f} MB")
    tracemalloc.stop()


class Accelerated:
    """Reader for tests, without a port or a clock: each call returns the frames of a quarter of a second at once."""

    plugged_in, problem, missed_bytes_n = True, "", 0

    def __init__(self, chunks: list[bytes]) -> None:
        self._chunks, self.now_s = cycle(chunks), 0.0

    def unix_s(self) -> float:
        return self.now_s

    def take(self, _wait_s: float) -> list[tuple[bytes, float]]:
        self.now_s += QUARTER_S
        return [(next(self._chunks), self.now_s)]


@pytest.mark.timeout(7200)
@pytest.mark.skipif(not STATM.exists(), reason="needs /proc of Linux")
def test_memory_used_while_bytes_are_decoded_for_hours(tmp_path):
    script, hours = make_script(pokes_n=20), float(os.environ.get("RESKIN_HOURS", size("1", "0.02")))
    frames_n = round(400 * QUARTER_S)
    chunks = [b"".join(script.pieces[i : i + frames_n]) for i in range(0, len(script) - frames_n + 1, frames_n)]
    skin, traces = LiveSkin("day", [read_network(write_model(tmp_path))]), Traces(layout_of(5), 0.0)
    skin.reader, next_s = Accelerated(chunks), 600.0
    begun_s = time.process_time()
    while skin.reader.now_s < 3600 * hours:
        if (estimates := skin.poll(0.0)) is not None:
            traces.add(estimates, skin.reader.now_s)
            traces.message(traces.newest_bin - 2, rate_hz=skin.health.rate_hz, lost_bytes_n=0)
        if skin.reader.now_s >= next_s:
            next_s += 1800.0
            resident_MB = int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
            print(
                f"\n  {skin.reader.now_s / 3600:.2f} h, {skin.account['frames_n']} frames: {resident_MB:.2f} MB", end=""
            )
    print(f"\n  {time.process_time() - begun_s:.0f} s of processor time")
