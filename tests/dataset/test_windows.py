import doctest

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.errors import ParamsError
from pipeline.dataset import windows as documented
from pipeline.dataset.windows import check_one_each, lay_windows, take
from tests.dataset.tables import readings

sizes = st.tuples(st.integers(1, 60), st.integers(1, 10), st.integers(0, 10), st.integers(0, 9))


@given(sizes)
def test_windows_are_what_a_walk_along_the_capture_finds(sizes):
    units_n, test_n, more_n, less_n = sizes
    every_n = test_n + more_n
    expected, cut_n, start = [], 0, every_n
    while start < units_n:
        if start + test_n <= units_n:
            expected.append((start, start + test_n))
        else:
            cut_n = units_n - start
        start += every_n
    asked = {"train_n": max(1, every_n - less_n), "test_n": test_n, "every_n": every_n}
    if not expected:
        with pytest.raises(ParamsError, match="question drift: the shortest capture must be at least"):
            lay_windows([units_n], **asked)
        return
    windows = lay_windows([units_n], **asked)
    assert list(windows.tests) == expected
    assert windows.left_out_units_n == cut_n


@given(sizes)
def test_no_unit_is_trained_on_and_tested_or_tested_twice(sizes):
    units_n, test_n, more_n, less_n = sizes
    every_n = test_n + more_n
    windows = lay_windows(
        [units_n + every_n + test_n], train_n=max(1, every_n - less_n), test_n=test_n, every_n=every_n
    )
    used = [unit for span in (windows.train, *windows.tests) for unit in range(*span)]
    assert len(used) == len(set(used))


def test_captures_of_several_skins_are_tested_as_far_as_all_go_and_the_rest_is_counted():
    windows = lay_windows([12, 24], train_n=5, test_n=2, every_n=5)
    assert windows.tests == ((5, 7), (10, 12))
    assert windows.left_out_units_n == 24 - 15  # all after the start of the first window that the shorter one lacks


def test_what_is_taken_of_a_capture_is_whole_rows():
    some = take(readings(), np.array([0, 1, 0, 0, 1, 0], bool))
    assert some.x_mm.tolist() == [1, 4] == some.indentation.tolist()
    assert some.b_uT[:, 0].tolist() == [101, 104]
    assert (some.capture, len(some)) == ("c0", 2)


def test_two_captures_of_one_skin_are_refused_in_one_sentence():
    with pytest.raises(ParamsError, match="captures of skin s0 must be one, as no clock orders several; got c0, c1"):
        check_one_each([readings("c0"), readings("c1")])
    check_one_each([readings("c0"), readings("c1", skin="s1")])


def test_the_documented_windows_are_what_is_laid():
    outcome = doctest.testmod(documented)
    assert (outcome.attempted, outcome.failed) == (2, 0)
