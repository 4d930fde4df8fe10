"""Tests of `LiveSkin`: estimates, no-load readings, alarms, and counts of bytes."""

import itertools
import math
import os
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

import reskin
from reskin.board.port import open_port
from reskin.errors import ReskinError
from reskin.live.emulator import make_port, play
from reskin.live.models import NetworkEstimator
from reskin.live.tracker import TAKING_NOLOAD, LiveSkin
from reskin.models.trained import read_network
from reskin.seeds import rng_for
from tests.live.boards import (
    PLACES,
    QUIET_S,
    ScriptReader,
    make_script,
    play_to_skin,
    plugged_in,
    write_model,
)
from tests.live.faults import inject

SCRIPT = make_script(pokes_n=2)
# On a busy machine, a healthy board may raise these alarms.
LATE = {"no data", "slower than before: frames are missing"}


def test_estimates_in_contact_have_the_place_and_force_of_the_poke(tmp_path):
    script = make_script(pokes_n=3, quiet_s=QUIET_S + 2.5)
    unread_n = 1000  # At most this number of frames is discarded if the pseudo-terminal is opened late.
    with plugged_in(script) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        wanted_n = len(script) - unread_n
        contacts = list(itertools.takewhile(lambda _: skin.account["frames_n"] < wanted_n, skin.every()))
        assert skin.account["frames_n"] * 82 == skin.account["frame_bytes_n"]
    found = np.array([contact[1:4] for contact in contacts if contact.F_N > 0])
    nearest = np.abs(found[:, None] - PLACES).sum(axis=2).argmin(axis=1)
    assert set(nearest) == {0, 1}
    # The tolerance in mm and N allows for noise of 3 uT in fifteen channels.
    np.testing.assert_allclose(found, PLACES[nearest], atol=0.5)
    assert all(math.isnan(contact.x_mm) for contact in contacts if contact.F_N == 0)
    assert 300 < len(found) < len(contacts)
    assert {alarm for contact in contacts for alarm in contact.alarms} <= LATE
    assert np.all(np.diff([contact.t_s for contact in contacts]) >= 0)
    assert abs(contacts[-1].t_s - time.time()) < 60
    assert all(math.isnan(contact.sd_mm[0]) for contact in contacts)


def test_estimates_of_several_models_are_averaged_with_a_standard_deviation(tmp_path):
    models = [write_model(tmp_path, f"m{i}", off_mm=i) for i in range(2)]
    with plugged_in(SCRIPT, loop=True) as name, reskin.open(name, model=models) as skin:
        touched = next(contact for contact in skin if contact.F_N > 0)
    # The first touch that is detected may be either of the two pokes, because a busy machine may miss the first poke.
    off = np.abs(touched[1:4] - (PLACES + (0.5, 0, 0))).max(axis=1)
    assert off.min() < 0.5
    np.testing.assert_allclose(touched.sd_mm, (math.sqrt(0.5), 0.0), atol=0.01)
    assert touched.sd_F_N == pytest.approx(0.0, abs=0.01)


def test_slow_caller_receives_the_latest_reading(tmp_path):
    def frame_i(contact) -> int:
        return int(np.flatnonzero((SCRIPT.frames.b_uT == contact.b_uT).all(axis=1))[0])

    with (
        plugged_in(SCRIPT, loop=True) as name,
        reskin.open(name, model=reskin.load_model(write_model(tmp_path))) as skin,
    ):
        # Readings with alarm "no data" (NaN) are excluded, because a busy machine may cause them.
        readings = (contact for contact in skin if np.isfinite(contact.b_uT).all())
        before, before_n = next(readings), skin.account["frames_n"]
        while skin.reader.waiting_bytes_n < 300 * 82:  # The caller waits, so that readings accumulate.
            time.sleep(0.01)
        late = next(readings)
        received_n = skin.account["frames_n"] - before_n
        assert received_n >= 300
        # The reading `late` is the latest frame, and no frame was lost.
        assert (frame_i(late) - frame_i(before) - received_n) % len(SCRIPT) == 0
        assert skin.reader.missed_bytes_n == skin.lost_bytes_n == 0


