"""Tests of the script that fits the settings of the simulated skin to recorded boards."""

from dataclasses import replace

import numpy as np
import pytest

from tests.fitting.recorded import AXES, TRUE, simulated_presses
from tools import fit_skin


def test_fit_finds_the_slide_and_the_amplitude_of_a_simulated_board(monkeypatch):
    monkeypatch.setattr(fit_skin, "FITS", {"linear": fit_skin.FITS["linear"]})
    true = replace(TRUE, stiffening=0.0, modulus_MPa=0.4, gap_mm=AXES.start.gap_mm, lets_go_N=6.0)
    (found,) = fit_skin.fit_board(AXES.align(simulated_presses(true)), AXES, draws_n=0)
    assert found["presses_n"] == 50
    assert found["cosine"] > 0.99
    assert found["away_um_mm"] == pytest.approx(true.away_um_mm, abs=0.7)
    assert (found["give_x_um"], found["give_y_um"]) == pytest.approx((true.give_x_um, true.give_y_um), abs=4)
    assert found["amplitude"] == pytest.approx(true.amplitude, rel=0.05)


def test_places_are_resampled_with_all_of_their_presses():
    presses = AXES.align(simulated_presses())
    (drawn,) = fit_skin.resamples(presses, 1, seed=0)
    assert len(drawn.recorded) == len(presses.recorded)
    soft, hard = (drawn.place_mm[drawn.recorded.group_i == group] for group in (0, 1))
    np.testing.assert_array_equal(soft, hard)
    assert len(np.unique(soft, axis=0)) < len(soft)
