"""Tests of the times of frames. They are interpolated between the arrival times of chunks of bytes."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings import clocks
from reskin.recordings.clocks import Arrivals

GOOD = "byte_end,t_s\n0,10.0\n100,10.5\n300,10.5\n400,11.5\n"
STEPS = st.lists(st.tuples(st.integers(1, 10_000), st.floats(0, 10)), min_size=1, max_size=30)
Steps = list[tuple[int, float]]


def arrivals_of(steps: Steps, first: tuple[int, float]) -> Arrivals:
    rows = np.cumsum([first, *steps], axis=0)
    return Arrivals(rows[:, 0].astype(np.int64), rows[:, 1] + 1e-6 * np.arange(len(rows)))


def naive_time_s(end_byte: int, table: Arrivals) -> float:
    """Return reference times, which a loop over the chunks computes as documented for `times_of`."""
    rows = list(zip(table.byte_end.tolist(), table.t_s.tolist(), strict=True))
    if end_byte <= rows[0][0]:
        return rows[0][1] - (rows[0][0] - end_byte) * (rows[-1][1] - rows[0][1]) / (rows[-1][0] - rows[0][0])
    for (byte_0, t_0), (byte_1, t_1) in pairwise(rows):
        if byte_0 < end_byte <= byte_1:
            return t_0 + (t_1 - t_0) * (end_byte - byte_0) / (byte_1 - byte_0)
    return float("nan")


@given(steps=STEPS, first=st.tuples(st.integers(0, 500), st.floats(-1e3, 1e3)))
def test_frame_times_equal_a_loop_over_chunks(steps: Steps, first: tuple[int, float]) -> None:
    table = arrivals_of(steps, first)
    end_byte = np.linspace(1, table.byte_end[-1] + 50, 40).astype(np.int64)
    expected_s = [naive_time_s(int(byte), table) for byte in end_byte]
    # Tolerance: sums of up to 31 numbers between 1e3 and 1e4 in double precision.
    np.testing.assert_allclose(clocks.times_of(end_byte, table), expected_s, rtol=1e-12, atol=1e-9)


@given(steps=STEPS, first=st.tuples(st.integers(0, 500), st.floats(-1e3, 1e3)))
def test_times_never_decrease(steps: Steps, first: tuple[int, float]) -> None:
    table = arrivals_of(steps, first)
    end_byte = np.arange(table.byte_end[0], min(table.byte_end[-1], table.byte_end[0] + 3000), dtype=np.int64) + 1
    t_s = clocks.times_of(end_byte, table)
    chunk_i = np.searchsorted(table.byte_end, end_byte)
    assert (np.diff(t_s) >= 0).all()
    assert (t_s <= table.t_s[chunk_i] + 1e-9).all()
    assert (t_s >= table.t_s[chunk_i - 1] - 1e-9).all()


def test_frame_that_ends_after_the_last_chunk_has_no_time() -> None:
    t_s = clocks.times_of(np.array([82, 400, 401], np.int64), clocks.parse(GOOD, "arrivals.csv"))
    np.testing.assert_array_equal(t_s, [10 + 0.5 * 0.82, 11.5, np.nan])


@given(steps=STEPS, first=st.tuples(st.integers(0, 500), st.floats(-1e9, 1e9)))
def test_written_arrival_times_are_read_unchanged(steps: Steps, first: tuple[int, float]) -> None:
    table = arrivals_of(steps, first)
    again = clocks.parse(clocks.render(table), "arrivals.csv")
    np.testing.assert_array_equal(again.byte_end, table.byte_end)
    np.testing.assert_array_equal(again.t_s, table.t_s)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("t_s", "t_ms", "no column 't_s'; the file has byte_end, t_ms"),
        ("300", "99", "row 4: byte_end must be more than in the row above; got 99"),
        ("11.5", "9.5", "row 5: t_s must be no earlier than in the row above; got 9.5"),
        ("11.5", "", "row 5: t_s must be a finite time; got nan"),
        ("11.5", "inf", "t_s in line 5 must be a number .*; got 'inf'"),
        ("300,", ",", "row 4: byte_end must be known"),
        ("\n0,", "\n-5,", "row 2: byte_end must be 0 or more; got -5"),
        ("300", "three", "byte_end in line 4 must be a number .*; got 'three'"),
        ("100,10.5\n300,10.5\n400,11.5\n", "", "the file has 1 rows"),
        (GOOD, "", "the file is empty"),
        (GOOD, "byte_end,t_s\n1,2\n3,2\n", "t_s is 2.0 in every row"),
    ],
)
def test_error_names_the_line_of_an_invalid_arrival_time(old: str, new: str, message: str) -> None:
    with pytest.raises(CaptureError, match=rf"^arrivals\.csv.*{message}"):
        clocks.parse(GOOD.replace(old, new, 1), "arrivals.csv")


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="arrivals.csv: file not found"):
        clocks.parse(tmp_path / "arrivals.csv", "arrivals.csv")
