"""Scattered pokes against the uniform distribution, by scipy; margins, middles and draws as laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from pipeline.core.config import parse
from pipeline.core.errors import ParamsError
from pipeline.core.seeds import rng_for
from pipeline.synthesis.protocols import Scatter

SCATTER = {
    "kind": "scatter", "boards": "sleeve", "skins_n": 1, "pokes_n": 3000, "depth_mm": [0.4, 1.2], "margin_mm": 4.0,
    "terms": [], "rate_hz": 133.0,
}  # fmt: skip
SLEEVE_MM = (50.8, 101.6)


def plan_of(name="plan", skin_mm=SLEEVE_MM, **changes):
    return parse(Scatter, SCATTER | changes, "test").plan(rng_for(0, name), skin_mm)


def test_places_and_depths_are_uniform_within_the_margin():
    plan = plan_of()
    for drawn, low, high in ((plan.x_mm, 4.0, 46.8), (plan.y_mm, 4.0, 97.6), (plan.depth_mm, 0.4, 1.2)):
        # One honest draw in a thousand is further off than this.
        assert kstest(drawn.ravel(), "uniform", args=(low, high - low)).pvalue > 1e-3
    assert abs(np.corrcoef(plan.x_mm.ravel(), plan.y_mm.ravel())[0, 1]) < 4 / np.sqrt(3000)


@given(st.tuples(st.floats(5, 200), st.floats(5, 200)), st.floats(0, 2.4))
def test_no_poke_is_nearer_to_an_edge_than_the_margin_and_the_middle_is_half_of_the_sides(skin_mm, margin_mm):
    plan = plan_of(skin_mm=skin_mm, margin_mm=margin_mm, pokes_n=50)
    place_mm = np.hstack([plan.x_mm, plan.y_mm])
    to_edge_mm = np.minimum(place_mm, np.array(skin_mm) - place_mm)
    assert to_edge_mm.min() >= margin_mm * (1 - 1e-9)
    assert plan.centre_mm == (skin_mm[0] / 2, skin_mm[1] / 2)
    assert plan.labelled
    assert not plan.tilt.any()


def test_other_draws_give_other_places():
    assert not np.array_equal(plan_of("one").x_mm, plan_of("other").x_mm)
    assert np.array_equal(plan_of("one").x_mm, plan_of("one").x_mm)


def test_a_margin_that_leaves_nothing_is_refused():
    with pytest.raises(ParamsError, match="less than half of the skin's shorter side, 25.4 mm; got 25.4"):
        plan_of(margin_mm=25.4)


def test_depths_that_fall_are_refused():
    with pytest.raises(ParamsError, match="from the shallower to the deeper"):
        plan_of(depth_mm=[1.2, 0.4])
