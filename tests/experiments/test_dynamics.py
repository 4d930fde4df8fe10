"""Presses of a linear skin, answered by its inverse: lags and errors by hand; naive loops; shifts as law."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.dynamics import WINDOW_N, find_presses, lag_ms, running_mean, score_presses
from reskin.seeds import rng_for

RATE_HZ = 400.0


def made(durations_n=(40, 100, 300), noise_uT=0.0, late_s=0.0):
    """A skin of three channels that give x, y and F at 100 uT a unit; its force is read `late_s` late."""
    rng = rng_for(0, "dynamics")
    true, read, t_s, indentation = [], [], [], []
    for press_i, frames_n in enumerate(durations_n):
        own_s = (np.arange(frames_n) + 0.5) / RATE_HZ
        long_s = frames_n / RATE_HZ
        place = np.tile([4.0 + press_i, 8.0], (frames_n, 1))
        force_N, late_N = (
            2 * np.sin(np.pi * np.clip(one_s, 0, long_s) / long_s) ** 1.5 for one_s in (own_s, own_s - late_s)
        )
        true.append(np.column_stack([place, force_N]))
        read.append(100 * np.column_stack([place, late_N]))
        t_s.append(2.0 * press_i + own_s)
        indentation.append(np.full(frames_n, 7 + press_i, np.int32))
    db_uT = np.concatenate(read)
    db_uT += noise_uT * rng.standard_normal(db_uT.shape)
    return find_presses(
        db_uT.astype(np.float32), np.concatenate(true), np.concatenate(t_s), np.concatenate(indentation)
    )


def inverse(db_uT):
    return db_uT / np.float32(100)


def test_a_press_lasts_as_long_as_its_frames_and_its_rate_is_measured():
    of = made()
    np.testing.assert_allclose(np.unique(of.duration_s), np.array([40, 100, 300]) / RATE_HZ)
    assert score_presses(of, [inverse], board="b0")["rate_hz"] == pytest.approx(RATE_HZ)


def test_the_running_mean_is_that_of_a_loop():
    values = rng_for(0, "mean").standard_normal((12, 2))
    naive = [values[max(i - WINDOW_N + 1, 0) : i + 1].mean(axis=0) for i in range(12)]
    np.testing.assert_allclose(running_mean(values), naive, atol=1e-12)


def test_no_window_reaches_into_the_press_before():
    of = made()
    for press_i in range(3):
        assert of.scored[of.press_i == press_i].argmax() >= WINDOW_N - 1
    assert (of.true[of.scored, 2] >= 0.2).all()


def test_without_noise_single_readings_are_exact_and_the_mean_lags_by_two_frames():
    numbers = score_presses(made(), [inverse], board="b0")
    assert numbers["all"]["one"]["mse_f_N2"]["mean"] < 1e-12  # float32
    assert numbers["lag_ms"]["one"]["mean"] == pytest.approx(0.0, abs=0.051)  # half the step of the search
    assert numbers["lag_ms"]["mean5"]["mean"] == pytest.approx(5.0, abs=0.15)  # and the force bends at its ends
    assert numbers["all"]["mean5"]["mse_f_N2"]["mean"] > 100 * numbers["all"]["mean5_of_middle"]["mse_f_N2"]["mean"]


def test_the_faster_a_press_the_worse_the_mean():
    errors = [one["mean5"]["mse_f_N2"]["mean"] for one in score_presses(made(), [inverse], board="b0")["by_duration"]]
    assert errors == sorted(errors, reverse=True)
    # by hand: a lag of 5 ms in sin^1.5 of 2 N over 0.1 s is at most 5e-3 * 2 * 1.5 * pi / 0.1 * 0.62 = 0.29 N
    assert 0.02 < np.sqrt(errors[0]) < 0.29


def test_noise_that_is_large_against_the_lag_makes_the_mean_the_better_one():
    slow = score_presses(made((2000,), noise_uT=20.0), [inverse], board="b0")["all"]
    assert slow["mean5"]["mse_f_N2"]["mean"] == pytest.approx(slow["one"]["mse_f_N2"]["mean"] / 5, rel=0.15)


@given(st.floats(-4.0, 15.0), st.floats(0.1, 10.0))
def test_a_delay_is_found_whatever_the_factor(delay_ms, factor):
    t_s = np.arange(200) / RATE_HZ
    force_N = np.sin(np.pi * t_s / 0.5) ** 2
    late_N = factor * np.interp(t_s - delay_ms / 1e3, t_s, force_N)
    own = slice(20, 180)  # away from the ends, where interpolation holds the last value
    assert lag_ms(t_s[own], late_N[own], t_s, force_N) == pytest.approx(delay_ms, abs=0.16)  # the step, and its bends


def test_readings_that_come_late_are_found_to_do_so():
    assert score_presses(made(late_s=1e-3), [inverse], board="b0")["lag_ms"]["one"]["mean"] == pytest.approx(
        1.0, abs=0.15
    )


def test_scores_are_summarised_over_networks():
    both = score_presses(made(), [inverse, lambda db_uT: inverse(db_uT) + np.float32(2)], board="b0")["all"]["one"]
    assert both["accuracy_pct"] == {"mean": 50.0, "n": 2, "sd": pytest.approx(100 / np.sqrt(2))}


def test_both_ways_that_answer_at_once_are_compared_in_pairs_on_one_board():
    whole = score_presses(made(noise_uT=20.0), [inverse, inverse], board="b0")["all"]
    difference = whole["paired"]["mean5_minus_one"]
    less = whole["mean5"]["mse_f_N2"]["mean"] - whole["one"]["mse_f_N2"]["mean"]
    assert difference["mse_f_N2"] == {"mean": pytest.approx(less), "n": 1}  # two networks, one board
    assert set(difference["by_board"]) == {"b0"}
