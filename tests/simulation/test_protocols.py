"""Tests of protocols: counts of the paper, order and spacing of places, random draws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from reskin.config import parse
from reskin.data.grid import SKIN_MM, points_mm
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from reskin.simulation.protocols import Grid, Hand, Scatter

SHARED = {"boards": "rigid", "skins_n": 1, "terms": ()}
GRID = Grid(kind="grid", passes_n=2, depths_mm=(0.2, 0.4, 0.6, 0.8, 1.0, 1.2), **SHARED)
HAND = Hand(
    kind="hand", lines_n=13, pokes_per_line_n=25, depth_mm=(0.4, 1.2), place_sd_mm=0.3, tilt_sd_deg=5.0, **SHARED
)


def plan_of(protocol, name="plan"):
    return protocol.plan(rng_for(0, name), SKIN_MM)


def test_grid_pass_has_390_indentations():
    plan = plan_of(GRID)
    assert plan.x_mm.shape == (2 * 390, 1)
    np.testing.assert_array_equal(np.hstack([plan.x_mm, plan.y_mm])[:65], points_mm())
    np.testing.assert_array_equal(plan.pass_i, np.repeat([0, 1], 390))


def test_hand_protocol_has_325_pokes_without_labels():
    plan = plan_of(HAND)
    assert len(plan) == 325  # This number is in section 5.2 of the paper.
    assert not plan.labelled
    x_mm, y_mm = plan.x_mm.reshape(13, 25), plan.y_mm.reshape(13, 25)
    assert (np.diff(x_mm.mean(axis=0)) > 0).all()
    assert (np.diff(y_mm.mean(axis=1)) > 0).all()
    # Tolerance for 325 draws, which are clipped at the edges.
    assert (y_mm - np.linspace(0, 16, 13)[:, None]).std() == pytest.approx(0.3, rel=0.15)
    assert plan.depth_mm.min() > 0.4
    assert plan.depth_mm.max() < 1.2
    # Tolerance for 650 draws, which are limited to two standard deviations.
    assert plan.tilt.std() == pytest.approx(np.tan(np.radians(5.0)), rel=0.15)
    # The tolerance is four standard errors, 0.23 / sqrt(325) each.
    assert plan.depth_mm.mean() == pytest.approx(0.8, abs=0.05)


SCATTER = {
    "kind": "scatter", "boards": "sleeve", "skins_n": 1, "pokes_n": 3000, "depth_mm": [0.4, 1.2], "margin_mm": 4.0,
    "terms": [], "rate_hz": 133.0,
}  # fmt: skip
SLEEVE_MM = (50.8, 101.6)


def scattered(name="plan", skin_mm=SLEEVE_MM, **changes):
    return parse(Scatter, SCATTER | changes, "test").plan(rng_for(0, name), skin_mm)


def test_scattered_places_and_depths_are_uniform():
    plan = scattered()
    for values, low, high in ((plan.x_mm, 4.0, 46.8), (plan.y_mm, 4.0, 97.6), (plan.depth_mm, 0.4, 1.2)):
        # A correct draw exceeds this tolerance with a probability of 1 in 1000.
        assert kstest(values.ravel(), "uniform", args=(low, high - low)).pvalue > 1e-3
    assert abs(np.corrcoef(plan.x_mm.ravel(), plan.y_mm.ravel())[0, 1]) < 4 / np.sqrt(3000)


@given(st.tuples(st.floats(5, 200), st.floats(5, 200)), st.floats(0, 2.4))
def test_scattered_places_keep_a_margin_to_the_edges(skin_mm, margin_mm):
    plan = scattered(skin_mm=skin_mm, margin_mm=margin_mm, pokes_n=50)
    place_mm = np.hstack([plan.x_mm, plan.y_mm])
    to_edge_mm = np.minimum(place_mm, np.array(skin_mm) - place_mm)
    assert to_edge_mm.min() >= margin_mm * (1 - 1e-9)
    assert plan.centre_mm == (skin_mm[0] / 2, skin_mm[1] / 2)
    assert plan.labelled
    assert not plan.tilt.any()


def test_margin_of_half_the_skin_or_more_is_refused():
    with pytest.raises(ParamsError, match="less than half of the skin's shorter side, 25.4 mm; got 25.4"):
        scattered(margin_mm=25.4)


def test_decreasing_depths_are_refused():
    with pytest.raises(ParamsError, match="must list the smaller depth first"):
        scattered(depth_mm=[1.2, 0.4])
