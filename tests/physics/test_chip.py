"""Tests of the simulated chip against its data sheet: gain, range, noise, temperature, conversion times."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.extremes import chips
from reskin.physics.board import Board
from reskin.physics.chip import (
    CONVERSION_S,
    DIG_FILT_MAX,
    OSR_MAX,
    ChipDesign,
    Overruns,
    conversion_s,
    last_conversions,
    read_field,
    read_temperature,
    sample_at_conversion,
    steps_uT,
)
from reskin.seeds import rng_for
from tests.laws import LIMITS

QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
QUIET = chips.quiet(7)
LOUD = ChipDesign(gain_sel=7, noise_xy_uT=3.3, noise_z_uT=5.0, noise_temperature_degC=0.1)


def board(*, turn=None, gain=1.0, offset_T=0.0):
    turn = np.eye(3) if turn is None else turn
    return Board("b0", np.zeros((1, 3)), turn[None], gain * np.eye(3)[None], np.full((1, 3), offset_T))


def read(b_T, of=None, design=QUIET):
    b_T = np.asarray(b_T, dtype=float).reshape(-1, 1, 3)
    return read_field(b_T, of or board(), design=design, rng=rng_for(0, "sensor"))


@given(st.integers(0, 7), st.integers(0, 10**6))
def test_step_and_range_of_readings_follow_the_data_sheet(gain_sel, seed):
    sheet_uT = np.array(chips.SHEET_uT) * chips.SHEET_GAINS[gain_sel]
    np.testing.assert_allclose(steps_uT(gain_sel), sheet_uT, rtol=LIMITS["steps"])
    share = rng_for(seed, "sensor").uniform(-0.99, 0.99, (200, 3))
    assert chips.conversion((share * 2**15 * sheet_uT).clip(-49e3, 49e3), gain_sel) <= LIMITS["range"]


@pytest.mark.parametrize(
    ("b_uT", "wrapped_n", "clipped_n"),
    [
        ([5000.0, -4000.0, -8000.0], 2, 0), ([4900.0, 0.0, 7900.0], 0, 0), ([0.0, 49_990.0, 0.0], 1, 0),
        ([0.0, 50_010.0, 0.0], 1, 1), ([0.0, -60e3, 0.0], 1, 1),
    ],
)  # fmt: skip
def test_readings_out_of_range_wrap_around_or_are_clipped(b_uT, wrapped_n, clipped_n):
    """A reading above the range of the chip's counter wraps around.

    In a field far above this range, the sensor itself saturates, and readings are clipped.
    """
    _, overruns = chips.read_bare(np.array([b_uT]), chips.quiet(7), rng_for(0, "chip"))
    assert overruns == Overruns(clipped_n=clipped_n, wrapped_n=wrapped_n)
    assert chips.conversion(np.array([b_uT]), 7) <= LIMITS["range"]


def test_rotated_chip_reads_the_field_along_its_own_axes():
    b_uT, _ = read([0, 300e-6, 0], board(turn=QUARTER))
    np.testing.assert_allclose(b_uT, [[300, 0, 0]], atol=0.08)  # The tolerance is half a step of a reading.


def test_gain_and_offset_are_applied_along_the_axes_of_the_chip():
    b_uT, _ = read([100e-6, 0, 0], board(gain=2.0, offset_T=30e-6))
    np.testing.assert_allclose(b_uT, [[230, 30, 30]], atol=0.13)  # The tolerance is half a step of a z reading.


def test_chip_saturates_by_the_field_without_its_offset():
    _, overruns = read([0, 0, 49.9e-3], board(offset_T=200e-6))
    assert overruns.clipped_n == 0
    assert read([0, 0, 49.9e-3], board(gain=1.1))[1].clipped_n == 1


def test_readings_have_the_given_noise_and_temperature_resolution():
    assert chips.noise(LOUD, 0) <= LIMITS["noise"]
    assert chips.temperature(0) <= LIMITS["temperature"]
    b_uT, _ = read(np.zeros((40_000, 3)), design=LOUD)
    # The tolerance is four standard errors of the mean, 5 uT / sqrt(n) each.
    np.testing.assert_allclose(b_uT.mean(axis=0), 0, atol=0.1)
    read_degC = read_temperature(np.full((10_000, 5), 25.0), LOUD, rng_for(2, "sensor"))
    assert read_degC.std() == pytest.approx(0.1, rel=0.05)
    assert read_degC.mean() == pytest.approx(25, abs=0.01)


rates_hz = st.floats(50, 5000)
phases_s = st.floats(0, CONVERSION_S)


@given(rates_hz, phases_s)
def test_frame_contains_the_last_conversion_that_ended_before_the_frame(rate_hz, phase_s):
    frame_s = (1 + np.arange(40)) / rate_hz
    age_s, _ = last_conversions(frame_s, np.array([phase_s]))
    ends_s = phase_s + CONVERSION_S * np.arange(-1, int(frame_s[-1] / CONVERSION_S) + 2)
    truth_s = [t - max(end for end in ends_s if end <= t + 1e-12) for t in frame_s]
    # If a conversion ends at the very time of the frame, it may be in this frame or in the next one.
    off_s = np.abs(age_s[:, 0] - truth_s)
    assert (np.minimum(off_s, CONVERSION_S - off_s) < 1e-9).all()


def test_share_of_repeated_conversions_grows_with_the_frame_rate():
    """If frames are read faster than the chip converts, some frames repeat the last conversion."""
    # A conversion lasts 1.84 ms, so at 1 kHz the share of repeated conversions is 1 - 1 / (1.84 ms x 1 kHz) = 0.457.
    for rate_hz, least, most in ((400, 0, 0), (1000, 0.44, 0.48)):
        _, source_i = last_conversions((1 + np.arange(2000)) / rate_hz, np.zeros(1))
        repeated = np.mean(source_i[:, 0] != np.arange(2000))
        assert least <= repeated <= most


@given(rates_hz)
def test_reading_is_the_field_at_the_end_of_its_conversion(rate_hz):
    frame_s = (1 + np.arange(30)) / rate_hz
    age_s, _ = last_conversions(frame_s, np.array([0.3e-3]))
    value = np.repeat(frame_s[:, None, None], 3, axis=2)
    seen = sample_at_conversion(value, age_s, rate_hz)
    # For conversions before the first frame, the field of the first frame is used, because no earlier field is known.
    late = frame_s - age_s[:, 0] >= frame_s[0]
    np.testing.assert_allclose(seen[late, 0, 0], (frame_s - age_s[:, 0])[late], atol=1e-9)


def test_conversion_time_follows_table_18_of_the_data_sheet():
    table_ms = [[1.27, 1.84, 3.00, 5.30], [1.46, 2.23, 3.76, 6.84], [1.84, 3.00, 5.30, 9.91], [2.61, 4.53, 8.37, 16.05]]
    computed_ms = [[1e3 * conversion_s(osr, dig_filt) for osr in range(OSR_MAX + 1)] for dig_filt in range(4)]
    np.testing.assert_allclose(computed_ms, table_ms, atol=0.005)  # The table gives times with two decimals.
    assert conversion_s(0, 2) == pytest.approx(CONVERSION_S, abs=5e-6)
    assert conversion_s(OSR_MAX, DIG_FILT_MAX) == pytest.approx(0.200, rel=0.01)
