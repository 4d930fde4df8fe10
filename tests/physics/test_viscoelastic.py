"""Relaxation: mpmath, a closed form and fine integration as truth; no time, splitting and linearity as laws."""

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import ParamsError
from pipeline.physics.viscoelastic import SKIN, Prony, Relaxation, advance, force_left, relax

ROUNDING = 1e-14  # a few dozen operations on doubles
times_s = st.floats(0, 1e5)
changes = st.floats(-10, 10)


def in_50_digits(state, change, dt_s, prony):
    with mpmath.workdps(50):
        new = []
        for q, tau, share in zip(state, prony.tau_s, prony.share, strict=True):
            x = mpmath.mpf(dt_s) / mpmath.mpf(tau)
            mean = (1 - mpmath.exp(-x)) / x
            new.append(float(mpmath.exp(-x) * mpmath.mpf(q) + mpmath.mpf(share) * mpmath.mpf(change) * mean))
    return np.array(new)


@pytest.mark.parametrize("ratio", [1e3, 1e4, 1e5, 1e6, 1e7, 1e8])
@pytest.mark.parametrize("dt_over_fastest", [1e-16, 1e-9, 1e-3, 1.0, 40.0, 1e8])
def test_one_step_is_that_of_50_digits_however_stiff(ratio, dt_over_fastest):
    prony = Prony(np.array([1e-3, 1e-3 * np.sqrt(ratio), 1e-3 * ratio]), np.array([0.3, 0.2, 0.1]))
    state, dt_s = np.array([0.7, -0.2, 0.4]), 1e-3 * dt_over_fastest
    truth = in_50_digits(state, 1.3, dt_s, prony)
    np.testing.assert_allclose(advance(state, 1.3, dt_s, prony), truth, rtol=ROUNDING, atol=1e-300)


def test_twenty_pokes_over_30_s_are_those_of_50_digits():
    time_s = np.sort(np.concatenate([np.arange(20) * 1.5, np.arange(20) * 1.5 + 0.3, np.arange(20) * 1.5 + 1.0]))
    elastic = np.tile([0.0, 2.0, 2.0], 20)
    state, truth = np.zeros(5), []
    for dt_s, change, now in zip(np.diff(time_s), np.diff(elastic), elastic[1:], strict=True):
        state = in_50_digits(state, change, dt_s, SKIN)
        truth.append((1 - SKIN.share.sum()) * now + state.sum())
    np.testing.assert_allclose(relax(time_s, elastic, SKIN)[1:], truth, rtol=1e-13)  # 60 steps add up


def test_a_step_that_is_held_relaxes_as_the_relaxation_function_says():
    time_s = np.geomspace(1e-5, 1e6, 200) - 1e-5
    truth = 3.0 * (1 - (SKIN.share * -np.expm1(-time_s[:, None] / SKIN.tau_s)).sum(axis=1))
    np.testing.assert_allclose(relax(time_s, np.full(200, 3.0), SKIN), truth, rtol=1e-13)


def test_no_time_and_no_change_leave_the_state_bit_for_bit():
    state = np.array([1 / 3, -2e-308, 7e15, 0.0, -0.1])
    assert advance(state, 0.0, 0.0, SKIN).tobytes() == state.tobytes()


@given(changes)
def test_a_jump_without_time_is_felt_in_full(change):
    np.testing.assert_array_equal(advance(np.zeros(5), change, 0.0, SKIN), SKIN.share * change)


@given(times_s, times_s, changes)
def test_a_ramp_may_be_cut_anywhere(first_s, second_s, rate):
    whole = advance(np.ones(5), rate * (first_s + second_s), first_s + second_s, SKIN)
    halfway = advance(np.ones(5), rate * first_s, first_s, SKIN)
    size = 1 + abs(rate) * (first_s + second_s)
    np.testing.assert_allclose(advance(halfway, rate * second_s, second_s, SKIN), whole, atol=ROUNDING * size)


@given(times_s, changes, st.floats(-3, 3))
def test_force_with_memory_is_linear_in_the_elastic_one(dt_s, change, factor):
    once = advance(np.zeros(5), change, dt_s, SKIN)
    np.testing.assert_allclose(advance(np.zeros(5), factor * change, dt_s, SKIN), factor * once, atol=ROUNDING * 30)


def test_a_held_skin_only_loses_force_and_keeps_what_the_shares_leave():
    relaxed = relax(np.linspace(0, 1e6, 1000), np.ones(1000), SKIN)
    assert (np.diff(relaxed) <= ROUNDING).all()
    assert relaxed[0] == pytest.approx(1, abs=ROUNDING)
    assert relaxed[-1] == pytest.approx(1 - SKIN.share.sum(), abs=1e-12)


@pytest.mark.parametrize("dt_s", [-1e-9, np.nan, np.inf])
def test_time_that_runs_backwards_or_is_no_number_is_refused(dt_s):
    with pytest.raises(ParamsError, match="time step"):
        advance(np.zeros(5), 1.0, dt_s, SKIN)
    with pytest.raises(ParamsError, match="time step"):
        relax(np.array([0.0, dt_s]), np.zeros(2), SKIN)


@pytest.mark.parametrize(("tau_s", "share"), [(0.0, 0.1), (-1.0, 0.1), (np.nan, 0.1), (1.0, -0.1), (1.0, 1.1)])
def test_impossible_relaxation_is_refused(tau_s, share):
    with pytest.raises(ParamsError, match="prony"):
        Prony(np.array([tau_s]), np.array([share]))


def test_an_indentation_is_read_after_the_tip_went_down_and_held():
    jump, slow = Relaxation(approach_s=0.0, hold_s=5.0), Relaxation(approach_s=5.0, hold_s=0.0)
    truth = 1 - (SKIN.share * -np.expm1(-5.0 / SKIN.tau_s)).sum()
    assert force_left(jump) == pytest.approx(truth, rel=1e-12)
    # While it went down, each part of the force had less time: by the mean of the decay over the approach.
    x = 5.0 / SKIN.tau_s
    assert force_left(slow) == pytest.approx(1 - (SKIN.share * (1 + np.expm1(-x) / x)).sum(), rel=1e-12)
