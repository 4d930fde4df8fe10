"""How badly a reading fits any single contact. In: what single contacts look like, readings, answers. Out: scores.

A higher score is odder; what is too odd, the caller decides. Refuses to know how contacts were paired, and networks.
"""

import numpy as np
from jaxtyping import Float
from sklearn.neighbors import KNeighborsRegressor, NearestNeighbors

NEIGHBOURS_N = 5  # assumed, of both detectors that ask neighbours
NOISE_uT = 15.0  # of all channels of a reading together (a channel's is 3 to 5 uT, FACTS 3): what lies below is not odd


def neighbour_distance(known: Float[np.ndarray, "a c"], asked: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    """Give the mean distance to the nearest known rows, each column in units of its deviation among these."""
    scale = np.maximum(known.std(axis=0), 1e-12)
    found = NearestNeighbors(n_neighbors=min(NEIGHBOURS_N, len(known))).fit(known / scale)
    return found.kneighbors(asked / scale)[0].mean(axis=1)


def direction_distance(
    known_uT: Float[np.ndarray, "a ch"], asked_uT: Float[np.ndarray, "f ch"]
) -> Float[np.ndarray, " f"]:
    """Give the mean distance to the nearest known directions dB / (|dB| + noise): a weak reading's weighs less."""
    known, asked = (db_uT / (np.linalg.norm(db_uT, axis=1, keepdims=True) + NOISE_uT) for db_uT in (known_uT, asked_uT))
    found = NearestNeighbors(n_neighbors=min(NEIGHBOURS_N, len(known))).fit(known)
    return found.kneighbors(asked)[0].mean(axis=1)


def residual(
    known: tuple[Float[np.ndarray, "a 3"], Float[np.ndarray, "a ch"]],
    answer: Float[np.ndarray, "f 3"],
    db_uT: Float[np.ndarray, "f ch"],
) -> Float[np.ndarray, " f"]:
    """Give what a single contact at the answer leaves of the change of field, as a share of it and its noise.

    Its field is that of the `known` (x_mm, y_mm, F_N; uT) nearest to the answer; a force that none knows is not asked.
    """
    target, known_uT = known
    columns = ~np.isnan(target).any(axis=0)
    scale = np.maximum(target[:, columns].std(axis=0), 1e-12)
    model = KNeighborsRegressor(min(NEIGHBOURS_N, len(target)), weights="distance")
    expected_uT = model.fit(target[:, columns] / scale, known_uT).predict(answer[:, columns] / scale)
    return np.linalg.norm(db_uT - expected_uT, axis=1) / (np.linalg.norm(db_uT, axis=1) + NOISE_uT)


def disagreement(answers: Float[np.ndarray, "m f 3"]) -> Float[np.ndarray, " f"]:
    """Give how far apart networks of several seeds place a contact: rms distance from their mean place, in mm."""
    place_mm = answers[:, :, :2]
    return np.sqrt(((place_mm - place_mm.mean(axis=0)) ** 2).sum(axis=2).mean(axis=0))


def roc_area(single: Float[np.ndarray, " a"], double: Float[np.ndarray, " b"]) -> float:
    """Give the share of (single, double) in which the double contact is the odder one; ties count half."""
    ordered = np.sort(single)
    below = np.searchsorted(ordered, double, side="left")
    not_above = np.searchsorted(ordered, double, side="right")
    return float((below + not_above).mean() / (2 * len(single)))
