"""Find captures whose places are rotated, mirrored or swapped, by comparing them with other captures of the scene.

Boards of one scene give similar readings for similar presses, so the place of a press can be estimated from the most
similar presses of other captures. If these estimates agree with the labels only after the labels are rotated or
mirrored, the labels of this capture or of the other captures are probably wrong. This method assumes nothing about the
board, so it cannot check a single capture.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from reskin.schema import Readings

PRESSES_MIN_N = 20  # with fewer presses, no orientation is reported
EXPLAINED_MIN = 0.5  # minimum fraction of the variance of the estimated places that another orientation must explain
GAIN_MIN = 0.5  # minimum difference between this fraction and the fraction that the unchanged labels explain
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
    """The place and the direction of the field change of each press."""

    place_mm: Float[np.ndarray, "n 2"]  # relative to the middle of all places
    direction: Float[np.ndarray, "n ch"]  # unit vector along the mean field change


def presses_of(blocks: Iterable[Readings]) -> Presses:
    """Average the readings of each press with a known place, in the blocks of one capture."""
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
    """Return the change after which the labels of `own` agree with those of `others`; None if no change is needed.

    The place of each press of `own` is estimated as the mean place of those three presses of `others` whose field
    changes have the most similar directions. A change of the labels is reported if the changed labels explain at least
    the fraction `EXPLAINED_MIN` of the variance of these estimates, and at least `GAIN_MIN` more than the unchanged
    labels.
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
