"""Tests of the superposition error.

This is the difference between the sum of the field changes of two contacts and the field change of both at once.
"""

import numpy as np
import pytest

from pipeline.experiments import contacts as module
from pipeline.experiments.contacts import press_on, superposition
from reskin.physics.board import draw_board
from reskin.physics.magnet import change_of_field
from reskin.physics.skin import draw_skin, moved_dipoles
from tests.simulation.scene import synthesis

SCENE = synthesis()
BOARD = draw_board(SCENE.main_boards.design, SCENE.spreads, seed=1, name="b0")
SKIN = draw_skin(SCENE.skin, SCENE.spreads, seed=1, name="b0_s0", rule=SCENE.main_boards.quadrature.in_si())
REST = SKIN.nodes_m, SKIN.moments_A_m2
DEPTH_M = 0.6e-3


@pytest.fixture(autouse=True, scope="module")
def few_heights():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "HEIGHTS_N", 5)
        yield


def pressed_T(*pokes_m):
    dipoles = REST
    for poke_m in pokes_m:
        dipoles = press_on(SKIN, dipoles, np.array(poke_m))
    return change_of_field(REST, dipoles, BOARD.chips_m)


def rms(values):
    return np.sqrt((values**2).mean())


def test_field_change_of_a_single_contact_equals_that_of_the_simulator():
    poke_m = np.array([[2e-3, -3e-3, DEPTH_M]])
    ((_, before, after),) = moved_dipoles(SKIN, poke_m - [0, 0, SKIN.depth_zero_m])
    theirs_T = change_of_field(before, after, BOARD.chips_m)
    # The tolerance is the error of interpolation: 1 % between the five heights used here, and 0.3 % between the nine
    # heights of the experiment.
    assert rms(pressed_T(poke_m[0]) - theirs_T) < 0.02 * rms(theirs_T)


def test_superposition_error_falls_with_distance_and_rises_with_depth():
    rows = {
        (row["depth_mm"], row["separation_mm"]): row["error_pct"] for row in superposition(SCENE, (4.0, 12.0), seed=1)
    }
    assert sorted(rows) == [(0.6, 4), (0.6, 12), (1.2, 4), (1.2, 12)]
    # The error is a product of the displacements by the two contacts, so it is quadratic in the depth. Relative to the
    # field change, which is linear in the depth, the error is therefore proportional to the depth.
    for separation_mm in (4, 12):
        assert rows[0.6, separation_mm] < 0.7 * rows[1.2, separation_mm]
    for depth_mm in (0.6, 1.2):
        assert 0 < rows[depth_mm, 12] < rows[depth_mm, 4]


def test_field_of_two_distant_contacts_is_nearly_the_sum_of_both_fields():
    a_m, b_m = (-5e-3, 0, DEPTH_M), (5e-3, 1e-3, DEPTH_M)
    together_T = pressed_T(a_m, b_m)
    for one_m in (a_m, b_m):
        assert rms(together_T - pressed_T(one_m)) > 0.3 * rms(together_T)
    assert rms(together_T - pressed_T(a_m) - pressed_T(b_m)) < 0.1 * rms(together_T)


def test_moments_rotated_by_two_contacts_keep_their_length():
    _, moments = press_on(SKIN, press_on(SKIN, REST, np.array([0, 0, DEPTH_M])), np.array([3e-3, 0, DEPTH_M]))
    length, before = (np.linalg.norm(vectors, axis=1) for vectors in (moments, SKIN.moments_A_m2))
    # The interpolation between two rotated vectors follows a chord instead of an arc, so its result is too short by up
    # to the squared angle divided by 8. The tolerance allows for this.
    np.testing.assert_allclose(length, before, rtol=0.05)
