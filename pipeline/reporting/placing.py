"""Where the labels of points go, so that none hides another or a point. In: points. Out: places. Knows no figure."""

import numpy as np
from jaxtyping import Float

STEP = 0.01  # of the width and height of the axes


def place_labels(
    points: Float[np.ndarray, "b 2"],
    wished: Float[np.ndarray, "o 2"],
    *,
    label: Float[np.ndarray, "2"],
    mark: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "o 2"]:
    """Give each label, in order, the free place nearest to where it is wished (middle of the label).

    All in parts of the width and height of the axes; `label` and `mark` are the sizes of a label and of a point's mark.
    """
    sides = [np.arange(size / 2, 1 - size / 2, STEP) for size in label]
    candidates = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    free = ~_touch(candidates, points, (label + mark) / 2).any(axis=1)
    placed = np.empty_like(wished)
    for i, wish in enumerate(wished):
        distance = np.linalg.norm((candidates - wish) / label, axis=1)
        placed[i] = candidates[np.argmin(np.where(free, distance, np.inf))]
        free &= ~_touch(candidates, placed[i : i + 1], label).any(axis=1)
    return placed


def _touch(
    some: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "k 2"], reach: Float[np.ndarray, "2"]
) -> np.ndarray:
    return (np.abs(some[:, None] - others[None]) < reach).all(axis=-1)
