import doctest
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data import splits
from reskin.data.splits import Split, draw_folds, from_ranges, parse_folds, render_folds, to_ranges
from reskin.errors import SchemaError
from tests.data.tables import rows

TABLE = rows(["b0", "b0", "b1", "b2"], ["s0", "s0", "s1", "s2"])


@given(st.sets(st.integers(0, 200)))
def test_ranges_hold_exactly_the_numbers(numbers):
    sorted_numbers = np.array(sorted(numbers), np.int64)
    assert from_ranges(to_ranges(sorted_numbers)).tolist() == sorted_numbers.tolist()


PASSES = rows(["b0"] * 3 + ["b1"] * 2, ["s0"] * 3 + ["s1"] * 2, [0, 1, 2, 0, 1])


@pytest.mark.parametrize(("table", "split"), [(TABLE, Split()), (PASSES, Split(pool_passes_n=1))])
def test_folds_survive_json_with_and_without_a_pool(table, split):
    def listed(folds):
        return [[one.name, one.train.tolist(), one.test.tolist(), one.pool.tolist()] for one in folds]

    drawn = draw_folds(table, ["lobo"], split, 0)
    words = json.loads(json.dumps(render_folds(["c0"], table, drawn)))
    assert listed(parse_folds(words, table, "folds.json")) == listed(drawn)


def test_folds_tell_a_reader_who_is_on_which_side():
    words = render_folds(["c0"], TABLE, draw_folds(TABLE, ["lobo"], Split(), 0))
    assert words["folds"][0]["test_boards"] == ["b0"]
    assert words["folds"][0]["train_skins"] == ["s1", "s2"]
    assert words["folds"][0]["pool_skins"] == []
    words = render_folds(["c0"], PASSES, draw_folds(PASSES, ["lobo"], Split(pool_passes_n=1), 0))
    assert [(one["pool_boards"], one["pool_skins"]) for one in words["folds"]] == [(["b0"], ["s0"]), (["b1"], ["s1"])]


def test_folds_of_other_rows_are_refused():
    words = render_folds(["c0"], TABLE, draw_folds(TABLE, ["lobo"], Split(), 0))
    with pytest.raises(SchemaError, match="rows_n must be the 2 rows"):
        parse_folds(words, rows(["b0", "b1"], ["s0", "s1"]), "folds.json")


def test_the_folds_drawn_in_the_docstrings_are_right():
    outcome = doctest.testmod(splits, extraglobs={"np": np})
    assert outcome.attempted > 0
    assert outcome.failed == 0
