"""The Pareto front of methods: who is on it, and how its members are told from the others and from each other."""

import re
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from pipeline.report.figures import look_of, trade_off, trade_off_points
from tests.report.test_work_precision import said


def rows_of(places) -> list[dict]:
    return [
        {"method": f"m{i}", "inputs": "raw", "train_s": float(cost), "mse_xy_mm2": {"mean": float(error), "n": 1}}
        for i, (cost, error) in enumerate(places)
    ]


def dominates(some, other) -> bool:
    return some != other and all(a <= b for a, b in zip(some, other, strict=True))


PLACES = st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=20)


@given(PLACES)
def test_the_numbered_methods_are_those_that_no_other_dominates(places):
    points = trade_off_points(rows_of(places), "train_s")
    naive = set()
    for place in places:
        beaten = False
        for other in places:
            beaten |= dominates(other, place)
        if not beaten:
            naive.add(place)
    assert {point.place for point in points if point.label} == naive
    assert sorted(point.place for point in points) == sorted(places)


@given(PLACES)
def test_numbers_of_the_front_rise_with_cost_and_fall_with_error(places):
    members = [point for point in trade_off_points(rows_of(places), "train_s") if point.label]
    numbered = {int(point.label): point.place for point in members}
    assert sorted(numbered) == list(range(1, len(numbered) + 1))
    ordered = [numbered[i] for i in sorted(numbered)]
    for (cost, error), (next_cost, next_error) in pairwise(ordered):
        assert cost < next_cost
        assert error > next_error


def test_the_figure_names_every_method_and_numbers_the_front():
    words = said(trade_off(rows_of([(1, 3), (2, 2), (3, 2.5)]), "train_s", title="t", cost="c"))
    for word in ("1  m0 (raw)", "2  m1 (raw)", "m2 (raw)", "Pareto front"):
        assert word in words


def test_a_step_of_the_front_promises_no_error_before_it_was_reached():
    # With more time the error stays (to the right) until the next method reaches less (down).
    svg = trade_off(rows_of([(1, 3), (2, 2)]), "train_s", title="t", cost="c")
    (drawn,) = re.findall(r'<path d="([^"]+)"[^>]*stroke: #666666', svg.split('id="legend_1"')[0])
    first, corner, last = re.findall(r"[ML] (\S+) (\S+)", drawn)
    assert first[1] == corner[1]
    assert corner[0] == last[0]


def test_raw_and_other_inputs_of_a_method_share_colour_and_marker_and_differ_in_filling():
    raw_row, other_row = rows_of([(1, 3), (2, 2)])
    rows = [raw_row | {"method": "ridge"}, other_row | {"method": "ridge", "inputs": "shape"}]
    raw, shape = (point.look for point in trade_off_points(rows, "train_s"))
    assert {key: shape[key] for key in raw} == raw
    assert shape["markerfacecolor"] == "white"


def test_forty_nine_methods_differ_in_colour_or_marker():
    assert len({(look_of(i)["color"], look_of(i)["marker"]) for i in range(49)}) == 49
