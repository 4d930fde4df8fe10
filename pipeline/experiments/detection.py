"""Detection of readings that are unlike known ones: scores, thresholds and areas under ROC curves."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

NEIGHBOURS_N = 5  # assumed
NOISE_uT = 15.0  # norm over all channels of a reading (3 to 5 uT per channel on recorded boards)

Scores = Mapping[str, Float[np.ndarray, "_"]]  # by detector; larger means less like known readings


def neighbour_distance(known: Float[np.ndarray, "a c"], tested: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    """Return the mean distance to the nearest known rows; columns are scaled by their standard deviation in `known`."""
    scale = np.maximum(known.std(axis=0), 1e-12)
    return _neighbour_distance(known / scale, tested / scale)


def direction_distance(
    known_uT: Float[np.ndarray, "a ch"], tested_uT: Float[np.ndarray, "f ch"]
) -> Float[np.ndarray, " f"]:
    """Return the mean distance to the nearest known directions dB / (|dB| + noise); weak fields give short vectors."""
    known, tested = (
        db_uT / (np.linalg.norm(db_uT, axis=1, keepdims=True) + NOISE_uT) for db_uT in (known_uT, tested_uT)
    )
    return _neighbour_distance(known, tested)


def _neighbour_distance(known: Float[np.ndarray, "a c"], tested: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    # Imported here because it takes a second, and checks of scenes do not need it.
    from sklearn.neighbors import NearestNeighbors

    neighbours = NearestNeighbors(n_neighbors=min(NEIGHBOURS_N, len(known))).fit(known)
    return neighbours.kneighbors(tested)[0].mean(axis=1)


def thresholds(scores: Scores, false_alarm_fraction: float) -> dict[str, float]:
    """Return for each detector the threshold that this fraction of its scores exceeds."""
    return {name: float(np.quantile(own, 1 - false_alarm_fraction)) for name, own in scores.items()}


def above_pct(scores: Scores, limits: Mapping[str, float]) -> dict[str, float]:
    """Return the percentage of rows above each detector's threshold."""
    return {name: 100 * float((scores[name] > limit).mean()) for name, limit in limits.items()}


def roc_areas(negative: Scores, positive: Scores) -> dict[str, float]:
    """Return each detector's area under the ROC curve."""
    return {name: roc_area(negative[name], positive[name]) for name in negative}


def roc_area(negative: Float[np.ndarray, " a"], positive: Float[np.ndarray, " b"]) -> float:
    """Return the area under the ROC curve: the share of pairs whose positive has the larger score; ties count half."""
    ordered = np.sort(negative)
    below = np.searchsorted(ordered, positive, side="left")
    not_above = np.searchsorted(ordered, positive, side="right")
    return float((below + not_above).mean() / (2 * len(negative)))
