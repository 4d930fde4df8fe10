"""Find captures whose labels have rotated, mirrored or swapped coordinates, by comparing captures of the same scene.

The boards of a scene give similar readings for similar presses. Therefore, the place of a press can be estimated from
the most similar presses of other captures. If these estimates agree with the labels only after the labels are rotated
or mirrored, the labels of this capture or of the other captures are probably wrong. The method needs no model of the
board, but it cannot check a single capture without others.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from reskin.schema import Readings

PRESSES_MIN_N = 20  # with fewer presses, no orientation is reported
# Another orientation of the labels is reported if it explains at least the fraction EXPLAINED_MIN of the variance of
# the estimated places, and if this fraction exceeds that of the unchanged labels by at least GAIN_MIN.
EXPLAINED_MIN = 0.5
GAIN_MIN = 0.5
ORIENTATIONS = {
    "as they are": [[1, 0], [0, 1]],
    "with x and y swapped": [[0, 1], [1, 0]],
    "with x mirrored": [[-1, 0], [0, 1]],
    "with y mirrored": [[1, 0], [0, -1]],
    "rotated by 90 degrees": [[0, -1], [1, 0]],
    "rotated by 180 degrees": [[-1, 0], [0, -1]],
    "rotated by 270 degrees": [[0, 1], [-1, 0]],
    "with x and y swapped and mirrored": [[0, -1], [-1, 0]],
}


@dataclass(frozen=True)
class Presses:
    """The presses of one capture: the place of each press, and the direction of its field change."""

    place_mm: Float[np.ndarray, "n 2"]  # relative to the middle of all places
    direction: Float[np.ndarray, "n ch"]  # unit vector along the mean field change


def presses_of(blocks: Iterable[Readings]) -> Presses:
    """Return the presses of a capture that have a known place; the readings of a press are averaged.

    `blocks` are the readings of the capture.
    """
    place_mm, change_uT = [], []
    for block in blocks:
        known = np.isfinite(block.x_mm) & np.isfinite(block.y_mm)
        for press in np.unique(block.indentation[known]):
            rows = known & (block.indentation == press)
            place_mm.append([block.x_mm[rows][0], block.y_mm[rows][0]])
            change_uT.append((block.b_uT[rows].astype(float) - block.noload_uT[rows]).mean(axis=0))
    if not place_mm:
        return Presses(np.zeros((0, 2)), np.zeros((0, 0)))
    places, changes = np.array(place_mm, float), np.array(change_uT)
    magnitude_uT = np.linalg.norm(changes, axis=1)
    sound = np.isfinite(magnitude_uT) & (magnitude_uT > 0)
    middle_mm = (places[sound].max(axis=0) + places[sound].min(axis=0)) / 2 if sound.any() else 0.0
    return Presses(places[sound] - middle_mm, changes[sound] / magnitude_uT[sound, None])


def other_orientation(own: Presses, others: Presses) -> str | None:
    """Return how the labels of `own` must be changed to agree with those of `others`.

    The result is a key of `ORIENTATIONS`, or None if no change is clearly better. The place of each press of `own` is
    estimated from the three presses of `others` whose field changes have the most similar directions: it is the mean of
    their places. A change is returned if the changed labels explain at least the fraction `EXPLAINED_MIN` of the
    variance of these estimates, and if this fraction exceeds that of the unchanged labels by at least `GAIN_MIN`.
    """
    comparable = own.direction.shape[1:] == others.direction.shape[1:]
    if not comparable or min(len(own.place_mm), len(others.place_mm)) < PRESSES_MIN_N:
        return None
    nearest = np.argsort(-own.direction @ others.direction.T, axis=1)[:, :3]
    looked_up_mm = others.place_mm[nearest].mean(axis=1)
    variance = max(float((looked_up_mm**2).mean()), 1e-12)
    explained = {
        name: 1 - float(((own.place_mm @ np.array(matrix).T - looked_up_mm) ** 2).mean()) / variance
        for name, matrix in ORIENTATIONS.items()
    }
    best = max(explained, key=lambda name: explained[name])
    unchanged = explained["as they are"]
    return best if explained[best] >= EXPLAINED_MIN and explained[best] - unchanged >= GAIN_MIN else None
