from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data.grid import points_mm, protocol
from reskin.data.lines import Lines, grid_lines, hand_lines, take_pokes
from reskin.data.rows import Rows, Selection, gather, stack
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from tests.data.tables import readings
from tests.data.tables import rows as make_rows

READINGS_N = 2  # The number of readings of each indentation.


def rows_at(place_mm, skins=None, indentation=None) -> Rows:
    """Return rows at these places (x, y in mm). By default, every row is an indentation of its own."""
    f = len(place_mm)
    skins = ["s0"] * f if skins is None else skins
    table = make_rows([f"b_{skin}" for skin in skins], skins)
    target = np.column_stack([place_mm, np.arange(f)]).astype(np.float32)
    numbers = np.arange(f) if indentation is None else np.asarray(indentation, np.int64)
    return replace(table, target=target, indentation=numbers)


def grid(depths_n: int = 1, passes_n: int = 1, skin: str = "s0") -> Rows:
    pokes = protocol([0.5 + 0.1 * i for i in range(depths_n)], passes_n)
    place_mm = np.repeat(np.column_stack([pokes.x_mm, pokes.y_mm]), READINGS_N, axis=0)
    return rows_at(place_mm, [skin] * len(place_mm), np.repeat(pokes.indentation, READINGS_N))


def all_rows(table: Rows) -> np.ndarray:
    return np.arange(len(table))


def as_set(lines: Lines, names=None) -> set:
    """Return the set of lines.

    Each line is a set of pairs (row, index along the line); the numbers of lines are ignored.
    """
    names = np.arange(lines.row.max() + 1) if names is None else np.asarray(names)
    pairs_of = {line: [] for line in lines.line_i.tolist()}
    for row, line, order in zip(lines.row, lines.line_i, lines.order_i, strict=True):
        pairs_of[int(line)].append((int(names[row]), int(order)))
    return {frozenset(pairs) for pairs in pairs_of.values()}


def grid_lines_naively(table: Rows, chosen) -> set:
    """Return the reference: rows with equal y form a line, with x as the index, and rows with equal x form a line."""
    found = set()
    place = {int(i): (str(table.skin[i]), *(round(float(v) * 10) for v in table.target[i, :2])) for i in chosen}
    for i in place:
        for across, along in ((2, 1), (1, 2)):
            skin = place[i][0]
            ranks = sorted({other[along] for other in place.values() if other[0] == skin})
            mates = [j for j in place if place[j][0] == skin and place[j][across] == place[i][across]]
            line = frozenset((j, ranks.index(place[j][along])) for j in mates)
            if len({order for _, order in line}) > 1:
                found.add((across, line))
    return found


places = st.lists(
    st.tuples(st.sampled_from(["s0", "s1"]), st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=30
)


@given(places, st.data())
def test_lines_of_a_grid_equal_those_found_by_nested_loops(labels, data):
    table = rows_at([(1.3 * x, 0.7 * y) for _, x, y in labels], [skin for skin, _, _ in labels])
    chosen = np.array(sorted(data.draw(st.sets(st.integers(0, len(labels) - 1), min_size=1))))
    lines, naive = grid_lines(table, chosen), grid_lines_naively(table, chosen)
    assert as_set(lines, all_rows(table)) == {line for _, line in naive}
    assert len(set(lines.line_i.tolist())) == len(naive)
    assert sorted(set(lines.line_i.tolist())) == list(range(len(naive)))


@given(places, st.data())
def test_lines_do_not_depend_on_the_order_of_rows(labels, data):
    order = data.draw(st.permutations(range(len(labels))))
    original = rows_at([(x, y) for _, x, y in labels], [skin for skin, _, _ in labels])
    reordered = [labels[i] for i in order]
    shuffled = rows_at([(x, y) for _, x, y in reordered], [skin for skin, _, _ in reordered])
    expected, found = grid_lines(original, all_rows(original)), grid_lines(shuffled, all_rows(shuffled))
    restored = [np.array(order)[found.row], found.line_i, found.order_i]
    assert sorted(zip(*map(np.ndarray.tolist, restored), strict=True)) == sorted(
        zip(expected.row.tolist(), expected.line_i.tolist(), expected.order_i.tolist(), strict=True)
    )


def test_places_that_differ_only_by_rounding_count_as_one_place():
    lines = grid_lines(rows_at([(0, 0), (2.00001, 0), (1.99999, 0.02), (4, 0)]), np.arange(4))
    assert as_set(lines) == {frozenset({(0, 0), (1, 1), (2, 1), (3, 2)})}


@pytest.mark.parametrize("lines", [grid_lines(grid(), np.arange(130)), hand_lines(*np.zeros((2, 4), np.int32))])
def test_lines_contain_no_places_forces_or_fields(lines):
    assert [field.name for field in fields(lines)] == ["row", "line_i", "order_i"]
    assert set(vars(lines)) == {"row", "line_i", "order_i"}
    for array in vars(lines).values():
        assert array.dtype.kind == "i"
        assert array.base is None  # The array is a copy. A view would give access to the whole table.


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 5)), min_size=1, max_size=30))
def test_lines_of_hand_pokes_equal_those_found_by_nested_loops(pokes):
    pass_i, poke_i = (np.array(column, np.int32) for column in zip(*pokes, strict=True))
    indentation = (10 * pass_i + poke_i).astype(np.int32)  # The numbers of indentations continue from pass to pass.
    naive = set()
    for one in set(pass_i.tolist()):
        pokes_of_pass = [i for i in range(len(pokes)) if pass_i[i] == one]
        first = min(indentation[i] for i in pokes_of_pass)
        if len({indentation[i] for i in pokes_of_pass}) > 1:
            naive.add(frozenset((i, int(indentation[i] - first)) for i in pokes_of_pass))
    lines = hand_lines(pass_i, indentation)
    assert as_set(lines, range(len(pokes))) == naive
    assert sorted(set(lines.line_i.tolist())) == list(range(len(naive)))


