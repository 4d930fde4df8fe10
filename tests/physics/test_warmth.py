"""Warmth: the published slope as truth, start and end of warming up as laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.physics.aging import Temperature, remanence, warmer_K

HOW = Temperature(warming_K=4.0, warming_s=100.0, swing_K=0.0, swing_s=600.0, chip_sensitivity_per_K=0.0)


def test_warmth_takes_3_6_uT_off_3_mT_for_each_kelvin():
    np.testing.assert_allclose(3e-3 * (remanence(np.array([-1.0, 0.0, 1.0])) - 1), [3.6e-6, 0.0, -3.6e-6], atol=1e-18)


def test_a_board_warms_up_from_nothing_to_all_of_it():
    np.testing.assert_allclose(warmer_K(np.array([0.0, 100.0, 1e5]), HOW), [0.0, 4 * (1 - np.exp(-1)), 4.0])


@given(st.floats(0, 1e5))
def test_the_room_goes_up_and_down_about_the_warming(time_s):
    room = HOW.model_copy(update={"swing_K": 2.0})
    assert warmer_K(np.zeros(1), room) == 0  # at the start it is as warm as at the start
    assert warmer_K(np.array([150.0]), room) > warmer_K(np.array([150.0]), HOW)  # and then warms up first
    time = np.array([time_s, time_s + 300.0])  # half a period apart
    swing_K = warmer_K(time, room) - warmer_K(time, HOW)
    assert swing_K.sum() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(swing_K).max() <= 2.0
