"""Tests of the live page in the browser Chromium: what is drawn, and what buttons, keys and forms do.

The environment variable RESKIN_BROWSER is the path of the browser; by default, Chromium is searched on PATH. Without a
browser, the tests are skipped. The tests use the browser's debugging protocol and need no additional package. If
RESKIN_SCREENSHOTS names a folder, screenshots are saved there.
"""

import asyncio
import base64
import os
import re
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from itertools import count
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from reskin.live.emulator import playing
from reskin.live.models import SkinFolder
from reskin.live.presses import PRESSES_N
from reskin.models.trained import read_network
from reskin.recordings.header import HEADER_FILE
from reskin.universal.model import load_universal
from tests.live.boards import PLACES, make_script, plugged_in, write_model, zero_requests
from tests.live.test_estimators import (  # noqa: F401 - fixtures
    POKED_N,
    QUIET_N,
    guided_pokes,
    make_poke_script,
    random_pokes,
)
from tests.live.test_server import LONG_S, serve
from tests.live.test_several import RATES_HZ, UNPLUGGED_I, plug_in_all

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
BROWSER = os.environ.get("RESKIN_BROWSER") or next(filter(None, map(shutil.which, NAMES)), None)
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--remote-debugging-port=0")
WIDTHS_PX = (400, 1400)
# This JavaScript returns the colour of the pixel at a place in mm, and the colour of the contact's force in the legend.
DOT = """((x, y) => { const {last, frame, parts: {board}} = boards[0], [px, py] = frame.at(x, y),
  ratio = devicePixelRatio;
  return last.contact ? [...board.getContext("2d").getImageData(ratio * px, ratio * py, 1, 1).data].slice(0, 3).concat(
    strengthColour(last.force).match(/[0-9]+/g).map(Number)) : []; })"""
# This JavaScript redraws a trace at once. It returns the number of pixels that differ from the trace before, and the
# number of drawn pixels.
COMPARE_TRACES = """((board, i) => {
  const count = i ? board.last.chips : 1, shown = board.traces[i];
  const anew = new Trace(shown.canvas, shown.first, shown.least, shown.below);
  while (shown.draw(board.rows, board.changed, count)) {}
  board.changed = Infinity; anew.columns = 1e6;
  while (anew.draw(board.rows, Infinity, count)) {}
  const [old, fresh] = [shown, anew].map(({pen, layer: {width, height}}) => pen.getImageData(0, 0, width, height).data)
    .map((values) => values.filter((_, at) => at % 4 === 3));
  return [old.filter((alpha, at) => Math.abs(alpha - fresh[at]) > 64).length, fresh.filter(Boolean).length]; })"""
pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason=f"RESKIN_BROWSER is not set, and PATH has none of {NAMES}"),
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.timeout(300),
]


