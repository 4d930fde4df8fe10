import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reskin.data import windows as documented
from reskin.data.baseline import each, initial, rank
from reskin.data.rows import Selection, gather
from reskin.data.windows import TRAIN, check_one_per_skin, make_parts, make_windows, stack, take
from reskin.errors import ParamsError
from tests.data.tables import readings

sizes = st.tuples(st.integers(1, 60), st.integers(1, 10), st.integers(0, 10), st.integers(0, 9))


@given(sizes)
def test_windows_equal_those_found_by_a_loop(sizes):
    units_n, test_n, more_n, less_n = sizes
    every_n = test_n + more_n
    expected, cut_n, start = [], 0, every_n
    while start < units_n:
        if start + test_n <= units_n:
            expected.append((start, start + test_n))
        else:
            cut_n = units_n - start
        start += every_n
    sizes_n = {"train_n": max(1, every_n - less_n), "test_n": test_n, "every_n": every_n}
    if not expected:
        with pytest.raises(ParamsError, match="experiment drift: the shortest capture must be at least"):
            make_windows([units_n], **sizes_n)
        return
    windows = make_windows([units_n], **sizes_n)
    assert list(windows.tests) == expected
    assert windows.left_out_units_n == cut_n


@given(sizes)
def test_no_unit_is_in_two_windows(sizes):
    units_n, test_n, more_n, less_n = sizes
    every_n = test_n + more_n
    windows = make_windows(
        [units_n + every_n + test_n], train_n=max(1, every_n - less_n), test_n=test_n, every_n=every_n
    )
    used = [unit for span in (windows.train, *windows.tests) for unit in range(*span)]
    assert len(used) == len(set(used))


def test_no_window_extends_beyond_the_end_of_the_shortest_capture():
    windows = make_windows([12, 24], train_n=5, test_n=2, every_n=5)
    assert windows.tests == ((5, 7), (10, 12))
    # The last window ends with the shorter capture, so the last units of the longer capture are in no window.
    assert windows.left_out_units_n == 24 - 15


def test_take_selects_rows_with_all_their_columns():
    taken = take(readings(), np.array([0, 1, 0, 0, 1, 0], bool))
    assert taken.x_mm.tolist() == [1, 4] == taken.indentation.tolist()
    assert taken.b_uT[:, 0].tolist() == [101, 104]
    assert (taken.capture, len(taken)) == ("c0", 2)


def test_check_one_per_skin_raises_if_a_skin_has_two_captures():
    with pytest.raises(ParamsError, match="the order in time of the 2 captures of skin s0 is unknown: c0, c1"):
        check_one_per_skin([readings("c0"), readings("c1")])
    check_one_per_skin([readings("c0"), readings("c1", skin="s1")])


def test_examples_in_docstrings_run():
    outcome = doctest.testmod(documented)
    assert (outcome.attempted, outcome.failed) == (2, 0)


POLICIES = {
    name: lambda captured, choose=choose: choose(captured.noload_uT, captured.indentation)
    for name, choose in (("initial", initial), ("each", each))
}


def capture(skin: str, f: int = 24):
    """Return `f` indentations with one reading each.

    The no-load field is the number of the indentation. Every fifth force is too low to be selected.
    """
    noload_uT = np.tile(np.arange(f, dtype=np.float32)[:, None], (1, 3))
    weak = np.where(np.arange(f) % 5 == 0, 0.01, 1).astype(np.float32)
    return readings(skin, skin=skin, f=f, noload_uT=noload_uT, b_uT=np.full((f, 3), 100, np.float32), Fz_N=weak)


def example_parts(*skins: str):
    captures = [(one, rank(one.indentation)) for one in map(capture, skins)]
    windows = make_windows([24] * len(skins), train_n=6, test_n=4, every_n=8)
    return make_parts(captures, POLICIES, windows=windows, selection=Selection(force_min_N=0.1))


def test_parts_have_the_field_changes_of_their_window_and_no_load_policy():
    for part in example_parts("s0", "s1"):
        start, end = {TRAIN: (0, 6), 0: (8, 12), 1: (16, 20)}[part.window_i]
        strong = [i for i in range(start, end) if i % 5]
        expected = [100.0 - (i if part.policy == "each" else 0) for i in strong]
        assert part.rows.db_uT[:, 0].tolist() == expected
        off = [0 if part.policy == "each" else i**2 for i in range(start, end)]
        np.testing.assert_allclose(part.noload_off_uT, np.sqrt(np.mean(off)))


def test_policy_initial_uses_the_first_no_load_reading_even_if_its_row_is_not_selected():
    first = next(part for part in example_parts("s0") if (part.policy, part.window_i) == ("initial", TRAIN))
    # The initial no-load field is that of reading 0, whose row is not selected because its force is too low.
    assert (first.rows.db_uT == 100).all()


def test_row_i_of_a_part_contains_the_indices_of_its_rows():
    parts = example_parts("s0", "s1")
    rows = stack(parts)
    assert np.concatenate([part.row_i for part in parts]).tolist() == list(range(len(rows)))
    for part in parts:
        assert (rows.db_uT[part.row_i] == part.rows.db_uT).all()
        assert (rows.skin[part.row_i] == part.readings.skin).all()


def test_rows_that_are_not_selected_are_counted_once():
    weak_n = sum(i % 5 == 0 for window in ((0, 6), (8, 12), (16, 20)) for i in range(*window))
    assert stack(example_parts("s0")).dropped == {"no_contact_rows_n": 0, "low_force_rows_n": weak_n}


@given(st.integers(1, 5), st.integers(1, 4), st.integers(0, 3))
def test_parts_with_policy_each_equal_the_gathered_rows_of_their_window(train_n, test_n, more_n):
    every_n = max(train_n, test_n) + more_n
    windows = make_windows([24], train_n=train_n, test_n=test_n, every_n=every_n)
    one, everything = capture("s0"), Selection(force_min_N=0.0)
    parts = make_parts(
        [(one, rank(one.indentation))], {"each": POLICIES["each"]}, windows=windows, selection=everything
    )
    whole = gather([one], everything)
    for part, (start, end) in zip(parts, (windows.train, *windows.tests), strict=True):
        assert (part.rows.db_uT == whole.db_uT[start:end]).all()
        assert (part.rows.target == whole.target[start:end]).all()
