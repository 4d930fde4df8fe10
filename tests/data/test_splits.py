"""Tests of folds, which divide rows into training rows, test rows and the pool (pokes for adaptation).

Further tests are about the JSON format of folds.
"""

import doctest
import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data import splits
from reskin.data.splits import Split, draw_folds, parse_folds, render_folds
from reskin.errors import ParamsError, SchemaError
from tests.data.tables import rows

TRANSFER = Split(transfer_skins_n=3)
RANDOM = Split(random_test_fraction=0.1, random_repeats_n=4)
TEMPORAL = Split(temporal_test_fraction=0.2)

labels = st.lists(st.tuples(st.sampled_from("abcd"), st.integers(0, 2)), min_size=4, max_size=40)


def rows_of_pairs(pairs):
    return rows([f"b{board}" for board, _ in pairs], [f"b{board}_s{skin}" for board, skin in pairs])


def six_by_three(readings_n: int = 4):
    return rows_of_pairs([(board, skin) for board in range(6) for skin in range(3) for _ in range(readings_n)])


@given(labels.filter(lambda pairs: len({board for board, _ in pairs}) > 1))
def test_every_row_is_held_out_in_exactly_one_fold(pairs):
    table = rows_of_pairs(pairs)
    folds = draw_folds(table, ["lobo"], Split(), 0)
    assert sorted(np.concatenate([fold.test for fold in folds]).tolist()) == list(range(len(table)))
    for fold in folds:
        assert sorted([*fold.train, *fold.test]) == list(range(len(table)))
        for names in (table.board, table.skin):
            assert not set(names[fold.train]) & set(names[fold.test])


@given(st.permutations(range(18)))
def test_folds_do_not_depend_on_the_order_of_rows(order):
    pairs = [(board, skin) for board in range(6) for skin in range(3)]
    original, shuffled = rows_of_pairs(pairs), rows_of_pairs([pairs[i] for i in order])
    for experiment, split in (("lobo", Split()), ("transfer", TRANSFER)):
        expected, actual = (draw_folds(table, [experiment], split, 0) for table in (original, shuffled))
        for one, other in zip(expected, actual, strict=True):
            assert one.name == other.name
            assert set(original.skin[one.test]) == set(shuffled.skin[other.test])


def test_each_transfer_fold_trains_on_one_skin_and_tests_nine_skins_of_other_boards():
    table = six_by_three()
    folds = draw_folds(table, ["transfer"], TRANSFER, 0)
    assert [set(table.skin[fold.train]) for fold in folds] == [{"b0_s0"}, {"b1_s0"}, {"b2_s0"}]
    for fold in folds:
        assert len(set(table.skin[fold.test])) == 9
        assert not set(table.board[fold.train]) & set(table.board[fold.test])


def test_experiment_single_random_splits_the_readings_of_one_skin():
    table = six_by_three(50)
    folds = draw_folds(table, ["single_random"], RANDOM, 5)
    assert len(folds) == 4
    assert {len(fold.test) for fold in folds} == {5}
    for fold in folds:
        assert set(table.skin[np.concatenate([fold.train, fold.test])]) == {"b0_s0"}
        assert not set(fold.train) & set(fold.test)
    assert len({tuple(fold.test) for fold in folds}) > 1
    again = draw_folds(table, ["single_random"], RANDOM, 5)
    assert all((a.test == b.test).all() for a, b in zip(folds, again, strict=True))


