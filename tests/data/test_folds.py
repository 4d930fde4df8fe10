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
def test_ranges_round_trip(numbers):
    sorted_numbers = np.array(sorted(numbers), np.int64)
    assert from_ranges(to_ranges(sorted_numbers)).tolist() == sorted_numbers.tolist()


PASSES = rows(["b0"] * 3 + ["b1"] * 2, ["s0"] * 3 + ["s1"] * 2, [0, 1, 2, 0, 1])


@pytest.mark.parametrize(("table", "split"), [(TABLE, Split()), (PASSES, Split(pool_passes_n=1))])
def test_folds_round_trip(table, split):
    def listed(folds):
        return [[one.name, one.train.tolist(), one.test.tolist(), one.pool.tolist()] for one in folds]

    drawn = draw_folds(table, ["lobo"], split, 0)
    document = json.loads(json.dumps(render_folds(["c0"], table, drawn)))
    assert listed(parse_folds(document, table, "folds.json")) == listed(drawn)


def test_folds_list_boards_and_skins():
    document = render_folds(["c0"], TABLE, draw_folds(TABLE, ["lobo"], Split(), 0))
    assert document["folds"][0]["test_boards"] == ["b0"]
    assert document["folds"][0]["train_skins"] == ["s1", "s2"]
    assert document["folds"][0]["pool_skins"] == []
    document = render_folds(["c0"], PASSES, draw_folds(PASSES, ["lobo"], Split(pool_passes_n=1), 0))
    assert [(one["pool_boards"], one["pool_skins"]) for one in document["folds"]] == [
        (["b0"], ["s0"]),
        (["b1"], ["s1"]),
    ]


def test_folds_of_other_rows_are_refused():
    document = render_folds(["c0"], TABLE, draw_folds(TABLE, ["lobo"], Split(), 0))
    with pytest.raises(SchemaError, match="rows_n must be the 2 rows"):
        parse_folds(document, rows(["b0", "b1"], ["s0", "s1"]), "folds.json")


def test_docstring_examples():
    outcome = doctest.testmod(splits, extraglobs={"np": np})
    assert outcome.attempted > 0
    assert outcome.failed == 0
