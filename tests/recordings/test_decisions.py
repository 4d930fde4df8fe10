"""Each fault is counted, with its span, and becomes what was decided: dropped, flagged, or the recording refused."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.board.faults import ConstantChannels
from reskin.board.stream import decode_all
from reskin.errors import CaptureError, ParamsError
from reskin.live.emulator import inject, parse_fault
from reskin.recordings.chips import Watch, find_whole_rows
from reskin.recordings.fault_policy import Decisions, Ledger, decide
from reskin.recordings.header import Clock
from reskin.seeds import rng_for
from tests.live.boards import RATE_HZ, make_script
from tests.recordings.headers import AS_USUAL, make_header

SCRIPTS = {wire: make_script(pokes_n=1, wire=wire) for wire in ("binary", "binary-clock", "text-txyz")}
CLOCK = Clock(kind="rate", rate_hz=RATE_HZ, marks=())
FROM_S, LASTS_S = 2.0, 0.5
# the fault that is put in, on which wire, the name it is found under, how many frames (or bytes: None)
FAULTS = [
    ("failed-read", "binary", "failed_read", 200), ("zeros", "binary", "zeros", 200), ("stuck", "binary", "stuck", 181),
    ("saturated", "binary", "saturated", 200), ("too-hot", "binary", "too_hot", 200),
    ("int16-wrap", "binary", "int16_wrap", 200), ("repeated", "binary", "repeated", 200),
    ("torn", "binary", "torn", None), ("torn", "text-txyz", "torn", None), ("wrong-baud", "binary", "wrong_baud", None),
    ("clock-jump", "binary-clock", "clock_jump", 2), ("dropped", "binary-clock", "dropped", 100),
]  # fmt: skip


def look(name: str, wire: str, decisions: Decisions = AS_USUAL):
    """Look at a stream with a fault, as ingest does; give what is found, and the frames that are kept."""
    script = SCRIPTS[wire] if name == "none" else inject(SCRIPTS[wire], parse_fault(f"{name}@{FROM_S}+{LASTS_S}"))
    frames, _ = decode_all(b"".join(script.pieces), wire, 5, name)
    sent_byte = np.cumsum([len(piece) for piece in script.pieces])
    t_s = np.interp(frames.end_byte, sent_byte, script.t_s)
    watch = Watch(make_header(layout="native", wire=wire, clock=CLOCK), name,
                  decisions)  # fmt: skip
    half = np.arange(len(frames)) < len(frames) // 3  # in two portions
    kept = [watch.look(frames.where(rows), t_s[rows]).whole for rows in (half, ~half)]
    return watch.ledger, np.concatenate(kept)


@pytest.mark.parametrize("wire", SCRIPTS)
def test_a_sound_stream_has_nothing_in_the_ledger(wire):
    ledger, kept = look("none", wire)
    assert ledger.account() == {}
    assert kept.all()


@pytest.mark.parametrize(("name", "wire", "fault", "frames_n"), FAULTS)
def test_each_fault_is_found_by_its_name_where_it_was_and_treated_as_decided(name, wire, fault, frames_n):
    for decision in Decisions.model_fields[fault].annotation.__args__:
        decisions = decide(AS_USUAL, [f"{fault}={decision}"], "test")
        if decision == "refuse":
            with pytest.raises(CaptureError, match=f"{fault.replace('_', ' ')} must be nowhere"):
                look(name, wire, decisions)
            continue
        ledger, kept = look(name, wire, decisions)
        assert set(ledger.found) == {fault}
        found = ledger.found[fault]
        assert found.decision == decision
        assert found.count_n == pytest.approx(frames_n, rel=0.1) if frames_n else found.count_n > 500
        assert FROM_S - 0.01 <= found.first <= FROM_S + LASTS_S + 0.05
        assert found.last <= FROM_S + LASTS_S + 0.1
        dropped = decision == "drop" and fault not in ("torn", "wrong_baud")  # there are no frames to drop
        assert (~kept).sum() == (found.count_n if dropped else 0)


def test_a_board_that_is_silent_for_a_second_was_unplugged():
    script = SCRIPTS["binary"]
    watch = Watch(make_header(layout="native", wire="binary", clock=CLOCK), "x", AS_USUAL)
    frames = replace(script.frames, end_byte=82 * (1 + np.arange(len(script))))
    watch.look(frames, script.t_s + 1.5 * (script.t_s > 1.0))
    assert {name: (one.count_n, round(one.first, 1)) for name, one in watch.ledger.found.items()} == {
        "unplug": (1, 2.5)
    }


def test_a_chip_reset_is_refused_or_flagged():
    script = inject(make_script(pokes_n=2), parse_fault("chip-reset@2+5"))
    frames, _ = decode_all(b"".join(script.pieces), "binary", 5, "reset")
    header = make_header(layout="native", wire="binary", clock=CLOCK)
    with pytest.raises(CaptureError, match="the LSB of chip 1"):
        Watch(header, "reset", AS_USUAL).look(frames, script.t_s)
    watch = Watch(header, "reset", decide(AS_USUAL, ["chip_reset=flag"], "test"))
    assert watch.look(frames, script.t_s).whole.all()
    assert watch.ledger.found["chip_reset"].count_n >= 4 * RATE_HZ
    assert 1.0 <= watch.ledger.found["chip_reset"].first <= 3.0


def test_a_fault_without_time_is_counted_and_leaves_the_span_as_it_is():
    hit, unknown_s = np.ones(2, bool), np.array([3.0, np.nan])
    ledger = Ledger(AS_USUAL, "x", "ms")
    for at_s in (unknown_s * np.nan, unknown_s, unknown_s * np.nan):
        ledger.note("stuck", hit, at_s)
    assert ledger.account() == {
        "fault_stuck_dropped_n": 6, "fault_stuck_first_ms": 3000, "fault_stuck_last_ms": 3000,
    }  # fmt: skip
    with pytest.raises(CaptureError, match="got 2, the first at an unknown time"):
        Ledger(decide(AS_USUAL, ["stuck=refuse"], "t"), "x", "ms").note("stuck", hit, unknown_s * np.nan)


def test_rows_of_somebodys_table_are_decided_likewise():
    rng, header = rng_for(0, "rows"), make_header(chips_n=2)
    b_uT, temperature_degC = rng.normal(300, 5, (200, 6)), np.full((200, 2), 25.0)
    temperature_degC[20:30, 1], b_uT[100] = 150.0, 0.0
    kept = find_whole_rows(b_uT, temperature_degC, header, where="here", decisions=AS_USUAL)
    assert np.flatnonzero(~kept.whole).tolist() == [100]
    assert kept.losses()["fault_too_hot_flagged_n"] == 10
    assert (kept.losses()["fault_too_hot_first_row"], kept.losses()["fault_too_hot_last_row"]) == (21, 30)
    decisions = decide(AS_USUAL, ["too_hot=drop", "zeros=flag"], "test")
    kept = find_whole_rows(b_uT, temperature_degC, header, where="here", decisions=decisions)
    assert np.flatnonzero(~kept.whole).tolist() == list(range(20, 30))
    assert kept.losses()["dropped_out_of_range_rows_n"] == 10
    with pytest.raises(CaptureError, match="here: zeros must be nowhere, as was decided; got 1, the first at row 101"):
        find_whole_rows(b_uT, temperature_degC, header, where="here", decisions=decide(AS_USUAL, ["zeros=refuse"], "t"))


def test_what_cannot_be_decided_is_refused_and_what_is_nowhere_is_not_in_the_account():
    for words, told in ((["melted=drop"], "NAME=drop"), (["torn=flag"], "torn=drop|refuse"), (["stuck"], "stuck=drop")):
        with pytest.raises(ParamsError, match="a decision must be") as error:
            decide(AS_USUAL, words, "--on-fault")
        assert told in str(error.value)
    ledger = Ledger(AS_USUAL, "x", "row")
    assert not ledger.note("stuck", np.zeros(3, bool), np.arange(3)).any()
    assert ledger.account() == {}


CONSTANT = (
    r"each channel must be one that changes; got one value throughout for Bz of chip 0 \(.*\), Bz of chip 1 \(0 uT\)"
)


def constant_z(b_uT: np.ndarray) -> np.ndarray:
    """Chips 0 and 1 whose z never changes, the second one at 0."""
    changed = b_uT.copy()
    changed[:, 2], changed[:, 5] = b_uT[0, 2], 0.0
    return changed


def test_channels_that_never_change_are_refused_or_flagged_in_rows():
    """All layouts of recordings by others look for faults with this function."""
    rng, header = rng_for(0, "constant"), make_header(chips_n=3)
    b_uT, warm_degC = constant_z(rng.normal(300, 5, (200, 9))), np.full((200, 3), 25.0)
    with pytest.raises(CaptureError, match=CONSTANT):
        find_whole_rows(b_uT, warm_degC, header, where="here", decisions=AS_USUAL)
    flagging = decide(AS_USUAL, ["constant_channel=flag"], "test")
    rows = find_whole_rows(b_uT, warm_degC, header, where="here", decisions=flagging)
    assert rows.whole.all()
    assert rows.losses()["fault_constant_channel_flagged_n"] == 200
    few = find_whole_rows(b_uT[:19], warm_degC[:19], header, where="here", decisions=AS_USUAL)
    assert few.whole.all()


@given(st.lists(st.integers(0, 400), max_size=4))
def test_channels_that_never_change_are_found_in_a_stream_of_any_portions(ends):
    frames = SCRIPTS["binary"].frames
    frames = replace(frames, b_uT=constant_z(frames.b_uT), end_byte=82 * (1 + np.arange(len(frames))))
    for words, refused in (([], True), (["constant_channel=flag"], False)):
        header = make_header(layout="native", wire="binary", clock=CLOCK)
        watch = Watch(header, "x", decide(AS_USUAL, words, "test"))
        edges = [0, *sorted(ends), len(frames)]
        for begin, end in pairwise(edges):
            rows = (np.arange(len(frames)) >= begin) & (np.arange(len(frames)) < end)
            watch.look(frames.where(rows), SCRIPTS["binary"].t_s[rows])
        if refused:
            with pytest.raises(CaptureError, match=CONSTANT):
                watch.close()
        else:
            watch.close()
            assert watch.ledger.account()["fault_constant_channel_last_ms"] > 0


def test_a_board_whose_chips_or_all_channels_stand_still_has_no_constant_channel():
    channels = ConstantChannels(2)
    channels.feed(np.zeros((50, 6)))
    assert channels.found() == []
    moving = np.zeros((50, 6))
    moving[:, 3:] = rng_for(0, "still").normal(0, 5, (50, 3))
    channels = ConstantChannels(2)
    channels.feed(moving)
    assert channels.found() == []  # chip 0 is stuck
