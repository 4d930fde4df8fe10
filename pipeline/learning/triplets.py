"""Triplets ordered by distance. In: points with a place in a group. Out: anchors' positives and negatives.

A group is what one triplet is drawn from: the readings of one skin, placed in mm, or the pokes of one line, placed by
their index. One sampler for both, so that it cannot know more of an unlabelled skin than the order along a line.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64, Shaped

from pipeline.core.errors import TrainingError

ROUNDS_MAX_N = 100  # with half of the draws tied, 1e-30 of the anchors are left after so many
TIED = 1e-5  # of the sum of both squared distances; places are float32 numbers, equal distances differ by 1e-6

PLACES_TOLD_BY_N = 64  # of a group; a place from which so many are equally far is taken for no anchor

Pairs = tuple[Int64[np.ndarray, " b"], Int64[np.ndarray, " b"]]


@dataclass(frozen=True)
class Points:
    """Points sorted by group: group g has `order[start[g] : start[g] + count[g]]`.

    A point is an anchor if some other points of its group are nearer to it than others.
    """

    place: Float[np.ndarray, "n d"]
    group: Int64[np.ndarray, " n"]
    order: Int64[np.ndarray, " n"]
    start: Int64[np.ndarray, " g"]
    count: Int64[np.ndarray, " g"]
    is_anchor: Bool[np.ndarray, " n"]

    @property
    def anchors(self) -> Int64[np.ndarray, " a"]:
        """The points that triplets can be ordered from."""
        return np.flatnonzero(self.is_anchor)

    def __len__(self) -> int:
        return len(self.group)


def make_points(place: Float[np.ndarray, "n d"], group: Shaped[np.ndarray, " n"]) -> Points:
    """Sort points by group; raise if all points of a group lie on one place, where nothing is nearer than anything."""
    names, codes = np.unique(group, return_inverse=True)
    order = np.argsort(codes, kind="stable")
    count = np.bincount(codes, minlength=len(names))
    start = np.cumsum(count) - count
    lowest = np.minimum.reduceat(place[order], start, axis=0)
    highest = np.maximum.reduceat(place[order], start, axis=0)
    flat = np.flatnonzero((lowest == highest).all(axis=1))
    if len(flat):
        raise TrainingError(
                f"triplets of group {names[flat[0]]}", "the places of its points", "two or more",
                f"{count[flat[0]]} points on one place", "Poke at several places, or leave the group out.",
            )  # fmt: skip
    is_anchor = np.zeros(len(place), bool)
    for first, n in zip(start, count, strict=True):
        is_anchor[order[first : first + n]] = _tells(place[order[first : first + n]])
    if not is_anchor.any():
        raise TrainingError(
                "triplets", "points", "some nearer to one than others are", f"{len(place)} that are equally far",
                "Poke at more places.",
            )  # fmt: skip
    return Points(place.astype(np.float64), codes.astype(np.int64), order, start, count, is_anchor)


def draw_pairs(points: Points, anchor: Int64[np.ndarray, " b"], rng: np.random.Generator) -> Pairs:
    """Draw a positive and a negative of the anchor's own group for every anchor, the positive strictly nearer.

    Both are drawn uniformly from the other points of the group; draws in which they are equally near are drawn again. A
    point that is no anchor gets itself twice, which costs and teaches nothing.
    """
    positive, negative = anchor.copy(), anchor.copy()
    left = np.flatnonzero(points.is_anchor[anchor])
    for _ in range(ROUNDS_MAX_N):
        own = anchor[left]
        one, other = _of_group(points, own, rng), _of_group(points, own, rng)
        one_d2 = ((points.place[one] - points.place[own]) ** 2).sum(axis=1)
        other_d2 = ((points.place[other] - points.place[own]) ** 2).sum(axis=1)
        near = one_d2 < other_d2
        positive[left], negative[left] = np.where(near, one, other), np.where(near, other, one)
        tied = (np.abs(one_d2 - other_d2) <= TIED * (one_d2 + other_d2)) | (one == own) | (other == own)
        left = left[tied]
        if not len(left):
            return positive, negative
    raise TrainingError(
            "triplets", "the distances from an anchor", "different ones",
            f"ties in {ROUNDS_MAX_N} draws at place {points.place[anchor[left[0]]].tolist()}", "Poke at more places.",
        )  # fmt: skip


def _tells(place: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
    """Find a group's points with others at two different distances, among as many of its places as tell."""
    places, which, visits_n = np.unique(place, axis=0, return_inverse=True, return_counts=True)
    others = places[:PLACES_TOLD_BY_N].astype(np.float64)
    d2 = ((places[:, None].astype(np.float64) - others) ** 2).sum(axis=2)  # [places others]
    farthest, nearest = d2.max(axis=1), np.where(d2 > 0, d2, np.inf).min(axis=1)
    tells: np.ndarray = (visits_n > 1) | (farthest - nearest > TIED * (farthest + nearest))
    return tells[which.ravel()]


def _of_group(points: Points, anchor: np.ndarray, rng: np.random.Generator) -> Int64[np.ndarray, " b"]:
    group = points.group[anchor]
    return points.order[points.start[group] + rng.integers(points.count[group])]