@given(st.integers(0, 6 * 65), st.integers(0, 2**32))
def test_chosen_pokes_are_spread_evenly_over_places(indentations_n, seed):
    table = grid(depths_n=3, passes_n=2)
    chosen = take_pokes(table, all_rows(table), indentations_n, rng_for(seed, "pokes"))
    indentations = set(table.indentation[chosen].tolist())
    assert len(indentations) == indentations_n
    assert chosen.tolist() == [row for row in range(len(table)) if table.indentation[row] in indentations]
    counts = Counter(map(tuple, table.target[chosen, :2].tolist()))
    visits_n = [counts[tuple(place_mm)] // READINGS_N for place_mm in points_mm().tolist()]
    assert max(visits_n) - min(visits_n) <= 1


def test_each_place_and_each_of_its_visits_is_equally_likely_to_be_chosen():
    # Place 0 has 8 visits, and place 1 has one. Both places are chosen with equal probability. At place 0, all visits
    # are equally likely.
    table = rows_at([(0, 0)] * 8 + [(2, 0)])
    draws_n = Counter(int(take_pokes(table, all_rows(table), 1, rng_for(0, "fair", i))[0]) for i in range(1600))
    # The tolerance is four standard deviations of a binomial distribution with p = 1/2.
    assert abs(draws_n[8] - 800) < 4 * np.sqrt(1600 / 4)
    assert all(abs(draws_n[row] - 100) < 4 * np.sqrt(100 * 15 / 16) for row in range(8))


def test_take_pokes_raises_if_the_pool_has_too_few_pokes():
    table = grid()
    with pytest.raises(
        ParamsError, match="skin s0: the number of pokes to draw must be at most the 65 indentations.*; got 66"
    ):
        take_pokes(table, all_rows(table), 66, rng_for(0, "pokes"))


def test_take_pokes_raises_if_the_pool_contains_several_skins():
    with pytest.raises(ParamsError, match="of several skins: s0, s1"):
        take_pokes(rows_at([(0, 0), (2, 0)], ["s0", "s1"]), np.arange(2), 1, rng_for(0, "pokes"))


ALL_READINGS = Selection(force_min_N=0.0)


@given(st.integers(2, 12), st.integers(2, 12))
def test_stacked_tables_keep_their_rows_and_get_new_indentation_numbers(above_n, below_n):
    above, below = (
        gather([readings("c0", f=above_n)], ALL_READINGS),
        gather([readings("c1", skin="s1", f=below_n)], ALL_READINGS),
    )
    both = stack(above, below)
    assert len(both) == above_n + below_n
    for name in ("capture", "board", "skin", "db_uT", "target", "pass_i", "indentation"):
        assert (getattr(both, name)[:above_n] == getattr(above, name)).all()
    assert (both.db_uT[above_n:] == below.db_uT).all()
    assert (both.skin[above_n:] == "s1").all()
    assert not {*both.indentation[:above_n]} & {*both.indentation[above_n:]}
    assert len({*both.indentation[above_n:]}) == len({*below.indentation})


def test_stacking_raises_if_channels_differ():
    wide = {name: np.zeros((6, 6), np.float32) for name in ("b_uT", "noload_uT")}
    other = gather([readings("c1", skin="s1", temperature_degC=np.zeros((6, 2), np.float32), **wide)], ALL_READINGS)
    with pytest.raises(ParamsError, match="6 channels, but c0 has 3"):
        stack(gather([readings("c0")], ALL_READINGS), other)
