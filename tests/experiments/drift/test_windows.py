"""Tests of the scores of experiment drift in windows, which are groups of successive contacts of a skin."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import linregress, sem

from pipeline.experiments.drift import (
    POINTS_MAX_N,
    WindowPredictions,
    contact_forces,
    field_sizes,
    force_bias,
    force_left,
    last_window,
    late_force,
    late_window,
    network_errors,
    pace,
    points,
    score_windows,
    window_means,
)
from reskin.metrics import METRICS, score
from reskin.seeds import rng_for
from tests.data.tables import readings


def predictions(policy="each", skin="s0", seed_i=0, window_i=0, n=40, bias_N=0.1, **changes) -> WindowPredictions:
    """Return predictions with two readings per indentation.

    Their place errors are 0.5 mm, and their forces have the bias `bias_N`.
    """
    rng = rng_for(0, "answers", policy, skin, window_i)
    true = np.repeat(rng.uniform(0.5, 3, (n // 2, 3)), 2, axis=0).astype(np.float32)
    error = rng_for(seed_i, "errors", policy, window_i).normal(0, 0.5, true.shape) + [0, 0, bias_N]
    values = {
        "contacts_n": 5000 * (window_i + 1), "noload_off_uT": 2.0, "indentation": np.repeat(np.arange(n // 2), 2),
        "true": true, "predicted": (true + error).astype(np.float32),
    }  # fmt: skip
    return WindowPredictions(policy, f"board of {skin}", skin, seed_i, window_i, **(values | changes))


def test_errors_in_a_window_have_a_mean_and_a_standard_deviation_over_skins_and_seeds():
    networks = [predictions(skin=skin, seed_i=seed_i) for skin in ("s0", "s1") for seed_i in (0, 1)]
    [row] = window_means(score_windows([*networks, predictions("initial")]), "each")
    for name in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2"):
        values = [score(one.true, one.predicted)[name] for one in networks]
        assert row[name] == pytest.approx(sum(values) / 4)
        assert row["spread"][name] == pytest.approx(np.std(values, ddof=1))
    errors_N = [float(p[2]) - float(t[2]) for one in networks for t, p in zip(one.true, one.predicted, strict=True)]
    assert row["bias_f_N"] == pytest.approx(sum(errors_N) / len(errors_N))
    assert row["contacts_n"] == 5000


def test_window_of_one_network_without_forces_has_no_force_error_and_no_spread():
    true = predictions().true.copy()
    true[:, 2] = np.nan
    [row] = window_means(score_windows([predictions(true=true)]), "each")
    assert set(row) == {"contacts_n", "accuracy_pct", "mse_xy_mm2", "noload_off_uT", "spread"}
    assert row["spread"] == {}
    assert late_force([predictions(true=true)], "each", 0) is None


def test_late_window_is_the_first_after_45000_contacts():
    assert late_window([{"contacts_n": n} for n in (40_000, 45_000, 50_000)]) == 1
    assert late_window([{"contacts_n": n} for n in (10_000, 20_000)]) == 1


def test_bias_and_standard_error_over_indentations_equal_scipy():
    networks = [predictions(), predictions(skin="s1")]
    true_N, predicted_N = [], []
    for skin in ("s0", "s1"):
        for press in range(20):
            rows = [(one, one.indentation == press) for one in networks if one.skin == skin]
            true_N.append(np.mean([one.true[selected, 2] for one, selected in rows]))
            predicted_N.append(np.mean([one.predicted[selected, 2] for one, selected in rows]))
    bias = force_bias(contact_forces(networks))
    errors_N = np.array(predicted_N) - np.array(true_N)
    assert bias["indentations_n"] == 40
    # The absolute tolerance is the rounding of forces to single precision, which is 1e-7 N.
    assert bias["bias_N"] == pytest.approx(errors_N.mean(), rel=1e-5)
    assert bias["bias_se_N"] == pytest.approx(sem(errors_N), rel=1e-5)
    assert bias["slope"] == pytest.approx(linregress(true_N, predicted_N).slope, rel=1e-5)
    assert bias["bias_pct"] == pytest.approx(100 * errors_N.mean() / np.mean(true_N), rel=1e-5)


@given(st.floats(-0.5, 0.5))
def test_constant_force_error_changes_only_the_bias(more_N):
    plain, more = (force_bias(contact_forces([predictions(bias_N=bias_N)])) for bias_N in (0.0, more_N))
    # The tolerance is rounding, because forces are in single precision.
    assert more["bias_N"] - plain["bias_N"] == pytest.approx(more_N, abs=1e-6)
    assert more["slope"] == pytest.approx(plain["slope"], abs=1e-6)


def readings_at(points_mm: list, force_N: list):
    """Return readings at these places x, y and depths in mm."""
    x_mm, y_mm, depth_mm = np.array(points_mm, np.float32).T
    return readings(f=len(points_mm), x_mm=x_mm, y_mm=y_mm, depth_mm=depth_mm, Fz_N=np.array(force_N, np.float32))


@given(st.floats(0.5, 1.0), st.permutations(range(4)))
def test_remaining_force_compares_readings_at_equal_places_and_depths(left, order):
    points_mm, force_N = [[0, 0, 1], [2, 0, 1], [0, 0, 2], [4, 4, 1]], [1.0, 2.0, 4.0, np.nan]
    early = readings_at([points_mm[i] for i in order], [force_N[i] for i in order])
    late = readings_at(
        [points_mm[1], points_mm[0], points_mm[0], points_mm[3], [6, 6, 1]], [2 * left, left, left, 9.0, 9.0]
    )
    # The tolerance is rounding, because forces are in single precision.
    assert force_left(early, late) == pytest.approx(100 * left, rel=1e-6)


def test_remaining_force_is_unknown_if_no_place_is_visited_twice():
    assert force_left(readings_at([[0, 0, 1]], [1]), readings_at([[0, 0, 2]], [1])) is None
    assert force_left(readings_at([[0, 0, np.nan]], [1]), readings_at([[0, 0, np.nan]], [1])) is None


def test_plotted_points_are_rounded_and_limited_in_number():
    contacts = contact_forces([predictions(n=6000)])
    plotted = points(contacts)
    assert len(plotted["true_N"]) == len(plotted["predicted_N"]) == 1500 <= POINTS_MAX_N
    # Plotted forces are rounded to 0.001 N.
    np.testing.assert_allclose(plotted["true_N"], contacts.true_N[::2], atol=5e-4)


def test_network_errors_are_ordered_by_skin_and_seed():
    units = [(skin, seed_i) for skin in ("s0", "s1") for seed_i in (0, 1)]
    networks = [
        predictions(skin=skin, seed_i=seed_i, window_i=window_i, bias_N=0.1 * i)
        for i, (skin, seed_i) in enumerate(units)
        for window_i in (0, 1)
    ]
    found = network_errors(score_windows([*reversed(networks), predictions("initial")]), "each")
    assert set(found) == set(METRICS)
    expected = [[score(one.true, one.predicted)["mse_f_N2"] for one in networks[2 * i : 2 * i + 2]] for i in range(4)]
    np.testing.assert_allclose(found["mse_f_N2"], expected)


def test_bias_in_the_late_window_is_the_mean_over_networks():
    networks = [predictions(seed_i=seed_i, bias_N=bias_N) for seed_i, bias_N in enumerate((0.1, -0.2, 0.4))]
    numbers, _ = late_force(networks, "each", 0)
    assert len(numbers["network_bias_N"]) == 3
    errors_N = [float((one.predicted - one.true)[:, 2].mean()) for one in networks]
    # The tolerance is rounding, because forces are in single precision.
    assert numbers["network_bias_N"] == pytest.approx(errors_N, abs=1e-6)
    assert numbers["bias_N"] == pytest.approx(np.mean(errors_N), abs=1e-6)


def test_forces_in_the_late_window_are_kept_per_seed_and_plotted_for_the_first_seed():
    high, low = predictions(seed_i=0, bias_N=0.3), predictions(seed_i=1, bias_N=-0.3)
    numbers, plotted = late_force([low, high], "each", 0)
    alone = [force_bias(contact_forces([one])) for one in (high, low)]
    for name in ("bias_N", "bias_pct", "bias_se_N", "slope"):
        assert numbers[name] == pytest.approx(np.mean([one[name] for one in alone]))
    assert numbers["indentations_n"] == 20
    # The plotted points are those of one network, and not of the mean over networks.
    assert plotted == points(contact_forces([high]))


def test_standard_deviation_of_the_last_window_is_over_the_seeds_of_each_skin():
    networks = [predictions(skin=skin, seed_i=seed_i) for skin in ("s0", "s1") for seed_i in (0, 1, 2)]
    mse_N2 = np.array([score(one.true, one.predicted)["mse_f_N2"] for one in networks]).reshape(2, 3)
    found = last_window(score_windows(networks), "each")["mse_f_N2"]
    assert found["sd_seeds"] == pytest.approx(mse_N2.std(axis=1, ddof=1).mean())
    assert found["mean"] == pytest.approx(mse_N2.mean())


def timed_readings(indentation: list, t_s: list):
    return readings(f=len(t_s), indentation=np.array(indentation, np.int32), t_s=np.array(t_s, float))


def test_time_per_contact_is_measured_between_indentations():
    first = timed_readings([0, 0, 0, 1, 1, 2], [10.0, 10.1, 10.9, 12.0, 12.1, 17.0])
    assert pace([first]) == pytest.approx({"contact_every_s": 3.5, "lasts_s": 7.0})
    assert pace([first, timed_readings([0, 1], [0, 1])]) == pytest.approx({"contact_every_s": 2.0, "lasts_s": 7.0})


def test_recording_without_clock_has_no_time_per_contact():
    assert pace([timed_readings([0, 1], [np.nan, np.nan])]) == {}


def test_size_of_contact_fields_is_computed_from_rows_in_contact_only():
    rng = rng_for(0, "field")
    noload_uT = rng.normal(0, 1.5, (4000, 15)).astype(np.float32) + np.linspace(0, 100, 4000, dtype=np.float32)[:, None]
    x_mm = np.where(np.arange(4000) % 2, 3, np.nan).astype(np.float32)
    b_uT = noload_uT + np.where(np.isnan(x_mm), 50, -3).astype(np.float32)[:, None]
    one = readings(
        f=4000, indentation=np.arange(4000, dtype=np.int32), b_uT=b_uT, noload_uT=noload_uT, x_mm=x_mm,
    )  # fmt: skip
    sizes = field_sizes([one])
    # The tolerance is the rounding of fields of 100 uT to single precision.
    assert sizes["contact_uT"] == pytest.approx(3, rel=1e-5)
    # The tolerance of 2 % is five standard errors for 60,000 draws.
    assert sizes["noload_noise_uT"] == pytest.approx(1.5, rel=0.02)
    both = field_sizes([one, replace(one, b_uT=noload_uT + np.float32(4))])
    assert both["contact_uT"] == pytest.approx(np.sqrt((3**2 + 4**2) / 2), rel=1e-5)
