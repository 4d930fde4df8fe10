"""Tests of drawing triplets for the triplet loss.

A triplet consists of an anchor, a positive that is nearer to the anchor, and a negative that is farther away. All
three are points of one group.
"""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from reskin.errors import TrainingError
from reskin.models.losses import TripletPoints, draw_triplets, triplet_points
from reskin.seeds import rng_for

ROW = np.arange(5, dtype=np.float64)[:, None]  # These are five pokes on a line. Their places are the indices 0 to 4.


def draw(points: TripletPoints, anchor: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    return draw_triplets(points, anchor, rng_for(seed, "pairs"))


def distances(place: np.ndarray, anchor: int) -> list[float]:
    """Return the squared distances of all points from the anchor, computed in a loop."""
    return [sum((float(a) - float(b)) ** 2 for a, b in zip(one, place[anchor], strict=True)) for one in place]


@st.composite
def placed_points(draw_one: st.DrawFn) -> tuple[np.ndarray, np.ndarray, int]:
    """Draw points in up to four groups, and a seed.

    Places are small integers, so that many distances are equal. Each place has two or three points.
    """
    axes_n = draw_one(st.sampled_from([1, 2]))
    place, group = [], []
    for name in draw_one(st.lists(st.integers(0, 99), min_size=1, max_size=4, unique=True)):
        steps = st.tuples(*[st.integers(0, 3)] * axes_n)
        for one in draw_one(st.lists(steps, min_size=2, max_size=12, unique=True)):
            visits_n = draw_one(st.integers(2, 3))
            place += [one] * visits_n
            group += [name] * visits_n
    seed = draw_one(st.integers(0, 10_000))
    shuffled = rng_for(seed, "shuffle").permutation(len(group))
    return np.array(place, np.float64)[shuffled], np.array(group)[shuffled], seed


@given(placed_points())
def test_positive_is_strictly_nearer_than_negative_in_the_group_of_the_anchor(case):
    place, group, seed = case
    anchor = rng_for(seed, "anchors").integers(len(group), size=64)
    positive, negative = draw(triplet_points(place, group), anchor, seed)
    for a, p, n in zip(anchor, positive, negative, strict=True):
        away = distances(place, a)
        assert group[a] == group[p] == group[n]
        assert away[p] < away[n]
        assert a not in (p, n)


def test_error_names_the_group_whose_points_are_all_at_one_place():
    place = np.array([[1.0, 2.0], [0.0, 0.0], [1.0, 2.0], [3.0, 0.0], [1.0, 2.0]])
    skins = np.array(["b3_s2", "b1_s1", "b3_s2", "b1_s1", "b3_s2"])
    with pytest.raises(TrainingError, match="group b3_s2: all 3 points are at one place"):
        triplet_points(place, skins)


def test_group_without_an_anchor_is_refused():
    with pytest.raises(TrainingError, match="all 2 points are equally far"):
        triplet_points(np.array([[0.0], [1.0]]), np.zeros(2, int))


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=3, max_size=12))
def test_points_that_can_be_anchors_equal_those_found_by_a_double_loop(places):
    expected = [
        len({(x - u) ** 2 + (y - v) ** 2 for j, (u, v) in enumerate(places) if j != i}) > 1
        for i, (x, y) in enumerate(places)
    ]
    assume(len(set(places)) > 1)
    assume(any(expected))
    assert triplet_points(np.array(places, float), np.zeros(len(places), int)).is_anchor.tolist() == expected


def test_every_pair_of_positive_and_negative_is_equally_likely():
    # From index 0, the four other points have different distances, so they form six ordered pairs (positive, negative).
    n = 6000
    positive, negative = draw(triplet_points(ROW, np.zeros(5, int)), np.zeros(n, int))
    pairs, times = np.unique(np.stack([positive, negative]), axis=1, return_counts=True)
    assert pairs.T.tolist() == [[1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
    # The tolerance is six standard deviations of a binomial distribution.
    assert (np.abs(times - n / 6) < 6 * (n * 5 / 36) ** 0.5).all()
