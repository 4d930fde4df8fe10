"""Novelty detection: find readings that are unlike all known readings.

This module computes scores of how unlike the known readings a reading is, thresholds of these scores, and areas under
ROC curves.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

NEIGHBOURS_N = 5  # number of nearest neighbours over which a distance is averaged; assumed
NOISE_uT = 15.0  # norm of a reading's noise over 15 channels; recorded boards have 3 to 5 uT per channel

# Scores by name of the detector, one per reading. A larger score means that the reading is less like known readings.
Scores = Mapping[str, Float[np.ndarray, "_"]]


def neighbour_distance(known: Float[np.ndarray, "a c"], tested: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    """Return, for each row of `tested`, the mean distance to its `NEIGHBOURS_N` nearest rows of `known`.

    Columns are divided by their standard deviation in `known`.
    """
    scale = np.maximum(known.std(axis=0), 1e-12)
    return _neighbour_distance(known / scale, tested / scale)


def direction_distance(
    known_uT: Float[np.ndarray, "a ch"], tested_uT: Float[np.ndarray, "f ch"]
) -> Float[np.ndarray, " f"]:
    """Return, for each row of `tested_uT`, the mean distance to its `NEIGHBOURS_N` nearest rows of `known_uT`.

    Distances are between the vectors dB / (|dB| + noise). These vectors have the direction of dB. Their length is near
    1 if the field change is strong, and near 0 if it is weak.
    """
    known, tested = (
        db_uT / (np.linalg.norm(db_uT, axis=1, keepdims=True) + NOISE_uT) for db_uT in (known_uT, tested_uT)
    )
    return _neighbour_distance(known, tested)


def _neighbour_distance(known: Float[np.ndarray, "a c"], tested: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    # Imported here because importing scikit-learn takes a second, and commands that only check scenes do not need
    # scikit-learn.
    from sklearn.neighbors import NearestNeighbors

    neighbours = NearestNeighbors(n_neighbors=min(NEIGHBOURS_N, len(known))).fit(known)
    return neighbours.kneighbors(tested)[0].mean(axis=1)


def thresholds(scores: Scores, false_alarm_fraction: float) -> dict[str, float]:
    """Return, for each detector, the threshold that a fraction `false_alarm_fraction` of its scores exceeds."""
    return {name: float(np.quantile(values, 1 - false_alarm_fraction)) for name, values in scores.items()}


def above_pct(scores: Scores, limits: Mapping[str, float]) -> dict[str, float]:
    """Return, for each detector, the percentage of its scores that are above its threshold in `limits`."""
    return {name: 100 * float((scores[name] > limit).mean()) for name, limit in limits.items()}


def roc_areas(negative: Scores, positive: Scores) -> dict[str, float]:
    """Return, for each detector, the area under the ROC curve (see `roc_area`)."""
    return {name: roc_area(negative[name], positive[name]) for name in negative}


def roc_area(negative: Float[np.ndarray, " a"], positive: Float[np.ndarray, " b"]) -> float:
    """Return the area under the ROC curve, from the scores of negatives and of positives.

    This is the fraction of pairs (negative, positive) in which the positive has the larger score; ties count half.
    """
    ordered = np.sort(negative)
    below = np.searchsorted(ordered, positive, side="left")
    not_above = np.searchsorted(ordered, positive, side="right")
    return float((below + not_above).mean() / (2 * len(negative)))
