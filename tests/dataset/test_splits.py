from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.dataset.splits import Split, draw_folds
from pipeline.errors import ParamsError
from tests.dataset.tables import rows

TRANSFER = Split(transfer_skins_n=3)
RANDOM = Split(random_test_fraction=0.1, random_repeats_n=4)
TEMPORAL = Split(temporal_test_fraction=0.2)

labels = st.lists(st.tuples(st.sampled_from("abcd"), st.integers(0, 2)), min_size=4, max_size=40)


def of_pairs(pairs):
    return rows([f"b{board}" for board, _ in pairs], [f"b{board}_s{skin}" for board, skin in pairs])


def six_by_three(readings_n: int = 4):
    return of_pairs([(board, skin) for board in range(6) for skin in range(3) for _ in range(readings_n)])


@given(labels.filter(lambda pairs: len({board for board, _ in pairs}) > 1))
def test_every_row_is_held_out_once_and_never_trained_on_in_its_fold(pairs):
    table = of_pairs(pairs)
    folds = draw_folds(table, ["lobo"], Split(), 0)
    assert sorted(np.concatenate([fold.test for fold in folds]).tolist()) == list(range(len(table)))
    for fold in folds:
        assert sorted([*fold.train, *fold.test]) == list(range(len(table)))
        for names in (table.board, table.skin):
            assert not set(names[fold.train]) & set(names[fold.test])


def test_six_boards_give_six_folds_of_three_skins():
    table = six_by_three()
    folds = draw_folds(table, ["lobo"], Split(), 0)
    assert [fold.name for fold in folds] == [f"b{i}" for i in range(6)]
    assert all(len(set(table.skin[fold.test])) == 3 for fold in folds)


@given(st.permutations(range(18)))
def test_the_order_of_rows_does_not_decide_who_is_held_out(order):
    pairs = [(board, skin) for board in range(6) for skin in range(3)]
    straight, shuffled = of_pairs(pairs), of_pairs([pairs[i] for i in order])
    for question, split in (("lobo", Split()), ("transfer", TRANSFER)):
        ahead, behind = (draw_folds(table, [question], split, 0) for table in (straight, shuffled))
        for one, other in zip(ahead, behind, strict=True):
            assert one.name == other.name
            assert set(straight.skin[one.test]) == set(shuffled.skin[other.test])


def test_transfer_is_three_single_skins_on_nine_others_as_in_the_paper():
    table = six_by_three()
    folds = draw_folds(table, ["transfer"], TRANSFER, 0)
    assert [set(table.skin[fold.train]) for fold in folds] == [{"b0_s0"}, {"b1_s0"}, {"b2_s0"}]
    for fold in folds:
        assert len(set(table.skin[fold.test])) == 9
        assert not set(table.board[fold.train]) & set(table.board[fold.test])


def test_random_readings_stay_within_one_skin_and_differ_between_repeats():
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
def test_the_last_passes_are_tested_and_no_later_pass_is_trained_on(passes_n):
    table = rows(["b0"] * 2 * passes_n, ["s0"] * 2 * passes_n, [i // 2 for i in range(2 * passes_n)])
    (fold,) = draw_folds(table, ["single_temporal"], TEMPORAL, 0)
    assert table.pass_i[fold.train].max() < table.pass_i[fold.test].min()
    assert len(fold.train) + len(fold.test) == len(table)


def test_fifty_passes_split_forty_to_ten():
    table = rows(["b0"] * 50, ["s0"] * 50, list(range(50)))
    (fold,) = draw_folds(table, ["single_temporal"], TEMPORAL, 0)
    assert (len(fold.train), len(fold.test)) == (40, 10)


ALMOST_ALL = Split(random_test_fraction=0.95, random_repeats_n=1)
ONE_BOARD = rows(["b0"] * 3, ["s0"] * 3)
TWO_CAPTURES = replace(ONE_BOARD, capture=np.array(["run2", "run10", "run10"]))


@pytest.mark.parametrize(
    ("table", "question", "split", "sentence"),
    [
        (ONE_BOARD, "lobo", Split(), "question lobo: boards must be two or more; got 1"),
        (ONE_BOARD, "transfer", TRANSFER, "split.transfer_skins_n must be less than .* 1 boards; got 3"),
        (ONE_BOARD, "single_temporal", TEMPORAL, "passes of skin s0 must be .*; got 1, of which 0.2 are 0"),
        (ONE_BOARD, "single_random", ALMOST_ALL, "got 3, of which 0.95 are 3"),
        (TWO_CAPTURES, "single_temporal", TEMPORAL, "the captures of skin s0 must be one, .*; got run10, run2"),
    ],
)  # fmt: skip
def test_folds_that_the_data_cannot_give_are_one_sentence(table, question, split, sentence):
    with pytest.raises(ParamsError, match=sentence):
        draw_folds(table, [question], split, 0)


def test_a_planted_leak_a_skin_on_two_boards_is_refused():
    with pytest.raises(ParamsError, match="a skin must be on one side only; got s0 on both"):
        draw_folds(rows(["b0", "b1"], ["s0", "s0"]), ["lobo"], Split(), 0)
