"""Is a run another's? What counts as equal, as within tolerance and as beyond it, and what is never compared."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.io import read_json
from pipeline.evaluation.reproduced import IGNORED, TOLERANCES, compare, ignored, leaves, tolerance_of
from tests.reporting.synthetic import all_questions, cost
from tests.stages.checkout import ROOT

NAMES = ("table2", "shear", "provenance", "accuracy_pct", "mse_xy_mm2", "rows_n", "mean", "holds", "seconds")
VALUES = st.one_of(
    st.booleans(), st.integers(-9, 9), st.floats(-100, 100), st.text("ab 1", max_size=3), st.none(),
)  # fmt: skip
NESTED = st.recursive(
    VALUES,
    lambda own: st.lists(own, max_size=3) | st.dictionaries(st.sampled_from(NAMES), own, max_size=3),
    max_leaves=9,
)
NUMBERS = st.dictionaries(st.sampled_from(NAMES), NESTED, max_size=4)
FEW = settings(max_examples=40, deadline=None)  # a nest of values takes milliseconds to draw


@FEW
@given(NUMBERS)
def test_a_run_is_itself(numbers):
    done = compare(numbers, numbers)
    assert done.reproduced
    assert done.equal_n == len(dict(leaves(numbers)))
    assert done.within_n == 0


@FEW
@given(NUMBERS, NUMBERS)
def test_every_value_is_counted_once_and_sides_may_be_exchanged(one, other):
    there, back = compare(one, other), compare(other, one)
    assert there.equal_n == back.equal_n
    assert (sorted(there.missing), sorted(there.new)) == (sorted(back.new), sorted(back.missing))
    both = there.equal_n + there.within_n + len(there.beyond)
    assert both == back.equal_n + back.within_n + len(back.beyond)
    assert both + len(there.missing) == len(dict(leaves(one)))
    assert both + len(there.new) == len(dict(leaves(other)))


def test_three_points_of_accuracy_are_this_machine_and_four_are_not():
    def run(accuracy_pct: float) -> dict:
        return {"table2": {"multi": {"accuracy_pct": {"mean": accuracy_pct, "n": 6}}}}

    assert compare(run(80.0), run(81.5)).reproduced
    done = compare(run(80.0), run(84.0))
    (difference,) = done.beyond
    assert (difference.name, difference.off) == ("table2.multi.accuracy_pct.mean", "+4")
    assert (done.equal_n, done.within_n) == (1, 0)


@pytest.mark.parametrize(
    ("name", "fresh", "within"),
    [
        ("table2.multi.mse_xy_mm2.mean", 1.2, True), ("table2.multi.mse_xy_mm2.mean", 1.3, False),
        ("described.grid.over_skins.noise_xy_uT.mean", 1.0005, True),
        ("described.grid.over_skins.noise_xy_uT.mean", 1.002, False),
        ("capture.frames_n", 1.0001, False), ("table2.multi.accuracy_pct.n", 1.0001, False),
        ("verification[field of a box].error", 1.0005, True), ("verification[field of a box].error", 1.01, False),
    ],
)  # fmt: skip
def test_what_is_counted_is_exact_what_is_computed_narrow_and_what_is_trained_wide(name, fresh, within):
    assert tolerance_of(name).allows(1.0, fresh) == within


def test_rounding_in_an_error_of_1e_10_is_no_difference():
    assert tolerance_of("verification[field of a box].error").allows(2e-10, 5e-10)


def test_costs_commits_and_machines_are_not_compared():
    numbers, other = all_questions(), all_questions()
    other["provenance"] |= {"git": "x", "trained": "x", "device": "x", "seconds": 9.0}
    other["runtime"] |= {"stages": {"report": cost(9.0), "drift": cost()}}
    assert compare(numbers, other).equal_n == compare(numbers, numbers).equal_n
    assert compare(numbers, other).reproduced
    assert not compare(numbers, numbers | {"provenance": numbers["provenance"] | {"seed": 2}}).reproduced


def test_a_row_more_shifts_no_other_and_is_told():
    rows = [{"method": "ridge", "labels_n": n, "accuracy_pct": float(n)} for n in (0, 10)]
    done = compare({"labels": rows}, {"labels": [{"method": "ridge", "labels_n": 5, "accuracy_pct": 50.0}, *rows]})
    assert done.beyond == []
    assert set(done.new) == {f"labels[ridge, 5].{key}" for key in rows[0]}
    assert done.missing == []


def test_rows_that_begin_alike_are_told_apart_by_their_places():
    names = [name for name, _ in leaves({"audit": [{"what": "a"}, {"what": "a"}, {"what": "b"}, {"x_mm": 8.0}]})]
    assert names == ["audit[a].what", "audit[a #2].what", "audit[b].what", "audit[#1].x_mm"]


def test_a_verdict_that_turns_is_a_difference_and_a_number_in_a_sentence_is_none():
    old = {"findings": [{"finding": "f", "holds": True, "measured": "yes: +3.2 points"}]}
    assert compare(old, {"findings": [{"finding": "f", "holds": True, "measured": "yes: +3.1 points"}]}).reproduced
    for turned in ({"holds": False}, {"measured": "no: +3.2 points"}):
        done = compare(old, {"findings": [old["findings"][0] | turned]})
        assert [one.off for one in done.beyond] == ["differs"]


@given(st.floats(-1e3, 1e3), st.floats(0, 1e3))
def test_a_tolerance_allows_all_that_is_nearer_than_what_it_allows(committed, off):
    for one in TOLERANCES:
        if one.allows(committed, committed + off):
            assert one.allows(committed, committed + off / 2)
        assert one.allows(committed, committed)


def test_every_limit_is_finite_and_has_its_reason():
    assert all(math.isfinite(one.absolute + one.relative) and one.why for one in TOLERANCES)
    assert all(why for _, why in IGNORED)


@pytest.mark.parametrize("file", sorted(ROOT.glob("reports/*/numbers.json")), ids=lambda file: file.parent.name)
def test_every_committed_value_has_a_name_of_its_own_and_but_costs_and_machine_is_compared(file):
    numbers = read_json(file)
    named = list(leaves(numbers))
    assert len(dict(named)) == len(named) > 100
    assert not any(ignored(name) for name, _ in named)
    assert {name.split(".")[1] for name, _ in named if name.startswith("provenance.")} == {"scene", "source", "seed"}
