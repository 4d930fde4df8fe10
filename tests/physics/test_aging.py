"""Tests of relaxation, hysteresis, wear and temperature.

References are closed forms, 50-digit numbers and published values.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.experiments.extremes import physics as laws
from reskin.errors import ParamsError
from reskin.physics.aging import (
    SKIN_RELAXATION,
    Memory,
    Prony,
    Relaxation,
    Temperature,
    advance,
    baseline_walk,
    fading,
    field_memory,
    relative_remanence,
    relax,
    relaxed_share,
    softening,
    temperature_rise_K,
)
from reskin.seeds import rng_for
from tests.laws import LIMITS

ROUNDING = 1e-14  # This is the relative rounding error of a few dozen operations in double precision.
times_s = st.floats(0, 1e5)
changes = st.floats(-10, 10)


@given(st.floats(1e3, 1e8), st.floats(1e-16, 1e8))
def test_one_relaxation_step_equals_50_digit_arithmetic(ratio, dt_over_fastest):
    assert laws.relaxation_step(1e-3 * dt_over_fastest, laws.stiff(ratio)) <= LIMITS["stiff_relaxation"]


def test_force_of_a_held_poke_follows_the_relaxation_function():
    time_s = np.geomspace(1e-5, 1e6, 200) - 1e-5
    decayed = -np.expm1(-time_s[:, None] / SKIN_RELAXATION.tau_s)
    truth = 3.0 * (1 - (SKIN_RELAXATION.share * decayed).sum(axis=1))
    # Each of the 200 steps is exact except for rounding errors, which add up.
    np.testing.assert_allclose(relax(time_s, np.full(200, 3.0), SKIN_RELAXATION), truth, atol=3e-13)


@given(times_s, times_s, changes)
def test_force_after_a_ramp_is_the_same_if_the_ramp_is_computed_in_two_steps(first_s, second_s, rate):
    whole = advance(np.ones(5), rate * (first_s + second_s), first_s + second_s, SKIN_RELAXATION)
    halfway = advance(np.ones(5), rate * first_s, first_s, SKIN_RELAXATION)
    size = 1 + abs(rate) * (first_s + second_s)
    np.testing.assert_allclose(
        advance(halfway, rate * second_s, second_s, SKIN_RELAXATION), whole, atol=ROUNDING * size
    )


@pytest.mark.parametrize(("tau_s", "share"), [(0.0, 0.1), (-1.0, 0.1), (np.nan, 0.1), (1.0, -0.1), (1.0, 1.1)])
def test_invalid_relaxation_is_refused(tau_s, share):
    with pytest.raises(ParamsError, match="prony"):
        Prony(np.array([tau_s]), np.array([share]))


def test_force_at_a_reading_has_relaxed_during_approach_and_hold():
    jump, slow = Relaxation(approach_s=0.0, hold_s=5.0), Relaxation(approach_s=5.0, hold_s=0.0)
    truth = 1 - (SKIN_RELAXATION.share * -np.expm1(-5.0 / SKIN_RELAXATION.tau_s)).sum()
    assert relaxed_share(jump) == pytest.approx(truth, rel=1e-12)
    # During the approach, the force builds up gradually. The parts that build up later relax for a shorter time, so the
    # decay is averaged over the approach.
    x = 5.0 / SKIN_RELAXATION.tau_s
    assert relaxed_share(slow) == pytest.approx(1 - (SKIN_RELAXATION.share * (1 + np.expm1(-x) / x)).sum(), rel=1e-12)


MEMORY = Memory(share=(0.11, 0.1), tau_s=(5.0, 60.0), contact_s=5.0, rest_s=1.0)


def test_field_memory_equals_the_differential_equation_solved_in_small_steps():
    """The memory is the part of a press's field change that remains in the next no-load reading, and decays."""
    stops_T, how, steps_n = np.random.default_rng(0).normal(0, 1e-4, (6, 3, 2, 3)), MEMORY, 20_000
    change_T = stops_T.mean(axis=1)
    q_T = np.zeros((2, *change_T.shape[1:]))
    before_T, added_T = field_memory(stops_T, how)
    for i, poke_T in enumerate(change_T):
        np.testing.assert_allclose(before_T[i], q_T.sum(axis=0), atol=1e-8)
        first_T = q_T.copy()
        for long_s, held_T in ((how.contact_s, poke_T), (how.rest_s, np.zeros_like(poke_T))):
            for _ in range(steps_n):
                rate = [(s * held_T - q) / tau for s, q, tau in zip(how.share, q_T, how.tau_s, strict=True)]
                q_T = q_T + long_s / steps_n * np.stack(rate)
            if held_T is poke_T:
                np.testing.assert_allclose(added_T[i, -1], (q_T - first_T).sum(axis=0), atol=1e-8)


