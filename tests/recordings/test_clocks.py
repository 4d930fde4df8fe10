"""Tests of synchronising the clock of the stream of readings with the clock of the probe (the robot that presses).

Clocks are synchronised by marks (pairs of times) or by the contacts themselves.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.errors import CaptureError
from reskin.recordings.clocks import Block, ClockMap, from_contacts, from_marks
from reskin.recordings.probe import LABELS, ProbeLog
from reskin.seeds import rng_for

FRAME_S = 1 / 400
NOISE_UT = 4.0  # This is the typical noise of real boards.
DRIFT_UT_PER_S = 10 / 60  # The no-load field of a board that warms up drifts at this rate.
UNIX_S = 1.7e9
JITTER_S = (0.2, 0.5)


def log_of(indentations_n: int, dwell_s: float, travel_s: tuple[float, float] = JITTER_S) -> ProbeLog:
    """Return a probe log with random travel times between dwells (stops of the tip).

    If the least and the greatest travel time are equal, the log is periodic.
    """
    gap_s = rng_for(0, "travel").uniform(*travel_s, 2 * indentations_n)
    start_s = np.cumsum(gap_s + dwell_s)
    d = np.arange(2 * indentations_n, dtype=np.int32)
    labels = dict.fromkeys(LABELS, np.full(len(d), np.nan, np.float32))
    return ProbeLog(d // 2, 0 * d, d % 2 == 1, start_s, start_s + dwell_s, **labels)


def clock_map(offset_s: float, rate: float = 1.0) -> ClockMap:
    return ClockMap(offset_s, rate, 0.0, 1.0)


def stream_of(log: ProbeLog, truth: ClockMap, margin_s: float = 1.0, faint: float = 0.0) -> Block:
    """Return times and fields (15 channels) of a skin that is touched at the contacts of the log.

    The no-load field drifts. A touch lasts from 60 ms before each contact dwell until 60 ms after it. A fraction
    `faint` of the contacts does not change the field.
    """
    rng = rng_for(1, "stream")
    probe_s = np.arange(log.t_start_s[0] - margin_s, log.t_end_s[-1] + margin_s, FRAME_S * truth.rate)
    start_s, end_s = log.t_start_s[log.contact], log.t_end_s[log.contact]
    corners_s = np.stack([start_s - 0.06, start_s, end_s, end_s + 0.06], axis=1)
    pressed = np.interp(probe_s, corners_s.ravel(), np.tile([0.0, 1, 1, 0], len(start_s)))
    nearest_i = np.searchsorted((end_s[:-1] + start_s[1:]) / 2, probe_s)
    contact_uT = rng.normal(0, 1, (len(start_s), 15)) * rng.uniform(20, 300, (len(start_s), 1))
    contact_uT[rng.uniform(0, 1, len(start_s)) < faint] = 0
    drift_uT = DRIFT_UT_PER_S * (probe_s - probe_s[0])[:, None]
    noload_uT = 1000 + drift_uT + rng.normal(0, NOISE_UT, (len(probe_s), 15))
    b_uT = noload_uT + pressed[:, None] * contact_uT[nearest_i]
    return (probe_s - truth.offset_s) / truth.rate, b_uT.astype(np.float32)


def worst_s(found: ClockMap, truth: ClockMap, stream_s: np.ndarray) -> float:
    return float(np.abs(found.probe_s(stream_s) - truth.probe_s(stream_s)).max())


@given(
    offset_s=st.floats(-1e6, 1e6),
    drift_ppm=st.floats(-100, 100),
    begin_s=st.sampled_from([0.0, UNIX_S]),
    marks_n=st.integers(2, 6),
)
def test_exact_marks_recover_offset_and_rate_of_the_clock(
    offset_s: float, drift_ppm: float, begin_s: float, marks_n: int
) -> None:
    stream_s = begin_s + np.linspace(3, 3600, marks_n)
    # Tolerance: at Unix times, double precision has a resolution of 2e-7 s. The map between the clocks is evaluated
    # between its marks.
    truth = clock_map(offset_s, 1 + drift_ppm * 1e-6)
    found = from_marks(np.stack([stream_s, truth.probe_s(stream_s)], axis=1), "header.json")
    assert worst_s(found, truth, stream_s) < 3e-6
    assert found.residual_s < 3e-6


def test_single_mark_determines_the_offset_at_equal_rates() -> None:
    found = from_marks(np.array([[10.0, 110.5]]), "header.json")
    assert (found.offset_s, found.rate, found.residual_s) == (100.5, 1.0, 0.0)


def test_noisy_marks_give_the_least_squares_line() -> None:
    stream_s = np.linspace(0, 600, 12)
    probe_s = 5 + (1 + 50e-6) * stream_s + rng_for(0, "marks").normal(0, 2e-3, 12)
    found = from_marks(np.stack([stream_s, probe_s], axis=1), "header.json")
    # The reference is another solver of least squares, which has other parameters.
    slope, offset_s = np.polyfit(stream_s, probe_s, 1)
    assert found.rate == pytest.approx(slope, abs=1e-12)
    assert found.offset_s == pytest.approx(offset_s, abs=1e-9)
    assert found.residual_s == pytest.approx(np.abs(probe_s - offset_s - slope * stream_s).max(), abs=1e-9)


def test_marks_with_errors_of_1_ms_suffice_for_ten_minutes_of_clock_drift() -> None:
    truth = clock_map(-37.25, 1 + 50e-6)
    stream_s = np.array([2.0, 300.0, 598.0])
    probe_s = truth.probe_s(stream_s) + np.array([1e-3, -1e-3, 1e-3])
    found = from_marks(np.stack([stream_s, probe_s], axis=1), "header.json")
    assert worst_s(found, truth, np.linspace(0, 600, 100)) < FRAME_S


@pytest.mark.parametrize(
    ("marks", "message"),
    [
        (np.array([[1.0, 2.0], [1.0, 3.0]]), "two marks in clock.marks have the same stream time"),
        (np.array([[1.0, 2.0], [2.0, 1002.0]]), "by a factor of 1000, but this factor must be between 0.9 and 1.1"),
    ],
)
def test_invalid_marks_are_refused(marks: np.ndarray, message: str) -> None:
    with pytest.raises(CaptureError, match=f"^header.json: .*{message}"):
        from_marks(marks, "header.json")


@pytest.mark.parametrize("offset_s", [0.0, 12.345, -250.06, UNIX_S])
@pytest.mark.parametrize("dwell_s", [0.1, 0.4])
def test_offset_of_the_clocks_is_found_from_contacts(offset_s: float, dwell_s: float) -> None:
    log, truth = log_of(100, dwell_s), clock_map(offset_s)
    t_s, b_uT = stream_of(log, truth)
    found = from_contacts([(t_s, b_uT)], log, "c")
    assert worst_s(found, truth, t_s) < dwell_s / 4
    # The estimated offset has no bias, because a touch begins as long before its dwell as it ends after it.
    assert worst_s(found, truth, t_s) < FRAME_S
    assert found.explained > 0.8


def test_rate_of_a_drifting_clock_is_found_from_contacts() -> None:
    log, truth = log_of(2000, 0.1), clock_map(8.0, 1 + 200e-6)
    t_s, b_uT = stream_of(log, truth)
    blocks = [(t_s[i : i + 20_000], b_uT[i : i + 20_000]) for i in range(0, len(t_s), 20_000)]
    found = from_contacts(blocks, log, "c")
    # If the rate of the clock were not estimated, times at the end would be wrong by more than the length of a dwell.
    assert 200e-6 * np.ptp(t_s) > 0.1
    assert worst_s(found, truth, t_s) < 0.1 / 4


def test_offset_is_found_from_contacts_that_are_longer_than_the_pauses() -> None:
    log, truth = log_of(60, 0.5, (0.13, 0.4)), clock_map(3.0)
    t_s, b_uT = stream_of(log, truth)
    assert worst_s(from_contacts([(t_s, b_uT)], log, "c"), truth, t_s) < 0.5 / 4


def test_offset_is_found_from_a_part_of_the_stream_if_travel_times_are_irregular() -> None:
    log, truth = log_of(100, 0.2), clock_map(3.0)
    t_s, b_uT = stream_of(log, truth)
    part = slice(np.searchsorted(truth.probe_s(t_s), log.t_start_s[60]), None)
    found = from_contacts([(t_s[part], b_uT[part])], log, "c")
    assert worst_s(found, truth, t_s[part]) < 0.2 / 4


@pytest.mark.parametrize("part", [slice(None), slice(5000, 15000)], ids=["whole", "piece"])
def test_stream_of_a_periodic_protocol_is_refused_because_several_offsets_fit(part: slice) -> None:
    log = log_of(40, 0.25, (0.25, 0.25))
    t_s, b_uT = stream_of(log, clock_map(7.0), margin_s=3.0)
    with pytest.raises(CaptureError, match="two offsets .* almost equally well.* Add sync marks: .*--mark"):
        from_contacts([(t_s[part], b_uT[part])], log, "c")


@given(
    faint=st.floats(0, 0.6),
    travel_s=st.sampled_from([(0.25, 0.25), (0.2, 0.3), JITTER_S]),
    margin_s=st.floats(0, 2),
    lost=st.floats(0, 0.3),
    indentations_n=st.integers(15, 60),
)
def test_offset_from_incomplete_data_is_either_correct_or_an_error_is_raised(
    faint: float, travel_s: tuple[float, float], margin_s: float, lost: float, indentations_n: int
) -> None:
    log, truth = log_of(indentations_n, 0.25, travel_s), clock_map(7.0)
    t_s, b_uT = stream_of(log, truth, margin_s, faint)
    # The remaining part of the stream still begins while the robot is lifted.
    begin_i = np.searchsorted(truth.probe_s(t_s), log.t_start_s[2 * int(lost * indentations_n)])
    try:
        found = from_contacts([(t_s[begin_i:], b_uT[begin_i:])], log, "c")
    except CaptureError:
        return
    assert worst_s(found, truth, t_s) < 0.25 / 4


def test_stream_in_which_contacts_are_not_visible_is_refused() -> None:
    log = log_of(50, 0.2)
    t_s, b_uT = stream_of(log, clock_map(0.0))
    still_uT = rng_for(3, "still").normal(1000, NOISE_UT, b_uT.shape).astype(np.float32)
    with pytest.raises(CaptureError, match="Add sync marks"):
        from_contacts([(t_s, still_uT)], log, "c")


def test_stream_of_another_log_is_refused() -> None:
    t_s, b_uT = stream_of(log_of(50, 0.2), clock_map(0.0))
    with pytest.raises(CaptureError, match="Add sync marks"):
        from_contacts([(t_s, b_uT)], log_of(50, 0.2, (0.1, 0.9)), "c")


def test_empty_log_and_empty_stream_are_refused() -> None:
    log = log_of(2, 0.2)
    with pytest.raises(CaptureError, match="no frames"):
        from_contacts([], log, "c")
    lifted = ProbeLog(**{name: getattr(log, name)[:1] for name in ProbeLog.__dataclass_fields__})
    with pytest.raises(CaptureError, match="no contacts"):
        from_contacts([stream_of(log, clock_map(0.0))], lifted, "c")


def test_failed_reads_do_not_change_the_offset() -> None:
    log, truth = log_of(60, 0.2), clock_map(1.5)
    t_s, b_uT = stream_of(log, truth)
    b_uT[::50] = np.nan
    t_s[-5:] = np.nan
    assert worst_s(from_contacts([(t_s, b_uT)], log, "c"), truth, t_s[:-5]) < 0.2 / 4