class Tab:
    """A page in a browser, which is controlled by the browser's debugging protocol."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket, self._numbers, self.errors = socket, count(1), []

    async def call(self, method: str, **params: object) -> dict:
        number = next(self._numbers)
        await self._socket.send_json({"id": number, "method": method, "params": params})
        while True:
            message = await self._socket.receive_json(timeout=LONG_S)
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(message["params"]["exceptionDetails"])
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    async def value(self, expression: str) -> object:
        return (await self.call("Runtime.evaluate", expression=expression, returnByValue=True))["result"].get("value")

    async def text(self, name: str) -> str:
        return str(await self.value(f"boards[0].parts.{name}.innerText"))

    async def until(self, expression: str, accept: Callable[[object], bool] = bool) -> object:
        for _ in range(round(LONG_S / 0.02)):
            if accept(found := await self.value(expression)):
                return found
            await asyncio.sleep(0.02)
        raise AssertionError(f"{expression} was never as expected; its last value is {found}")

    async def press_key(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, text=key if kind == "keyDown" else "")

    async def look(self, name: str, when: str = "boards[0].last.contact && !isNaN(boards[0].last.x)") -> None:
        """Check that nothing is cut off on screens with the widths of a phone and of a desktop.

        Save screenshots if requested.
        """
        for wide in WIDTHS_PX:
            await self.call(
                "Emulation.setDeviceMetricsOverride", width=wide, height=900, deviceScaleFactor=1, mobile=False
            )
            await asyncio.sleep(0.3)
            assert await self.value("document.documentElement.scrollWidth <= innerWidth")
            if folder := os.environ.get("RESKIN_SCREENSHOTS"):
                await self.until(when)
                shot = await self.call("Page.captureScreenshot", captureBeyondViewport=True)
                Path(folder, f"live-{name}-{wide}.png").write_bytes(base64.b64decode(shot["data"]))


def in_browser(folder: Path, act: Callable) -> Callable:
    """Return a function for `serve` that opens the page in a browser and calls `act` on its tab."""

    async def act_in_browser(address: str, client: aiohttp.ClientSession) -> None:
        profile = folder / "profile"
        browser = await asyncio.create_subprocess_exec(
            BROWSER, *FLAGS, f"--user-data-dir={profile}", stderr=asyncio.subprocess.DEVNULL
        )
        try:
            port_file = profile / "DevToolsActivePort"
            while not (port_file.exists() and "\n" in port_file.read_text()):
                await asyncio.sleep(0.05)
            debugging = f"http://127.0.0.1:{port_file.read_text().split()[0]}"
            async with client.put(f"{debugging}/json/new?about:blank") as response:
                socket_url = (await response.json())["webSocketDebuggerUrl"]
            async with client.ws_connect(socket_url, max_msg_size=0) as socket:
                tab = Tab(socket)
                await tab.call("Runtime.enable")
                await tab.call("Page.navigate", url=address)
                await tab.until("typeof boards === 'object' && boards[0].state.zeroed === true")
                await act(tab)
                assert tab.errors == []
        finally:
            browser.kill()
            await browser.wait()

    return act_in_browser


def test_page_draws_contacts_and_its_buttons_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    zeroed = zero_requests(monkeypatch)

    async def act(tab: Tab) -> None:
        for x_mm, y_mm, force_N in PLACES:
            near = (
                "(({state, last, dirty}) => !state.silent && last && last.contact && !dirty && "
                f"Math.hypot(last.x - {x_mm}, last.y - {y_mm}) < .5)(boards[0])"
            )
            colours = np.array(await tab.until(f"{near} ? {DOT}({x_mm}, {y_mm}) : []"))
            # The dot on the page has the colour that the legend gives for its force.
            assert np.abs(colours[:3] - colours[3:]).max() < 3
            await tab.until(f"({near}) && /x {x_mm:.0f}|x {x_mm - 1:.0f}/.test(boards[0].parts.place.textContent)")
            assert abs(float((await tab.text("force")).split()[0]) - force_N) < 0.5
        await tab.until(
            "(({rate}) => rate.innerText.endsWith('Hz') && parseFloat(rate.innerText) < 520)(boards[0].parts)"
        )
        await tab.look("network")
        for trace_i in range(2):  # A trace that was scrolled and rescaled must look like one that is drawn at once.
            differ_n, inked_n = await tab.value(f"{COMPARE_TRACES}(boards[0], {trace_i})")
            # The tolerance is 1 % of the pixels, because Chromium smooths short and long paths differently.
            assert differ_n < 0.01 * inked_n
            assert inked_n > 1000
        await tab.value("boards[0].parts.record.click()")
        await tab.until("boards[0].state.recording")
        await tab.press_key("r")
        await tab.until("boards[0].state.recorded.startsWith('recorded')")
        await tab.press_key("z")
        while not zeroed:
            await asyncio.sleep(0.02)
        await tab.until("boards[0].state.zeroed")
        await tab.until("boards[0].parts.zeroed.innerText.startsWith('2 times')")
        assert await tab.value("boards[0].parts.adapt.disabled")  # Only the universal model can be adapted.
        # The true place on a real board is unknown, so there is no switch to show it. Nothing would be drawn even if
        # the switch were on.
        await tab.value("boards[0].parts.truth.checked = true")
        assert await tab.value("boards[0].parts.emulated.offsetHeight") == 0
        assert not await tab.value("boards[0].truthShown()")

    with plugged_in(make_script(pokes_n=4), loop=True) as name:
        serve(name, [read_network(write_model(tmp_path))], in_browser(tmp_path, act))
    (folder,) = (tmp_path / "captures").iterdir()
    assert (folder / HEADER_FILE).is_file()


# This JavaScript clicks on a place in mm.
CLICK = """((x, y) => { const {frame, parts: {board}} = boards[0], [px, py] = frame.at(x, y),
  at = board.getBoundingClientRect();
  board.dispatchEvent(new MouseEvent("click", {clientX: at.left + px, clientY: at.top + py, bubbles: true})); })"""


def test_calibrations_can_be_saved_loaded_and_undone_on_the_page(tmp_path, random_pokes):  # noqa: F811
    quiet = make_poke_script(random_pokes)
    place_mm, force_N = random_pokes[2:]
    poke_i = np.minimum(np.maximum(np.arange(len(quiet)) - QUIET_N, 0) // (2 * POKED_N), len(place_mm) - 1)
    true = np.column_stack([place_mm, force_N])[poke_i]
    true[np.linalg.norm(quiet.frames.b_uT - quiet.frames.b_uT[0], axis=1) < 100] = np.nan

    async def act(tab: Tab) -> None:
        assert not await tab.value("boards[0].truthShown()")  # The true place is shown only if the user asks for it.
        await tab.value("boards[0].parts.truth.click()")
        await tab.until("boards[0].parts.off.innerText.includes('the estimate is off by')")
        await tab.until("boards[0].last.contact && !isNaN(boards[0].last.trueX)")
        await tab.look("true", "boards[0].last.contact && !isNaN(boards[0].last.trueX)")

        x_mm, y_mm = place_mm[0]
        wrong_mm = x_mm, y_mm + (8.3 if y_mm < 8 else -8.3)
        await tab.value(f"{CLICK}({wrong_mm[0]}, {wrong_mm[1]})")
        await tab.value("boards[0].parts.label.click()")
        await tab.until("!boards[0].parts.doubt.hidden")
        assert "8." in str(await tab.value("boards[0].state.alarms.join()"))
        await tab.look("doubt")
        await tab.value("boards[0].parts.discard.click()")
        await tab.until("boards[0].parts.doubt.hidden && boards[0].state.labelled.startsWith('discarded')")
        await tab.value(f"{CLICK}({x_mm}, {y_mm})")
        typed = "[boards[0].parts.x.value, boards[0].parts.y.value].map(Number)"
        found_mm = await tab.until(typed, lambda values: values != [0, 0])
        # The tolerance is in mm. A pixel is 0.05 mm wide, and values are shown with one decimal.
        assert np.abs(np.array(found_mm) - place_mm[0]).max() < 0.15
        await tab.value("boards[0].parts.label.click()")
        await tab.until("boards[0].state.labelled.includes('calibrated to a labelled press')")
        assert await tab.text("learnt") == "1 press with a label that you entered"

        await tab.value("boards[0].parts.skinbox.open = true; boards[0].parts.name.focus()")
        for key in "zap1":  # Text that is typed into a field must not press the buttons Zero, Adapt and Places.
            await tab.press_key(key)
        assert await tab.value("boards[0].parts.name.value") == "zap1"
        assert await tab.value("boards[0].state.adapting === '' && boards[0].state.zeroings_n === 1")
        await tab.value("boards[0].parts.save_form.requestSubmit()")
        await tab.until("boards[0].state.adapted.startsWith('saved ')")
        await tab.value("boards[0].parts.save_form.requestSubmit()")
        await tab.until("boards[0].parts.skin_said.innerText.includes('exists already. Choose another name.')")
        assert await tab.text("adapting") == await tab.text("skin_said")
        await tab.value("boards[0].parts.undo.click()")
        await tab.until("boards[0].parts.learnt.innerText === 'nothing yet'")
        await tab.until("!boards[0].parts.load.disabled")
        await tab.value("boards[0].parts.load_form.requestSubmit()")
        await tab.until("boards[0].parts.model.innerText.includes('with the saved skin zap1')")
        await tab.look("skins")

    with playing(replace(quiet, true_contacts=true)) as board:
        skins = SkinFolder(tmp_path / "skins")
        serve(board.port, load_universal(), in_browser(tmp_path, act), emulated=board, skins=skins)
    assert [file.name for file in (tmp_path / "skins").iterdir()] == ["zap1.safetensors"]


def test_key_a_adapts_the_model_to_presses(tmp_path, random_pokes):  # noqa: F811
    async def act(tab: Tab) -> None:
        await tab.until(
            "boards[0].last && boards[0].last.contact && boards[0].last.sdX > .1 && boards[0].last.sdY > .1"
        )
        await tab.press_key("a")
        await tab.until(f"boards[0].state.adapting.includes('of {PRESSES_N}')")
        await tab.until("boards[0].state.adapted.startsWith('adapted to 12 presses')")
        assert "mm before" in await tab.text("adapting")
        await tab.look("map")

    with plugged_in(make_poke_script(random_pokes), loop=True) as name:
        serve(name, load_universal(), in_browser(tmp_path, act))


def test_page_shows_errors_before_and_after_adapting_to_guided_presses(tmp_path, guided_pokes):  # noqa: F811
    quiet = make_poke_script(guided_pokes)
    # The script begins with a pause, in which the test presses the button.
    late_s = np.where(np.arange(len(quiet)) < 400, 0.0, 3.0)
    script = replace(quiet, t_s=quiet.t_s + late_s)

    async def act(tab: Tab) -> None:
        # The 30 rows without contact are longer than the pause between two places.
        no_contact = "rows.slice(-30).every(({high}) => high[0] === 0)"
        await tab.until(
            f"(({{rows}}) => rows.length > 30 && rows.at(-1).n - rows.at(-30).n < 35 && {no_contact})(boards[0])"
        )
        await tab.press_key("p")
        await tab.until("boards[0].state.next_mm && !boards[0].dirty")
        await tab.look("cross")
        await tab.until("boards[0].state.adapted.startsWith('adapted to 8 known places')")
        before_mm, after_mm = map(float, re.findall(r"([0-9.]+) mm (?:before|after)", await tab.text("adapting")))
        assert after_mm < before_mm
        assert await tab.value("boards[0].state.next_mm") is None
        await tab.look("places")

    with plugged_in(script, loop=True) as name:
        serve(name, load_universal(), in_browser(tmp_path, act))


def test_page_draws_several_boards(tmp_path):
    async def act(tab: Tab) -> None:
        await tab.until("boards.length === 8 && boards.every(({state}) => state.zeroed)")
        # The model is for five chips, so there is no estimate for the sleeve, which has forty chips.
        for i in range(1, 8):
            await tab.until(f"(({{last}}) => last && last.contact && !isNaN(last.x))(boards[{i}])")
        for i, rate_hz in enumerate(RATES_HZ[:UNPLUGGED_I]):
            await tab.until(f"((hz) => 0 < hz && hz < 1.4 * {rate_hz})(parseFloat(boards[{i}].parts.rate.innerText))")
        await asyncio.to_thread(unplugged.close)
        await tab.until("boards[7].state.silent && boards[7].parts.rate.innerText === '–'")
        # A board that sends no data shows no rate, and loses no further frames.
        lost = ",".join(["0"] * UNPLUGGED_I + ["NaN"])
        await tab.until("boards.map(({parts}) => parseFloat(parts.lost.innerText)).join()", lost.__eq__)
        assert "unplugged" in str(await tab.value("boards[7].state.alarms.join()"))
        assert await tab.value("boards.slice(0, 7).every(({state}) => !state.alarms.join().includes('unplugged'))")
        await tab.look("several", "boards[1].last.contact")
        # Place and force stand above the fold of a usual window, and not below the picture of the skin.
        bottom = "boards.slice(0, 2).map(({parts}) => parts.force.getBoundingClientRect().bottom + scrollY)"
        assert max(await tab.value(bottom)) < 450

    with ExitStack() as stack, ExitStack() as unplugged:
        names = plug_in_all(stack, unplugged, tmp_path, range(8))
        serve(names, load_universal(), in_browser(tmp_path, act))
