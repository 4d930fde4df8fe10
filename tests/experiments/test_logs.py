"""Tests of estimates from logs, which are long recordings without labels.

Other tests simulate a board that is tilted (pitched) in the earth's field.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from pipeline.experiments.logs import (
    PITCHES_DEG,
    Log,
    describe,
    earth_in_board_T,
    estimate,
    score_contacts,
    score_pitches,
    thin,
    truth_at,
)
from reskin.errors import CaptureError
from reskin.logs import FALSE_SHARE, QUIET_MIN_S, START_WINDOWS_N, WINDOW_S, contacts_n, quiet_start
from reskin.physics.ambient import EARTH_DIP_DEG, EARTH_SIZE_T, EARTH_T, Instrument
from reskin.physics.board import Board
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


def plain_board(name, chips_n):
    """Return a board whose chips are exact and not rotated."""
    eyes = np.tile(np.eye(3), (chips_n, 1, 1))
    return Board(name, np.zeros((chips_n, 3)), eyes, eyes, np.zeros((chips_n, 3)))


def instrument(noise_uT=0.0):
    board = plain_board("b0", 5)
    return Instrument(board, plain_board("aside", 1), board.turn, np.full(3, noise_uT))


def pitched_log(noise_uT=0.0):
    t_s, b_uT, force_N = make_log()
    quiet_n = quiet_start(t_s, b_uT, where="log")
    log = Log(t_s, b_uT, truth(force_N), quiet_n)
    return log, score_pitches(log, instrument(noise_uT), [predict], rng_for(0, "aside"))


def test_pitched_board_reads_the_earth_field_in_rotated_axes():
    np.testing.assert_allclose(earth_in_board_T(np.array([0.0])), EARTH_T[None])
    # If the pitch equals the dip of the earth's field, the x axis of the board is parallel to the field.
    along_T = earth_in_board_T(np.radians([EARTH_DIP_DEG]))
    np.testing.assert_allclose(along_T, [[EARTH_SIZE_T, 0, 0]], atol=1e-18)


@given(st.floats(-1.5, 1.5))
def test_length_of_the_change_of_the_earth_field_equals_the_chord_of_the_rotation(pitch_rad):
    rotated_T = earth_in_board_T(np.array([pitch_rad]))[0]
    assert np.linalg.norm(rotated_T) == pytest.approx(EARTH_SIZE_T)
    chord_T = 2 * EARTH_SIZE_T * np.sin(abs(pitch_rad) / 2)
    # The tolerance is the rounding error of fields of 50 uT.
    assert np.linalg.norm(rotated_T - EARTH_T) == pytest.approx(chord_T, abs=1e-18)


def test_scores_at_pitch_zero_equal_the_scores_of_the_log():
    log, rows = pitched_log()
    found = estimate_log(log.t_s, log.b_uT, [predict])
    level = rows[0]
    assert level["pitch_deg"] == 0
    assert level["contacts_n"] == contacts_n(found.contact) == 4
    scores = score_contacts(found, log.true)
    assert level["false_readings_n"] == scores["false_readings_n"] == 0
    # The tolerance allows for the rounding of 1000 uT to single precision, which is 6e-5 uT.
    assert level["mse_f_N2"] == pytest.approx(scores["mse_f_N2"], rel=1e-3)


def test_reference_chip_removes_the_false_contacts_caused_by_pitch():
    log, rows = pitched_log()
    assert [row["pitch_deg"] for row in rows] == list(PITCHES_DEG)
    false_n = [row["false_readings_n"] for row in rows]
    assert false_n == sorted(false_n)
    # At 45 degrees, the norm of the field changes of five chips oscillates between 0 and sqrt(5) 38 uT = 86 uT. This
    # norm is below the contact threshold of sqrt(15) 3 uT + 18 uT = 30 uT for less than a third of the time.
    off_n = int((np.isnan(log.true[:, 2]) & (np.arange(len(log.t_s)) >= log.quiet_n)).sum())
    assert 0.6 * off_n < false_n[-1] < off_n
    for row in rows:
        assert row["reference_chip"] == {name: rows[0]["reference_chip"][name] for name in row["reference_chip"]}
        assert row["reference_chip"]["false_readings_n"] == 0


def test_noise_of_the_reference_chip_increases_the_force_error():
    rows = pitched_log(noise_uT=3.0)[1]
    assert all(row["reference_chip"]["mse_f_N2"] > 1.5 * rows[0]["mse_f_N2"] for row in rows)
    assert all(row["reference_chip"]["contacts_n"] == 4 for row in rows)
