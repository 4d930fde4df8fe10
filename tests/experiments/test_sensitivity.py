"""Resolved weights against naive loops, the normal distribution and scipy; scaling."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import linregress, norm, spearmanr

from pipeline.experiments.sensitivity import (
    analyse_levels,
    direction,
    group_by_level,
    monotonic,
    ordered_share,
    smallest_step_N,
)
from reskin.errors import SchemaError
from reskin.seeds import rng_for

STEP_N = 0.02
WEIGHT_N = STEP_N * np.arange(26)
GAIN_uT_PER_N, NOISE_uT = 300.0, 5.0
ALONG = np.array([0.6, 0.0, -0.8])


def fillings(fillings_n=40, readings_n=5, noise_uT=NOISE_uT, name="glass"):
    """A linear skin of three channels."""
    noise = noise_uT * rng_for(0, name).standard_normal((fillings_n, len(WEIGHT_N), readings_n, 3))
    return (GAIN_uT_PER_N * WEIGHT_N[:, None, None] * ALONG + noise).astype(np.float32)


def test_shares_are_those_of_a_loop_over_all_pairs():
    response = rng_for(0, "pairs").integers(0, 4, size=(2, 5, 3)).astype(float)
    for steps_n in range(1, 5):
        right = [
            (a > b) + 0.5 * (a == b)
            for filling in response
            for i in range(5 - steps_n)
            for a in filling[i + steps_n]
            for b in filling[i]
        ]
        assert ordered_share(response)[steps_n - 1] == pytest.approx(np.mean(right))


def test_on_a_linear_skin_a_difference_is_told_as_often_as_two_normal_readings_say():
    told = analyse_levels(fillings(), WEIGHT_N)[1]["told"]
    z = GAIN_uT_PER_N * STEP_N * np.arange(1, 4) / (np.sqrt(2) * NOISE_uT)
    np.testing.assert_allclose(told["one_reading"][:3], norm.cdf(z), atol=0.015)  # 12,500 pairs, sharing readings
    np.testing.assert_allclose(told["five_readings"][:3], norm.cdf(np.sqrt(5) * z), atol=0.03)  # 500 pairs


def test_gain_and_noise_are_found_again():
    numbers, drawn = analyse_levels(fillings(), WEIGHT_N)
    assert numbers["gain_uT_per_N"] == pytest.approx(GAIN_uT_PER_N, rel=0.01)  # 0.5 uT of error a level of 150 uT
    assert numbers["noise_uT"] == pytest.approx(NOISE_uT, rel=0.05)  # 2080 degrees of freedom: 1.6 %
    # the least difference that both shares reach: 1.645 sqrt(2) sd / gain, up to the next step
    assert numbers["smallest_step_N"]["one_reading"] == pytest.approx(0.04)
    assert numbers["smallest_step_N"]["five_readings"] == pytest.approx(0.02)
    assert numbers["smallest_step_mL"]["five_readings"] == pytest.approx(
        2.04, abs=0.01
    )  # 0.02 N / 9.81 m/s^2 is 2.04 g
    assert len(drawn["response_uT"]) == numbers["levels_n"] == 26


def test_the_direction_is_that_of_the_fitting_half_alone():
    uT = fillings(noise_uT=0.0)
    np.testing.assert_allclose(direction(uT[:20].astype(float)), ALONG, atol=1e-6)  # float32
    turned = uT.copy()
    turned[20:] = turned[20:, :, :, [1, 0, 2]]  # what is held out points elsewhere
    assert analyse_levels(turned, WEIGHT_N)[0]["gain_uT_per_N"] == pytest.approx(GAIN_uT_PER_N * 0.64, rel=1e-4)


@given(st.floats(0.1, 10.0))
def test_a_stronger_skin_with_as_much_more_noise_tells_the_same(factor):
    uT = fillings(4)
    one, other = (analyse_levels((own * uT).astype(np.float32), WEIGHT_N)[0] for own in (1.0, factor))
    assert one["smallest_step_N"] == other["smallest_step_N"]


def test_the_smallest_step_is_the_one_after_the_last_that_fails():
    assert smallest_step_N(np.array([0.96, 0.94, 0.95, 1.0]), 0.1) == pytest.approx(0.3)
    assert smallest_step_N(np.array([0.95, 1.0]), 0.1) == pytest.approx(0.1)
    assert smallest_step_N(np.array([1.0, 0.9]), 0.1) is None


def test_a_skin_that_tells_nothing_has_no_smallest_step():
    numbers, _ = analyse_levels(fillings(noise_uT=1e6), WEIGHT_N)
    assert numbers["smallest_step_N"] == numbers["smallest_step_mL"] == {}
    assert not numbers["monotonic"]["holds"]
    assert "step_N" not in numbers["monotonic"]


def alike(values, spread):
    """Two fillings whose mean is `values`, told in steps of 0.1 N; every rise differs by as much."""
    wobble = spread / 2 * (-1.0) ** np.arange(len(values)) / 2
    return np.array([values + wobble, values - wobble]), 0.1 * np.arange(len(values))


@given(
    st.lists(st.integers(-5, 5), min_size=4, max_size=20).filter(lambda values: values[-1] > values[0]),
    st.floats(0.1, 5.0),
)
def test_falls_are_counted_at_a_step_that_stands_out_of_noise_and_ranks_correlate_as_scipy_says(values, spread):
    found = monotonic(*alike(np.array(values, float), spread))
    gain = linregress(np.arange(len(values)), values).slope  # a step
    noise = spread / np.sqrt(2)  # two rises, `spread` apart
    steps_n = int(np.ceil(1.6448536 * noise / gain)) if gain > 0 else len(values)
    if steps_n < len(values):
        pairs = list(zip(values, values[steps_n:], strict=False))
        assert found["falls_n"] == sum(after <= before for before, after in pairs)
        assert found["pairs_n"] == len(pairs)
        assert found["step_N"] == pytest.approx(0.1 * steps_n)
    else:
        assert "step_N" not in found
    assert found["holds"] == (found["falls_n"] == 0 and "step_N" in found)
    assert found["neighbours"]["falls_n"] == sum(after <= before for before, after in pairwise(values))
    assert found["spearman"] == pytest.approx(spearmanr(np.arange(len(values)), values).statistic)


def test_a_skin_is_judged_alike_however_finely_the_glass_is_filled():
    fine_N = 0.002 * np.arange(251)  # up to 0.5 N, as WEIGHT_N, ten times as fine
    noise = NOISE_uT * rng_for(0, "fine").standard_normal((40, len(fine_N), 5, 3))
    fine = (GAIN_uT_PER_N * fine_N[:, None, None] * ALONG + noise).astype(np.float32)
    pourings = ((fine, fine_N), (fillings(), WEIGHT_N))
    found, coarse = (analyse_levels(uT, weight_N)[0]["monotonic"] for uT, weight_N in pourings)
    assert found["neighbours"]["falls_n"] > 0  # noise of a mean rise: 5 sqrt(2 / 100) = 0.7 uT, as much as a step's 0.6
    assert found["holds"]
    assert coarse["holds"]
    assert found["step_N"] <= coarse["step_N"] == pytest.approx(0.02)


def test_a_response_that_falls_by_more_than_is_told_apart_is_not_monotonic():
    uT = fillings()
    uT[:, 13:] -= uT[:, 13:].mean(axis=(0, 1, 2)) / 2  # drops by half of what it had reached
    assert not analyse_levels(uT, WEIGHT_N)[0]["monotonic"]["holds"]


def test_falls_that_noise_makes_are_as_many_as_expected():
    rng = rng_for(0, "falls")
    rise_uT, noise_uT, fillings_n = 0.5, 2.0, 10
    response_uT = rise_uT * np.arange(2001) + noise_uT * rng.standard_normal((fillings_n, 2001))
    found = monotonic(response_uT, 0.01 * np.arange(2001))["neighbours"]
    expected_n = 2000 * norm.cdf(-rise_uT / (noise_uT * np.sqrt(2 / fillings_n)))  # 576
    assert found["expected_falls_n"] == pytest.approx(expected_n, rel=0.02)  # noise known to 1 %
    assert found["falls_n"] == pytest.approx(expected_n, abs=4 * np.sqrt(expected_n))


def test_readings_are_sorted_by_filling_weight_and_reading():
    db_uT = np.arange(24, dtype=np.float32).reshape(12, 2)
    indentation = np.repeat([0, 1], 6).astype(np.int32)
    force_N = np.repeat([0.0, 0.1, 0.2, 0.2, 0.1, 0.3], 2).astype(np.float32)  # the second begins as the first ends
    levels = group_by_level(db_uT, indentation, force_N, levels_n=3, where="glass")
    assert levels.shape == (2, 3, 2, 2)
    np.testing.assert_array_equal(levels.reshape(12, 2), db_uT)
    with pytest.raises(SchemaError, match=r"glass: stops must be 4 a filling.*got 6 stops of \[2\] readings"):
        group_by_level(db_uT, indentation, force_N, levels_n=4, where="glass")
    with pytest.raises(SchemaError, match=r"got 6 stops of \[1, 2\] readings"):
        group_by_level(db_uT[1:], indentation[1:], force_N[1:], levels_n=3, where="glass")
