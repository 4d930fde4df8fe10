"""Tests that every fault raises an alarm with the number of the chip, and that a healthy board raises none."""

from dataclasses import replace

import numpy as np
import pytest

from reskin.board.chips import RESET_LSB_XY_uT, RESET_LSB_Z_uT
from reskin.board.faults import FAILED_B_uT, FAILED_TEMPERATURE_degC
from reskin.board.wire import Frames
from reskin.live.health import BATCH_FRAMES_N, LIVE_POLICY, READINGS_REPEAT, REPEATS_FRAMES_N, Health
from reskin.recordings.fault_policy import override
from tests.live.boards import make_script
from tests.live.faults import inject

SCRIPT = make_script(pokes_n=2)
ALARMS = {
    "failed-read": "chip 1: failed I2C reads",
    "chip-reset": "chip 1: resolution differs from the other chips: the chip was probably reset",
    "stuck": "chip 1: stuck",
    "saturated": "chip 1: field at the end of the range",
    "int16-wrap": "chip 1: int16 overflow",
    "too-hot": "chip 1: temperature out of range",
}


def feed(script, frames_n=7):
    """Feed the frames of a script to a health monitor, in batches of `frames_n`. Return the monitor."""
    health, frames = Health(script.frames.temperature_degC.shape[1]), script.frames
    for first in range(0, len(frames), frames_n):
        rows = (np.arange(len(frames)) >= first) & (np.arange(len(frames)) < first + frames_n)
        health.feed(frames.where(rows), float(script.t_s[rows][-1]))
    return health


def inject_fault(name, wire="binary"):
    """Return a script with a fault at 1.5 s. Its frames are decoded from the damaged bytes."""
    from reskin.board.stream import decode_all
    from reskin.live.emulator import Script

    duration_s = 4.0 if name == "chip-reset" else 1.5  # A reset of a chip lasts until the end of the script.
    script = inject(make_script(pokes_n=2, wire=wire), f"{name}@1.5+{duration_s}")
    frames, _ = decode_all(b"".join(script.pieces), wire, 5, name)
    t_s = script.t_s if len(frames) == len(script) else np.linspace(0, script.duration_s, len(frames))
    return Script("recorded", wire, frames, [b""] * len(frames), t_s)


def test_healthy_board_raises_no_alarm():
    health = feed(SCRIPT)
    assert health.alarms == {}
    assert health.rate_hz == pytest.approx(400, rel=0.02)


@pytest.mark.parametrize("name", ALARMS)
def test_alarm_names_the_fault_and_counts_its_frames(name):
    health = feed(inject_fault(name))
    assert set(health.alarms) == {ALARMS[name]}
    alarm = health.alarms[ALARMS[name]]
    duration_s = 4.0 if name == "chip-reset" else 1.5  # A reset of a chip is found only after 400 frames.
    assert 1.4 <= alarm.first_s <= 1.5 + duration_s
    assert alarm.last_s <= 1.6 + duration_s
    assert alarm.count_n >= 100
    assert health.active(alarm.last_s + 1.0) == [alarm]
    assert health.active(alarm.last_s + 3.0) == []


def fail_reads_of_chip_0(script, every_n):
    """Return the script with failed reads of chip 0. One in `every_n` frames has a failed read."""
    b_uT, temperature_degC = script.frames.b_uT.copy(), script.frames.temperature_degC.copy()
    b_uT[every_n - 1 :: every_n, :3], temperature_degC[every_n - 1 :: every_n, 0] = FAILED_B_uT, FAILED_TEMPERATURE_degC
    return replace(script, frames=replace(script.frames, b_uT=b_uT, temperature_degC=temperature_degC))


@pytest.mark.parametrize("every_n", [30, BATCH_FRAMES_N])
@pytest.mark.parametrize("name", ["stuck", "chip-reset", "int16-wrap", "repeated"])
def test_failed_reads_of_another_chip_do_not_hide_a_fault(name, every_n):
    alarms = feed(fail_reads_of_chip_0(inject_fault(name), every_n)).alarms
    assert {"chip 0: failed I2C reads", ALARMS.get(name, "frames repeat")} == set(alarms)