def test_readings_continue_after_alarms_for_pauses_and_unplugging(tmp_path):
    script, link = inject(make_script(pokes_n=3), "stall@2.5+1"), str(tmp_path / "board")
    awaited = ["no data", "unplugged"]
    with ExitStack() as board:
        board.enter_context(plugged_in(script, link, loop=True))
        with reskin.open(link, model=write_model(tmp_path)) as skin:
            for contact in skin:
                assert contact.usable == np.isfinite(contact.b_uT).all()
                if awaited and awaited[0] in " ".join(contact.alarms):
                    if awaited.pop(0) == "no data":
                        board.close()  # unplugs the board
                    else:
                        board.enter_context(plugged_in(script, link, loop=True))
                if not awaited and contact.F_N > 0:
                    break


def test_frames_with_failed_reads_have_no_estimate(tmp_path):
    skin, readings = play_to_skin(inject(SCRIPT, "failed-read@1.7+0.5"), [read_network(write_model(tmp_path))])
    failed = [row for batch in readings for row in batch.target[batch.b_uT[:, 3] == np.float32(8028.16)]]
    assert len(failed) == 200
    assert np.isnan(failed).all()
    assert skin.health.alarms["chip 1: failed I2C reads"].count_n == 200


def test_estimate_that_is_not_finite_is_never_usable(tmp_path):
    class Overflowing(NetworkEstimator):
        def __call__(self, db_uT):
            return super().__call__(db_uT)._replace(target=np.tile([np.inf, 4.0, 1.0], (len(db_uT), 1)))

    skin = LiveSkin("played")
    skin.reader, skin.estimator = ScriptReader(SCRIPT), Overflowing([read_network(write_model(tmp_path))])
    contacts = []
    while not skin.reader.at_end:
        if (estimates := skin.poll(0.0)) is not None:
            contacts += [skin._contact(estimates, i) for i in range(len(estimates))]
    assert not any(contact.usable and not contact.F_N == 0 for contact in contacts)
    assert "the estimate is not a finite number" in skin.health.alarms


def test_no_frame_is_lost_if_the_port_is_opened_within_a_frame():
    whole = make_script(pokes_n=0)
    # If the stream begins with a line feed, the next frame is skipped too, because its start is not known.
    for cut_i, left_n, skipped_n in ((0, 52, 52), (0, 1, 1 + 82), (400, 52, 52)):
        pieces = [piece[-left_n:] if i == cut_i else piece for i, piece in enumerate(whole.pieces)]
        skin, _ = play_to_skin(replace(whole, pieces=pieces))
        assert skin.account["skipped_resync_bytes_n"] == skipped_n
        assert skin.lost_bytes_n == (skipped_n if cut_i else 0)
        assert set(skin.health.alarms) == ({"bytes lost between frames"} if cut_i else set())


@pytest.mark.parametrize("chunk_n", [20, 3280])
def test_bytes_without_frames_after_plugging_in_are_counted_as_lost(chunk_n):
    skin, _ = play_to_skin(make_script(pokes_n=0))
    garbage = np.random.default_rng(0).bytes(40 * 3280)
    skin._start_stream(skin.detected)
    for i in range(0, len(garbage), chunk_n):
        skin._decode_stream([(garbage[i : i + chunk_n], 0.0)])
    assert skin.lost_bytes_n > 0.9 * len(garbage)
    assert {"bytes lost between frames", "no frames in the data: wrong baud rate?"} <= set(skin.health.alarms)


def test_magnet_raises_only_the_alarm_for_external_fields(tmp_path):
    skin, _ = play_to_skin(inject(SCRIPT, "magnet@3+1"), [read_network(write_model(tmp_path))])
    assert {word.split(":")[0] for word in skin.health.alarms} == {"external field"}


def test_no_load_reading_waits_until_the_skin_is_not_touched():
    script = inject(make_script(pokes_n=0, quiet_s=4.0), "magnet@0.35+0.7")
    skin, _ = play_to_skin(script)
    rest_uT = script.frames.b_uT[:100].mean(axis=0)
    # The tolerance is four standard errors of a mean of 100 readings with 3 uT of noise.
    np.testing.assert_allclose(skin.noload_uT, rest_uT, atol=4 * 3 / np.sqrt(100))
    moving = inject(make_script(pokes_n=0, quiet_s=2.0), "magnet@0.35+0.7")
    assert not play_to_skin(moving)[0].zeroed


