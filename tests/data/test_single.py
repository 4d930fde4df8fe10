"""Tests of splits of the rows of one skin into training rows and test rows.

Only the paper's split puts readings of one indentation into both.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.model_selection import ShuffleSplit

from reskin.data.splits import Split, draw_folds, draw_sides
from reskin.errors import ParamsError
from tests.data.tables import rows

UNSPLIT_BY = {"single_indentation": "indentation", "single_pass": "pass_i"}
splits = st.builds(
    lambda fraction, repeats_n: Split(random_test_fraction=fraction, random_repeats_n=repeats_n),
    st.floats(0.05, 0.6), st.integers(1, 4),
)  # fmt: skip


def make_passes(passes_n: int, pokes_n: int, readings_n: int = 2, skins_n: int = 2):
    """Return rows of `skins_n` skins on one board.

    Each skin has `passes_n` passes of `pokes_n` indentations with `readings_n` rows each.
    """
    labels = [(skin, p) for skin in range(skins_n) for p in range(passes_n) for _ in range(pokes_n * readings_n)]
    table = rows(["b0"] * len(labels), [f"b0_s{skin}" for skin, _ in labels], [p for _, p in labels])
    return replace(table, indentation=np.arange(len(labels)) // readings_n)


@pytest.mark.parametrize("experiment", UNSPLIT_BY)
@given(passes_n=st.integers(2, 7), pokes_n=st.integers(1, 6), split=splits, seed=st.integers(0, 2**40))
def test_readings_of_one_indentation_or_pass_are_all_for_training_or_all_for_tests(
    experiment, passes_n, pokes_n, split, seed
):
    table = make_passes(passes_n, pokes_n)
    group = getattr(table, UNSPLIT_BY[experiment])
    folds = draw_folds(table, [experiment], split, seed)
    assert [fold.name for fold in folds] == [f"repeat{i}" for i in range(split.random_repeats_n)]
    for fold in folds:
        assert not {*group[fold.train]} & {*group[fold.test]}
        assert not {*table.indentation[fold.train]} & {*table.indentation[fold.test]}
        assert sorted([*fold.train, *fold.test]) == np.flatnonzero(table.skin == "b0_s0").tolist()
        assert len(fold.test) > 0
        assert len(fold.pool) == 0


@given(st.integers(2, 200), st.floats(0.01, 0.9), st.integers(0, 2**32 - 1))
def test_split_of_single_readings_equals_scikit_learn(rows_n, fraction, state):
    test_n = max(1, round(fraction * rows_n))
    if test_n == rows_n:
        return
    ours = draw_sides(np.arange(rows_n), test_fraction=fraction, repeats_n=2, state=state, what="rows", where="here")
    theirs = ShuffleSplit(2, test_size=test_n, random_state=state).split(np.arange(rows_n))
    for (train, test), (train_too, test_too) in zip(ours, theirs, strict=True):
        assert train.tolist() == sorted(train_too)
        assert test.tolist() == sorted(test_too)


def test_at_least_one_pass_is_held_out_for_tests():
    table = make_passes(4, 5)
    folds = draw_folds(table, ["single_pass"], Split(random_test_fraction=0.1, random_repeats_n=20), 0)
    assert {len({*table.pass_i[fold.test]}) for fold in folds} == {1}
    # For an arbitrary seed, the probability that one of four passes is never tested is 4 (3/4)^20 = 1 %.
    assert {int(table.pass_i[fold.test[0]]) for fold in folds} == {0, 1, 2, 3}


def test_split_by_passes_raises_if_a_skin_has_only_one_pass():
    split = Split(random_test_fraction=0.1, random_repeats_n=1)
    with pytest.raises(ParamsError, match="experiment single_pass: 1 passes of skin b0_s0 are too few to split"):
        draw_folds(make_passes(1, 5), ["single_pass"], split, 0)
