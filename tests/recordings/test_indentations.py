"""Tests of matching frames with dwells, the stops of the tip during which a label is valid.

The reference is a double loop. Frames come in blocks of any size, and every frame is counted.
"""

import dataclasses
import tracemalloc
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reskin.board.wire import Frames
from reskin.recordings.clocks import ClockMap
from reskin.recordings.fault_policy import CheckedRows
from reskin.recordings.ingest import Joiner, TimedFrames
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.schema import Readings
from reskin.seeds import rng_for
from tests.recordings.headers import make_header

CHIPS_N = 2
CLOCK = ClockMap(offset_s=-5.0, rate=1.25, residual_s=0.0, explained=1.0)
HEADER = make_header(chips_n=CHIPS_N, contacts_before_n=100)
# The dwells of an indentation are pairs (gap before the dwell, length). Gaps and lengths are multiples of half a frame
# period, so that some frames are on the edge of a dwell.
DWELLS = st.lists(st.tuples(st.integers(0, 3), st.integers(1, 9)), min_size=1, max_size=3)


def log_of(indentations: list[list[tuple[int, int]]]) -> ProbeLog:
    """Return a probe log of these dwells.

    The first dwell of each indentation is without contact, the others are in contact.
    """
    rows = [
        (number, dwell_i > 0, *dwell) for number, one in enumerate(indentations) for dwell_i, dwell in enumerate(one)
    ]
    number, contact, gap, length = (np.array(column) for column in zip(*rows, strict=True))
    end_s = np.cumsum(gap + length) / 2
    labels = {name: np.where(contact, i + end_s, np.nan).astype(np.float32) for i, name in enumerate(LABELS)}
    number = (10 * number).astype(np.int32)
    return ProbeLog(number, number // 20, contact.astype(bool), end_s - length / 2, end_s, **labels)


def timed_of(frames_n: int, faults: dict[int, str] | None = None) -> TimedFrames:
    """Return frames at intervals of 1 s of probe time, which begin 2 s before the log.

    `faults` maps the numbers of faulty frames to the kinds of fault.
    """
    rng = rng_for(0, "frames", frames_n)
    b_uT = rng.normal(0, 100, (frames_n, 3 * CHIPS_N)).astype(np.float32)
    temperature_degC = rng.normal(25, 1, (frames_n, CHIPS_N)).astype(np.float32)
    t_s = (np.arange(frames_n) - 2.0 - CLOCK.offset_s) / CLOCK.rate
    failed, stuck = np.zeros((2, frames_n), bool)
    for row_i, fault in (faults or {}).items():
        if row_i < frames_n:
            failed[row_i], stuck[row_i] = fault == "failed", fault == "stuck"
            b_uT[row_i, -1] = np.nan if fault == "field" else b_uT[row_i, -1]
            temperature_degC[row_i, 0] = np.inf if fault == "temperature" else 25
    checked = CheckedRows(~(failed | stuck), failed, stuck, np.zeros(frames_n, bool), {})
    end_byte = 34 * (1 + np.arange(frames_n, dtype=np.int64))
    return TimedFrames(Frames(b_uT, temperature_degC, np.full(frames_n, np.nan), end_byte), t_s, checked)


def cut(whole: TimedFrames, ends: list[int]) -> list[TimedFrames]:
    edges = [0, *sorted(min(end, len(whole.t_s)) for end in ends), len(whole.t_s)]
    blocks = []
    for begin, end in pairwise(edges):
        names = [field.name for field in dataclasses.fields(Frames)]
        frames = Frames(**{name: getattr(whole.frames, name)[begin:end] for name in names})
        blocks.append(TimedFrames(frames, whole.t_s[begin:end], whole.checked.part(slice(begin, end))))
    return blocks


def join_blocks(blocks: list[TimedFrames], log: ProbeLog) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Join all blocks of frames with the log. Return the readings as columns, and the account of frames."""
    joiner = Joiner(log, CLOCK, HEADER)
    parts = [*map(joiner.feed, blocks), joiner.close()]
    names = [
        field.name for field in dataclasses.fields(Readings) if field.name not in ("capture", "board", "skin", "source")
    ]
    return {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}, joiner.account()


def join_naively(timed: TimedFrames, log: ProbeLog) -> list[dict[str, object]]:
    """Return the expected readings, by comparing every frame with every dwell.

    A frame on the common edge of two dwells belongs to the later one.
    """
    noload: dict[int, list[np.ndarray]] = {}
    contact: list[tuple[int, int]] = []
    for frame_i, t_s in enumerate(timed.t_s.tolist()):
        finite = (
            np.isfinite(timed.frames.b_uT[frame_i]).all() and np.isfinite(timed.frames.temperature_degC[frame_i]).all()
        )
        inside = [d for d in range(len(log)) if log.t_start_s[d] <= CLOCK.offset_s + CLOCK.rate * t_s <= log.t_end_s[d]]
        if inside and finite and timed.checked.keep[frame_i]:
            dwell_i = inside[-1]
            if log.contact[dwell_i]:
                contact.append((frame_i, dwell_i))
            else:
                noload.setdefault(int(log.indentation[dwell_i]), []).append(timed.frames.b_uT[frame_i])
    rows: list[dict[str, object]] = []
    for frame_i, dwell_i in contact:
        number = int(log.indentation[dwell_i])
        if number in noload:
            rows.append(
                {
                    "indentation": number,
                    "pass_i": log.pass_i[dwell_i],
                    "reading_i": sum(row["indentation"] == number for row in rows),
                    **{name: getattr(log, name)[dwell_i] for name in LABELS},
                    "b_uT": timed.frames.b_uT[frame_i],
                    "noload_uT": np.mean(noload[number], axis=0, dtype=np.float64),
                    "temperature_degC": timed.frames.temperature_degC[frame_i],
                    "t_s": timed.t_s[frame_i],
                    "n_contacts": 100 + len({int(n) for n in log.indentation[log.contact] if n < number}),
                }
            )
    return rows


FAULTS = st.dictionaries(st.integers(0, 60), st.sampled_from(["failed", "stuck", "field", "temperature"]), max_size=12)


@given(indentations=st.lists(DWELLS, min_size=1, max_size=6), frames_n=st.integers(0, 60), faults=FAULTS)
def test_readings_equal_those_of_a_double_loop(
    indentations: list[list[tuple[int, int]]], frames_n: int, faults: dict[int, str]
) -> None:
    log, timed = log_of(indentations), timed_of(frames_n, faults)
    actual, _ = join_blocks([timed], log)
    expected = join_naively(timed, log)
    assert len(actual["indentation"]) == len(expected)
    for row_i, row in enumerate(expected):
        for name, value in row.items():
            # The tolerance is for the mean, which is computed in double precision. All other values are copied.
            np.testing.assert_allclose(
                actual[name][row_i], value, rtol=1e-6 if name == "noload_uT" else 0, err_msg=name
            )


@given(
    indentations=st.lists(DWELLS, min_size=1, max_size=6),
    frames_n=st.integers(0, 60),
    faults=FAULTS,
    ends=st.lists(st.integers(0, 60), max_size=60),
)
def test_readings_do_not_depend_on_the_size_of_blocks(
    indentations: list[list[tuple[int, int]]], frames_n: int, faults: dict[int, str], ends: list[int]
) -> None:
    log, timed = log_of(indentations), timed_of(frames_n, faults)
    whole, whole_account = join_blocks([timed], log)
    parts, parts_account = join_blocks(cut(timed, ends), log)
    assert parts_account == whole_account
    for name, column in whole.items():
        np.testing.assert_array_equal(parts[name], column, err_msg=name)


@given(
    indentations=st.lists(DWELLS, min_size=1, max_size=6),
    frames_n=st.integers(0, 60),
    faults=FAULTS,
    untimed_n=st.integers(0, 5),
)
def test_every_frame_and_every_indentation_is_counted(
    indentations: list[list[tuple[int, int]]], frames_n: int, faults: dict[int, str], untimed_n: int
) -> None:
    log, timed = log_of(indentations), timed_of(frames_n, faults)
    timed.t_s[frames_n - min(untimed_n, frames_n) :] = np.nan
    rows, account = join_blocks([timed], log)
    frames = [key for key in account if key.startswith("frames_") or key.endswith("_frames_n")]
    assert account["frames_n"] == frames_n == sum(account[key] for key in frames if key != "frames_n")
    parts = [key for key in account if key.endswith("indentations_n") and key != "logged_indentations_n"]
    assert account["logged_indentations_n"] == len(indentations) == sum(account[key] for key in parts)
    assert account["frames_contact_n"] == len(rows["indentation"])
    assert account["indentations_n"] == len(set(rows["indentation"].tolist()))
    assert min(account.values()) >= 0


def test_dropped_frames_are_counted_by_reason() -> None:
    # Frames are at -2, -1, 0, ... s of probe time; the dwells of three indentations are at 0-2 and 3-4 s, at 5-6 and
    # 7-8 s, and at 9-9.5 s. The dwells of the fourth indentation are after the end of the stream.
    log = log_of([[(0, 4), (2, 2)], [(2, 2), (2, 2)], [(2, 1), (1, 1)], [(60, 2), (2, 2)]])
    timed = timed_of(13, {2: "failed", 3: "field", 7: "field", 8: "failed"})
    timed.t_s[12:] = np.nan
    rows, account = join_blocks([timed], log)
    assert account == {
        "frames_n": 13,
        "frames_noload_n": 1,  # This is the frame at 2 s.
        "frames_contact_n": 2,  # These are the frames at 3 and 4 s.
        "dropped_no_time_frames_n": 1,
        "dropped_not_finite_frames_n": 2,
        "dropped_failed_read_frames_n": 2,
        "dropped_stuck_chip_frames_n": 0,
        "dropped_between_dwells_frames_n": 2,  # These are the frames at -2 and -1 s.
        # The frames at 7 and 8 s are dropped, because the no-load dwell of their indentation has no valid frame.
        "dropped_no_noload_frames_n": 2,
        "dropped_no_contact_frames_n": 1,  # This is the frame at 9 s.
        "indentations_n": 1,
        "dropped_no_noload_indentations_n": 1,
        "logged_indentations_n": 4,
        "dropped_no_frame_indentations_n": 2,
    }
    assert rows["n_contacts"].tolist() == [100, 100]
    assert rows["reading_i"].tolist() == [0, 1]


def test_readings_of_an_indentation_are_returned_when_the_next_one_begins() -> None:
    log = log_of([[(2, 6), (2, 6)]] * 50)
    timed = timed_of(400)
    joiner = Joiner(log, CLOCK, HEADER)
    rows_n = [len(joiner.feed(block)) for block in cut(timed, list(range(400)))]
    assert max(rows_n) == 4  # A dwell of 3 s has four frames, because one frame is on each edge.
    assert len(joiner.close()) <= 4


def test_memory_does_not_grow_with_the_length_of_the_stream() -> None:
    block = timed_of(4000)

    def peak_bytes_n(blocks_n: int) -> int:
        log = log_of([[(2, 6), (2, 6)]] * (blocks_n * 500))
        joiner = Joiner(log, CLOCK, HEADER)
        tracemalloc.start()
        for block_i in range(blocks_n):
            joiner.feed(dataclasses.replace(block, t_s=block.t_s + block_i * 4000 / CLOCK.rate))
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return peak

    assert peak_bytes_n(30) < 1.1 * peak_bytes_n(3)  # The tolerance of 10 % is for counters and the memory allocator.