@pytest.mark.parametrize("every_n", [3, 30, BATCH_FRAMES_N])
def test_frames_with_a_stuck_chip_are_invalid_even_if_another_chip_has_failed_reads(every_n):
    script = fail_reads_of_chip_0(inject_fault("stuck"), every_n)  # Chip 1 is stuck from 1.5 to 3.0 s.
    health, used = Health(5), np.zeros(len(script), bool)
    for i in range(len(script)):
        used[i : i + 1] = health.feed(script.frames.where(np.arange(len(script)) == i), float(script.t_s[i]))
    # A stuck chip is detected within two batches of frames without failed reads. Here, up to a third of the frames have
    # a failed read, so detection takes longer.
    found_s = 1.5 + 2 * BATCH_FRAMES_N * 1.5 / 400
    assert not used[(script.t_s > found_s) & (script.t_s < 2.95)].any()
    assert used[script.t_s < 1.5].any()


def test_reset_chip_is_found_on_a_board_without_contact():
    rng, step_uT = np.random.default_rng(0), np.tile([0.15, 0.15, 0.242], 5)
    # These are the steps of chip 1 at the settings that it has after power-on.
    step_uT[3:6] = RESET_LSB_XY_uT, RESET_LSB_XY_uT, RESET_LSB_Z_uT
    b_uT = np.round(rng.normal(0, 1.0, (1200, 15)) / step_uT) * step_uT
    script = make_script(pokes_n=2)
    frames = replace(script.frames.where(np.arange(len(script)) < 1200), b_uT=b_uT.astype(np.float32))
    alarms = feed(replace(script, frames=frames, pieces=script.pieces[:1200], t_s=script.t_s[:1200])).alarms
    assert ALARMS["chip-reset"] in alarms


def test_alarm_names_a_chip_that_reads_zeros():
    health = feed(inject_fault("zeros"))
    assert {name: alarm.count_n for name, alarm in health.alarms.items()} == {
        f"chip {chip_i}: zeros in place of a reading": 600 for chip_i in range(5)
    }


def test_repeated_frames_and_clock_jumps_raise_alarms():
    assert "frames repeat" in feed(inject_fault("repeated")).alarms
    assert "the board's clock jumps" in feed(inject_fault("clock-jump", "binary-clock")).alarms


def test_chips_that_are_slower_than_the_frames_raise_an_alarm():
    health = feed(inject_fault("slow-chips"))
    assert set(health.alarms) == {READINGS_REPEAT}
    alarm = health.alarms[READINGS_REPEAT]
    assert alarm.count_n == pytest.approx(2 / 3 * 600, abs=5)  # This is two thirds of the number of readings in 1.5 s.
    assert 1.5 < alarm.first_s <= 1.5 + REPEATS_FRAMES_N / 400
    assert alarm.action == "flag"


def test_missing_frames_raise_the_alarm_that_the_board_is_slower_than_before():
    half = (np.arange(len(SCRIPT)) < 1000) | (np.arange(len(SCRIPT)) % 2 == 0)
    health = Health(5)
    for i in np.flatnonzero(half):
        health.feed(SCRIPT.frames.where(np.arange(len(SCRIPT)) == i), float(SCRIPT.t_s[i]))
    assert set(health.alarms) == {"slower than before: frames are missing"}
    assert health.rate_hz == pytest.approx(200, rel=0.1)


def test_frames_with_a_fault_are_invalid():
    for name in ("failed-read", "zeros", "saturated", "too-hot"):
        script = inject(SCRIPT, f"{name}@0+0.05")
        assert script.pieces[0] != SCRIPT.pieces[0]
        assert not feed_once(decode_first_frames(script, BATCH_FRAMES_N))[:20].any(), name
        assert feed_once(decode_first_frames(script, BATCH_FRAMES_N))[20:].all(), name
    assert feed_once(SCRIPT.frames.where(np.arange(len(SCRIPT)) < BATCH_FRAMES_N)).all()


