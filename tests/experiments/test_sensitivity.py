"""Tests of experiment sensitivity, which finds the smallest weight whose addition the readings show.

Results are compared with loops, the normal distribution and SciPy.
"""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import linregress, spearmanr

from pipeline.experiments.results import group_by_level
from pipeline.experiments.sensitivity import (
    analyse_levels,
    direction,
    monotonic,
    ordered_share,
)
from reskin.errors import SchemaError
from reskin.seeds import rng_for

STEP_N = 0.02
WEIGHT_N = STEP_N * np.arange(26)
GAIN_uT_PER_N, NOISE_uT = 300.0, 5.0
ALONG = np.array([0.6, 0.0, -0.8])


def fillings(fillings_n=40, readings_n=5, noise_uT=NOISE_uT, name="glass"):
    """Return readings [filling, level, reading, channel] under a glass that is filled in steps.

    The field of the skin is linear in the weight.
    """
    noise = noise_uT * rng_for(0, name).standard_normal((fillings_n, len(WEIGHT_N), readings_n, 3))
    return (GAIN_uT_PER_N * WEIGHT_N[:, None, None] * ALONG + noise).astype(np.float32)


def test_fractions_of_correctly_ordered_pairs_equal_a_loop():
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


def test_gain_and_noise_of_simulated_fillings_are_recovered():
    numbers, figure_data = analyse_levels(fillings(), WEIGHT_N)
    # The tolerance is about three standard errors: 0.5 uT in 150 uT.
    assert numbers["gain_uT_per_N"] == pytest.approx(GAIN_uT_PER_N, rel=0.01)
    # The noise has 2080 degrees of freedom, so its standard error is 1.6 %.
    assert numbers["noise_uT"] == pytest.approx(NOISE_uT, rel=0.05)
    # The smallest resolved step of weight is 1.645 sqrt(2) noise / gain, rounded up to a whole number of levels.
    assert numbers["smallest_step_N"]["one_reading"] == pytest.approx(0.04)
    assert numbers["smallest_step_N"]["five_readings"] == pytest.approx(0.02)
    # A weight of 0.02 N is 2.04 g of water, because 0.02 N / 9.81 m/s^2 = 2.04 g.
    assert numbers["smallest_step_mL"]["five_readings"] == pytest.approx(2.04, abs=0.01)
    assert len(figure_data["response_uT"]) == numbers["levels_n"] == 26


def test_direction_of_the_response_is_fitted_to_the_first_half_of_fillings():
    uT = fillings(noise_uT=0.0)
    # The tolerance is rounding to single precision.
    np.testing.assert_allclose(direction(uT[:20].astype(float)), ALONG, atol=1e-6)
    swapped_uT = uT.copy()
    # In the second half of the fillings, the field changes in another direction.
    swapped_uT[20:] = swapped_uT[20:, :, :, [1, 0, 2]]
    assert analyse_levels(swapped_uT, WEIGHT_N)[0]["gain_uT_per_N"] == pytest.approx(GAIN_uT_PER_N * 0.64, rel=1e-4)


def two_fillings(values, spread):
    """Return readings of two fillings with levels 0.1 N apart.

    The mean field of both fillings at each level is given by `values`. From one level to the next, the increases of the
    field in the two fillings differ by `spread`.
    """
    wobble = spread / 2 * (-1.0) ** np.arange(len(values)) / 2
    return np.array([values + wobble, values - wobble]), 0.1 * np.arange(len(values))


@given(
    st.lists(st.integers(-5, 5), min_size=4, max_size=20).filter(lambda values: values[-1] > values[0]),
    st.floats(0.1, 5.0),
)
def test_number_of_falls_and_rank_correlation_equal_loops_and_scipy(values, spread):
    found = monotonic(*two_fillings(np.array(values, float), spread))
    gain = linregress(np.arange(len(values)), values).slope  # The gain is in uT per level.
    noise = spread / np.sqrt(2)  # This is the standard deviation of two values that differ by `spread`.
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


def test_readings_are_sorted_by_filling_and_weight():
    db_uT = np.arange(24, dtype=np.float32).reshape(12, 2)
    indentation = np.repeat([0, 1], 6).astype(np.int32)
    # There are two fillings, whose levels are not in order.
    force_N = np.repeat([0.0, 0.1, 0.2, 0.2, 0.1, 0.3], 2).astype(np.float32)
    levels = group_by_level(db_uT, indentation, force_N, levels_n=3, where="glass")
    assert levels.shape == (2, 3, 2, 2)
    np.testing.assert_array_equal(levels.reshape(12, 2), db_uT)
    with pytest.raises(SchemaError, match=r"glass: each filling needs 4 stops.*got 6 stops of \[2\] readings"):
        group_by_level(db_uT, indentation, force_N, levels_n=4, where="glass")
    with pytest.raises(SchemaError, match=r"got 6 stops of \[1, 2\] readings"):
        group_by_level(db_uT[1:], indentation[1:], force_N[1:], levels_n=3, where="glass")


def glass(noise_uT):
    noise = noise_uT * rng_for(0, "glass").standard_normal((8, 11, 5, 3))
    levels = np.arange(11)[:, None, None] * np.array([3.0, 4.0, 0.0]) + noise
    return analyse_levels(levels.astype(np.float32), 0.1 * np.arange(11))