@given(st.integers(3, 30))
def test_experiment_single_temporal_tests_the_last_passes(passes_n):
    table = rows(["b0"] * 2 * passes_n, ["s0"] * 2 * passes_n, [i // 2 for i in range(2 * passes_n)])
    (fold,) = draw_folds(table, ["single_temporal"], TEMPORAL, 0)
    assert table.pass_i[fold.train].max() < table.pass_i[fold.test].min()
    assert len(fold.train) + len(fold.test) == len(table)


def six_by_three_in_passes(passes_n: int, readings_n: int = 2):
    labels = [
        (f"b{board}", f"b{board}_s{skin}", pass_i)
        for board in range(6) for skin in range(3) for pass_i in range(passes_n) for _ in range(readings_n)
    ]  # fmt: skip
    return rows(*(list(column) for column in zip(*labels, strict=True)))


SENSORS = Split(sensors_skins_n=(15, 1, 6), sensors_draws_n=3, pool_passes_n=2)


@pytest.mark.parametrize(("experiment", "split"), [("lobo", Split(pool_passes_n=2)), ("sensors", SENSORS)])
def test_pool_consists_of_the_first_passes_of_held_out_skins(experiment, split):
    table = six_by_three_in_passes(5)
    for fold in draw_folds(table, [experiment], split, 0):
        board = {*table.board[fold.test]}
        assert len(board) == 1
        held = [i for i in range(len(table)) if table.board[i] in board]
        assert fold.pool.tolist() == [i for i in held if table.pass_i[i] in (0, 1)]
        assert fold.test.tolist() == [i for i in held if table.pass_i[i] not in (0, 1)]
        assert not {*table.indentation[fold.pool]} & {*table.indentation[fold.test]}


@given(st.integers(0, 2**32))
def test_smaller_sets_of_sensors_are_subsets_of_larger_ones_in_the_same_draw(seed):
    table = six_by_three_in_passes(3, readings_n=1)
    folds = {fold.name: fold for fold in draw_folds(table, ["sensors"], SENSORS, seed)}
    boards = [f"b{i}" for i in range(6)]
    assert list(folds) == [
        name
        for board in boards
        for name in [board, *(f"{board}-{k:02d}skins-draw{draw_i}" for k in (1, 6) for draw_i in range(3))]
    ]
    for board, draw_i in product(boards, range(3)):
        of_sizes = [*(folds[f"{board}-{k:02d}skins-draw{draw_i}"] for k in (1, 6)), folds[board]]
        assert {skin for fold in of_sizes for skin in table.skin[fold.test]} == {f"{board}_s{i}" for i in range(3)}
        one, six, all_of_them = ({*table.skin[fold.train]} for fold in of_sizes)
        assert one < six < all_of_them
        assert (len(one), len(six), len(all_of_them)) == (1, 6, 15)
        assert board not in {skin[:2] for skin in all_of_them}


ALMOST_ALL = Split(random_test_fraction=0.95, random_repeats_n=1)
POOL_OF_2 = Split(pool_passes_n=2)
MANY_SENSORS = Split(sensors_skins_n=(3, 16), sensors_draws_n=1)
ONE_BOARD = rows(["b0"] * 3, ["s0"] * 3)
TWO_CAPTURES = replace(ONE_BOARD, capture=np.array(["run2", "run10", "run10"]))


@pytest.mark.parametrize(
    ("table", "experiment", "split", "message"),
    [
        (ONE_BOARD, "lobo", Split(), "experiment lobo: boards must be two or more; got 1"),
        (ONE_BOARD, "transfer", TRANSFER, "split.transfer_skins_n must be less than .* in the scene, 1; got 3"),
        (ONE_BOARD, "single_temporal", TEMPORAL, "1 passes of skin s0 are too few .* of 0.2 holds out 0"),
        (ONE_BOARD, "single_random", ALMOST_ALL, "3 readings of skin s0 are too few .* of 0.95 holds out 3"),
        (six_by_three_in_passes(2), "lobo", POOL_OF_2, "passes of held-out skin b0_s0 must be more than .*, 2; got 2"),
        (six_by_three_in_passes(2), "sensors", SENSORS, "passes of held-out skin b0_s0 must be more than .*, 2; got 2"),
        (six_by_three_in_passes(1), "sensors", MANY_SENSORS, "at most the 15 skins of all boards but b0; got 16"),
        (ONE_BOARD, "sensors", SENSORS, "at most the 0 skins of all boards but b0; got 15"),
        (TWO_CAPTURES, "single_temporal", TEMPORAL, "captures of skin s0 is unknown: run10, run2"),
    ],
)  # fmt: skip
def test_draw_folds_raises_if_the_settings_do_not_fit_the_rows(table, experiment, split, message):
    with pytest.raises(ParamsError, match=message):
        draw_folds(table, [experiment], split, 0)


@pytest.mark.parametrize(
    ("experiment", "split"), [("lobo", Split()), ("sensors", Split(sensors_skins_n=(1,), sensors_draws_n=1))]
)
def test_draw_folds_raises_if_a_skin_is_on_two_boards(experiment, split):
    with pytest.raises(ParamsError, match="is both in the training rows and in the held-out rows"):
        draw_folds(rows(["b0", "b1"], ["s0", "s0"]), [experiment], split, 0)


TABLE = rows(["b0", "b0", "b1", "b2"], ["s0", "s0", "s1", "s2"])


PASSES = rows(["b0"] * 3 + ["b1"] * 2, ["s0"] * 3 + ["s1"] * 2, [0, 1, 2, 0, 1])


@pytest.mark.parametrize(("table", "split"), [(TABLE, Split()), (PASSES, Split(pool_passes_n=1))])
def test_saved_folds_are_read_unchanged(table, split):
    def listed(folds):
        return [[one.name, one.train.tolist(), one.test.tolist(), one.pool.tolist()] for one in folds]

    folds = draw_folds(table, ["lobo"], split, 0)
    document = json.loads(json.dumps(render_folds(["c0"], table, folds)))
    assert listed(parse_folds(document, table, "folds.json")) == listed(folds)


def test_parse_folds_raises_if_folds_were_saved_for_other_rows():
    document = render_folds(["c0"], TABLE, draw_folds(TABLE, ["lobo"], Split(), 0))
    with pytest.raises(SchemaError, match="but the captures have 2 rows"):
        parse_folds(document, rows(["b0", "b1"], ["s0", "s1"]), "folds.json")


def test_examples_in_docstrings_run():
    outcome = doctest.testmod(splits, extraglobs={"np": np})
    assert outcome.attempted > 0
    assert outcome.failed == 0
