"""Tests of the grid protocol against the paper's counts and the order of real recordings."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.grid import points_mm, protocol

depths_mm = st.lists(st.floats(0.1, 1.2), min_size=1, max_size=6, unique=True)


def test_grid_has_65_places():
    points = {tuple(point) for point in points_mm()}
    full = {(2.0 * i, 2.0 * j) for i in range(9) for j in range(9)}
    missing = {(x, y) for x in (0.0, 2.0, 14.0, 16.0) for y in (0.0, 2.0, 14.0, 16.0)}
    assert len(points) == 65
    assert points == full - missing


def test_places_are_visited_in_snake_order():
    steps_mm = np.abs(np.diff(points_mm(), axis=0))
    assert (steps_mm[:, 1] <= 2).all()
    along = steps_mm[:, 1] == 0
    assert (steps_mm[along, 0] == 2).all()
    # Larger steps occur only from one row to the next. The lengths of these rows differ by at most two places.
    assert (steps_mm[~along, 0] <= 4).all()


@given(depths_mm, st.integers(1, 3))
def test_every_pass_visits_every_place_at_every_depth(depths, passes_n):
    plan = protocol(depths, passes_n)
    pokes = set(zip(plan.pass_i, plan.x_mm, plan.y_mm, plan.depth_mm, strict=True))
    assert len(pokes) == len(plan) == passes_n * len(depths) * 65
    assert np.array_equal(plan.indentation, np.arange(len(plan)))
    assert (np.diff(plan.pass_i) >= 0).all()


@given(depths_mm)
def test_adding_a_pass_does_not_change_earlier_passes(depths):
    short, long = protocol(depths, 1), protocol(depths, 2)
    for name in ("indentation", "pass_i", "x_mm", "y_mm", "depth_mm"):
        assert np.array_equal(getattr(short, name), getattr(long, name)[: len(short)])
