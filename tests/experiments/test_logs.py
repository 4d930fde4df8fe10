"""Tests of estimates from logs, which are long recordings without labels."""

import numpy as np
import pytest
from scipy.stats import norm

from pipeline.experiments.logs import (
    describe,
    estimate,
    score_contacts,
    thin,
    truth_at,
)
from reskin.errors import CaptureError
from reskin.logs import FALSE_SHARE, QUIET_MIN_S, START_WINDOWS_N, WINDOW_S, quiet_start
from reskin.seeds import rng_for

RATE_HZ = 250.0
NOISE_uT = 3.0


def make_log(quiet_s=2.0, steps_n=4, name="walk"):
    """Return the times, fields and forces of a simulated log.

    The log begins without contact. Then follow steps of 0.3 s in contact and 0.2 s without contact. The field changes
    by 200 uT per newton.
    """
    quiet_n, on_n, off_n = round(quiet_s * RATE_HZ), 75, 50
    force_N = np.zeros(quiet_n + steps_n * (on_n + off_n))
    for step_i in range(steps_n):
        start = quiet_n + step_i * (on_n + off_n)
        force_N[start : start + on_n] = 1.0 + step_i
    noise_uT = NOISE_uT * rng_for(0, name).standard_normal((len(force_N), 15))
    b_uT = (1000.0 + 200 * force_N[:, None] + noise_uT).astype(np.float32)
    return (1 + np.arange(len(force_N))) / RATE_HZ, b_uT, force_N


def predict(db_uT):
    force_N = db_uT.mean(axis=1) / 200
    return np.stack([np.full(len(db_uT), 8.0), np.full(len(db_uT), 4.0), force_N], axis=1).astype(np.float32)


def estimate_log(t_s, b_uT, networks):
    return estimate(quiet_start(t_s, b_uT, where="log"), t_s, b_uT, networks)


def truth(force_N):
    rows = np.stack([np.full(len(force_N), 8.0), np.full(len(force_N), 4.0), force_N], axis=1)
    return np.where(force_N[:, None] > 0, rows, np.nan)


@pytest.mark.parametrize("quiet_s", [0.8, 2.0, 5.0])
def test_start_without_contact_ends_before_the_first_step(quiet_s):
    t_s, b_uT, _ = make_log(quiet_s)
    found_s = quiet_start(t_s, b_uT, where="log") / RATE_HZ
    assert quiet_s - 0.1 <= found_s <= quiet_s


def test_log_that_begins_with_a_contact_is_refused():
    t_s, b_uT, _ = make_log(0.2)
    with pytest.raises(CaptureError, match=r"log: the start without contact lasts .* less than 0\.5 s"):
        quiet_start(t_s, b_uT, where="log")
    with pytest.raises(
        CaptureError, match=r"log: the log has 40 readings \(0\.16 s\), but it must begin with at least 0\.5 s"
    ):
        quiet_start(t_s[:40], b_uT[:40], where="log")


def test_number_of_contacts_forces_and_noise_are_recovered():
    t_s, b_uT, force_N = make_log()
    found = estimate_log(t_s, b_uT, [predict])
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
    # The expected squared error in N^2 is the variance of the mean of 15 noisy channels. The no-load reading is a mean
    # of many readings, so its noise adds only 1 / 500 of this variance.
    assert scores["mse_f_N2"] == pytest.approx((NOISE_uT / 200) ** 2 / 15, rel=0.3)


def test_score_is_the_mean_score_of_networks_and_not_that_of_their_mean_prediction():
    t_s, b_uT, force_N = make_log()
    networks = [lambda db_uT, by=by: predict(db_uT) + np.array([0, 0, by], np.float32) for by in (-1.0, 1.0, 2.0)]
    found = estimate_log(t_s, b_uT, networks)
    scores = score_contacts(found, truth(force_N))
    # The mean prediction of the three networks would have a squared error of 0.44 N^2.
    assert scores["mse_f_N2"] == pytest.approx((1 + 1 + 4) / 3, rel=0.01)
    assert scores["spread"]["mse_f_N2"] == pytest.approx(np.std([1, 1, 4], ddof=1), rel=0.02)
    # The largest force is the mean of the largest forces of the three networks, which are 3, 5 and 6 N.
    assert describe(found)["force_max_N"] == pytest.approx(4 + 2 / 3, abs=0.05)
    assert "spread" not in score_contacts(estimate_log(t_s, b_uT, networks[:1]), truth(force_N))


@pytest.mark.parametrize(("share", "is_found"), [(0.75, False), (1.25, True)])
def test_quiet_start_ends_at_a_pulse_that_noise_does_not_explain(share, is_found):
    """The limit is that of normal noise whose standard deviation is known, for all means compared in half a second."""
    window_n, channels_n, draws_n = round(WINDOW_S * RATE_HZ), 15, 20
    error_uT = NOISE_uT * np.sqrt(1 / window_n + 1 / (START_WINDOWS_N * window_n))
    limit_uT = norm.isf(FALSE_SHARE / (channels_n * QUIET_MIN_S / WINDOW_S) / 2) * error_uT
    found = []
    for i in range(draws_n):
        t_s, b_uT, _ = make_log(steps_n=0, quiet_s=8.0, name=f"pulse {i}")
        b_uT[40 * window_n : 41 * window_n, 3] += share * limit_uT
        found.append(quiet_start(t_s, b_uT, where="log") == 40 * window_n)
    # A pulse of 0.75 or 1.25 times the limit is found with a probability of 13 or 87 %.
    assert np.mean(found) == pytest.approx(0.87 if is_found else 0.13, abs=0.25)


def test_plotted_range_contains_the_estimates_of_all_networks():
    t_s, b_uT, force_N = make_log()
    networks = [lambda db_uT, by=by: predict(db_uT) + np.array([by, 0, 0], np.float32) for by in (0.0, 1.0, -2.0)]
    plotted = thin(estimate_log(t_s, b_uT, networks), truth(force_N))
    assert [np.nanmax(np.array(plotted[which]["x_mm"], float)) for which in ("low", "estimated", "high")] == [6, 8, 9]


def test_true_values_of_a_reading_are_those_of_the_step_at_its_time():
    true = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    found = truth_at(np.array([0.0, 1.5, 2.5, 3.5, 9.0]), np.array([1.0, 3.0]), np.array([2.0, 4.0]), true)
    np.testing.assert_array_equal(found, [[np.nan] * 3, true[0], [np.nan] * 3, true[1], [np.nan] * 3])
