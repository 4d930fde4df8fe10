"""Tests that messages to the live page have a limited size and contain the peaks of the force."""

import numpy as np

from reskin.live.session import BIN_S, BINS_N, HEAD, NUMBERS_N, Traces
from reskin.live.tracker import Estimates, layout_of


def readings(t_s, force_N):
    db_uT = np.zeros((len(t_s), 15), np.float32)
    target = np.column_stack([np.full((len(t_s), 2), 8.0), force_N])
    return Estimates(t_s, db_uT, db_uT, target, np.full((len(t_s), 2), np.nan), np.full(len(t_s), np.nan), force_N > 0)


def forces(data):
    """Return the start, the minimum force and the maximum force of each time bin in a message."""
    _, chips_n, bins_n, t_s = HEAD.unpack_from(data)
    rest = np.frombuffer(data, "<f4", offset=HEAD.size)[NUMBERS_N + 3 * chips_n :]
    start_s, traces = t_s + rest[:bins_n].astype(float), rest[bins_n:].reshape(2, bins_n, 1 + chips_n)
    return start_s, traces[0, :, 0], traces[1, :, 0]


def test_time_bins_contain_force_peaks_and_cover_the_last_ten_seconds():
    traces, peak_s = Traces(layout_of(5), 0.0), 115.0
    for first in range(0, 48_000, 40):  # The loop adds two minutes of readings at 400 Hz.
        t_s = (first + np.arange(40)) / 400
        traces.add(readings(t_s, np.where(np.abs(t_s - peak_s) < 1e-3, 3.0, 0.1)), t_s[-1] + 0.001)
    start_s, low_N, high_N = forces(traces.message(0, rate_hz=400.0, lost_bytes_n=0))
    assert len(start_s) <= BINS_N
    np.testing.assert_allclose(start_s[-1], 120, atol=2 * BIN_S)
    peak = np.abs(start_s - peak_s) < 1.5 * BIN_S
    assert high_N[peak].max() == 3.0
    assert set(high_N[~peak]) == set(low_N) == {np.float32(0.1)}
    assert len(traces.message(traces.newest_bin, rate_hz=400.0, lost_bytes_n=0)) < 300


def test_messages_omit_empty_time_bins_and_bins_that_were_sent_before():
    traces = Traces(layout_of(5), 0.0)
    for t_s in (np.arange(0, 1, 0.01), np.arange(5, 6, 0.01)):
        traces.add(readings(t_s, np.ones(len(t_s))), t_s[-1])
    start_s, _, _ = forces(traces.message(0, rate_hz=100.0, lost_bytes_n=0))
    assert not np.any((start_s > 1.0) & (start_s < 4.9))
    later_s, _, _ = forces(traces.message(275, rate_hz=100.0, lost_bytes_n=0))
    np.testing.assert_allclose(later_s, start_s[start_s >= 5.5 - 1e-6], atol=1e-5)


def test_times_of_time_bins_are_still_precise_after_two_weeks():
    traces, t_s = Traces(layout_of(5), 0.0), 14 * 86_400 + np.arange(0, 2, 0.005)
    traces.add(readings(t_s, np.ones(len(t_s))), t_s[-1])
    start_s, _, _ = forces(traces.message(0, rate_hz=200.0, lost_bytes_n=0))
    np.testing.assert_allclose(np.diff(start_s), BIN_S, atol=1e-5)


def test_latency_is_measured_when_the_page_confirms_a_message():
    traces = Traces(layout_of(5), 0.0)
    traces.add(readings(np.array([1.0]), np.ones(1)), 1.002)
    number = HEAD.unpack_from(traces.message(0, rate_hz=1.0, lost_bytes_n=0))[0]
    # No latency is measured for a message that is confirmed a second time, or for a number that no message had.
    for seen in (number, number + 1, -1):
        traces.confirm(seen, 1.03)
    np.testing.assert_allclose(traces.to_screen_s, [0.03])
    np.testing.assert_allclose(traces.to_estimate_s, [0.002])
