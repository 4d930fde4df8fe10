"""Tests that the tables contain the simulated fields, and the slopes of the fields with respect to each parameter."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from reskin.universal import map
from reskin.universal.law import simulate_uT
from reskin.universal.map import LOGARITHMIC, NOMINAL, NOMINAL_SPREADS, RIG_SPREADS, STEP, mean_law, perturb, tabulate
from tests.universal.skins import SETUP


def test_tables_equal_simulated_fields_and_slopes(monkeypatch):
    monkeypatch.setattr(map, "lattice_mm", lambda _: np.array([-4.0, 1.0]))
    found = tabulate(NOMINAL, {"amplitude": 0.2, "label_x_mm": 0.5}, SETUP)
    at_mm = np.array([[-4.0, 1.0]])
    for i, force_N in enumerate(found.force_N):
        there_uT = simulate_uT(NOMINAL, SETUP, at_mm, np.array([force_N])).ravel()
        np.testing.assert_allclose(found.mean_uT[0, 1, i], there_uT, rtol=1e-9)
        moved_uT = simulate_uT(NOMINAL, SETUP, at_mm + [STEP * 0.5, 0], np.array([force_N])).ravel()
        np.testing.assert_allclose(found.slope_uT[0, 1, i, :, 1], (moved_uT - there_uT) / STEP, rtol=1e-9, atol=1e-9)
    # This is the expected slope with respect to the amplitude. Fields are proportional to the amplitude, and its spread
    # is that of the logarithm. Therefore the relative finite difference for a step is exp(STEP * spread) - 1, divided
    # by STEP.
    grown = (np.exp(STEP * 0.2) - 1) / STEP
    np.testing.assert_allclose(found.slope_uT[..., 0], grown * found.mean_uT, rtol=1e-9)
    np.testing.assert_allclose(found.rest_slope_uT, np.outer(found.rest_uT, [grown, 0]), rtol=1e-9, atol=1e-9)


def test_mean_law_has_mean_parameters_of_boards_and_the_designed_seat():
    """The seat (the position of the skin on the board) is random on each board, so its mean is not used."""
    weak, strong = replace(NOMINAL, amplitude=1.0, seat_x_mm=0.4), replace(NOMINAL, amplitude=4.0, gap_mm=2.0)
    found = mean_law([weak, strong])
    assert (found.amplitude, found.gap_mm) == pytest.approx((2.0, 1.8))
    assert (found.seat_x_mm, found.seat_y_mm, found.rotation_deg) == (0, 0, 0)


@pytest.mark.parametrize("spreads", [RIG_SPREADS, NOMINAL_SPREADS])
def test_perturbing_a_parameter_forward_and_back_restores_it(spreads):
    assert set(spreads) <= set(asdict(NOMINAL))
    assert set(LOGARITHMIC) <= set(spreads)
    for name, spread in spreads.items():
        back = perturb(perturb(NOMINAL, name, spread), name, -spread)
        assert getattr(back, name) == pytest.approx(getattr(NOMINAL, name))
