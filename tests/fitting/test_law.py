"""Tests of the law of a skin: fits recover the parameters of simulated skins, and limits and symmetries hold."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from pipeline.fitting import law_fit
from pipeline.fitting.frames import quarter_turn
from reskin.physics import layer
from reskin.universal import law
from tests.fitting.recorded import AXES, SETUP, TRUE, simulated_presses

# The tolerances are the errors of a fit to 50 presses with 3 uT of noise. The tolerances of gap and amplitude are
# large, because an error of the gap can be compensated by an error of the amplitude.
TOLERANCES = law.Law(0.05, 0.05, 0.0, 0.15, 0.3, 0.1, 0.1, 0.03, 0.6, 3.0, 3.0)


def test_fit_recovers_the_parameters_of_a_simulated_skin():
    fitted = asdict(law_fit.fit(AXES.align(simulated_presses()), SETUP, law_fit.TEN, AXES.start))
    for name, true in asdict(TRUE).items():
        assert fitted[name] == pytest.approx(true, abs=asdict(TOLERANCES)[name]), name


def test_second_fit_for_a_single_board_changes_only_the_parameters_of_this_board():
    start = replace(AXES.start, modulus_MPa=0.25, away_um_mm=6.0, give_x_um=40.0, give_y_um=10.0)
    presses = AXES.align(simulated_presses(replace(TRUE, rotation_deg=2.0)))
    fitted = law_fit.fit(presses, SETUP, law_fit.SEVEN, AXES.start, start)
    assert fitted.rotation_deg == pytest.approx(2.0, abs=0.3)
    assert (fitted.seat_x_mm, fitted.seat_y_mm) == pytest.approx((0.4, -0.3), abs=0.05)
    assert [getattr(fitted, name) for name in law_fit.TEN[6:]] == [0.25, 6.0, 40.0, 10.0]


def test_flipped_checkerboard_skin_equals_the_skin_rotated_by_a_quarter_turn():
    plain, flipped = (replace(SETUP, skin_flipped=is_flipped).rest for is_flipped in (False, True))
    turn = quarter_turn(1)
    moments_by_node = {
        tuple(np.round(node * 1e6).astype(int)): moment
        for node, moment in zip(plain.nodes_m, plain.moments_A_m2, strict=True)
    }
    for node, moment in zip(flipped.nodes_m[::97], flipped.moments_A_m2[::97], strict=True):
        before = moments_by_node[tuple(np.round(turn.T @ node * 1e6).astype(int))]
        np.testing.assert_allclose(turn @ before, moment, atol=1e-6 * np.abs(plain.moments_A_m2).max())


def test_presses_deeper_than_the_greatest_depth_get_the_field_of_this_depth():
    deepest_m = np.array([0.72e-3 * SETUP.design.thickness_mm])
    layer_settings = {"modulus_Pa": 1e6 * TRUE.modulus_MPa, "thickness_m": SETUP.thickness_m, "tip_radius_m": 2e-3}
    (deepest_N,) = layer.force(deepest_m, **layer_settings, base="bonded") * 0.28**-TRUE.stiffening
    force_N = deepest_N * np.array([0.5, 0.999, 1.001, 3.0])
    assert law.beyond_n(TRUE, SETUP, force_N) == 2
    # The skin does not slide here, because the slide would change the field with the force even at a constant depth.
    without_slide = replace(TRUE, away_um_mm=0.0)
    held_uT = law.simulate_uT(without_slide, SETUP, np.zeros((4, 2)), force_N)
    # A skin with half the modulus is indented as deeply by half the force.
    soft = replace(TRUE, modulus_MPa=TRUE.modulus_MPa / 2)
    assert law.beyond_n(soft, SETUP, force_N[1:]) == 3
    np.testing.assert_allclose(held_uT[2], held_uT[3])
