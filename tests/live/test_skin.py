"""A controller's view: the place and force of what touches, within a second of plugging in, and what is wrong."""

import itertools
import math
import threading
import time
from collections import Counter

import numpy as np
import pytest

import reskin
from pipeline.core.errors import ReskinError
from pipeline.core.seeds import rng_for
from pipeline.live.emulate import open_far_end, play
from pipeline.live.inject import MAGNET_uT, inject, parse
from pipeline.live.skin import Skin
from tests.live.boards import PLACES, make_script, plugged_in, write_model

SCRIPT = make_script(pokes_n=2)
LATE = {"nothing comes", "slower than it was: frames are missing"}  # what a busy machine makes of a healthy board


def gather(contacts, until_s):
    """Take contacts for so long."""
    end_s = time.monotonic() + until_s
    return list(itertools.takewhile(lambda _: time.monotonic() < end_s, contacts))


def test_every_reading_has_its_time_place_and_force_in_contact_and_none_off_it(tmp_path):
    with plugged_in(SCRIPT) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        contacts = gather(skin.every(), 3.5)
        assert skin.account["frames_n"] * 82 == skin.account["frame_bytes_n"]
    found = np.array([contact[1:4] for contact in contacts if contact.F_N > 0])
    nearest = np.abs(found[:, None] - PLACES).sum(axis=2).argmin(axis=1)
    assert set(nearest) == {0, 1}
    np.testing.assert_allclose(found, PLACES[nearest], atol=0.5)  # noise of 3 uT in fifteen channels
    assert all(math.isnan(contact.x_mm) for contact in contacts if contact.F_N == 0)
    assert 300 < len(found) < len(contacts)
    assert {alarm for contact in contacts for alarm in contact.alarms} <= LATE
    assert np.all(np.diff([contact.t_s for contact in contacts]) >= 0)
    assert abs(contacts[-1].t_s - time.time()) < 60
    assert all(math.isnan(contact.sd_mm[0]) for contact in contacts)


def test_several_models_say_how_far_they_are_apart(tmp_path):
    models = [write_model(tmp_path, f"m{i}", off_mm=i) for i in range(2)]
    with plugged_in(SCRIPT) as name, reskin.open(name, model=models) as skin:
        touched = next(contact for contact in skin if contact.F_N > 0)
    np.testing.assert_allclose(touched[1:4], PLACES[0] + (0.5, 0, 0), atol=0.5)
    np.testing.assert_allclose(touched.sd_mm, (math.sqrt(0.5), 0.0), atol=0.01)


def test_who_is_slow_gets_the_latest_and_no_byte_is_lost(tmp_path):
    with plugged_in(SCRIPT) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        next(iter(skin))
        before_n = skin.account["frames_n"]
        time.sleep(1.0)  # a slow controller
        late = next(iter(skin))
        assert time.time() - late.t_s < 0.5
        assert 300 < skin.account["frames_n"] - before_n < 700
        assert skin.reader.missed_bytes_n == 0


def test_a_stall_and_an_unplugging_are_told_while_they_last_and_it_goes_on_after(tmp_path):
    script = inject(inject(make_script(pokes_n=3), parse("stall@2.5+1")), parse("unplug@4.5+1"))
    link, told = str(tmp_path / "board"), []
    with plugged_in(script, link) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        for contact in skin:
            told += [] if told and told[-1] == contact.alarms else [contact.alarms]
            if any("unplugged" in alarm for alarms in told for alarm in alarms) and contact.F_N > 0:
                break
    words = " ".join(alarm for alarms in told for alarm in alarms)
    assert "nothing comes" in words
    assert "unplugged" in words


def test_a_failed_read_is_no_contact(tmp_path):
    script = inject(SCRIPT, parse("failed-read@1.5+1"))
    with plugged_in(script) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        contacts = gather(skin.every(), 1.5)
    failed = [contact for contact in contacts if contact.b_uT[3] == np.float32(8028.16)]
    assert len(failed) > 50
    assert all(math.isnan(contact.F_N) for contact in failed)
    assert "chip 1: failed I2C reads" in contacts[-1].alarms or "chip 1: failed I2C reads" in failed[-1].alarms


def test_a_magnet_is_a_field_from_outside_and_an_input_far_from_training_an_unknown_skin(tmp_path):
    script = inject(SCRIPT, parse("magnet@3+1"))
    with plugged_in(script) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        words = {alarm for contact in gather(skin.every(), 3.0) for alarm in contact.alarms}
    assert {word.split(":")[0] for word in words - LATE} == {"field from outside"}


def test_a_second_in_which_something_moves_is_no_no_load_reading(tmp_path):
    script = inject(make_script(pokes_n=0), parse("magnet@0.35+1"))
    with plugged_in(script, loop=True) as name, reskin.open(name, model=write_model(tmp_path)) as skin:
        z_uT = skin._zero.noload_uT[2::3]
    rest_uT = script.frames.b_uT[0, 2::3]
    distance_uT = np.abs(z_uT - np.stack([rest_uT, rest_uT + MAGNET_uT]))
    assert distance_uT.max(axis=1).min() < 20  # one of the two levels, and nothing in between


@pytest.mark.parametrize("minutes_n", [1])
def test_every_byte_that_was_sent_is_a_frames_or_lost_and_counted(minutes_n):
    script, rng = make_script(pokes_n=20), rng_for(0, "faults")
    for fault in ("torn", "dropped", "repeated", "wrong-baud", "crlf", "failed-read", "torn"):
        script = inject(script, parse(f"{fault}@{rng.uniform(3, 55):.2f}+{rng.uniform(0.1, 2):.2f}"))
    end, stop, sent = open_far_end("pty"), threading.Event(), []
    player = threading.Thread(
        target=lambda: sent.extend(play(script, end, stop, speed=100.0) for _ in range(minutes_n))
    )
    skin = Skin(end.name)
    skin.reader.start(there=True)
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
    assert 0 <= waiting_n < 3 * 82  # of what comes last, more bytes would tell
    assert account["frames_n"] * 82 == account["frame_bytes_n"]
    assert account["skipped_resync_bytes_n"] > 1000


def test_a_model_of_other_boards_and_a_port_without_one_are_refused(tmp_path):
    with plugged_in(make_script(pokes_n=1, chips_n=4)) as name:
        with pytest.raises(ReskinError, match="channels must be the 15 of the model; got 12"):
            reskin.open(name, model=write_model(tmp_path)).__enter__()
    with pytest.raises(ReskinError, match="the port must be one that opens"), reskin.open("/dev/none"):
        pass
