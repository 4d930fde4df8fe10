"""Tests of the contact response against the formulas of its optional terms, such as ageing.

Without optional terms, all contacts must be equal.
"""

import numpy as np
import pytest

from reskin.physics.aging import Ageing, Relaxation, relaxed_share
from reskin.physics.board import draw_board
from reskin.physics.shear import Friction
from reskin.physics.skin import changes_of_field, draw_skin, forces
from reskin.seeds import rng_for
from reskin.simulation.contact import Terms, simulate_response
from tests.simulation.scene import synthesis

SETTINGS = synthesis()
BOARD = draw_board(SETTINGS.boards["rigid"].design, SETTINGS.spreads, seed=1, name="b0")
SKIN = draw_skin(
    SETTINGS.skin, SETTINGS.spreads, seed=1, name="b0_s0", rule=SETTINGS.boards["rigid"].quadrature.in_si()
)
TIP_M = np.tile([[[1e-3, 2e-3, 0.8e-3]]], (200, 1, 1))


@pytest.fixture(scope="module")
def first() -> tuple[np.ndarray, np.ndarray]:
    """Return the field at rest and the field change of the first contact, in T, at the chips."""
    rest_T, change_T = changes_of_field(BOARD, SKIN, TIP_M[0])
    return rest_T, change_T[0]


def response(tilt=0.0, **terms):
    lean = np.tile([tilt, 0.0], (len(TIP_M), 1))
    return simulate_response(BOARD, SKIN, TIP_M, tilt=lean, terms=Terms(**terms), rng=rng_for(0, "felt"))


def test_all_contacts_are_equal_without_optional_physics_terms(first):
    one, (rest_T, change_T) = response(), first
    np.testing.assert_array_equal(one.rest_T, np.tile(rest_T, (200, 1, 1)))
    np.testing.assert_array_equal(one.change_T[:, 0], np.tile(change_T, (200, 1, 1)))
    np.testing.assert_allclose(one.force_N[:, 0, 2], forces(SKIN, np.array([0.8e-3]))[0])
    assert not one.force_N[:, :, :2].any()


def test_field_fades_by_the_given_fraction_per_decade_of_contacts(first):
    one = response(ageing=Ageing(settling=0.0, ageing=0.0, fading_per_decade=0.02, wandering_uT=0.0))
    # The number of decades after 100 contacts is log10(1 + 99) = 2.
    np.testing.assert_allclose(one.rest_T[99], (1 - 0.02 * 2) * first[0], rtol=1e-12)


def test_softening_and_relaxation_reduce_all_components_of_the_force():
    ageing, slack = Ageing(settling=0.2, ageing=0.0, fading_per_decade=0.0, wandering_uT=0.0), (0.1, 2.0)
    relaxation = Relaxation(approach_s=slack[0], hold_s=slack[1])
    plain = response(tilt=0.1, friction=Friction(coefficient=0.8))
    worn = response(tilt=0.1, friction=Friction(coefficient=0.8), ageing=ageing, relaxation=relaxation)
    left = (1 - 0.2 * -np.expm1(-199 / 300)) * relaxed_share(relaxation)
    np.testing.assert_allclose(worn.force_N[199], left * plain.force_N[199], rtol=1e-12)


@pytest.mark.parametrize(("depth_mm", "deep"), [(0.5, False), (1.4, True)])
def test_presses_deeper_than_the_verified_depth_are_counted(depth_mm, deep):
    tip_m = np.array([[[0.0, 0.0, depth_mm * 1e-3]]])
    one = simulate_response(BOARD, SKIN, tip_m, tilt=np.zeros((1, 2)), terms=Terms(), rng=rng_for(0, "felt"))
    assert one.beyond_verified_n == deep
