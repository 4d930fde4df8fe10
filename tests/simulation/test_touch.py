"""Tests that the field changes continuously from the first millinewton of a touch to lift-off, on random skins."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from reskin.config import parse
from reskin.layouts import PAPER, geometry
from reskin.physics import slide
from reskin.physics.board import Board, BoardDesign, Spreads, draw_board
from reskin.physics.magnet import Quadrature
from reskin.physics.shear import Friction
from reskin.physics.skin import Skin, SkinDesign, changes_of_field, draw_skin, forces
from reskin.simulation.contact import Terms, drag_tip, simulate_response
from reskin.simulation.defaults import SHARED, nominal

ROOT = Path(__file__).resolve().parents[2]
PARAMS = {name: nominal(name) for name in SHARED}
DESIGN = parse(SkinDesign, PARAMS["skin"], "skin")
SPREADS = parse(Spreads, PARAMS["spreads"], "spreads")
RIGID = parse(BoardDesign, geometry(PAPER)["design"], "layout")
TERMS = parse(Terms, PARAMS["terms"], "terms")
COARSE = Quadrature(1e-3, 4)
STOPS_N = 48  # A path has this number of stops. The finer path has twice as many.
places = st.tuples(st.floats(-8e-3, 8e-3), st.floats(-8e-3, 8e-3))
FEW = settings(max_examples=8, deadline=None)


def draw_board_and_skin(name: str) -> tuple[Board, Skin]:
    board = draw_board(RIGID, SPREADS, seed=1, name=name)
    return board, draw_skin(DESIGN, SPREADS, seed=1, name=f"{name}_s0", rule=COARSE)


def depths_of_forces_m(skin: Skin, force_N) -> np.ndarray:
    """Return the commanded depths in m for these forces. For zero force, the tip is 20 um above the skin."""
    names = ("thickness_m", "tip_radius_m", "modulus_Pa", "stiffening")
    skin_settings = {name: getattr(skin, name) for name in names}
    depth_m = slide.depth_at(np.asarray(force_N, float), **skin_settings) - skin.depth_zero_m
    return np.where(np.asarray(force_N) > 0, depth_m, -20e-6 - skin.depth_zero_m)


def sizes_uT(change_T) -> np.ndarray:
    return 1e6 * np.linalg.norm(change_T.reshape(len(change_T), -1), axis=1)


def path(skin: Skin, ends_m, forces_N, stops_n: int) -> np.ndarray:
    """Return the path of a tip that presses, drags and lifts, in equal steps of place and force."""
    share = np.linspace(0, 3, stops_n + 1)
    place_m = np.stack([np.interp(share, (1, 2), ends) for ends in np.transpose(ends_m)], axis=1)
    force_N = np.interp(share, (0, 1, 2, 3), (0.0, *forces_N, 0.0))
    return np.column_stack([place_m, depths_of_forces_m(skin, force_N)])[None]


@FEW  # Forces stay below those at which a drag with a friction of 1.2 is refused.
@example((0.0, 0.0), 0.0, 1.5, 1.2, 0.3, 0)
@example((0.0, 0.0), 0.0, 1.0, 2.2e-311, 0.0, 0)  # Here, the coefficient of friction is a subnormal number.
@given(
    places, st.floats(0, 2 * np.pi), st.floats(0.02, 1.5), st.floats(0, 1.2), st.floats(-0.3, 0.3), st.integers(0, 99)
)
def test_sum_of_sideways_forces_of_press_and_drag_is_limited_by_friction(
    start_m, angle_rad, force_N, friction, lean, name_i
):
    board, skin = draw_board_and_skin(f"b{name_i}")
    assert skin.hold is not None
    drag_m = 2e-3 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    end_m = np.clip(np.subtract(start_m, drag_m), -8e-3, 8e-3)  # The end of the drag must be on the skin.
    tip_m = path(skin, (start_m, end_m), (force_N, force_N), STOPS_N // 4)
    found = drag_tip(board, skin, tip_m, tilt=np.array([[lean, 0.0]]), friction=Friction(coefficient=friction))
    # Tolerance: rounding, also of subnormal numbers if the coefficient of friction is tiny.
    limit_N = friction * forces(skin, tip_m[0, :, 2]) * (1 + 1e-9) + 1e-15
    assert (np.hypot(*found.force_N[0].T) <= limit_N).all()
    assert (skin.hold.springs_N_per_m * np.hypot(*found.slide_m[0].T) <= limit_N).all()
    if friction == 0:
        assert not found.slide_m.any()


@pytest.mark.parametrize("depth_m", [3e-5, 2e-4, 6e-4])
def test_field_changes_smoothly_while_a_sticking_tip_is_pressed_deeper(depth_m):
    board, skin = draw_board_and_skin("b0")
    # The depths include one at which the shear tables change.
    deeper_m = depth_m + np.arange(41) * 0.5e-6 - skin.depth_zero_m
    place_m = np.column_stack([np.r_[0.0, np.full(41, 4e-5)], np.zeros(42)])
    tip_m = np.column_stack([place_m, np.r_[deeper_m[0], deeper_m]])[None]
    found = drag_tip(board, skin, tip_m, tilt=np.zeros((1, 2)), friction=Friction(coefficient=0.8))
    steps_uT = sizes_uT(np.diff(found.change_T[0, 1:], axis=0))
    assert steps_uT.max() < 1.5 * np.median(steps_uT)


@pytest.mark.parametrize("terms", [(), ("memory",)])
def test_after_lift_off_only_the_field_memory_remains(terms):
    board, skin = draw_board_and_skin("b0")
    depth_m = depths_of_forces_m(skin, np.array([0.5, 2.0, 0.5, 0.0]))
    tip_m = np.column_stack([np.full(4, 5e-3), np.full(4, -3e-3), depth_m])[None].repeat(3, axis=0)
    rng = np.random.default_rng(0)
    found = simulate_response(board, skin, tip_m, tilt=np.zeros((3, 2)), terms=TERMS.only(terms), rng=rng)
    left_uT, pressed_uT = sizes_uT(found.change_T[:, -1]), sizes_uT(found.change_T[:, 1])
    assert not found.force_N[:, -1].any()
    if terms:  # In recordings, 5 to 8 % of the last field change remain in the next no-load reading.
        assert (left_uT < 0.2 * pressed_uT).all()
        assert left_uT[0] > 0
    else:
        assert not left_uT.any()


def test_friction_limits_the_slide_by_light_touches_but_not_by_firm_ones():
    board, skin = draw_board_and_skin("b0")
    assert skin.hold is not None
    firm = replace(skin, hold=replace(skin.hold, friction=1e12))
    place_m = np.array([7e-3, 4e-3])
    tips_m = np.column_stack([np.tile(place_m, (2, 1)), depths_of_forces_m(skin, np.array([1e-3, 6.0]))])
    light_uT, hard_uT = (sizes_uT(changes_of_field(board, one, tips_m)[1]) for one in (skin, firm))
    assert light_uT[0] < 0.02 * hard_uT[0]
    assert light_uT[1] == pytest.approx(hard_uT[1], rel=1e-3)
