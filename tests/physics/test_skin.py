"""The change of field under a poke: a naive loop as truth; symmetry, no contact, amplitude and names as laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import ParamsError
from pipeline.physics import layer
from pipeline.physics.board import Board
from pipeline.physics.dipole import MU0_4PI
from pipeline.physics.skin import SkinDesign, changes_of_field, draw_skin, forces
from tests.physics.test_board import design as board_design
from tests.physics.test_board import draw_board, no_spread, same, spreads

EXACT, UNEVEN = no_spread(), spreads()
BOARD = draw_board(board_design(), EXACT, seed=0, name="b0")
PEAK_T = 1e-3  # size of the fields; tolerances are rounding relative to it
places_m = st.floats(-8e-3, 8e-3)
depths_m = st.floats(0.1e-3, 1.2e-3)


def design(**changes):
    usual = {
        "polarity": "checkerboard",
        "saturation_T": 0.17,
        "half_field_T": 0.5,
        "thickness_mm": 2.0,
        "modulus_kPa": 190.0,
        "tip_radius_mm": 3.0,
    }
    return SkinDesign(**(usual | changes))


def skin(spread=EXACT, name="s0", **changes):
    return draw_skin(design(**changes), spread, seed=0, name=name)


def change(poke_m, on=None, board=BOARD):
    return changes_of_field(board, on or skin(), np.array([poke_m]))[1][0]


def rotated_dipoles_in_a_loop(one, board, poke_m):
    """The specification: move each node, turn its moment about the tangent, take the difference of its field."""
    dent = layer.dent_under_sphere(poke_m[2] + one.depth_zero_m, one.tip_radius_m, one.thickness_m)
    total_T = np.zeros_like(board.chips_m)
    for node, moment in zip(one.nodes_m, one.moments_A_m2, strict=True):
        away = node - (poke_m[0], poke_m[1], node[2])
        r = float(np.linalg.norm(away))
        outward, up = (part[0] for part in layer.displacement(np.array([r]), node[2:], dent))
        f = layer.gradient(np.array([r]), node[2:], dent)
        angle = np.arctan2(f.rz - f.zr, f.rr + f.zz)[0]
        radial, vertical = away / r, np.array([0.0, 0.0, 1.0])
        tangent = np.cross(vertical, radial)
        turned = (  # Rodrigues
            moment * np.cos(angle)
            + np.cross(tangent, moment) * np.sin(angle)
            + tangent * (tangent @ moment) * (1 - np.cos(angle))
        )
        for chip_i, chip in enumerate(board.chips_m):
            total_T[chip_i] += one_dipole(node + outward * radial + up * vertical, turned, chip)
            total_T[chip_i] -= one_dipole(node, moment, chip)
    return total_T


def one_dipole(position, moment, chip):
    d = chip - position
    r = np.linalg.norm(d)
    return MU0_4PI * (3 * d * (moment @ d) / r**5 - moment / r**3)


def test_a_poke_equals_the_loop_over_turned_dipoles():
    one, poke_m = skin(UNEVEN), (1.1e-3, -2.3e-3, 0.7e-3)
    truth_T = rotated_dipoles_in_a_loop(one, BOARD, poke_m)
    # 1 %: the loop also sums what lies past the reach, where material moves less than 0.3 % of the depth
    assert np.abs(change(poke_m, one) - truth_T).max() < 0.01 * np.abs(truth_T).max()


def test_the_field_at_rest_is_the_loop_over_dipoles():
    one = skin(UNEVEN)
    truth_T = sum(one_dipole(n, m, BOARD.chips_m[3]) for n, m in zip(one.nodes_m, one.moments_A_m2, strict=True))
    rest_T, _ = changes_of_field(BOARD, one, np.zeros((0, 3)))
    np.testing.assert_allclose(rest_T[3], truth_T, atol=1e-12 * PEAK_T)


@pytest.mark.parametrize("depth_m", [0.0, -0.1e-3])
def test_without_contact_the_field_does_not_change_at_all(depth_m):
    assert not change((1e-3, 2e-3, depth_m)).any()
    assert not forces(skin(), np.array([depth_m])).any()


def test_a_tip_that_starts_too_high_makes_no_contact_at_a_shallow_command():
    high = next(s for s in (skin(UNEVEN, name=f"s{i}") for i in range(50)) if s.depth_zero_m < -0.05e-3)
    assert not change((0.0, 0.0, 0.05e-3), high).any()


@settings(max_examples=20)
@given(places_m, places_m, depths_m, st.floats(0, 5))
def test_the_change_is_proportional_to_the_magnetisation(x_m, y_m, depth_m, factor):
    once = change((x_m, y_m, depth_m), skin(saturation_T=0.1))
    scaled = change((x_m, y_m, depth_m), skin(saturation_T=0.1 * factor))
    np.testing.assert_allclose(scaled, factor * once, atol=1e-12 * PEAK_T)


@settings(max_examples=20)
@given(places_m, places_m, depths_m, st.sampled_from(["checkerboard", "same"]))
def test_turning_board_and_poke_by_90_degrees_turns_the_change(x_m, y_m, depth_m, polarity):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    sign = -1 if polarity == "checkerboard" else 1  # a quarter turn swaps the poles of a checkerboard
    one = skin(polarity=polarity)
    turned_board = Board("turned", BOARD.chips_m @ turn.T, BOARD.turn, BOARD.sensitivity, BOARD.offset_T)
    there = change((-y_m, x_m, depth_m), one, turned_board)
    np.testing.assert_allclose(there, sign * change((x_m, y_m, depth_m), one) @ turn.T, atol=1e-10 * PEAK_T)


@settings(max_examples=20)
@given(places_m, places_m, depths_m)
def test_the_mirror_image_of_a_poke_has_the_mirrored_field(x_m, y_m, depth_m):
    # Chips 1 and 3 swap. B is axial (By, Bz flip in x -> -x), and so does the checkerboard: Jx of it flips instead.
    mirrored = change((-x_m, y_m, depth_m))[[0, 3, 2, 1, 4]]
    np.testing.assert_allclose(mirrored, change((x_m, y_m, depth_m)) * (1, -1, -1), atol=1e-10 * PEAK_T)


def test_moving_skin_poke_and_chips_together_changes_nothing():
    one = skin(UNEVEN)
    shift_m = np.array([0.4e-3, -0.7e-3, 0.0])
    moved = type(one)(**{**one.__dict__, "nodes_m": one.nodes_m + shift_m})
    board = Board("moved", BOARD.chips_m + shift_m, BOARD.turn, BOARD.sensitivity, BOARD.offset_T)
    there = change(np.array([1e-3, 1e-3, 1e-3]) + shift_m, moved, board)
    np.testing.assert_allclose(there, change((1e-3, 1e-3, 1e-3), one), atol=1e-10 * PEAK_T)


def test_stiffness_changes_the_force_and_not_the_field():
    soft, hard = skin(modulus_kPa=190.0), skin(modulus_kPa=1e6)
    assert np.array_equal(change((1e-3, 0.0, 1e-3), soft), change((1e-3, 0.0, 1e-3), hard))
    np.testing.assert_allclose(forces(hard, np.array([1e-3])) * 190, forces(soft, np.array([1e-3])) * 1e6)


def test_many_pokes_are_what_each_poke_is_alone():
    pokes_m = np.array([[0.0, 0.0, 1e-3], [3e-3, -8e-3, 0.2e-3], [1e-3, 1e-3, 0.0]])
    _, together = changes_of_field(BOARD, skin(), pokes_m)
    for poke_m, of_many in zip(pokes_m, together, strict=True):
        assert np.array_equal(of_many, change(poke_m))


def test_the_same_name_and_seed_give_the_same_skin_and_another_name_another():
    assert same(skin(UNEVEN, "s7"), skin(UNEVEN, "s7"))
    assert not same(skin(UNEVEN, "s7"), skin(UNEVEN, "s8"))


def test_over_many_skins_the_draws_have_the_spreads_that_are_stated():
    skins = [skin(UNEVEN, f"s{i}") for i in range(100)]
    middle_m = [one.nodes_m.mean(axis=0)[:2] for one in skins]
    # 25 %: three and a half times the sampling error 1 / sqrt(2 n) of 100 skins
    assert np.std(middle_m) == pytest.approx(0.25e-3, rel=0.25)
    assert np.std([one.depth_zero_m for one in skins]) == pytest.approx(0.05e-3, rel=0.25)
    assert np.std(np.log([one.thickness_m for one in skins])) == pytest.approx(0.03, rel=0.25)
    assert np.std(np.log([one.modulus_Pa for one in skins])) == pytest.approx(0.1, rel=0.25)


def test_filler_and_amplitude_scale_the_moments_by_their_spreads():
    exact = np.linalg.norm(skin().moments_A_m2, axis=1)
    for spread, within in ((no_spread(skin_amplitude=0.1), False), (no_spread(skin_filler=0.1), True)):
        factors = [np.log(np.linalg.norm(skin(spread, f"s{i}").moments_A_m2, axis=1) / exact) for i in range(60)]
        assert np.std(factors) == pytest.approx(0.1, rel=0.3)  # three times the sampling error of 60 skins
        assert (np.std(factors, axis=1).min() > 0.01) == within


def test_the_size_of_the_change_is_that_of_a_real_skin_within_a_factor_of_three():
    # Recorded at about 3 N: 650-1090 uT over 15 channels (PHYSICS 3). A bonded skin of this J gives about half.
    pokes_m = np.array([[x, y, 1.2e-3] for x in (-4e-3, 0.0, 4e-3) for y in (-4e-3, 0.0, 4e-3)])
    rest_T, changes_T = changes_of_field(BOARD, skin(), pokes_m)
    assert 300e-6 < np.median(np.linalg.norm(changes_T.reshape(9, -1), axis=1)) < 1090e-6
    assert forces(skin(), np.array([1.2e-3])) == pytest.approx(3.0, rel=0.1)
    assert np.abs(rest_T[:, :2]).max() > 10 * np.abs(rest_T[:, 2]).max()  # in-plane, as the lab's skins


def test_a_poke_that_would_fold_the_skin_is_refused():
    with pytest.raises(ParamsError, match="depth"):
        change((0.0, 0.0, 1.6e-3))
