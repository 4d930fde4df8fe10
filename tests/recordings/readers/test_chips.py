"""A chip is believed if it was read, and if it speaks the scale of its header or neighbours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin import seeds
from reskin.board import faults
from reskin.errors import CaptureError
from reskin.recordings.chips import GRID_ROWS_N, find_whole_rows
from tests.recordings.headers import AS_USUAL, make_header

HEADER = make_header()
CHIPS_N = 5


def noisy_fields_uT(rows_n: int) -> np.ndarray:
    """Fields as five chips at GAIN_SEL 7 send them: 5 uT of noise about 300 uT, on the grid of their LSB."""
    lsb_uT = np.tile([0.15, 0.15, 0.242], CHIPS_N)
    b_uT = 300 + 5 * seeds.rng_for(2021, "fields").standard_normal((rows_n, 3 * CHIPS_N))
    return np.round(b_uT / lsb_uT) * lsb_uT


@settings(max_examples=30, deadline=None)
@given(failed=st.sets(st.tuples(st.integers(0, 49), st.integers(0, CHIPS_N - 1))))
def test_a_row_is_whole_if_none_of_its_chips_failed(failed: set[tuple[int, int]]) -> None:
    b_uT, temperature_degC = noisy_fields_uT(50), np.full((50, CHIPS_N), 25.0)
    for row_i, chip_i in failed:
        b_uT[row_i, 3 * chip_i : 3 * chip_i + 3] = faults.FAILED_B_uT
        temperature_degC[row_i, chip_i] = faults.FAILED_TEMPERATURE_degC
    rows = {row_i for row_i, _ in failed}
    if len(rows) < 50:
        whole = find_whole_rows(b_uT, temperature_degC, HEADER, where="here", decisions=AS_USUAL).whole
        assert set(np.flatnonzero(~whole).tolist()) == rows


def test_a_row_with_zeros_in_place_of_a_chips_reading_is_not_whole():
    b_uT = noisy_fields_uT(50)
    b_uT[7, 3:6] = 0.0
    rows = find_whole_rows(b_uT, np.full((50, CHIPS_N), 25.0), HEADER, where="here", decisions=AS_USUAL)
    assert np.flatnonzero(~rows.whole).tolist() == [7]
    assert rows.losses()["dropped_failed_read_rows_n"] == 1


@pytest.mark.parametrize("chip_i", range(CHIPS_N))
def test_a_chip_without_the_others_grid_is_named(chip_i: int) -> None:
    b_uT = noisy_fields_uT(GRID_ROWS_N)
    spread = seeds.rng_for(2021, "spread").standard_normal((GRID_ROWS_N, 3))
    b_uT[:, 3 * chip_i : 3 * chip_i + 3] = 300 + 5 * spread
    with pytest.raises(CaptureError, match=f"chip {chip_i} must be"):
        find_whole_rows(b_uT, np.full((GRID_ROWS_N, CHIPS_N), np.nan), HEADER, where="here", decisions=AS_USUAL)


def test_fields_that_show_no_grid_at_all_are_believed() -> None:
    # As of a recorder that averages: there is nothing to compare.
    b_uT = 300 + 5 * seeds.rng_for(2021, "averaged").standard_normal((GRID_ROWS_N, 3 * CHIPS_N))
    unknown_degC = np.full((GRID_ROWS_N, CHIPS_N), np.nan)
    assert find_whole_rows(b_uT, unknown_degC, HEADER, where="here", decisions=AS_USUAL).whole.all()


def test_a_row_with_a_stuck_chip_is_told_from_one_that_failed() -> None:
    b_uT, temperature_degC = noisy_fields_uT(100), np.full((100, CHIPS_N), 25.0)
    b_uT[50:, 3:6] = b_uT[50, 3:6]
    b_uT[10, :3], temperature_degC[10, 0] = faults.FAILED_B_uT, faults.FAILED_TEMPERATURE_degC
    rows = find_whole_rows(b_uT, temperature_degC, HEADER, where="here", decisions=AS_USUAL)
    assert np.flatnonzero(rows.failed).tolist() == [10]
    assert np.flatnonzero(rows.stuck).tolist() == list(range(50 + faults.STUCK_FRAMES_MIN_N - 1, 100))
    assert rows.losses() == {
        "dropped_failed_read_rows_n": 1, "dropped_stuck_chip_rows_n": 31,
        "fault_failed_read_dropped_n": 1, "fault_failed_read_first_row": 11, "fault_failed_read_last_row": 11,
        "fault_stuck_dropped_n": 31, "fault_stuck_first_row": 70, "fault_stuck_last_row": 100,
    }  # fmt: skip
    np.testing.assert_array_equal(rows.whole, ~(rows.failed | rows.stuck))
