"""Tests of the inversion of the law (the formula that gives the field change for a place and a force).

The inversion recovers presses and parameters, and readings that are not presses have large residuals.
"""

from dataclasses import asdict, replace

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal import inversion
from reskin.universal.inversion import LEAST, PARAMETERS, STEP_MM, _JointFit, chart, fit_unlabelled, search
from reskin.universal.law import COARSE, at_rest_uT, simulate_uT
from reskin.universal.map import NOMINAL, lattice_mm
from tests.universal.skins import SETUP

COARSE_SETUP = replace(SETUP, rule=COARSE)
TRUE = replace(NOMINAL, seat_x_mm=0.5, seat_y_mm=-0.4, amplitude=1.8, gap_mm=1.75, give_x_um=40.0)
PLACE_MM = np.stack(np.meshgrid([-2.0, -0.5, 1.1, 2.4], [-2.2, -0.7, 0.6, 2.1]), axis=-1).reshape(-1, 2)
FORCE_N = np.exp(rng_for(0, "inversion").uniform(np.log(0.8), np.log(6.0), len(PLACE_MM)))


@pytest.fixture(autouse=True)
def small_lattice(monkeypatch):
    # To save time, the search covers only places within 2.8 mm of the middle.
    monkeypatch.setattr(inversion, "lattice_mm", lambda: lattice_mm()[7:15])


def fields_uT() -> np.ndarray:
    return simulate_uT(TRUE, COARSE_SETUP, PLACE_MM, FORCE_N).reshape(len(PLACE_MM), -1)


def test_search_recovers_places_and_forces_of_simulated_presses():
    found = search(chart(TRUE, COARSE_SETUP), fields_uT())
    # The tolerance is a quarter of the lattice's pitch. The search takes a single step from the nearest lattice point,
    # with the slopes at this point, so it is not exact between lattice points.
    np.testing.assert_allclose(found.place_mm, PLACE_MM, atol=0.2)
    np.testing.assert_allclose(np.log(found.force_N), np.log(FORCE_N), atol=0.2)
    assert found.residual.max() < 0.1


def test_residual_is_zero_for_simulated_presses_at_lattice_points():
    known = chart(TRUE, COARSE_SETUP)
    found = search(known, known.field_uT)
    np.testing.assert_allclose(found.place_mm, known.place_mm, atol=1e-9)
    np.testing.assert_allclose(found.residual, 0.0, atol=1e-9)
    assert np.median(search(known, -fields_uT()).residual) > 0.5


def test_slopes_of_residuals_equal_finite_differences():
    two = _JointFit(TRUE, COARSE_SETUP, fields_uT()[:2], at_rest_uT(TRUE, COARSE_SETUP).ravel())
    presses = np.column_stack([PLACE_MM[:2], np.log(FORCE_N[:2])]) + 0.2
    values = np.concatenate([[asdict(TRUE)[name] for name in PARAMETERS], presses.ravel()])
    columns = two.slopes(values)
    # i is the index of a parameter of the law, then of x of the first press, then of y of the second press.
    for i in (0, len(PARAMETERS), len(PARAMETERS) + 4):
        change = (np.arange(len(values)) == i) * (STEP_MM if i else 0.1 * inversion.STEP.seat_x_mm)
        expected = (two.residuals(values + change) - two.residuals(values)) / change.max()
        np.testing.assert_allclose(columns[:, i], expected, rtol=1e-6, atol=1e-9)


def test_unlabelled_presses_determine_the_parameters_of_the_law(monkeypatch):
    monkeypatch.setattr(inversion, "ROUNDS_N", 1)
    rest_uT, presses_uT = at_rest_uT(TRUE, COARSE_SETUP).ravel(), fields_uT()[::2]
    found = fit_unlabelled(presses_uT, rest_uT, COARSE_SETUP)
    left = [np.median(search(chart(law, COARSE_SETUP), presses_uT).residual) for law in (NOMINAL, found)]
    assert left[1] < 0.3 * left[0]
    for name, near in {"seat_x_mm": 0.15, "seat_y_mm": 0.15, "give_x_um": 15.0}.items():
        assert abs(asdict(found)[name] - asdict(TRUE)[name]) < near
    assert all(asdict(found)[name] > least for name, least in LEAST.items())
    noload_only = fit_unlabelled(presses_uT[:0], rest_uT, COARSE_SETUP)
    assert noload_only.seat_x_mm == pytest.approx(TRUE.seat_x_mm, abs=0.15)
    assert noload_only.give_x_um == NOMINAL.give_x_um