def decode_first_frames(script, frames_n):
    from reskin.board.stream import decode_all

    return decode_all(b"".join(script.pieces[:frames_n]), "binary", 5, "script")[0]


def feed_once(frames: Frames):
    return started().feed(frames, 4.0)


def started(policy=LIVE_POLICY):
    """Return a health monitor that knows the steps of the chips from earlier frames."""
    health = Health(5, policy)
    for first in range(0, 2000, BATCH_FRAMES_N):
        rows = np.arange(len(SCRIPT))
        health.feed(SCRIPT.frames.where((rows >= first) & (rows < first + BATCH_FRAMES_N)), first / 400)
    return health


def test_alarm_for_external_fields_is_raised_if_all_chips_change_equally():
    turn = np.tile(np.eye(3), (5, 1, 1))
    health = Health(5)
    # This change is too weak to be called an external field.
    health.feed_change(np.tile([0.0, 0.0, 20.0], 5), turn, 0.0)
    health.feed_change(np.array([200.0, 0, 0, -100, 50, 0, 0, 0, 100, 0, -50, 0, 30, 0, 0]), turn, 0.0)
    assert health.alarms == {}
    health.feed_change(np.tile([0.0, 0.0, 400.0], 5), turn, 0.0)
    assert [name.split(":")[0] for name in health.alarms] == ["external field"]


def test_fault_policy_decides_which_frames_are_valid():
    for name, fault in (("failed-read", "failed_read"), ("saturated", "saturated"), ("too-hot", "too_hot")):
        script = inject(SCRIPT, f"{name}@0+0.05")
        frames = decode_first_frames(script, BATCH_FRAMES_N)
        for action, used in (("drop", False), ("flag", True), ("refuse", False)):
            health = started(override(LIVE_POLICY, [f"{fault}={action}"], "test"))
            assert health.feed(frames, 4.0)[:20].all() == used, name
            (alarm,) = health.alarms.values()
            assert (alarm.action, alarm.count_n) == (action, 20)


def test_frames_with_a_stuck_chip_are_invalid_unless_the_policy_flags_them():
    for action, unused_n in (("drop", 500), ("flag", 0)):
        health, script, lost_n = Health(5, override(LIVE_POLICY, [f"stuck={action}"], "test")), inject_fault("stuck"), 0
        for first in range(0, len(script.frames), 10):
            rows = (np.arange(len(script.frames)) >= first) & (np.arange(len(script.frames)) < first + 10)
            lost_n += int((~health.feed(script.frames.where(rows), float(script.t_s[rows][-1]))).sum())
        assert lost_n == pytest.approx(unused_n, abs=100)


RESET, FAILED = "resolution differs from the other chips: the chip was probably reset", "failed I2C reads"


@pytest.mark.parametrize(
    ("name", "alarms"),
    [
        ("b20_artillery_AFG_board2_50_screw.txt", []),
        ("norm_b20_artillery_AFG_board2_50_screw.txt", []),
        ("faults/b20_artillery_AFG_flex_50.head400.txt", [f"chip {i}: {FAILED}" for i in range(5)]),
        ("faults/b20_artillery_AFG_test_new_board15.head400.txt", [f"chip 3: {RESET}"]),
        ("faults/b20_artillery_piezo.head400.txt", [f"chip {i}: {RESET}" for i in range(5)]),
    ],
)
def test_real_recordings_raise_the_expected_alarms(shared_data, name, alarms):
    chips = np.loadtxt(shared_data / "ini" / name, dtype=np.float32).reshape(-1, 5, 4)
    b_uT, temperature_degC = chips[..., :3].reshape(len(chips), -1), chips[..., 3]
    health = Health(5)
    for first in range(0, len(chips), 5):
        rows = slice(first, first + 5)
        unknown = np.full(len(b_uT[rows]), np.nan), np.zeros(len(b_uT[rows]), np.int64)
        health.feed(Frames(b_uT[rows], temperature_degC[rows], *unknown), first / 100.0)
    assert sorted(health.alarms) == alarms
