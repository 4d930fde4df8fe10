"""Logs made by hand: quiet starts, contacts and truth found again; refusals; naive loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import CaptureError
from pipeline.core.seeds import rng_for
from pipeline.experiments.logs.estimates import (
    contacts_n,
    describe,
    estimate,
    quiet_start,
    score_contacts,
    thin,
    truth_at,
)

RATE_HZ = 250.0
NOISE_uT = 3.0


def walk(quiet_s=2.0, steps_n=4, name="walk"):
    """A board of 15 channels at rest in a field; 0.3 s in contact, 0.2 s off, by turns; 200 uT a newton."""
    quiet_n, on_n, off_n = round(quiet_s * RATE_HZ), 75, 50
    force_N = np.zeros(quiet_n + steps_n * (on_n + off_n))
    for step_i in range(steps_n):
        start = quiet_n + step_i * (on_n + off_n)
        force_N[start : start + on_n] = 1.0 + step_i
    noise_uT = NOISE_uT * rng_for(0, name).standard_normal((len(force_N), 15))
    b_uT = (1000.0 + 200 * force_N[:, None] + noise_uT).astype(np.float32)
    return (1 + np.arange(len(force_N))) / RATE_HZ, b_uT, force_N


def answers(db_uT):
    force_N = db_uT.mean(axis=1) / 200
    return np.stack([np.full(len(db_uT), 8.0), np.full(len(db_uT), 4.0), force_N], axis=1).astype(np.float32)


def truth(force_N):
    rows = np.stack([np.full(len(force_N), 8.0), np.full(len(force_N), 4.0), force_N], axis=1)
    return np.where(force_N[:, None] > 0, rows, np.nan)


@pytest.mark.parametrize("quiet_s", [0.8, 2.0, 5.0])
def test_the_quiet_start_lasts_until_the_window_of_the_first_step(quiet_s):
    t_s, b_uT, _ = walk(quiet_s)
    found_s = quiet_start(t_s, b_uT, where="log") / RATE_HZ
    assert quiet_s - 0.1 <= found_s <= quiet_s


def test_a_log_without_a_quiet_start_is_refused():
    t_s, b_uT, _ = walk(0.2)
    with pytest.raises(CaptureError, match=r"log: the start without contact must be 0\.5 s or more"):
        quiet_start(t_s, b_uT, where="log")
    with pytest.raises(CaptureError, match=r"the start without contact must be .* got 0 s"):
        quiet_start(t_s[:40], b_uT[:40], where="log")


def test_a_log_that_is_quiet_throughout_has_no_contact():
    t_s, b_uT, _ = walk(5.0, steps_n=0)
    found = estimate(t_s, b_uT, [answers], where="log")
    assert found.quiet_n >= 0.9 * len(t_s)
    numbers = describe(found)
    assert numbers["contacts_n"] == 0
    assert "force_max_N" not in numbers


def test_steps_forces_and_noise_are_found_again():
    t_s, b_uT, force_N = walk()
    found = estimate(t_s, b_uT, [answers], where="log")
    np.testing.assert_array_equal(found.contact, force_N > 0)
    numbers = describe(found)
    assert numbers["contacts_n"] == 4
    assert numbers["rate_hz"] == pytest.approx(RATE_HZ)
    assert numbers["duration_s"] == pytest.approx(len(t_s) / RATE_HZ)
    assert numbers["noise_uT"] == pytest.approx(NOISE_uT, rel=0.05)
    assert numbers["force_max_N"] == pytest.approx(4.0, abs=5 * NOISE_uT / np.sqrt(15) / 200)
    scores = score_contacts(found, truth(force_N))
    assert scores["contacts_true_n"] == 4
    assert scores["missed_readings_n"] == scores["false_readings_n"] == 0
    assert scores["accuracy_pct"] == 100.0
    # noise of the mean of 15 channels, in N, squared; the no-load reading adds 1 / 500 of it
    assert scores["mse_f_N2"] == pytest.approx((NOISE_uT / 200) ** 2 / 15, rel=0.3)


def test_networks_are_averaged():
    t_s, b_uT, _ = walk()
    one = estimate(t_s, b_uT, [answers], where="log").answer
    both = estimate(t_s, b_uT, [answers, lambda db_uT: answers(db_uT) + np.float32(1)], where="log").answer
    np.testing.assert_allclose(both, one + 0.5, atol=1e-5)  # float32


@given(st.lists(st.booleans(), max_size=40))
def test_contacts_are_runs_of_two_or_more_and_a_single_gap_parts_nothing(contact):
    closed = [now or (0 < i < len(contact) - 1 and contact[i - 1] and contact[i + 1]) for i, now in enumerate(contact)]
    words = "".join("x" if now else " " for now in closed).split()
    assert contacts_n(np.array(contact, bool)) == sum(len(word) > 1 for word in words)


def test_truth_is_that_of_the_dwell_a_reading_lies_in():
    true = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    found = truth_at(np.array([0.0, 1.5, 2.5, 3.5, 9.0]), np.array([1.0, 3.0]), np.array([2.0, 4.0]), true)
    np.testing.assert_array_equal(found, [[np.nan] * 3, true[0], [np.nan] * 3, true[1], [np.nan] * 3])


def test_a_drawn_series_is_thin_and_says_nothing_off_contact():
    t_s, b_uT, force_N = walk(steps_n=40)
    drawn = thin(estimate(t_s, b_uT, [answers], where="log"), truth(force_N))
    assert len(drawn["t_s"]) <= 1500
    assert drawn["t_s"][0] == pytest.approx(0.004)
    for which in ("estimated", "true"):
        assert drawn[which]["F_N"][0] is None
        assert None in drawn[which]["x_mm"]
        assert 8.0 in drawn[which]["x_mm"]
