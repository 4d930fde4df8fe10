"""Tests of the field change by a poke.

It is compared with a loop over all dipoles, and tested for symmetries, pokes without contact, its amplitude, and skins
that slide.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.experiments.extremes import physics as laws
from reskin.errors import ParamsError
from reskin.physics import deformation, layer, magnet, slide
from reskin.physics.board import Board
from reskin.physics.magnet import DEFAULT_QUADRATURE, MU0_4PI, Quadrature, change_of_field
from reskin.physics.skin import SkinDesign, changes_of_field, count_beyond_verified, draw_skin, forces, moved_dipoles
from tests.laws import LIMITS
from tests.physics.test_board import design as board_design
from tests.physics.test_board import draw_board, no_spread, spreads
from tests.physics.test_deformation import depth_steps

EXACT, UNEVEN = no_spread(), spreads()
SEATED = no_spread(skin_seat_mm=0.35)
BOARD = draw_board(board_design(), EXACT, seed=0, name="b0")
PEAK_T = 1e-3  # Fields are of this order of magnitude. Tolerances for rounding are relative to this value.
# Skins are represented by grids of nodes (quadratures). COARSE is used in tests of laws that hold with any quadrature.
# SPARSE has fewer nodes and is used in tests with many skins, which would otherwise be slow.
COARSE, SPARSE = Quadrature(1e-3, 3), Quadrature(5e-3, 1)
DEPTH_M = 0.6e-3  # The tested laws hold at any depth. All tests use the same depth, so that a single table is computed.
places_m = st.floats(-8e-3, 8e-3)
# Hypothesis has no time limit for an example, because the first example computes the tables for all examples.
patient = settings(max_examples=20, deadline=None)


def design(**changes):
    usual = {
        "polarity": "checkerboard",
        "flipped": False,
        "base": "bonded",
        "hold": None,
        "saturation_T": 0.11,
        "half_field_T": 0.5,
        "thickness_mm": 2.0,
        "modulus_kPa": 190.0,
        "stiffening": 0.0,
        "tip_radius_mm": 3.0,
    }
    return SkinDesign(**(usual | changes))


def skin(spread=EXACT, name="s0", rule=COARSE, **changes):
    return draw_skin(design(**changes), spread, seed=0, name=name, rule=rule)


def change(poke_m, on=None, board=BOARD):
    return changes_of_field(board, on or skin(), np.array([poke_m]))[1][0]


def move_dipoles(one, poke_m):
    true_m = np.array(poke_m) + (0, 0, one.depth_zero_m)
    rest = deformation.group_by_height(one.nodes_m, one.moments_A_m2, one.thickness_m)
    return deformation.move_dipoles(table_of(one, rest, true_m[2]), rest, true_m)


def table_of(one, rest, depth_m):
    return deformation.tabulate(one.thickness_m, one.tip_radius_m, depth_m, heights=rest.heights, base=one.base)


def change_by_loop(one, board, poke_m):
    """Return the reference: the sum of the field differences of all moving nodes, in a loop."""
    moved, total_T = move_dipoles(one, poke_m), np.zeros_like(board.chips_m)
    for i, place, after in zip(moved.i, *moved.after, strict=True):
        for chip_i, chip in enumerate(board.chips_m):
            total_T[chip_i] += one_dipole(place, after, chip)
            total_T[chip_i] -= one_dipole(one.nodes_m[i], one.moments_A_m2[i], chip)
    return total_T


def one_dipole(position, moment, chip):
    d = chip - position
    r = np.linalg.norm(d)
    return MU0_4PI * (3 * d * (moment @ d) / r**5 - moment / r**3)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_field_change_by_a_poke_equals_a_loop_over_rotated_dipoles(base):
    one, poke_m = skin(UNEVEN, base=base), (1.1e-3, -2.3e-3, 0.7e-3)
    truth_T = change_by_loop(one, BOARD, poke_m)
    np.testing.assert_allclose(change(poke_m, one), truth_T, atol=1e-12 * PEAK_T)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
@pytest.mark.parametrize("depth_m", [0.2e-3, 1.0e-3])
def test_error_of_the_default_quadrature_is_below_2_percent(depth_m, base):
    # Field changes are compared with those of finer quadratures. The pattern of the magnets is shifted relative to the
    # chips, so that no symmetry hides errors. For a shallow indentation over a seam, 2 % would be below the resolution
    # of a chip: there the limit is a tenth of the chip's noise of 3.3 uT.
    cell_m, layers_n = DEFAULT_QUADRATURE.cell_m, DEFAULT_QUADRATURE.layers_n
    rules = DEFAULT_QUADRATURE, Quadrature(cell_m / 2, layers_n), Quadrature(cell_m, 2 * layers_n)
    pokes_m = np.array([(x, y, depth_m) for x in (-6e-3, 0.0, 4e-3) for y in (-2e-3, 6e-3)])
    used_T, *finer = (changes_of_field(BOARD, skin(SEATED, rule=rule, base=base), pokes_m)[1] for rule in rules)
    for finer_T in finer:
        assert np.linalg.norm(used_T - finer_T) < 0.02 * np.linalg.norm(finer_T)
        size_T = np.linalg.norm(finer_T, axis=(1, 2), keepdims=True)
        assert (np.abs(used_T - finer_T) < np.maximum(0.02 * size_T, 0.33e-6)).all()


def test_field_at_rest_equals_a_loop_over_dipoles():
    one = skin(UNEVEN)
    truth_T = sum(one_dipole(n, m, BOARD.chips_m[3]) for n, m in zip(one.nodes_m, one.moments_A_m2, strict=True))
    rest_T, _ = changes_of_field(BOARD, one, np.zeros((0, 3)))
    np.testing.assert_allclose(rest_T[3], truth_T, atol=1e-12 * PEAK_T)


def test_field_change_equals_the_difference_of_two_fields():
    one, poke_m = skin(UNEVEN), (1.1e-3, -2.3e-3, 1e-3)
    moved = move_dipoles(one, poke_m)
    places_m, moments = one.nodes_m.copy(), one.moments_A_m2.copy()
    places_m[moved.i], moments[moved.i] = moved.after
    after_T = magnet.field(places_m, moments, BOARD.chips_m)
    before_T = magnet.field(one.nodes_m, one.moments_A_m2, BOARD.chips_m)
    np.testing.assert_allclose(change(poke_m, one), after_T - before_T, atol=1e-11 * PEAK_T)


@pytest.mark.parametrize("base", ["bonded", "slipping"])
def test_skins_are_drawn_by_name_and_change_no_field_without_contact_or_magnetisation(base):
    usual, again, renamed = (skin(UNEVEN, name, base=base) for name in ("s7", "s7", "s8"))
    np.testing.assert_array_equal(usual.moments_A_m2, again.moments_A_m2)
    assert (usual.moments_A_m2 != renamed.moments_A_m2).any()
    assert not change((1e-3, 2e-3, DEPTH_M), skin(UNEVEN, "s7", base=base, saturation_T=0.0)).any()
    assert not change((1e-3, 2e-3, -usual.depth_zero_m), usual).any()  # The tip touches the skin without indenting it.


@patient
@given(places_m, places_m, st.sampled_from(["checkerboard", "same"]), st.sampled_from(["bonded", "slipping"]))
def test_field_change_has_the_symmetries_of_board_and_skin(x_m, y_m, polarity, base):
    even = skin(polarity=polarity, base=base)
    assert laws.symmetries(BOARD.chips_m, even, polarity, np.array([x_m, y_m])) <= LIMITS["symmetries"]


@pytest.mark.parametrize(  # The four cases cover each pair of base, thickness and kind of depth once.
    ("base", "thickness_mm", "at", "error"),
    [
        ("bonded", 1.82, 0.0, 0.003),
        ("bonded", 2.0, 0.5, 0.006),
        ("slipping", 1.82, 0.5, 0.006),
        ("slipping", 2.0, 0.0, 0.003),
    ],
)
def test_field_change_from_tables_equals_that_of_nodes_moved_in_steps(thickness_mm, at, error, base):
    # A thickness of 1.82 mm is halfway between two tables. At the depths of the tables, the error is due to
    # interpolation in R/h (radius of the tip divided by the thickness) and in r. Between these depths, the error is 0.6
    # %, because the reference then ends with half a step of `deformation.STEP`, which changes dB by 0.6 %.
    one = skin(SEATED, thickness_mm=thickness_mm, base=base)
    ladder_m = one.thickness_m * deformation.depth_scale(one.tip_radius_m / one.thickness_m) * deformation.LADDER
    for rung_i in (6, 16, 22):
        poke_m = np.array([1.3e-3, -2.1e-3, (1 - at) * ladder_m[rung_i] + at * ladder_m[rung_i + 1]])
        depths_m = depth_steps(poke_m[2], layer.IndentedLayer(one.thickness_m, one.tip_radius_m, base))
        truth = laws.follow_dipoles(one, poke_m[:2], depths_m)
        # On a bonded base, nothing moves beyond the range of the table.
        near = np.linalg.norm(
            one.nodes_m[:, :2] - poke_m[:2], axis=1, keepdims=True
        ) < one.thickness_m * deformation.reach(one.tip_radius_m / one.thickness_m, base)
        rest = one.nodes_m, one.moments_A_m2
        moved = tuple(np.where(near | (base == "slipping"), *pair) for pair in zip(truth, rest, strict=True))
        truth_T = change_of_field(rest, moved, BOARD.chips_m)
        assert np.linalg.norm(change(poke_m, one) - truth_T) < error * np.linalg.norm(truth_T)


def test_drawn_skins_have_the_given_spreads():
    skins = [skin(UNEVEN, f"s{i}", SPARSE) for i in range(100)]
    # The tolerance of 25 % is three and a half standard errors, which are 1 / sqrt(2 n) each for n = 100 skins.
    assert np.std([one.seat_m for one in skins]) == pytest.approx(0.25e-3, rel=0.25)
    np.testing.assert_allclose([one.nodes_m[:, :2].mean(axis=0) for one in skins], [one.seat_m for one in skins])
    assert np.std([one.depth_zero_m for one in skins]) == pytest.approx(0.05e-3, rel=0.25)
    assert np.std(np.log([one.thickness_m for one in skins])) == pytest.approx(0.03, rel=0.25)
    assert np.std(np.log([one.modulus_Pa for one in skins])) == pytest.approx(0.1, rel=0.25)


def test_random_filler_and_amplitude_scale_the_moments():
    # The nodes are in a single layer at half the height. At this height, the field is zero where seams cross, but not
    # at the nodes.
    exact = np.linalg.norm(skin(rule=SPARSE).moments_A_m2, axis=1)
    for spread, within in ((no_spread(skin_amplitude=0.1), False), (no_spread(skin_filler=0.1), True)):
        moments = [np.linalg.norm(skin(spread, f"s{i}", SPARSE).moments_A_m2, axis=1) for i in range(60)]
        factors = np.log(np.array(moments) / exact)
        assert np.std(factors) == pytest.approx(0.1, rel=0.3)  # The tolerance is three standard errors for 60 skins.
        assert (np.std(factors, axis=1).min() > 0.01) == within


def test_slipping_skin_is_softer_and_changes_the_field_of_distant_chips_more():
    bonded, slipping = skin(), skin(base="slipping")
    # At a depth of 1.2 mm, the bonded skin is 1.8 times as stiff as the slipping one.
    assert forces(slipping, np.array([1e-3])) < 0.7 * forces(bonded, np.array([1e-3]))
    # Chip 3 is 15 mm away from the poke.
    far = [np.linalg.norm(change((-8e-3, 0.0, 1e-3), one)[3]) for one in (bonded, slipping)]
    assert far[1] > 10 * far[0]


def test_force_equals_the_specification():
    # The specification gives this force with two digits.
    assert forces(skin(), np.array([1.2e-3])) == pytest.approx(3.0, rel=0.05)


def test_pokes_are_limited_by_the_edge_of_the_skin():
    one = skin(SEATED)
    corner_m = np.append(one.seat_m + np.sign(one.seat_m) * 9.99e-3, 0.0)
    assert np.abs(corner_m).max() > 10e-3
    assert not change(corner_m, one).any()
    with pytest.raises(ParamsError, match="on the skin"):
        change(-corner_m, one)


def test_pokes_deeper_than_the_verified_depth_are_counted():
    one = skin()
    high, low = (type(one)(**{**one.__dict__, "depth_zero_m": zero_m}) for zero_m in (-0.1e-3, 0.1e-3))
    depths_m = np.array([0.6, 1.15, 1.25]) * 1e-3  # The model is verified up to a true depth of 1.2 mm.
    assert [count_beyond_verified(skin_, depths_m) for skin_ in (high, one, low)] == [0, 1, 2]


HELD = {"give_um": (48.0, 7.0), "away_um_mm": 6.0, "lets_go_N": 8.0, "springs_N_mm": 7.0, "friction": 0.8}


def held_skin(spread=UNEVEN, **changes):
    return skin(spread, base="slipping", hold=HELD | changes)


def test_skin_held_by_springs_slides_as_a_rigid_body_up_to_the_friction_limit():
    one, free = skin(UNEVEN, base="slipping", hold=HELD, modulus_kPa=30), skin(UNEVEN, base="slipping")
    poke_m = np.array([[3e-3, -2e-3, 0.7e-3]])
    [(_, _, free_m)] = moved_dipoles(free, poke_m)
    [(_, _, held_m)] = moved_dipoles(one, poke_m)
    apart_m = held_m[0] - free_m[0]
    assert np.abs(apart_m[:, 2]).max() == 0
    distance_m = np.linalg.norm(held_m[0][:50, None] - held_m[0][50:100], axis=2)
    np.testing.assert_allclose(distance_m, np.linalg.norm(free_m[0][:50, None] - free_m[0][50:100], axis=2), rtol=1e-9)
    # If friction did not limit the motion, the skin would move by `taken_m` at the place of the poke (formula of
    # `press_displacement_m`). Friction allows the fraction `share` of this move.
    away_m, depth_m = poke_m[0, :2] - one.seat_m, poke_m[0, 2:]
    (normal_N,) = forces(one, depth_m)
    taken_m = (48e-6, 7e-6) - 6e-3 * (1 - normal_N / 8) * away_m
    needed_N = 7e3 * np.linalg.norm(slide.rigid_motion(away_m[None], taken_m[None], one.sides_m).move_m)
    share = 1 - np.exp(-0.8 * normal_N / needed_N)
    assert 0.2 < share < 0.9
    nearest = np.argmin(np.linalg.norm(free_m[0][:, :2] - poke_m[0, :2], axis=1))
    np.testing.assert_allclose(apart_m[nearest, :2], share * taken_m, atol=2e-6)
    alike = spreads(skin_give_um=0.0, skin_away_um_mm=0.0)
    without_slide = held_skin(alike, give_um=(0.0, 0.0), away_um_mm=0.0)
    np.testing.assert_array_equal(change(poke_m[0], without_slide), change(poke_m[0], free))


def test_force_on_a_skin_held_by_springs_is_that_of_a_bonded_layer_times_its_stiffening():
    one, bonded, depth_m = held_skin(EXACT), skin(base="bonded"), np.array([0.4e-3, 1.0e-3])
    np.testing.assert_array_equal(forces(one, depth_m), forces(bonded, depth_m))
    stiffer = (1 - depth_m / one.thickness_m) ** -1.5
    for other in (one, bonded):
        found_N = forces(replace(other, stiffening=1.5), depth_m)
        np.testing.assert_allclose(found_N, stiffer * forces(bonded, depth_m), rtol=1e-12)


def test_rotating_the_skin_equals_rotating_the_board_in_the_opposite_direction():
    rotated = skin(EXACT.model_copy(update={"skin_rotation_deg": 5.0}), base="slipping")
    first = skin(base="slipping").nodes_m
    angle = np.arctan2(rotated.nodes_m[0, 1], rotated.nodes_m[0, 0]) - np.arctan2(first[0, 1], first[0, 0])
    assert angle != 0
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    board = Board("turned", BOARD.chips_m @ rotation, BOARD.turn, BOARD.sensitivity, BOARD.offset_T)
    poke_m = np.array([2e-3, 1e-3, DEPTH_M])
    found, expected = change(poke_m, rotated), change(poke_m @ rotation, skin(base="slipping"), board) @ rotation.T
    np.testing.assert_allclose(found, expected, atol=1e-9 * PEAK_T)
