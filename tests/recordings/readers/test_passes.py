"""Tests that the passes of a recording are found from the repetition of its places."""

import time
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from reskin import seeds
from reskin.recordings.readers.alignment import find_passes


def raster(columns_n: int, rows_n: int, presses_n: int) -> np.ndarray:
    """Return the places of one pass over a grid with steps of 2 mm, with `presses_n` rows per place."""
    places = [(2.0 * x, 2.0 * y) for x in range(columns_n) for y in range(rows_n)]
    return np.repeat(np.array(places), presses_n, axis=0)


grids = st.tuples(st.integers(2, 5), st.integers(2, 5), st.integers(1, 6))


@settings(deadline=None)
@given(grid=grids, passes_n=st.integers(2, 5))
def test_new_pass_begins_where_the_raster_repeats(grid: tuple[int, int, int], passes_n: int) -> None:
    once = raster(*grid)
    place_mm = np.tile(once, (passes_n, 1))
    expected = np.repeat(np.arange(passes_n), len(once))
    assert find_passes(place_mm, np.ones(len(place_mm), bool)).tolist() == expected.tolist()


@settings(deadline=None)
@given(seed=st.integers(0, 1000), passes_n=st.integers(4, 8))
def test_places_of_rows_without_contact_do_not_change_the_passes(seed: int, passes_n: int) -> None:
    once = raster(4, 4, 3)
    place_mm = np.tile(once, (passes_n, 1))
    contact = seeds.rng_for(seed, "contact").random(len(place_mm)) > 0.1
    place_mm[~contact] = (4.0, 4.0)
    expected = np.repeat(np.arange(passes_n), len(once))
    assert find_passes(place_mm, contact).tolist() == expected.tolist()


@settings(deadline=None)
@given(grid=grids, passes_n=st.integers(2, 4), shift_mm=st.floats(-50, 50))
def test_passes_are_found_on_a_shifted_grid(grid: tuple[int, int, int], passes_n: int, shift_mm: float) -> None:
    place_mm = np.tile(raster(*grid), (passes_n, 1))
    contact = np.ones(len(place_mm), bool)
    np.testing.assert_array_equal(find_passes(place_mm + shift_mm, contact), find_passes(place_mm, contact))


def test_last_pass_may_have_fewer_rows() -> None:
    once = raster(3, 3, 2)
    place_mm = np.tile(once, (3, 1))[:-5]
    assert np.bincount(find_passes(place_mm, np.ones(len(place_mm), bool))).tolist() == [18, 18, 13]


def test_single_row_with_a_wrong_label_does_not_change_the_passes() -> None:
    place_mm = np.tile(raster(9, 9, 6), (5, 1))
    place_mm[700] = (-1.0, -1.0)
    assert find_passes(place_mm, np.ones(len(place_mm), bool)).max() == 4


def test_recording_in_which_no_place_repeats_is_one_pass() -> None:
    for place_mm in (raster(5, 5, 3), raster(1, 1, 40)):
        assert not find_passes(place_mm, np.ones(len(place_mm), bool)).any()


def test_recording_without_contact_is_one_pass() -> None:
    assert not find_passes(raster(3, 3, 2), np.zeros(18, bool)).any()


def passes_naively(place_mm: np.ndarray, contact: np.ndarray) -> np.ndarray:
    """Return the expected passes, by trying all periods and using the shortest one after which the places repeat."""
    rows_n = len(place_mm)
    touched = np.flatnonzero(contact).tolist()
    pairs = pairwise(touched)
    moves = [(a, b) for a, b in pairs if tuple(place_mm[a]) != tuple(place_mm[b])]
    for period_n in range(1, rows_n // 2 + 1):
        met = [(a, b) for a, b in moves if b + period_n < rows_n and contact[a + period_n] and contact[b + period_n]]
        same_n = sum(
            tuple(place_mm[a]) == tuple(place_mm[a + period_n]) and tuple(place_mm[b]) == tuple(place_mm[b + period_n])
            for a, b in met
        )
        if met and len(met) >= 0.25 * len(moves) and same_n >= 0.95 * len(met):
            return np.arange(rows_n) // period_n
    return np.zeros(rows_n, int)


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10000), once_n=st.integers(2, 30), touch=st.floats(0.3, 1.0), kinds_n=st.integers(1, 4))
def test_passes_equal_those_of_an_exhaustive_search(seed: int, once_n: int, touch: float, kinds_n: int) -> None:
    rng = seeds.rng_for(seed, "passes")
    place_mm = np.tile(rng.integers(0, kinds_n, (once_n, 2)).astype(float), (3, 1))[: rng.integers(2, 3 * once_n + 1)]
    contact = rng.random(len(place_mm)) < touch
    wrong = rng.random(len(place_mm)) < 0.02
    place_mm[wrong] = -1
    np.testing.assert_array_equal(find_passes(place_mm, contact), passes_naively(place_mm, contact))


def test_long_recording_without_repeated_places_is_searched_fast() -> None:
    place_mm = seeds.rng_for(0, "never").random((20000, 2))
    begin_s = time.process_time()
    assert not find_passes(place_mm, np.ones(len(place_mm), bool)).any()
    # An exhaustive search would take 17 s, and `find_passes` takes 0.1 to 0.3 s.
    assert time.process_time() - begin_s < 5
