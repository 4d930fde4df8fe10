"""Tests of the field of an iron ball against magpylib's sphere, boundary conditions and laws of magnetostatics.

The ball is magnetised by the earth's field and by the skin, and its field disturbs the readings. Other tests compare
changes of readings in ambient fields with simulated chips, and with the estimate of a reference chip.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from magpylib.core import magnet_sphere_Bfield

from reskin.physics import magnet
from reskin.physics.ambient import (
    EARTH_SIZE_T,
    EARTH_T,
    ball_field,
    ball_images,
    draw_instrument,
    random_directions,
    readings_uT,
    reference_uT,
)
from reskin.physics.board import Spreads
from reskin.physics.chip import ChipDesign, read_field, steps_uT
from reskin.seeds import rng_for
from tests.simulation.scene import SECTIONS, synthesis

RADIUS_M = 5e-3
CENTRE_M = np.array([1e-3, -2e-3, 12e-3])
B_T = np.array([20e-6, 10e-6, -45e-6])
ROUNDING = 1e-10  # This is the relative rounding error of a difference between places that are a few mm apart.
MU_R = st.floats(1.0, 1e5)
NEAR = np.array([[3e-3, 1e-3, 2e-3], [-4e-3, -1e-3, 4e-3]]), np.array([[0.0, 1e-3, 5e-3], [2e-3, 0.0, -1e-3]])


def on_sphere(radius_m, n=40):
    return CENTRE_M + radius_m * random_directions(n, rng_for(0, "sphere"))


def field(observers_m, b_T=B_T, mu_r=1000.0):
    return ball_field(observers_m, b_T, centre_m=CENTRE_M, radius_m=RADIUS_M, mu_r=mu_r)


def images(observers_m, dipoles=NEAR):
    return ball_images(observers_m, dipoles, centre_m=CENTRE_M, radius_m=RADIUS_M)


def outward(observers_m):
    away = observers_m - CENTRE_M
    return away / np.linalg.norm(away, axis=1, keepdims=True)


@given(MU_R)
def test_field_outside_equals_magpylib_sphere(mu_r):
    observers_m = on_sphere(1.7 * RADIUS_M)
    polarisation_T = np.tile(3 * (mu_r - 1) / (mu_r + 2) * B_T, (len(observers_m), 1))
    diameters_m = np.full(len(observers_m), 2 * RADIUS_M)
    theirs_T = magnet_sphere_Bfield(
        observers=observers_m - CENTRE_M, diameters=diameters_m, polarizations=polarisation_T
    )
    # The tolerances are rounding errors of fields of 50 uT.
    np.testing.assert_allclose(field(observers_m, mu_r=mu_r), theirs_T, rtol=1e-9, atol=1e-18)


@given(MU_R)
def test_fields_satisfy_the_boundary_conditions_on_the_surface_of_the_ball(mu_r):
    observers_m = on_sphere(RADIUS_M)
    normal = outward(observers_m)
    outside_T, inside_T = B_T + field(observers_m, mu_r=mu_r), 3 * mu_r / (mu_r + 2) * B_T
    np.testing.assert_allclose((outside_T * normal).sum(1), normal @ inside_T, rtol=0, atol=ROUNDING * 1e-4)
    h_outside, h_inside = np.cross(outside_T, normal), np.cross(inside_T / mu_r, normal)
    np.testing.assert_allclose(h_outside, h_inside, rtol=0, atol=ROUNDING * 1e-4)


def test_field_of_dipoles_and_their_images_is_perpendicular_to_the_surface_of_iron():
    observers_m = on_sphere(RADIUS_M)
    together_T = magnet.field(*NEAR, observers_m) + images(observers_m)
    sideways_T = np.cross(together_T, outward(observers_m))
    # The component along the surface is zero, except for rounding.
    assert np.abs(sideways_T).max() < 1e-9 * np.abs(together_T).max()
    without_T = np.cross(magnet.field(*NEAR, observers_m), outward(observers_m))
    # Without the ball, the field has a component along the surface. If it had none, the assertion above would also hold
    # without the ball.
    assert np.abs(without_T).max() > 0.1 * np.abs(together_T).max()


def test_earth_field_has_the_given_magnitude_and_points_down():
    assert np.linalg.norm(EARTH_T) == pytest.approx(EARTH_SIZE_T)
    assert EARTH_T[2] < 0 < EARTH_T[0]


# --- Readings in ambient fields ---

SCENE = synthesis()
DESIGN, CHIP = SCENE.main_boards.design, ChipDesign(gain_sel=6, noise_xy_uT=0, noise_z_uT=0, noise_temperature_degC=0)
NO_SPREAD = Spreads(
    **{name: 0.0 for name in SECTIONS["spreads"] if name != "skin_filler_length_mm"}, skin_filler_length_mm=3
)
fields_T = st.tuples(*[st.floats(-1e-4, 1e-4)] * 3).map(np.array)


@given(fields_T)
def test_uniform_field_changes_readings_as_it_changes_those_of_simulated_chips(b_T):
    board = draw_instrument(DESIGN, SCENE.spreads, CHIP, seed=1, name="b0").board
    at_chips_T = np.tile(b_T, (1, 5, 1))
    at_rest_uT, with_field_uT = (
        read_field(b_T, board, design=CHIP, rng=rng_for(0, "x"))[0] for b_T in (0 * at_chips_T, at_chips_T)
    )
    # Each reading is rounded by at most half a step, so a difference of two readings is off by at most one step.
    change_uT = readings_uT(board, at_chips_T)
    assert np.abs((with_field_uT - at_rest_uT) - change_uT).max() <= steps_uT(6).max() * 1.001


@given(fields_T)
def test_reference_chip_without_errors_measures_a_uniform_field_at_every_chip(b_T):
    perfect = draw_instrument(DESIGN, NO_SPREAD, CHIP, seed=1, name="b0")
    added_uT = readings_uT(perfect.board, np.tile(b_T, (1, 5, 1)))
    np.testing.assert_allclose(reference_uT(perfect, b_T[None], rng_for(0, "silent")), added_uT, rtol=0, atol=1e-9)
