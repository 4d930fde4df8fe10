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
    """Two readings of each indentation; a network that errs by half a millimetre and `bias_N`."""
    rng = rng_for(0, "answers", policy, skin, window_i)
    true = np.repeat(rng.uniform(0.5, 3, (n // 2, 3)), 2, axis=0).astype(np.float32)
    error = rng_for(seed_i, "errors", policy, window_i).normal(0, 0.5, true.shape) + [0, 0, bias_N]
    values = {
        "contacts_n": 5000 * (window_i + 1), "noload_off_uT": 2.0, "indentation": np.repeat(np.arange(n // 2), 2),
        "true": true, "predicted": (true + error).astype(np.float32),
    }  # fmt: skip
    return WindowPredictions(policy, f"board of {skin}", skin, seed_i, window_i, **(values | changes))


def test_a_window_has_the_mean_and_deviation_of_its_skins_and_seeds():
    own = [predictions(skin=skin, seed_i=seed_i) for skin in ("s0", "s1") for seed_i in (0, 1)]
    [row] = window_means(score_windows([*own, predictions("initial")]), "each")
    for name in ("accuracy_pct", "mse_xy_mm2", "mse_f_N2"):
        values = [score(one.true, one.predicted)[name] for one in own]
        assert row[name] == pytest.approx(sum(values) / 4)
        assert row["spread"][name] == pytest.approx(np.std(values, ddof=1))
    errors_N = [float(p[2]) - float(t[2]) for one in own for t, p in zip(one.true, one.predicted, strict=True)]
    assert row["bias_f_N"] == pytest.approx(sum(errors_N) / len(errors_N))
    assert row["contacts_n"] == 5000


def test_without_known_forces_a_window_has_no_force_metrics_and_a_single_run_no_deviation():
    true = predictions().true.copy()
    true[:, 2] = np.nan
    [row] = window_means(score_windows([predictions(true=true)]), "each")
    assert set(row) == {"contacts_n", "accuracy_pct", "mse_xy_mm2", "noload_off_uT", "spread"}
    assert row["spread"] == {}
    assert late_force([predictions(true=true)], "each", 0) is None


def test_late_is_the_first_window_after_45000_contacts_or_else_the_last():
    assert late_window([{"contacts_n": n} for n in (40_000, 45_000, 50_000)]) == 1
    assert late_window([{"contacts_n": n} for n in (10_000, 20_000)]) == 1


def test_the_bias_is_what_scipy_finds_over_indentations_and_not_over_readings():
    own = [predictions(), predictions(skin="s1")]
    true_N, predicted_N = [], []
    for skin in ("s0", "s1"):
        for press in range(20):
            rows = [(one, one.indentation == press) for one in own if one.skin == skin]
            true_N.append(np.mean([one.true[at, 2] for one, at in rows]))
            predicted_N.append(np.mean([one.predicted[at, 2] for one, at in rows]))
    bias = force_bias(contact_forces(own))
    errors_N = np.array(predicted_N) - np.array(true_N)
    assert bias["indentations_n"] == 40
    # float32 readings of newtons carry 1e-7 each
    assert bias["bias_N"] == pytest.approx(errors_N.mean(), rel=1e-5)
    assert bias["bias_se_N"] == pytest.approx(sem(errors_N), rel=1e-5)
    assert bias["slope"] == pytest.approx(linregress(true_N, predicted_N).slope, rel=1e-5)
    assert bias["bias_pct"] == pytest.approx(100 * errors_N.mean() / np.mean(true_N), rel=1e-5)


@given(st.floats(-0.5, 0.5))
def test_a_constant_added_to_every_prediction_changes_the_bias_alone(more_N):
    plain, more = (force_bias(contact_forces([predictions(bias_N=of)])) for of in (0.0, more_N))
    assert more["bias_N"] - plain["bias_N"] == pytest.approx(more_N, abs=1e-6)  # float32 newtons
    assert more["slope"] == pytest.approx(plain["slope"], abs=1e-6)


def pressed(at: list, force_N: list):
    """Readings at x, y and depth in mm."""
    x_mm, y_mm, depth_mm = np.array(at, np.float32).T
    return readings(f=len(at), x_mm=x_mm, y_mm=y_mm, depth_mm=depth_mm, Fz_N=np.array(force_N, np.float32))


@given(st.floats(0.5, 1.0), st.permutations(range(4)))
def test_softening_is_found_at_equal_places_and_depths_whatever_else_was_pressed(left, order):
    at, force_N = [[0, 0, 1], [2, 0, 1], [0, 0, 2], [4, 4, 1]], [1.0, 2.0, 4.0, np.nan]
    early = pressed([at[i] for i in order], [force_N[i] for i in order])
    late = pressed([at[1], at[0], at[0], at[3], [6, 6, 1]], [2 * left, left, left, 9.0, 9.0])
    assert force_left(early, late) == pytest.approx(100 * left, rel=1e-6)  # float32 newtons


def test_softening_is_unknown_where_no_place_and_depth_is_visited_again():
    assert force_left(pressed([[0, 0, 1]], [1]), pressed([[0, 0, 2]], [1])) is None
    assert force_left(pressed([[0, 0, np.nan]], [1]), pressed([[0, 0, np.nan]], [1])) is None


def test_drawn_points_are_rounded_and_limited_in_number():
    contacts = contact_forces([predictions(n=6000)])
    drawn = points(contacts)
    assert len(drawn["true_N"]) == len(drawn["predicted_N"]) == 1500 <= POINTS_MAX_N
    np.testing.assert_allclose(drawn["true_N"], contacts.true_N[::2], atol=5e-4)  # rounded


def test_networks_are_rows_ordered_by_skin_and_seed_so_that_policies_pair():
    units = [(skin, seed_i) for skin in ("s0", "s1") for seed_i in (0, 1)]
    own = [
        predictions(skin=skin, seed_i=seed_i, window_i=window_i, bias_N=0.1 * i)
        for i, (skin, seed_i) in enumerate(units)
        for window_i in (0, 1)
    ]
    found = network_errors(score_windows([*reversed(own), predictions("initial")]), "each")
    assert set(found) == set(METRICS)
    want = [[score(one.true, one.predicted)["mse_f_N2"] for one in own[2 * i : 2 * i + 2]] for i in range(4)]
    np.testing.assert_allclose(found["mse_f_N2"], want)


def test_the_late_force_has_a_bias_for_every_network_whose_mean_is_the_bias():
    own = [predictions(seed_i=seed_i, bias_N=bias_N) for seed_i, bias_N in enumerate((0.1, -0.2, 0.4))]
    numbers, _ = late_force(own, "each", 0)
    assert len(numbers["network_bias_N"]) == 3
    errors_N = [float((one.predicted - one.true)[:, 2].mean()) for one in own]
    assert numbers["network_bias_N"] == pytest.approx(errors_N, abs=1e-6)  # float32 newtons
    assert numbers["bias_N"] == pytest.approx(np.mean(errors_N), abs=1e-6)


def test_each_seed_has_its_own_late_force_and_the_points_are_those_of_the_first():
    high, low = predictions(seed_i=0, bias_N=0.3), predictions(seed_i=1, bias_N=-0.3)
    numbers, drawn = late_force([low, high], "each", 0)
    alone = [force_bias(contact_forces([one])) for one in (high, low)]
    for name in ("bias_N", "bias_pct", "bias_se_N", "slope"):
        assert numbers[name] == pytest.approx(np.mean([one[name] for one in alone]))
    assert numbers["indentations_n"] == 20
    assert drawn == points(contact_forces([high]))  # and not those of the mean network


def test_the_last_window_has_its_spread_over_seeds_on_each_skin():
    own = [predictions(skin=skin, seed_i=seed_i) for skin in ("s0", "s1") for seed_i in (0, 1, 2)]
    mse_N2 = np.array([score(one.true, one.predicted)["mse_f_N2"] for one in own]).reshape(2, 3)
    found = last_window(score_windows(own), "each")["mse_f_N2"]
    assert found["sd_seeds"] == pytest.approx(mse_N2.std(axis=1, ddof=1).mean())
    assert found["mean"] == pytest.approx(mse_N2.mean())


def timed(indentation: list, t_s: list):
    return readings(f=len(t_s), indentation=np.array(indentation, np.int32), t_s=np.array(t_s, float))


def test_the_pace_is_from_one_indentation_to_the_next_whatever_the_times_of_its_readings():
    first = timed([0, 0, 0, 1, 1, 2], [10.0, 10.1, 10.9, 12.0, 12.1, 17.0])
    assert pace([first]) == pytest.approx({"contact_every_s": 3.5, "lasts_s": 7.0})
    assert pace([first, timed([0, 1], [0, 1])]) == pytest.approx({"contact_every_s": 2.0, "lasts_s": 7.0})


def test_a_recording_without_a_clock_has_no_pace():
    assert pace([timed([0, 1], [np.nan, np.nan])]) == {}


def test_field_sizes_are_the_simulated_ones_and_free_air_is_no_contact():
    rng = rng_for(0, "field")
    noload_uT = rng.normal(0, 1.5, (4000, 15)).astype(np.float32) + np.linspace(0, 100, 4000, dtype=np.float32)[:, None]
    x_mm = np.where(np.arange(4000) % 2, 3, np.nan).astype(np.float32)
    b_uT = noload_uT + np.where(np.isnan(x_mm), 50, -3).astype(np.float32)[:, None]
    one = readings(
        f=4000, indentation=np.arange(4000, dtype=np.int32), b_uT=b_uT, noload_uT=noload_uT, x_mm=x_mm,
    )  # fmt: skip
    sizes = field_sizes([one])
    assert sizes["contact_uT"] == pytest.approx(3, rel=1e-5)  # float32 fields of 100 uT
    assert sizes["noload_noise_uT"] == pytest.approx(1.5, rel=0.02)  # 60,000 draws: 0.4 %, five of them
    both = field_sizes([one, replace(one, b_uT=noload_uT + np.float32(4))])
    assert both["contact_uT"] == pytest.approx(np.sqrt((3**2 + 4**2) / 2), rel=1e-5)
