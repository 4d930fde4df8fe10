"""Every fault is named, with the chip that has it, and a healthy board raises no alarm."""

import numpy as np
import pytest

from reskin.board.wire import Frames
from reskin.live.emulator import inject, parse_fault
from reskin.live.health import BATCH_FRAMES_N, LIVE_POLICY, Health
from reskin.recordings.fault_policy import override
from tests.live.boards import make_script

SCRIPT = make_script(pokes_n=2)
TOLD = {
    "failed-read": "chip 1: failed I2C reads",
    "chip-reset": "chip 1: another step than the others: reset",
    "stuck": "chip 1: stuck",
    "saturated": "chip 1: field at the end of the range",
    "int16-wrap": "chip 1: past int16",
    "too-hot": "chip 1: temperature out of range",
}


def feed(script, frames_n=7):
    """Feed a script's frames as they would come, a few at a time."""
    health, frames = Health(script.frames.temperature_degC.shape[1]), script.frames
    for first in range(0, len(frames), frames_n):
        rows = (np.arange(len(frames)) >= first) & (np.arange(len(frames)) < first + frames_n)
        health.feed(frames.where(rows), float(script.t_s[rows][-1]))
    return health


def changed(name, wire="binary"):
    """The frames of a script with a fault, decoded again."""
    from reskin.board.stream import decode_all
    from reskin.live.emulator import Script

    lasts_s = 4.0 if name == "chip-reset" else 1.5  # lost settings do not come back
    script = inject(make_script(pokes_n=2, wire=wire), parse_fault(f"{name}@1.5+{lasts_s}"))
    frames, _ = decode_all(b"".join(script.pieces), wire, 5, name)
    t_s = script.t_s if len(frames) == len(script) else np.linspace(0, script.duration_s, len(frames))
    return Script("recorded", wire, frames, [b""] * len(frames), t_s)


def test_a_healthy_board_raises_no_alarm_pressed_or_not():
    health = feed(SCRIPT)
    assert health.alarms == {}
    assert health.rate_hz == pytest.approx(400, rel=0.02)


@pytest.mark.parametrize("name", TOLD)
def test_a_fault_is_named_with_its_chip_and_counted_where_it_was(name):
    health = feed(changed(name))
    assert set(health.alarms) == {TOLD[name]}
    alarm = health.alarms[TOLD[name]]
    lasted_s = 4.0 if name == "chip-reset" else 1.5  # a step shows in 400 frames
    assert 1.4 <= alarm.first_s <= 1.5 + lasted_s
    assert alarm.last_s <= 1.6 + lasted_s
    assert alarm.count_n >= 100
    assert health.active(alarm.last_s + 1.0) == [alarm]
    assert health.active(alarm.last_s + 3.0) == []


def test_zeros_are_named_on_every_chip():
    health = feed(changed("zeros"))
    assert {name: alarm.count_n for name, alarm in health.alarms.items()} == {
        f"chip {chip_i}: zeros in place of a reading": 600 for chip_i in range(5)
    }


def test_frames_that_repeat_and_a_clock_that_jumps_are_named():
    assert "frames repeat" in feed(changed("repeated")).alarms
    assert "the board's clock jumps" in feed(changed("clock-jump", "binary-clock")).alarms


def test_a_board_of_which_half_the_frames_are_missing_is_slower_than_it_was():
    half = (np.arange(len(SCRIPT)) < 1000) | (np.arange(len(SCRIPT)) % 2 == 0)
    health = Health(5)
    for i in np.flatnonzero(half):
        health.feed(SCRIPT.frames.where(np.arange(len(SCRIPT)) == i), float(SCRIPT.t_s[i]))
    assert set(health.alarms) == {"slower than it was: frames are missing"}
    assert health.rate_hz == pytest.approx(200, rel=0.1)


def test_frames_that_a_fault_has_hit_are_not_believed():
    frames = SCRIPT.frames.where(np.arange(len(SCRIPT)) < BATCH_FRAMES_N)
    for name in ("failed-read", "zeros", "saturated", "too-hot"):
        script = inject(SCRIPT, parse_fault(f"{name}@0+0.05"))
        assert script.pieces[0] != SCRIPT.pieces[0]
        assert not feed_once(changed_frames(script, BATCH_FRAMES_N))[:20].any(), name
        assert feed_once(changed_frames(script, BATCH_FRAMES_N))[20:].all(), name
    assert feed_once(frames).all()


def changed_frames(script, frames_n):
    from reskin.board.stream import decode_all

    return decode_all(b"".join(script.pieces[:frames_n]), "binary", 5, "script")[0]


def feed_once(frames: Frames):
    return Health(5).feed(frames, 1.0)


def test_a_change_of_field_that_all_chips_share_comes_from_outside():
    turn = np.tile(np.eye(3), (5, 1, 1))
    health = Health(5)
    health.feed_change(np.tile([0.0, 0.0, 20.0], 5), turn, 0.0)  # too weak to say
    health.feed_change(np.array([200.0, 0, 0, -100, 50, 0, 0, 0, 100, 0, -50, 0, 30, 0, 0]), turn, 0.0)
    assert health.alarms == {}
    health.feed_change(np.tile([0.0, 0.0, 400.0], 5), turn, 0.0)
    assert [name.split(":")[0] for name in health.alarms] == ["field from outside"]


def test_what_becomes_of_readings_that_a_fault_has_hit_is_decided_by_setting():
    for name, fault in (("failed-read", "failed_read"), ("saturated", "saturated"), ("too-hot", "too_hot")):
        script = inject(SCRIPT, parse_fault(f"{name}@0+0.05"))
        frames = changed_frames(script, BATCH_FRAMES_N)
        for action, believed in (("drop", False), ("flag", True), ("refuse", False)):
            health = Health(5, override(LIVE_POLICY, [f"{fault}={action}"], "test"))
            assert health.feed(frames, 1.0)[:20].all() == believed, name
            (alarm,) = health.alarms.values()
            assert (alarm.action, alarm.count_n) == (action, 20)


def test_a_chip_that_is_stuck_is_not_believed_while_it_is_unless_flagged():
    for action, unbelieved_n in (("drop", 500), ("flag", 0)):
        health, script, lost_n = Health(5, override(LIVE_POLICY, [f"stuck={action}"], "test")), changed("stuck"), 0
        for first in range(0, len(script.frames), 10):
            rows = (np.arange(len(script.frames)) >= first) & (np.arange(len(script.frames)) < first + 10)
            lost_n += int((~health.feed(script.frames.where(rows), float(script.t_s[rows][-1]))).sum())
        assert lost_n == pytest.approx(unbelieved_n, abs=100)
