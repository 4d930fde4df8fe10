"""How long a byte takes to an estimate, with a page open; and what a day of frames takes in memory.

`pytest -s -o addopts= tests/benchmarks/test_live_benchmark.py`. The board is another process, on a pseudo-terminal; the
page is read by another too. Nothing is asserted but that frames came.
"""

import asyncio
import os
import subprocess
import sys
import time
import tracemalloc
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from pipeline.live.layout import layout_of
from pipeline.live.session import Live
from pipeline.live.skin import Readings, Skin
from pipeline.live.view import View
from pipeline.predicting import read_network
from tests.live.boards import make_script, plugged_in, write_model, write_script
from tests.live.test_browser import BROWSER, Tab, in_browser
from tests.live.test_server import serve
from tests.stages.checkout import ROOT

SECONDS = 30.0
QUARTER_S = 0.25
STATM = Path("/proc/self/statm")
PAGE = """
import asyncio, sys, aiohttp
async def look():
    async with aiohttp.ClientSession() as client, client.ws_connect(sys.argv[1]) as page:
        async for said in page:
            pass
asyncio.run(look())
"""


@pytest.mark.parametrize(("chips_n", "rate_hz"), [(5, 400.0), (40, 133.0)])
def test_from_the_last_byte_of_a_frame_to_its_estimate(tmp_path, chips_n, rate_hz):
    capture = write_script(make_script(chips_n=chips_n, rate_hz=rate_hz), tmp_path / "c0")
    link, model = tmp_path / "board", read_network(write_model(tmp_path, chips_n=chips_n))
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    words = ["-m", "pipeline.cli", "emulate", str(capture), "--port", str(link), "--loop"]
    board = subprocess.Popen([sys.executable, *words], env=environment, cwd=ROOT)
    live = Live(str(link), [model], "benchmark")
    live.start()
    server = serve_beside(live)
    page = subprocess.Popen([sys.executable, "-c", PAGE, f"{server}/live"], env=environment)
    try:
        while live.view is None or not live.skin.zeroed:
            time.sleep(0.1)
        time.sleep(2.0)
        live.view.to_estimate_s.clear()
        before_s, before_n = time.process_time(), live.skin.account["frames_n"]
        time.sleep(min(SECONDS, 4000 / rate_hz))  # as many as a view remembers
        took_s, frames_n = time.process_time() - before_s, live.skin.account["frames_n"] - before_n
        latency_ms = 1e3 * np.array(live.view.to_estimate_s)
    finally:
        for process in (page, board):
            process.kill()
            process.wait()
        live.stop()
    assert frames_n
    p50, p95, p99 = np.percentile(latency_ms, [50, 95, 99])
    print(f"\n{chips_n} chips at {rate_hz:g} Hz, a page open: {frames_n} frames")
    print(f"  byte to estimate: p50 {p50:.2f} ms, p95 {p95:.2f} ms, p99 {p99:.2f} ms")
    print(f"  processor time a frame, page and reading included: {1e3 * took_s / frames_n:.2f} ms")
    print(f"  load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def serve_beside(live: Live) -> str:
    """Serve the page on a thread; give its address."""
    import threading

    from aiohttp import web

    from pipeline.live.server import Server

    ready, address = threading.Event(), []

    async def run() -> None:
        runner = web.AppRunner(Server([live], "").application())
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        address.append(f"http://127.0.0.1:{site._server.sockets[0].getsockname()[1]}")
        ready.set()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(run()), daemon=True).start()
    ready.wait()
    return address[0]


@pytest.mark.skipif(BROWSER is None, reason="no browser: see tests/live/test_browser.py")
def test_from_the_last_byte_of_a_frame_to_the_screen(tmp_path):
    async def act(tab: Tab) -> None:
        await asyncio.sleep(SECONDS)
        screen_ms = await tab.value("[last.screen50, last.screen99, last.estimate50, last.estimate99]")
        p50, p99, *estimate_ms = screen_ms
        print(f"\n5 chips at 400 Hz, in {BROWSER}: byte to screen p50 {p50:.0f} ms, p99 {p99:.0f} ms")
        print(f"  byte to estimate: p50 {estimate_ms[0]:.2f} ms, p99 {estimate_ms[1]:.2f} ms")

    with plugged_in(make_script(pokes_n=4), loop=True) as name:
        serve(name, [read_network(write_model(tmp_path))], in_browser(tmp_path, act))


@pytest.mark.timeout(3600)
def test_a_day_of_frames_takes_the_memory_of_ten_minutes():
    view, made_n = View(layout_of(5), 0.0), 400
    rng = np.random.Generator(np.random.PCG64(0))
    db_uT = rng.standard_normal((made_n, 15)).astype(np.float32)
    answer, sd_mm = rng.standard_normal((made_n, 3)), np.full((made_n, 2), np.nan)
    tracemalloc.start()
    for second in range(86_400):
        t_s = second + np.arange(made_n) / made_n
        view.feed(Readings(t_s, db_uT, db_uT, answer, sd_mm, answer[:, 2] > 0), t_s[-1])
        if second in (600, 86_399):
            print(f"\n  after {second} s: {tracemalloc.get_traced_memory()[0] / 1e6:.3f} MB")
    tracemalloc.stop()


class Accelerated:
    """A reader without port and clock: a quarter of a second of frames whenever it is asked."""

    plugged_in, problem, missed_bytes_n = True, "", 0

    def __init__(self, chunks: list[bytes]) -> None:
        self._chunks, self.now_s = cycle(chunks), 0.0

    def unix_s(self) -> float:
        return self.now_s

    def take(self, _wait_s: float) -> list[tuple[bytes, float]]:
        self.now_s += QUARTER_S
        return [(next(self._chunks), self.now_s)]


@pytest.mark.timeout(7200)
@pytest.mark.skipif(not STATM.exists(), reason="reads the memory of Linux")
def test_hours_of_bytes_take_the_memory_of_ten_minutes(tmp_path):
    script, hours = make_script(pokes_n=20), float(os.environ.get("RESKIN_HOURS", "1"))
    frames_n = round(400 * QUARTER_S)
    chunks = [b"".join(script.pieces[i : i + frames_n]) for i in range(0, len(script) - frames_n + 1, frames_n)]
    skin, view = Skin("day", [read_network(write_model(tmp_path))]), View(layout_of(5), 0.0)
    skin.reader, next_s = Accelerated(chunks), 600.0
    begun_s = time.process_time()
    while skin.reader.now_s < 3600 * hours:
        if (readings := skin.poll(0.0)) is not None:
            view.feed(readings, skin.reader.now_s)
            view.message(view.newest_bin - 2, rate_hz=skin.health.rate_hz, lost_bytes_n=0)
        if skin.reader.now_s >= next_s:
            next_s += 1800.0
            resident_MB = int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
            print(
                f"\n  {skin.reader.now_s / 3600:.2f} h, {skin.account['frames_n']} frames: {resident_MB:.2f} MB", end=""
            )
    print(f"\n  {time.process_time() - begun_s:.0f} s of processor time")