def test_no_load_reading_restarts_if_another_thread_calls_zero():
    class ZeroingList(list):
        def append(self, frames):  # This function runs between two statements of the thread that reads the port.
            super().append(frames)
            skin.zero()

    skin = LiveSkin("played")
    skin.reader, skin._quiet = ScriptReader(make_script(pokes_n=0, quiet_s=2.0)), ZeroingList()
    while not skin.zeroed:
        assert not skin.reader.at_end
        skin.poll(0.0)
    skin.zero()
    assert not skin.zeroed
    assert TAKING_NOLOAD in skin.alarms()


@pytest.mark.timeout(3600)
def test_every_byte_is_in_a_frame_or_counted_as_lost():
    minutes_n = int(os.environ.get("RESKIN_MINUTES", "1"))
    script, rng = make_script(pokes_n=20), rng_for(0, "faults")
    for fault in ("torn", "dropped", "repeated", "wrong-baud", "crlf", "failed-read", "torn"):
        script = inject(script, f"{fault}@{rng.uniform(3, 55):.2f}+{rng.uniform(0.1, 2):.2f}")
    end, stop, sent = make_port("pty"), threading.Event(), []
    player = threading.Thread(
        target=lambda: sent.extend(play(script, end, stop, speed=100.0) for _ in range(minutes_n))
    )
    skin = LiveSkin(end.name)
    skin.reader.start(must_exist=True)
    player.start()
    while skin.poll(1.0) is not None or player.is_alive():
        pass
    account = skin.account + Counter({"missed_bytes_n": skin.reader.missed_bytes_n})
    end.unplug()
    skin.reader.stop()
    waiting_n = (
        account["bytes_n"]
        - account["frame_bytes_n"]
        - sum(count for name, count in account.items() if name.startswith("skipped_"))
    )
    assert account["bytes_n"] + account["missed_bytes_n"] == sum(sent)
    assert 0 <= waiting_n < 3 * 82  # The last bytes are not yet in a frame, and not yet lost.
    assert account["frames_n"] * 82 == account["frame_bytes_n"]
    assert account["skipped_resync_bytes_n"] > 1000
    print(f"\n{sum(sent)} bytes sent: {dict(account)}, {waiting_n} bytes wait for more")


def test_places_and_forces_are_estimated_on_a_sleeve_of_forty_chips(tmp_path):
    model = read_network(write_model(tmp_path, chips_n=40))
    skin, readings = play_to_skin(make_script(pokes_n=2, chips_n=40, rate_hz=133.0), [model])
    assert skin.layout.known
    assert skin.detected.chips_n == 40
    found = np.concatenate([batch.target[batch.contact] for batch in readings])
    nearest = np.abs(found[:, None] - PLACES).sum(axis=2).argmin(axis=1)
    assert set(nearest) == {0, 1}
    np.testing.assert_allclose(found, PLACES[nearest], atol=0.5)
    assert skin.health.alarms == {}


def test_eight_boards_are_read_at_once():
    chips_n = range(1, 9)

    def look(name: str) -> int:
        with LiveSkin(name) as skin:
            contact = next(iter(skin))
            assert skin.reader.missed_bytes_n == 0
            return len(contact.b_uT) // 3

    with ExitStack() as stack, ThreadPoolExecutor(8) as pool:
        scripts = [make_script(pokes_n=0, chips_n=n, rate_hz=50.0, quiet_s=2.0) for n in chips_n]
        names = [stack.enter_context(plugged_in(script, loop=True)) for script in scripts]
        assert list(pool.map(look, names)) == list(chips_n)


def test_open_raises_for_a_wrong_number_of_chips_or_a_missing_port(tmp_path):
    with plugged_in(make_script(pokes_n=1, chips_n=4)) as name:
        with pytest.raises(ReskinError, match="the board has 12 channels, but the model has 15"):
            reskin.open(name, model=write_model(tmp_path)).__enter__()
    with pytest.raises(ReskinError, match="cannot open the port"), reskin.open("/dev/none"):
        pass


def test_port_that_another_program_uses_is_reported():
    with plugged_in(SCRIPT, loop=True) as name, open_port(name, 115200):
        skin = LiveSkin(name)
        skin.reader.start(must_exist=False)
        try:
            # If no problem were reported, the time limit of the test suite would end the loop.
            while not skin.reader.problem:
                time.sleep(0.01)
            assert skin.alarms()[0].startswith(f"not open: {name}: cannot open the port")
        finally:
            skin.reader.stop()