def test_field_memory_of_a_press_is_5_to_8_percent_and_decays():
    once_T = np.zeros((5, 1, 1, 3))
    once_T[0] = 1e-3
    before_T, _ = field_memory(once_T, MEMORY)
    left = before_T[:, 0, 0] / 1e-3
    assert left[0] == 0
    assert 0.05 < left[1] < 0.08
    assert (np.diff(left[1:]) < 0).all()


DESIGN = {"settling": 0.10, "ageing": 0.01}


def test_softening_is_the_sum_of_settling_and_ageing():
    # Expected after 300 contacts: settling of 0.1 (1 - e^-1) = 0.0632121 and ageing of 0.01 log10(1.3) = 0.0011394.
    # After 999,000 contacts: 0.1 + 0.01 * 3.
    np.testing.assert_allclose(softening(np.array([300, 999_000]), **DESIGN), [0.9356485, 0.87], atol=1e-7)


def test_magnetisation_fades_by_half_a_percent_per_decade_of_contacts():
    np.testing.assert_allclose(fading(np.array([9, 99, 999]), per_decade=0.005), [0.005, 0.010, 0.015], atol=1e-15)


def test_baseline_drift_grows_with_the_square_root_of_contacts():
    walks_T = baseline_walk(np.array([100, 10_000]), 20_000, step_T=0.2e-6, rng=rng_for(0, "wear"))
    # The tolerance of 2 % is four standard errors. The standard error of a standard deviation of n draws is 1 / sqrt(2
    # n).
    np.testing.assert_allclose(walks_T.std(axis=1), [2e-6, 20e-6], rtol=0.02)
    # The drift up to contact 10,000 contains the drift up to contact 100, which is a tenth as large. Therefore the
    # correlation of the two is 0.1.
    np.testing.assert_allclose(np.corrcoef(walks_T)[0, 1], 0.1, atol=0.03)


@pytest.mark.parametrize(
    "of",
    [
        lambda: softening(np.array([-1]), **DESIGN),
        lambda: fading(np.array([-1]), per_decade=0.005),
        lambda: baseline_walk(np.array([3, 2]), 1, step_T=1e-7, rng=rng_for(0, "wear")),
    ],
)
def test_invalid_contact_counts_are_refused(of):
    with pytest.raises(ParamsError, match="contact count"):
        of()


def test_wear_that_leaves_no_stiffness_is_refused():
    with pytest.raises(ParamsError, match="remaining force"):
        softening(np.array([10_000]), settling=0.99, ageing=0.1)


TEMPERATURE = Temperature(warming_K=4.0, warming_s=100.0, swing_K=0.0, swing_s=600.0, chip_sensitivity_per_K=0.0)


def test_field_of_3_mT_changes_by_3_6_uT_per_kelvin():
    np.testing.assert_allclose(
        3e-3 * (relative_remanence(np.array([-1.0, 0.0, 1.0])) - 1), [3.6e-6, 0.0, -3.6e-6], atol=1e-18
    )


def test_board_warms_up_exponentially():
    np.testing.assert_allclose(
        temperature_rise_K(np.array([0.0, 100.0, 1e5]), TEMPERATURE), [0.0, 4 * (1 - np.exp(-1)), 4.0]
    )


@given(st.floats(0, 1e5))
def test_oscillation_of_the_room_temperature_is_added_to_the_warming(time_s):
    room = TEMPERATURE.model_copy(update={"swing_K": 2.0})
    # The temperature is given as the rise since the start, so it is zero at the start.
    assert temperature_rise_K(np.zeros(1), room) == 0
    # In the first half of the oscillation, the room is warmer.
    assert temperature_rise_K(np.array([150.0]), room) > temperature_rise_K(np.array([150.0]), TEMPERATURE)
    # The two times are half a period apart, so the oscillation has opposite signs.
    time = np.array([time_s, time_s + 300.0])
    swing_K = temperature_rise_K(time, room) - temperature_rise_K(time, TEMPERATURE)
    assert swing_K.sum() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(swing_K).max() <= 2.0
