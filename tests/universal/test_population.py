"""Tests that random simulated skins are reproducible, and that their parameters follow the prior."""

from dataclasses import fields, replace

import numpy as np
import pytest

from reskin.seeds import rng_for
from reskin.universal import population
from reskin.universal.law import COARSE as COARSE_RULE
from reskin.universal.law import at_rest_uT, inside, simulate_uT
from reskin.universal.layout import paper_layout
from reskin.universal.population import (
    LEAST,
    NOMINAL,
    NOMINAL_SPREADS,
    PLACES_N,
    draw_gains,
    draw_law,
    draw_places,
    draw_population,
    fill,
    grid,
)

SETUP = paper_layout().setup()
FORCES = paper_layout().forces
COARSE = replace(SETUP, rule=COARSE_RULE)


def test_drawn_skins_do_not_depend_on_how_many_are_drawn(monkeypatch):
    # Only one thickness and one tip are simulated, because the tables for each combination take seconds.
    monkeypatch.setattr(population, "THICKNESSES", {1.0: 1.0})
    monkeypatch.setattr(population, "TIPS", {1.0: 1.0})
    one, two = (draw_population(NOMINAL, NOMINAL_SPREADS, SETUP, n, rng_for(0, "skins"), FORCES) for n in (1, 2))
    for field in fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name)[:1])
    assert not np.allclose(two.rest_uT[0], two.rest_uT[1])
    # In its second session, a skin slides differently, so its presses change the field differently.
    lengths = [np.linalg.norm(one.db_uT[0, first] - one.db_uT[0, second]) for first, second in ((0, 0), (0, 1))]
    assert lengths[0] == 0 < lengths[1] < np.linalg.norm(one.db_uT[0, 0])


def test_drawn_parameters_have_the_given_spreads_and_bounds():
    rng = rng_for(1, "laws")
    laws = [draw_law(NOMINAL, NOMINAL_SPREADS, rng) for _ in range(300)]
    for name in ("seat_x_mm", "label_y_mm", "tilt_x_deg", "give_x_um"):
        # The tolerance of 16 % is four standard errors: the standard deviation of 300 draws has a standard error of 4
        # %.
        assert np.std([getattr(law, name) for law in laws]) == pytest.approx(NOMINAL_SPREADS[name], rel=0.16)
    for name, least in LEAST.items():
        assert min(getattr(law, name) for law in laws) >= least
    gap_mm, log = np.array([law.gap_mm for law in laws]), np.log([law.amplitude for law in laws])
    assert np.polyfit(gap_mm, log, 1)[0] == pytest.approx(population.LOG_AMPLITUDE_PER_MM, abs=0.15)


def test_presses_cover_the_grid_and_stay_on_the_skin():
    place_mm = draw_places(rng_for(2, "places"), SETUP.area)
    assert place_mm.shape == (2 * PLACES_N, 2)
    assert inside(place_mm, SETUP.area).all()
    # Places are points of the grid with a random offset. The limit is six standard deviations of this offset.
    grid_mm = grid(SETUP.area)
    assert np.abs(place_mm[:PLACES_N] - grid_mm).max() < 0.3
    assert len(np.unique(grid_mm, axis=0)) == PLACES_N
    assert inside(grid_mm, SETUP.area).all()


def test_fields_are_proportional_to_the_density_of_filler_which_varies_along_the_skin(monkeypatch):
    place_mm, force_N = np.array([[1.0, 2.0]]), np.array([3.0])
    twice = replace(COARSE.rest, moments_A_m2=2 * COARSE.rest.moments_A_m2)
    plain_uT = simulate_uT(NOMINAL, COARSE, place_mm, force_N)
    np.testing.assert_allclose(simulate_uT(NOMINAL, COARSE, place_mm, force_N, twice), 2 * plain_uT, rtol=1e-9)
    np.testing.assert_allclose(at_rest_uT(NOMINAL, COARSE, twice), 2 * at_rest_uT(NOMINAL, COARSE), rtol=1e-9)
    filled = fill(COARSE.rest, rng_for(3, "filler"))
    part = np.linalg.norm(filled.moments_A_m2, axis=1) / np.linalg.norm(COARSE.rest.moments_A_m2, axis=1)
    # The standard deviation is 0.15 on the average over many skins. A single skin is only about six correlation lengths
    # wide, so its standard deviation can be far from the average.
    assert 0.05 < np.std(np.log(part)) < 0.3


def test_errors_of_chip_gains_are_small_with_the_given_spread():
    gain = draw_gains(2000, rng_for(4, "gains"))
    np.testing.assert_allclose(gain.mean(axis=0), np.eye(3), atol=0.005)
    turn = np.deg2rad(population.CHIP_TURN_DEG)
    assert gain[:, 0, 1].std() == pytest.approx(np.hypot(turn, population.CROSS_SD), rel=0.1)
