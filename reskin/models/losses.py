"""The loss functions of the training: the squared error, and the triplet loss (paper section 5).

The triplet loss is computed from triplets, which this module draws at random. A triplet consists of three points of the
same group, where a group is a skin or a line of pokes: an anchor, a positive and a negative. The positive is strictly
nearer to the anchor than the negative. The loss makes the network's features of the anchor more similar to the
features of the positive than to the features of the negative.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped

from reskin.errors import TrainingError

# Largest number of draws for an anchor. A draw is repeated if it is a tie, which means that both drawn points are
# equally far from the anchor. Even if half of all draws were ties, the probability that 100 draws in a row are ties
# would be only 1e-30.
MAX_DRAWS_N = 100
# Two squared distances count as equal (a tie) if their difference is at most this fraction of their sum. The fraction
# is larger than the differences due to rounding to float32, which are about 1e-6.
TIE_RTOL = 1e-5
# To decide whether a point can be an anchor, its distances from this number of places in its group are compared. The
# point is not used as an anchor if all these distances are equal.
COMPARED_PLACES_N = 64

Pairs = tuple[Int64[np.ndarray, " b"], Int64[np.ndarray, " b"]]  # numbers of the positives and of the negatives


def squared_error(
    predicted: Float[torch.Tensor, "m b t"], truth: Float[torch.Tensor, "m b t"]
) -> Float[torch.Tensor, " m"]:
    """Return the mean squared error over the known targets of a batch, for each of m networks.

    Unknown targets (NaN) contribute neither to the loss nor to the gradient.
    """
    known = ~torch.isnan(truth)
    # Differences from unknown targets are replaced by 0 before they are squared. If their squares were replaced
    # instead, the gradient would be 0 * NaN = NaN.
    difference = torch.where(known, predicted - truth, 0.0)
    return (difference**2).sum((1, 2)) / known.sum((1, 2))


def triplet_loss(
    anchor: Float[torch.Tensor, "m b d"], positive: Float[torch.Tensor, "m b d"], negative: Float[torch.Tensor, "m b d"]
) -> Float[torch.Tensor, " m"]:
    """Return the triplet loss of a batch for each of m networks (section 5 of the paper).

    The loss is the mean of max(0, |a - p|^2 - |a - n|^2) over the batch, where a, p and n are the features of the
    anchor, the positive and the negative. It has no margin. The distances are squared, so that the gradient is 0 if two
    points coincide; the gradient of the distance itself would be undefined there.
    """
    positive_d2 = ((anchor - positive) ** 2).sum(-1)
    negative_d2 = ((anchor - negative) ** 2).sum(-1)
    return torch.relu(positive_d2 - negative_d2).mean(-1)


@dataclass(frozen=True)
class TripletPoints:
    """Points from which triplets are drawn, sorted into groups.

    place: the place of each point.
    group: the number of each point's group.
    order, start, count: the numbers of the points of group g are `order[start[g] : start[g] + count[g]]`.
    is_anchor: whether a point can be an anchor. This is the case if the other points of its group are not all at the
        same distance from it.
    """

    place: Float[np.ndarray, "n d"]
    group: Int64[np.ndarray, " n"]
    order: Int64[np.ndarray, " n"]
    start: Int64[np.ndarray, " g"]
    count: Int64[np.ndarray, " g"]
    is_anchor: Bool[np.ndarray, " n"]

    @property
    def anchors(self) -> Int64[np.ndarray, " a"]:
        return np.flatnonzero(self.is_anchor)

    def __len__(self) -> int:
        return len(self.group)


def triplet_points(place: Float[np.ndarray, "n d"], group: Shaped[np.ndarray, " n"]) -> TripletPoints:
    """Sort points by group, and find the points that can be anchors.

    Raises
    ------
    TrainingError
        If all points of a group are at the same place, or if no point of any group can be an anchor.
    """
    names, codes = np.unique(group, return_inverse=True)
    order = np.argsort(codes, kind="stable")
    count = np.bincount(codes, minlength=len(names))
    start = np.cumsum(count) - count
    lowest = np.minimum.reduceat(place[order], start, axis=0)
    highest = np.maximum.reduceat(place[order], start, axis=0)
    flat = np.flatnonzero((lowest == highest).all(axis=1))
    if len(flat):
        where, found = f"triplets of group {names[flat[0]]}", f"all {count[flat[0]]} points are at one place"
        remedy = "Add presses at other places to this group, or remove the group from the training rows."
        raise TrainingError(f"{where}: {found}. {remedy}")
    is_anchor = np.zeros(len(place), bool)
    for first, n in zip(start, count, strict=True):
        is_anchor[order[first : first + n]] = _find_anchors(place[order[first : first + n]])
    if not is_anchor.any():
        raise TrainingError(
            f"triplets: all {len(place)} points are equally far from each other. Add presses at other places."
        )
    return TripletPoints(place.astype(np.float64), codes.astype(np.int64), order, start, count, is_anchor)


def draw_triplets(points: TripletPoints, anchor: Int64[np.ndarray, " b"], rng: np.random.Generator) -> Pairs:
    """Draw a positive and a negative for each anchor; return the numbers of these points.

    For each anchor, two other points of its group are drawn uniformly. The point that is nearer to the anchor is the
    positive. If both are equally near (a tie), they are drawn again. `anchor` may contain points that cannot be anchors
    (see `TripletPoints`). Such a point itself is used as positive and as negative, so that its loss and its gradient
    are 0.
    """
    positive, negative = anchor.copy(), anchor.copy()
    left = np.flatnonzero(points.is_anchor[anchor])
    for _ in range(MAX_DRAWS_N):
        a = anchor[left]
        p, q = _draw_from_group(points, a, rng), _draw_from_group(points, a, rng)
        p_d2 = ((points.place[p] - points.place[a]) ** 2).sum(axis=1)
        q_d2 = ((points.place[q] - points.place[a]) ** 2).sum(axis=1)
        p_is_nearer = p_d2 < q_d2
        positive[left], negative[left] = np.where(p_is_nearer, p, q), np.where(p_is_nearer, q, p)
        tied = (np.abs(p_d2 - q_d2) <= TIE_RTOL * (p_d2 + q_d2)) | (p == a) | (q == a)
        left = left[tied]
        if not len(left):
            return positive, negative
    place = points.place[anchor[left[0]]].tolist()
    raise TrainingError(
        f"triplets: for the anchor at {place}, {MAX_DRAWS_N} draws gave no two points at different distances. Add "
        "presses at other places."
    )


def _draw_from_group(points: TripletPoints, anchor: np.ndarray, rng: np.random.Generator) -> Int64[np.ndarray, " b"]:
    group = points.group[anchor]
    return points.order[points.start[group] + rng.integers(points.count[group])]


def _find_anchors(place: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, " n"]:
    """Return a mask of the points that can be anchors. `place` contains the places of all points of one group.

    To save time, a point's distances are compared only for the first `COMPARED_PLACES_N` places of the group.
    """
    places, index, points_n = _unique_places(place)
    others = places[:COMPARED_PLACES_N].astype(np.float64)
    d2 = ((places[:, None].astype(np.float64) - others) ** 2).sum(axis=2)  # [places others]
    farthest, nearest = d2.max(axis=1), np.where(d2 > 0, d2, np.inf).min(axis=1)
    is_anchor: np.ndarray = (points_n > 1) | (farthest - nearest > TIE_RTOL * (farthest + nearest))
    return is_anchor[index]


def _unique_places(
    place: Float[np.ndarray, "n d"],
) -> tuple[Float[np.ndarray, "p d"], Int64[np.ndarray, " n"], Int64[np.ndarray, " p"]]:
    """Return the sorted unique places, the index of each point's place, and the number of points at each place.

    `np.unique(place, axis=0, ...)` gives the same result, but takes three times as long, because it compares rows as
    records.

    >>> _unique_places(np.array([[1.0, 2.0], [0.0, 3.0], [1.0, 2.0]]))[1:]
    (array([1, 0, 1]), array([1, 2]))
    """
    order = np.lexsort(place.T[::-1])
    is_new = np.append(True, (place[order[1:]] != place[order[:-1]]).any(axis=1))
    index = np.empty(len(place), np.int64)
    index[order] = np.cumsum(is_new) - 1
    return place[order[is_new]], index, np.bincount(index)
