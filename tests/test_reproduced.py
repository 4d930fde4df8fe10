"""Tests of the comparison of two runs: equality, names of values, changed verdicts."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.manage.compare import compare, leaves
from reskin.io import read_json
from tests.stages.checkout import ROOT

NAMES = ("table2", "shear", "accuracy_pct", "mse_xy_mm2", "rows_n", "mean", "holds")
VALUES = st.one_of(
    st.booleans(), st.integers(-9, 9), st.floats(-100, 100), st.text("ab 1", max_size=3), st.none(),
)  # fmt: skip
NESTED = st.recursive(
    VALUES,
    lambda children: st.lists(children, max_size=3) | st.dictionaries(st.sampled_from(NAMES), children, max_size=3),
    max_leaves=9,
)
NUMBERS = st.dictionaries(st.sampled_from(NAMES), NESTED, max_size=4)
# Fewer examples than usual, because drawing nested values takes milliseconds.
FEW = settings(max_examples=40, deadline=None)


@FEW
@given(NUMBERS)
def test_run_has_no_difference_from_itself(numbers):
    done = compare(numbers, numbers)
    assert done.reproduced
    assert done.equal.total() == len(list(leaves(numbers)))


@FEW
@given(NUMBERS, NUMBERS)
def test_each_value_is_counted_once_in_either_direction_of_the_comparison(one, other):
    forwards, backwards = compare(one, other), compare(other, one)
    assert forwards.equal.total() == backwards.equal.total()
    both_n = forwards.equal.total() + len(forwards.differing)
    assert (
        both_n + len(forwards.missing)
        == len(list(leaves(one)))
        == backwards.equal.total() + len(backwards.differing) + len(backwards.new)
    )
    assert both_n + len(forwards.new) == len(list(leaves(other)))


@pytest.mark.parametrize(
    ("old", "new", "relative"),
    [
        (1.0, 1.0 + 2**-52, 2**-52), (80, 60, 0.25), (-1.0, 1.0, 2.0), (0.0, 1e-9, 1.0), (1, True, None),
        ("a", "b", None),
    ],
)  # fmt: skip
def test_values_that_differ_at_all_are_listed_with_their_relative_difference(old, new, relative):
    (difference,) = compare({"shear": {"mean": old}}, {"shear": {"mean": new}}).differing
    assert difference.name == "shear.mean"
    assert difference.relative == (None if relative is None else pytest.approx(relative))


def test_equal_values_are_counted_by_section():
    numbers = {"table2": {"a": 1.0, "b": 2.0}, "labels": [{"method": "ridge", "mean": 1.0}]}
    assert compare(numbers, numbers).equal == {"table2": 2, "labels": 2}


def test_nan_counts_as_equal_to_nan():
    assert compare({"a": float("nan")}, {"a": float("nan")}).reproduced


def test_additional_row_does_not_change_the_names_of_others():
    rows = [{"method": "ridge", "labels_n": n, "accuracy_pct": float(n)} for n in (0, 10)]
    done = compare({"labels": rows}, {"labels": [{"method": "ridge", "labels_n": 5, "accuracy_pct": 50.0}, *rows]})
    assert done.differing == []
    assert set(done.new) == {f"labels[ridge, 5].{key}" for key in rows[0]}
    assert done.missing == []


def test_rows_with_equal_labels_are_numbered():
    names = [name for name, _ in leaves({"audit": [{"what": "a"}, {"what": "a"}, {"what": "b"}, {"x_mm": 8.0}]})]
    assert names == ["audit[a].what", "audit[a #2].what", "audit[b].what", "audit[#1].x_mm"]


def test_rows_with_changed_labels_are_paired_by_their_position():
    old = [{"claim": "better", "holds": "no"}, {"claim": "better", "holds": "yes"}]
    new = [old[0], {"claim": "better", "holds": "inconclusive"}]
    (difference,) = compare({"order": old}, {"order": new}).differing
    assert (difference.name, difference.verdicts) == ("order[better, yes].holds", ("yes", "inconclusive"))


@pytest.mark.parametrize(
    ("old", "new", "verdicts"),
    [
        ("inconclusive: -2.08 [-4.4, 0.2]", "yes: -2.1 [-4.1, -0.1]", ("inconclusive", "yes")),
        ("yes", "no", ("yes", "no")), ("no, known", "yes", ("no", "yes")),
        ("inconclusive (one board)", "inconclusive", ("inconclusive (one board)", "inconclusive")),
        ("yes: +3.2 points", "yes: +3.1 points", None), ("no force", "yes", None), ("nothing", "yes", None),
        (True, False, None), (1.0, 2.0, None),
    ],
)  # fmt: skip
def test_change_of_the_verdict_at_the_start_of_a_text_is_recognised(old, new, verdicts):
    (difference,) = compare({"cell": old}, {"cell": new}).differing
    assert difference.verdicts == verdicts


@pytest.mark.parametrize("file", sorted(ROOT.glob("reports/*/numbers.json")), ids=lambda file: file.parent.name)
def test_names_of_committed_values_are_unique(file):
    named = list(leaves(read_json(file)))
    assert len(dict(named)) == len(named) > 100
