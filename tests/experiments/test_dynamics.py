"""Tests of filters for readings during presses whose force changes quickly, on a skin with a linear field.

The delays that filters cause are compared with closed forms, and filters with loops.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.dynamics import (
    LESS,
    WINDOW_N,
    figures,
    find_presses,
    lag_ms,
    running_mean,
    score_presses,
    tables,
)
from reskin.seeds import rng_for

RATE_HZ = 400.0


def linear_presses(durations_n=(40, 100, 300), noise_uT=0.0, delay_s=0.0):
    """Return presses on a skin with three channels, which are 100 uT per mm of x, per mm of y and per N of force.

    The field is that of the force `delay_s` ago, so it lags behind the force labels.
    """
    rng = rng_for(0, "dynamics")
    labels, fields, t_s, indentation = [], [], [], []
    for press_i, frames_n in enumerate(durations_n):
        frame_s = (np.arange(frames_n) + 0.5) / RATE_HZ
        duration_s = frames_n / RATE_HZ
        place = np.tile([4.0 + press_i, 8.0], (frames_n, 1))
        force_N, late_N = (
            2 * np.sin(np.pi * np.clip(one_s, 0, duration_s) / duration_s) ** 1.5
            for one_s in (frame_s, frame_s - delay_s)
        )
        labels.append(np.column_stack([place, force_N]))
        fields.append(100 * np.column_stack([place, late_N]))
        t_s.append(2.0 * press_i + frame_s)
        indentation.append(np.full(frames_n, 7 + press_i, np.int32))
    db_uT = np.concatenate(fields)
    db_uT += noise_uT * rng.standard_normal(db_uT.shape)
    return find_presses(
        db_uT.astype(np.float32), np.concatenate(labels), np.concatenate(t_s), np.concatenate(indentation)
    )


def inverse(db_uT):
    return db_uT / np.float32(100)


def test_duration_and_frame_rate_of_presses_are_found():
    presses = linear_presses()
    np.testing.assert_allclose(np.unique(presses.duration_s), np.array([40, 100, 300]) / RATE_HZ)
    assert score_presses(presses, [inverse], board="b0")["rate_hz"] == pytest.approx(RATE_HZ)


def test_running_mean_equals_a_loop():
    values = rng_for(0, "mean").standard_normal((12, 2))
    naive = [values[max(i - WINDOW_N + 1, 0) : i + 1].mean(axis=0) for i in range(12)]
    np.testing.assert_allclose(running_mean(values), naive, atol=1e-12)


def test_only_readings_whose_averaging_window_is_within_the_press_are_scored():
    presses = linear_presses()
    for press_i in range(3):
        assert presses.scored[presses.press_i == press_i].argmax() >= WINDOW_N - 1
    assert (presses.true[presses.scored, 2] >= 0.2).all()


def test_running_mean_is_delayed_and_a_single_reading_is_not():
    numbers = score_presses(linear_presses(), [inverse], board="b0")
    # The error is zero, except for rounding to single precision.
    assert numbers["all"]["one"]["mse_f_N2"]["mean"] < 1e-12
    # The tolerance is half a step of the search for the delay.
    assert numbers["lag_ms"]["one"]["mean"] == pytest.approx(0.0, abs=0.051)
    # The tolerance is larger, because the delay is less exact where the force is curved, at both ends of a press.
    assert numbers["lag_ms"]["mean5"]["mean"] == pytest.approx(5.0, abs=0.15)
    assert numbers["all"]["mean5"]["mse_f_N2"]["mean"] > 100 * numbers["all"]["mean5_of_middle"]["mse_f_N2"]["mean"]


def test_running_mean_has_larger_errors_in_faster_presses():
    errors = [
        one["mean5"]["mse_f_N2"]["mean"]
        for one in score_presses(linear_presses(), [inverse], board="b0")["by_duration"]
    ]
    assert errors == sorted(errors, reverse=True)
    # The fastest press has the force 2 N sin^1.5(pi t / 0.1 s). Its slope is at most 2 * 1.5 * pi / 0.1 * 0.62 N/s = 58
    # N/s, so a delay of 5 ms causes an error of at most 0.29 N.
    assert 0.02 < np.sqrt(errors[0]) < 0.29


def test_running_mean_of_five_readings_divides_the_noise_variance_by_five():
    slow = score_presses(linear_presses((2000,), noise_uT=20.0), [inverse], board="b0")["all"]
    assert slow["mean5"]["mse_f_N2"]["mean"] == pytest.approx(slow["one"]["mse_f_N2"]["mean"] / 5, rel=0.15)


@given(st.floats(-4.0, 15.0), st.floats(0.1, 10.0))
def test_delay_is_estimated_for_any_scale_of_the_force(delay_ms, factor):
    t_s = np.arange(200) / RATE_HZ
    force_N = np.sin(np.pi * t_s / 0.5) ** 2
    late_N = factor * np.interp(t_s - delay_ms / 1e3, t_s, force_N)
    inner = slice(20, 180)  # The range excludes both ends, where `np.interp` continues the force by a constant.
    # The tolerance in ms is the step of the search, plus the effect of the curvature of the force.
    assert lag_ms(t_s[inner], late_N[inner], t_s, force_N) == pytest.approx(delay_ms, abs=0.16)


def test_delay_is_found_if_the_field_lags_behind_the_force_labels():
    assert score_presses(linear_presses(delay_s=1e-3), [inverse], board="b0")["lag_ms"]["one"]["mean"] == pytest.approx(
        1.0, abs=0.15
    )


def test_scores_have_mean_and_standard_deviation_over_networks():
    both = score_presses(linear_presses(), [inverse, lambda db_uT: inverse(db_uT) + np.float32(2)], board="b0")["all"][
        "one"
    ]
    assert both["accuracy_pct"] == {"mean": 50.0, "n": 2, "sd": pytest.approx(100 / np.sqrt(2))}


def test_filters_are_compared_by_paired_differences():
    whole = score_presses(linear_presses(noise_uT=20.0), [inverse, inverse], board="b0")["all"]
    difference = whole["paired"]["mean5_minus_one"]
    less = whole["mean5"]["mse_f_N2"]["mean"] - whole["one"]["mse_f_N2"]["mean"]
    # The difference is averaged over the two networks, and n counts boards.
    assert difference["mse_f_N2"] == {"mean": pytest.approx(less), "n": 1}
    assert set(difference["by_board"]) == {"b0"}


ERROR = {"mean": 0.5, "sd": 0.1, "n": 3}
BETTER = {"mean": 0.25, "n": 1}


def metrics(error):
    return {"accuracy_pct": error, "mse_xy_mm2": error, "mse_f_N2": error}


PAIRED = {"mean5_minus_one": metrics({"mean": -0.25, "n": 1})}
SCORES = {"one": metrics(ERROR), "mean5": metrics(BETTER), "mean5_of_middle": metrics(ERROR), "paired": PAIRED}
NUMBERS = {
    "readings_n": 20, "presses_n": 3, "rate_hz": 400.0, "window_n": 5, "force_min_N": 0.2,
    "by_duration": [
        {"duration_s": 0.1, "n": 8, "presses_n": 1} | SCORES, {"duration_s": 0.5, "n": 12, "presses_n": 2} | SCORES,
    ],
    "all": SCORES, "lag_ms": {"one": {"mean": 0.9, "n": 1}, "mean5": {"n": 0}},
}  # fmt: skip


def test_dynamics_table_has_a_column_for_each_filter():
    table = tables(NUMBERS, "simulated")["dynamics"]
    judged = table[LESS] != ""
    assert list(table.loc[judged, "estimated from"].unique()) == ["mean of the last five readings"]
    assert set(table.loc[judged, LESS]) == {"not judged (fewer than 4 boards): -0.25"}
    assert list(table["lag / ms"][-3:]) == ["0.9", "–", "–"]
    assert table["MSE_F / N²"][0] == "0.5 ± 0.1"


def test_figure_names_its_source_and_is_reproducible():
    figure = figures(NUMBERS, {}, "simulated")["dynamics.svg"]
    assert "(simulated)" in figure
    assert figure == figures(NUMBERS, {}, "simulated")["dynamics.svg"]
