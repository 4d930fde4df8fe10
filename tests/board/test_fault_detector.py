"""Tests of the detection of faulty chips in a stream that arrives in chunks."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin import seeds
from reskin.board import faults
from reskin.board.chips import RESET_LSB_XY_uT, RESET_LSB_Z_uT
from reskin.board.faults import SCALE_FRAMES_N, FaultDetector
from reskin.board.wire import Frames
from reskin.errors import CaptureError
from reskin.recordings.fault_policy import FaultLog
from tests.board.signals import frames_of
from tests.recordings.headers import DEFAULT_POLICY

CHIPS_N = 3
RESET_uT = (RESET_LSB_XY_uT, RESET_LSB_XY_uT, RESET_LSB_Z_uT)


def board(frames_n: int, *, steps_uT: tuple[float, float, float] = (0.15, 0.15, 0.242), seed: int = 0) -> Frames:
    """Return frames of a constant field with 5 uT of noise, rounded to multiples of the steps `steps_uT`."""
    rng = seeds.rng_for(seed, "watch")
    rest_uT = seeds.rng_for(0, "rest").uniform(-1500, 1500, 3 * CHIPS_N)
    b_uT = rest_uT + 5 * rng.standard_normal((frames_n, 3 * CHIPS_N))
    grid_uT = np.tile(steps_uT, CHIPS_N)
    return frames_of(np.round(b_uT / grid_uT) * grid_uT, np.full((frames_n, CHIPS_N), 25.0))


def with_chip_values(frames: Frames, rows: slice, chip_i: int, values_uT: np.ndarray) -> Frames:
    b_uT = frames.b_uT.copy()
    b_uT[rows, 3 * chip_i : 3 * chip_i + 3] = values_uT
    return dataclasses.replace(frames, b_uT=b_uT)


def detect(frames: Frames, *ends: int, expected_lsb_uT: tuple[float, float] | None = None) -> np.ndarray:
    """Feed the frames in chunks that end at `ends`. Return the mask of frames in which a chip is stuck."""
    detector = FaultDetector(CHIPS_N, expected_lsb_uT=expected_lsb_uT)
    log = FaultLog(DEFAULT_POLICY, "stream.bin", "ms")
    masks = []
    for begin, end in pairwise([0, *sorted(ends), len(frames)]):
        rows = (np.arange(len(frames)) >= begin) & (np.arange(len(frames)) < end)
        t_s = np.flatnonzero(rows) / 400
        masks.append(log.apply(detector.feed(frames.where(rows), t_s), t_s).stuck)
    return np.concatenate(masks)


def test_no_fault_is_detected_on_a_working_board() -> None:
    assert not detect(board(2000)).any()
    assert not detect(board(2000), expected_lsb_uT=(0.15, 0.242)).any()


@pytest.mark.parametrize("chips", [(1,), (0, 1, 2)])
@pytest.mark.parametrize("expected_lsb_uT", [None, (0.15, 0.242)])
def test_chip_at_power_on_settings_raises_an_error(
    chips: tuple[int, ...], expected_lsb_uT: tuple[float, float] | None
) -> None:
    frames, reset = board(2000), board(2000, steps_uT=RESET_uT)
    for chip_i in chips:
        columns = slice(3 * chip_i, 3 * chip_i + 3)
        frames = with_chip_values(frames, slice(1200, None), chip_i, reset.b_uT[1200:, columns])
    message = rf"stream.bin from frame 1201 on .*: the LSB of chip {', '.join(map(str, chips))} must .* got 0.98 uT"
    with pytest.raises(CaptureError, match=message):
        detect(frames, 500, 1300, expected_lsb_uT=expected_lsb_uT)


def test_change_of_the_step_of_all_chips_raises_an_error() -> None:
    frames, other = board(1600), board(1600, steps_uT=(0.6, 0.6, 0.968))
    for chip_i in range(CHIPS_N):
        frames = with_chip_values(frames, slice(800, None), chip_i, other.b_uT[800:, 3 * chip_i : 3 * chip_i + 3])
    with pytest.raises(CaptureError, match="from frame 801 on .*: the LSB of chip 0, 1, 2 must be the same as before"):
        detect(frames)


def test_chip_that_repeats_its_reading_counts_as_stuck() -> None:
    frames = board(1500)
    frozen = with_chip_values(frames, slice(500, None), 1, frames.b_uT[500, 3:6])
    stuck = detect(frozen)
    # A chip counts as stuck from its 20th equal reading on.
    assert np.flatnonzero(stuck).tolist() == list(range(500 + faults.STUCK_FRAMES_MIN_N - 1, 1500))


@settings(max_examples=20, deadline=None)
@given(ends=st.lists(st.integers(0, 3 * SCALE_FRAMES_N), max_size=6))
def test_detected_faults_do_not_depend_on_the_chunks_that_are_fed(ends: list[int]) -> None:
    frames = board(3 * SCALE_FRAMES_N)
    frozen = with_chip_values(frames, slice(100, 300), 1, frames.b_uT[100, 3:6])
    np.testing.assert_array_equal(detect(frozen, *ends), detect(frozen))


def test_chip_with_failed_reads_does_not_count_as_stuck() -> None:
    failed = with_chip_values(board(100), slice(10, 60), 0, np.array(faults.FAILED_B_uT))
    failed.temperature_degC[10:60, 0] = faults.FAILED_TEMPERATURE_degC
    assert not detect(failed).any()
