"""Tests of eight boards on eight ports. One of them has forty chips (a sleeve), and one is unplugged."""

import asyncio
import math
import os
import time
from collections import Counter
from contextlib import ExitStack

import aiohttp
import numpy as np
import pytest

import reskin
from reskin.board.find import BOARDS_MAX_N
from reskin.errors import ReskinError
from reskin.live.server import PAGES_MAX_N
from reskin.live.session import BINS_N, LATENCIES_N, Session, open_sessions
from reskin.live.tracker import LiveSkin, LiveSkins
from reskin.universal.model import load_universal
from tests.live.boards import PLACES, FailingModel, ScriptReader, make_script, plugged_in, write_model
from tests.live.test_server import serve, until

RATES_HZ = [133.0, 400.0, *(50.0,) * 6]
CHIPS_N = [40, *(5,) * 7]
UNPLUGGED_I = 7
pytestmark = [
    pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


def plug_in_all(stack: ExitStack, unplugged: ExitStack, folder, boards) -> list[str]:
    """Emulate eight boards in threads.

    Closing `unplugged` unplugs the last board, and closing `stack` unplugs the others.
    """
    names = []
    for i in boards:
        script = make_script(pokes_n=3, chips_n=CHIPS_N[i], rate_hz=RATES_HZ[i])
        owner = unplugged if i == UNPLUGGED_I else stack
        names.append(owner.enter_context(plugged_in(script, str(folder / f"board{i}"), loop=True)))
    return names


def test_page_of_eight_boards_shows_which_board_is_unplugged(tmp_path):
    async def look(address: str, client: aiohttp.ClientSession, i: int) -> None:
        async with client.ws_connect(f"{address}/live?board={i}") as page:
            state = await until(page, lambda message: message.get("zeroed") is True)
            assert state["boards_n"] == len(CHIPS_N)
            assert len(state["chips_mm"]) == CHIPS_N[i]
            assert f"board{i}" in state["what"]
            poke = await until(
                page, lambda message: message.get("contact") == 1 and 0 < message["rate_hz"] < 1.3 * RATES_HZ[i]
            )
            # The model is for five chips. Boards with another number of chips have no estimate.
            assert math.isfinite(poke["x_mm"]) == (CHIPS_N[i] == 5)
            assert len(poke["change_uT"]) == 3 * CHIPS_N[i]
            assert np.abs(poke["change_uT"]).max() > 100

    async def act(address: str, client: aiohttp.ClientSession) -> None:
        async with client.get(f"{address}/live?board=8") as page:
            assert page.status == 404
        await asyncio.gather(*(look(address, client, i) for i in range(len(CHIPS_N))))
        pages = [await client.ws_connect(f"{address}/live?board={i}") for i in range(len(CHIPS_N))]
        await asyncio.to_thread(unplugged.close)
        await until(pages[UNPLUGGED_I], lambda message: "unplugged" in " ".join(message.get("alarms", [])))
        for page in pages[:UNPLUGGED_I]:
            after = await until(page, lambda message: "lost" in message)
            assert after["lost"] == 0
            assert after["bins_n"] <= BINS_N
            later = await until(page, lambda message, t_s=after["t_s"]: message.get("t_s", 0) > t_s + 0.5)
            assert later["lost"] == 0
        for page in pages:
            await page.close()

    assert PAGES_MAX_N * BOARDS_MAX_N * BINS_N < 1e5  # The number of stored time bins has an upper bound.
    assert LATENCIES_N < 1e4
    with ExitStack() as stack, ExitStack() as unplugged:
        serve(plug_in_all(stack, unplugged, tmp_path, range(len(CHIPS_N))), load_universal(), act)


def test_unplugged_board_does_not_delay_the_others(tmp_path):
    with ExitStack() as stack, ExitStack() as unplugged:
        names = plug_in_all(stack, unplugged, tmp_path, (1, 2, UNPLUGGED_I))
        with reskin.open(names, model=write_model(tmp_path)) as skins:
            # For each update of the last board, `updates` counts the readings of the other boards.
            updates, found = Counter(), []
            for *others, last in skins:
                found += [contact[1:4] for contact in others if contact.F_N > 0]
                if len(found) > 20:
                    unplugged.close()
                if math.isnan(last.F_N) and any("unplugged" in alarm for alarm in last.alarms):
                    assert not any("unplugged" in alarm for contact in others for alarm in contact.alarms)
                    updates[last.t_s] += 1
                if len(updates) >= 5 and max(updates.values()) >= 5:
                    break
        nearest = np.abs(np.array(found)[:, None] - PLACES).sum(axis=2).min(axis=1)
        assert np.median(nearest) < 0.5


def skin_at(port: str) -> LiveSkin:
    skin = LiveSkin(port)
    skin.reader = ScriptReader(make_script(pokes_n=1))
    return skin


def test_error_in_the_model_is_raised_in_the_thread_that_iterates_over_skins():
    failing, working = skin_at("failing"), skin_at("working")
    failing.estimator = FailingModel()
    with LiveSkins([failing, working]) as skins:
        skins._threads[0].join(60.0)
        with pytest.raises(RuntimeError, match="out of memory"):
            next(iter(skins))


def test_error_in_the_model_is_shown_as_an_alarm_on_the_page():
    live = Session("played", [], "a board")
    live.skin = skin_at("played")
    live.skin.estimator = FailingModel()
    live.start()
    end_s = time.monotonic() + 60.0
    while not any("estimation stopped" in alarm for alarm in live.state()["alarms"]) and time.monotonic() < end_s:
        time.sleep(0.01)
    live.stop()
    assert "estimation stopped: RuntimeError('out of memory')" in live.state()["alarms"]


def test_invalid_lists_of_ports_are_refused(tmp_path):
    for ports in (["a", "a"], [f"p{i}" for i in range(BOARDS_MAX_N + 1)], []):
        with pytest.raises(ReskinError, match="--port: ports must be 1 to 16, each named once"):
            open_sessions(ports, [], "a board")
        with pytest.raises(ReskinError, match=r"reskin.open: ports must be 1 to 16, each named once; got \w+"):
            reskin.open(ports)
    with plugged_in(make_script(pokes_n=1), loop=True) as name, pytest.raises(ReskinError, match="/dev/none"):
        reskin.open([name, "/dev/none"]).__enter__()
