"""Tests that faults are counted with their span of time, and that the policy for faults is applied.

The policy says for each fault whether faulty frames are dropped, flagged, or the capture is refused.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin import seeds
from reskin.board import faults
from reskin.board.faults import GRID_ROWS_N, ConstantChannels, FaultDetector
from reskin.board.stream import decode_all
from reskin.board.wire import Frames, record_type
from reskin.errors import CaptureError, ParamsError
from reskin.recordings.fault_policy import FaultLog, FaultPolicy, check_rows, override
from reskin.seeds import rng_for
from tests.live.boards import RATE_HZ, make_script
from tests.live.faults import inject
from tests.recordings.headers import DEFAULT_POLICY

SCRIPTS = {wire: make_script(pokes_n=1, wire=wire) for wire in ("binary", "binary-clock", "text-txyz")}
FROM_S, LASTS_S = 2.0, 0.5
# Each case consists of an injected fault, the wire format, the name of the fault in the log, and the number of faulty
# frames. None instead of a number means that the fault is counted in bytes.
FAULTS = [
    ("failed-read", "binary", "failed_read", 200), ("zeros", "binary", "zeros", 200), ("stuck", "binary", "stuck", 181),
    ("saturated", "binary", "saturated", 200), ("too-hot", "binary", "too_hot", 200),
    ("int16-wrap", "binary", "int16_wrap", 200), ("repeated", "binary", "repeated", 200),
    ("torn", "binary", "torn", None), ("torn", "text-txyz", "torn", None), ("wrong-baud", "binary", "wrong_baud", None),
    ("clock-jump", "binary-clock", "clock_jump", 2), ("dropped", "binary-clock", "dropped", 100),
]  # fmt: skip


def record(frames: Frames, t_s: np.ndarray, ends: list[int], policy: FaultPolicy, wire: str = "binary"):
    """Feed frames in chunks that end at `ends`, as stage ingest does. Return fault log and mask of kept frames."""
    frame_bytes_n = None if wire.startswith("text") else record_type(wire, 5).itemsize
    detector = FaultDetector(frames.temperature_degC.shape[1], frame_bytes_n=frame_bytes_n)
    log, kept = FaultLog(policy, "stream.bin", "ms"), []
    for begin, end in pairwise([0, *sorted(ends), len(frames)]):
        rows = (np.arange(len(frames)) >= begin) & (np.arange(len(frames)) < end)
        kept.append(log.apply(detector.feed(frames.where(rows), t_s[rows]), t_s[rows]).keep)
    log.record_constant(detector.constant_channels())
    return log, np.concatenate(kept)


def record_fault(name: str, wire: str, policy: FaultPolicy = DEFAULT_POLICY):
    """Decode a stream with a fault in two chunks. Return the fault log and the mask of kept frames."""
    script = SCRIPTS[wire] if name == "none" else inject(SCRIPTS[wire], f"{name}@{FROM_S}+{LASTS_S}")
    frames, _ = decode_all(b"".join(script.pieces), wire, 5, name)
    sent_byte = np.cumsum([len(piece) for piece in script.pieces])
    t_s = np.interp(frames.end_byte, sent_byte, script.t_s)
    return record(frames, t_s, [len(frames) // 3], policy, wire)


@pytest.mark.parametrize("wire", SCRIPTS)
def test_stream_without_damage_has_no_fault(wire):
    log, kept = record_fault("none", wire)
    assert log.account() == {}
    assert kept.all()


@pytest.mark.parametrize(("name", "wire", "fault", "frames_n"), FAULTS)
def test_injected_faults_are_found_and_their_policy_is_applied(name, wire, fault, frames_n):
    for action in FaultPolicy.model_fields[fault].annotation.__args__:
        policy = override(DEFAULT_POLICY, [f"{fault}={action}"], "test")
        if action == "refuse":
            with pytest.raises(CaptureError, match=f"found fault {fault.replace('_', ' ')} "):
                record_fault(name, wire, policy)
            continue
        log, kept = record_fault(name, wire, policy)
        assert set(log.records) == {fault}
        found = log.records[fault]
        assert found.action == action
        assert found.count_n == pytest.approx(frames_n, rel=0.1) if frames_n else found.count_n > 500
        assert FROM_S - 0.01 <= found.first <= FROM_S + LASTS_S + 0.05
        assert found.last <= FROM_S + LASTS_S + 0.1
        # After these faults, there are no frames that could be dropped.
        dropped = action == "drop" and fault not in ("torn", "wrong_baud")
        assert (~kept).sum() == (found.count_n if dropped else 0)


def test_silence_of_more_than_a_second_counts_as_unplugging():
    script = SCRIPTS["binary"]
    frames = replace(script.frames, end_byte=82 * (1 + np.arange(len(script))))
    log, _ = record(frames, script.t_s + 1.5 * (script.t_s > 1.0), [], DEFAULT_POLICY)
    assert {name: (found.count_n, round(found.first, 1)) for name, found in log.records.items()} == {"unplug": (1, 2.5)}


def test_chip_with_power_on_settings_is_refused_or_flagged():
    script = inject(make_script(pokes_n=2), "chip-reset@2+5")
    frames, _ = decode_all(b"".join(script.pieces), "binary", 5, "reset")
    with pytest.raises(CaptureError, match="the LSB of chip 1"):
        record(frames, script.t_s, [], DEFAULT_POLICY)
    log, kept = record(frames, script.t_s, [], override(DEFAULT_POLICY, ["chip_reset=flag"], "test"))
    assert kept.all()
    assert log.records["chip_reset"].count_n >= 4 * RATE_HZ
    assert 1.0 <= log.records["chip_reset"].first <= 3.0


def test_fault_at_an_unknown_time_does_not_change_first_and_last_time_of_its_kind():
    mask, unknown_s = np.ones(2, bool), np.array([3.0, np.nan])
    log = FaultLog(DEFAULT_POLICY, "x", "ms")
    for at_s in (unknown_s * np.nan, unknown_s, unknown_s * np.nan):
        log.record("stuck", mask, at_s)
    assert log.account() == {
        "fault_stuck_dropped_n": 6, "fault_stuck_first_ms": 3000, "fault_stuck_last_ms": 3000,
    }  # fmt: skip
    with pytest.raises(CaptureError, match="count 2, first at an unknown time"):
        FaultLog(override(DEFAULT_POLICY, ["stuck=refuse"], "t"), "x", "ms").record("stuck", mask, unknown_s * np.nan)


def test_policy_is_applied_to_rows_of_a_table():
    rng = rng_for(0, "rows")
    b_uT, temperature_degC = rng.normal(300, 5, (200, 6)), np.full((200, 2), 25.0)
    temperature_degC[20:30, 1], b_uT[100] = 150.0, 0.0
    kept = check_rows(b_uT, temperature_degC, None, where="here", policy=DEFAULT_POLICY)
    assert np.flatnonzero(~kept.keep).tolist() == [100]
    assert kept.account()["fault_too_hot_flagged_n"] == 10
    assert (kept.account()["fault_too_hot_first_row"], kept.account()["fault_too_hot_last_row"]) == (21, 30)
    policy = override(DEFAULT_POLICY, ["too_hot=drop", "zeros=flag"], "test")
    kept = check_rows(b_uT, temperature_degC, None, where="here", policy=policy)
    assert np.flatnonzero(~kept.keep).tolist() == list(range(20, 30))
    assert kept.account()["dropped_out_of_range_rows_n"] == 10
    with pytest.raises(CaptureError, match="here: found fault zeros .count 1, first at row 101."):
        check_rows(b_uT, temperature_degC, None, where="here", policy=override(DEFAULT_POLICY, ["zeros=refuse"], "t"))


def test_invalid_changes_of_the_policy_are_refused():
    wrong = {
        "melted=drop": "The possible NAMEs are: .*stuck",
        "stuk=flag": "Did you mean stuck=flag",
        "torn=flag": "torn must be drop or refuse; got 'flag'",
        "stuck": "stuck must be drop or flag or refuse; got ''. Try: stuck=drop",
    }
    for text, message in wrong.items():
        with pytest.raises(ParamsError, match=f"--on-fault: .*{message}"):
            override(DEFAULT_POLICY, [text], "--on-fault")
    log = FaultLog(DEFAULT_POLICY, "x", "row")
    assert not log.record("stuck", np.zeros(3, bool), np.arange(3)).any()
    assert log.account() == {}


CONSTANT = r"Bz of chip 0 \(.*\), Bz of chip 1 \(0 uT\) never changed in the whole recording"


def constant_z(b_uT: np.ndarray) -> np.ndarray:
    """Return fields in which z of chip 0 is constant, and z of chip 1 is always 0."""
    changed = b_uT.copy()
    changed[:, 2], changed[:, 5] = b_uT[0, 2], 0.0
    return changed


def test_constant_channels_of_a_table_are_refused_or_flagged():
    rng = rng_for(0, "constant")
    b_uT, warm_degC = constant_z(rng.normal(300, 5, (200, 9))), np.full((200, 3), 25.0)
    with pytest.raises(CaptureError, match=CONSTANT):
        check_rows(b_uT, warm_degC, None, where="here", policy=DEFAULT_POLICY)
    flagging = override(DEFAULT_POLICY, ["constant_channel=flag"], "test")
    rows = check_rows(b_uT, warm_degC, None, where="here", policy=flagging)
    assert rows.keep.all()
    assert rows.account()["fault_constant_channel_flagged_n"] == 200
    few = check_rows(b_uT[:19], warm_degC[:19], None, where="here", policy=DEFAULT_POLICY)
    assert few.keep.all()


@given(st.lists(st.integers(0, 400), max_size=4))
def test_constant_channels_are_found_for_any_size_of_chunks(ends):
    frames = SCRIPTS["binary"].frames
    frames = replace(frames, b_uT=constant_z(frames.b_uT), end_byte=82 * (1 + np.arange(len(frames))))
    with pytest.raises(CaptureError, match=CONSTANT):
        record(frames, SCRIPTS["binary"].t_s, ends, DEFAULT_POLICY)
    log, _ = record(frames, SCRIPTS["binary"].t_s, ends, override(DEFAULT_POLICY, ["constant_channel=flag"], "test"))
    assert log.account()["fault_constant_channel_last_ms"] > 0


def test_stuck_chips_and_boards_that_never_change_are_not_reported_as_constant_channels():
    channels = ConstantChannels(2)
    channels.feed(np.zeros((50, 6)))
    assert channels.describe() == []
    moving = np.zeros((50, 6))
    moving[:, 3:] = rng_for(0, "still").normal(0, 5, (50, 3))
    channels = ConstantChannels(2)
    channels.feed(moving)
    assert channels.describe() == []  # Chip 0 is stuck, which is another fault.


CHIPS_N = 5


def noisy_fields_uT(rows_n: int) -> np.ndarray:
    """Return fields of five chips at GAIN_SEL 7.

    They are 300 uT with 5 uT of noise, rounded to multiples of the step (LSB).
    """
    lsb_uT = np.tile([0.15, 0.15, 0.242], CHIPS_N)
    b_uT = 300 + 5 * seeds.rng_for(2021, "fields").standard_normal((rows_n, 3 * CHIPS_N))
    return np.round(b_uT / lsb_uT) * lsb_uT


@settings(max_examples=30, deadline=None)
@given(failed=st.sets(st.tuples(st.integers(0, 49), st.integers(0, CHIPS_N - 1))))
def test_rows_are_kept_except_those_in_which_a_chip_has_failed(failed: set[tuple[int, int]]) -> None:
    b_uT, temperature_degC = noisy_fields_uT(50), np.full((50, CHIPS_N), 25.0)
    for row_i, chip_i in failed:
        b_uT[row_i, 3 * chip_i : 3 * chip_i + 3] = faults.FAILED_B_uT
        temperature_degC[row_i, chip_i] = faults.FAILED_TEMPERATURE_degC
    rows = {row_i for row_i, _ in failed}
    if len(rows) < 50:
        whole = check_rows(b_uT, temperature_degC, None, where="here", policy=DEFAULT_POLICY).keep
        assert set(np.flatnonzero(~whole).tolist()) == rows


@pytest.mark.parametrize("chip_i", range(CHIPS_N))
def test_error_names_a_chip_whose_steps_differ_from_those_of_the_other_chips(chip_i: int) -> None:
    b_uT = noisy_fields_uT(GRID_ROWS_N)
    spread = seeds.rng_for(2021, "spread").standard_normal((GRID_ROWS_N, 3))
    b_uT[:, 3 * chip_i : 3 * chip_i + 3] = 300 + 5 * spread
    with pytest.raises(CaptureError, match=f"chip {chip_i} must be"):
        check_rows(b_uT, np.full((GRID_ROWS_N, CHIPS_N), np.nan), None, where="here", policy=DEFAULT_POLICY)


def test_fields_that_are_not_multiples_of_a_step_are_accepted() -> None:
    # Such fields are written, for example, by a recorder that averages readings. They have no step that could be
    # compared between chips.
    b_uT = 300 + 5 * seeds.rng_for(2021, "averaged").standard_normal((GRID_ROWS_N, 3 * CHIPS_N))
    unknown_degC = np.full((GRID_ROWS_N, CHIPS_N), np.nan)
    assert check_rows(b_uT, unknown_degC, None, where="here", policy=DEFAULT_POLICY).keep.all()


def test_rows_with_stuck_and_with_failed_chips_are_counted_separately() -> None:
    b_uT, temperature_degC = noisy_fields_uT(100), np.full((100, CHIPS_N), 25.0)
    b_uT[50:, 3:6] = b_uT[50, 3:6]
    b_uT[10, :3], temperature_degC[10, 0] = faults.FAILED_B_uT, faults.FAILED_TEMPERATURE_degC
    rows = check_rows(b_uT, temperature_degC, None, where="here", policy=DEFAULT_POLICY)
    assert np.flatnonzero(rows.failed).tolist() == [10]
    assert np.flatnonzero(rows.stuck).tolist() == list(range(50 + faults.STUCK_FRAMES_MIN_N - 1, 100))
    assert rows.account() == {
        "dropped_failed_read_rows_n": 1, "dropped_stuck_chip_rows_n": 31,
        "fault_failed_read_dropped_n": 1, "fault_failed_read_first_row": 11, "fault_failed_read_last_row": 11,
        "fault_stuck_dropped_n": 31, "fault_stuck_first_row": 70, "fault_stuck_last_row": 100,
    }  # fmt: skip
    np.testing.assert_array_equal(rows.keep, ~(rows.failed | rows.stuck))
