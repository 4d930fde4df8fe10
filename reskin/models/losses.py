"""Triplets ordered by distance, for the triplet loss (paper section 5)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64, Shaped

from reskin.errors import TrainingError

ROUNDS_MAX_N = 100  # with half of the draws tied, 1e-30 of the anchors are left after so many
TIED = 1e-5  # of the sum of both squared distances; places are float32 numbers, equal distances differ by 1e-6

PLACES_COMPARED_N = 64  # of a group; a place from which so many are equally far is taken for no anchor

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
        where, got = f"triplets of group {names[flat[0]]}", f"{count[flat[0]]} points on one place"
        remedy = "Poke at several places, or leave the group out."
        raise TrainingError(where, "the places of its points", "two or more", got, remedy)
    is_anchor = np.zeros(len(place), bool)
    for first, n in zip(start, count, strict=True):
        is_anchor[order[first : first + n]] = _anchors(place[order[first : first + n]])
    if not is_anchor.any():
        rule, got = "some nearer to one than others are", f"{len(place)} that are equally far"
        raise TrainingError("triplets", "points", rule, got, "Poke at more places.")
    return Points(place.astype(np.float64), codes.astype(np.int64), order, start, count, is_anchor)


def draw_pairs(points: Points, anchor: Int64[np.ndarray, " b"], rng: np.random.Generator) -> Pairs:
    """Draw a positive and a negative of its group for every anchor, the positive strictly nearer.

    Both are drawn uniformly from the other points of the group; draws in which they are equally near are drawn again. A
    point that is no anchor gets itself twice, which costs and teaches nothing.
    """
    positive, negative = anchor.copy(), anchor.copy()
    left = np.flatnonzero(points.is_anchor[anchor])
    for _ in range(ROUNDS_MAX_N):
        a = anchor[left]
        p, q = _of_group(points, a, rng), _of_group(points, a, rng)
        p_d2 = ((points.place[p] - points.place[a]) ** 2).sum(axis=1)
        q_d2 = ((points.place[q] - points.place[a]) ** 2).sum(axis=1)
        p_is_nearer = p_d2 < q_d2
        positive[left], negative[left] = np.where(p_is_nearer, p, q), np.where(p_is_nearer, q, p)
        tied = (np.abs(p_d2 - q_d2) <= TIED * (p_d2 + q_d2)) | (p == a) | (q == a)
        left = left[tied]
        if not len(left):
            return positive, negative
    got = f"ties in {ROUNDS_MAX_N} draws at place {points.place[anchor[left[0]]].tolist()}"
    raise TrainingError("triplets", "the distances from an anchor", "different ones", got, "Poke at more places.")


def _anchors(place: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
    """Find a group's points with others at two different distances, among `PLACES_COMPARED_N` of its places."""
    places, index, visits_n = _distinct(place)
    others = places[:PLACES_COMPARED_N].astype(np.float64)
    d2 = ((places[:, None].astype(np.float64) - others) ** 2).sum(axis=2)  # [places others]
    farthest, nearest = d2.max(axis=1), np.where(d2 > 0, d2, np.inf).min(axis=1)
    is_anchor: np.ndarray = (visits_n > 1) | (farthest - nearest > TIED * (farthest + nearest))
    return is_anchor[index]


def _distinct(
    place: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, "p d"], Int64[np.ndarray, " n"], Int64[np.ndarray, " p"]]:
    """Give the different places in order, which of them each point is, and how many points are there.

    As `np.unique(place, axis=0, ...)`, which compares rows as records and takes three times as long.

    >>> _distinct(np.array([[1.0, 2.0], [0.0, 3.0], [1.0, 2.0]]))[1:]
    (array([1, 0, 1]), array([1, 2]))
    """
    order = np.lexsort(place.T[::-1])
    is_new = np.append(True, (place[order[1:]] != place[order[:-1]]).any(axis=1))
    index = np.empty(len(place), np.int64)
    index[order] = np.cumsum(is_new) - 1
    return place[order[is_new]], index, np.bincount(index)


def _of_group(points: Points, anchor: np.ndarray, rng: np.random.Generator) -> Int64[np.ndarray, " b"]:
    group = points.group[anchor]
    return points.order[points.start[group] + rng.integers(points.count[group])]
