"""Fields of one touch and of two: which place, how far two add up, one or two? Numbers only.

A place's field is taken as one direction times an amplitude: the mean direction of its training rows. Refuses to know
recordings, blocks of time and tables.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from scipy.optimize import nnls

from pipeline.experiments.contacts.pairs import (
    NEIGHBOURS_N,
    NOISE_uT,
    direction_distance,
    neighbour_distance,
    roc_area,
)
from reskin.models.inputs import shape

Directions = Mapping[int, Float64[np.ndarray, " ch"]]  # by place
Scores = dict[str, Float[np.ndarray, "_"]]  # by detector: the larger, the less like one touch


def unit(db_uT: Float32[np.ndarray, "f ch"]) -> Float64[np.ndarray, "f ch"]:
    """Give directions dB / (|dB| + noise): a weak reading's is short."""
    return np.asarray(db_uT / (np.linalg.norm(db_uT.astype(np.float64), axis=1, keepdims=True) + NOISE_uT))


def name_places(
    known_uT: Float32[np.ndarray, "a ch"], places: Float64[np.ndarray, " a"], asked_uT: Float32[np.ndarray, "f ch"]
) -> Float64[np.ndarray, " f"]:
    """Answer the place that most of the nearest known directions are of."""
    from sklearn.neighbors import KNeighborsClassifier  # late: it takes a second, and scenes are checked without it

    voters = KNeighborsClassifier(min(NEIGHBOURS_N, len(known_uT))).fit(unit(known_uT), places)
    return np.asarray(voters.predict(unit(asked_uT)))


def directions(
    known_uT: Float32[np.ndarray, "a ch"], places: Float64[np.ndarray, " a"]
) -> dict[int, Float64[np.ndarray, " ch"]]:
    """Give the mean direction of each place's rows."""
    units = unit(known_uT)
    return {int(place): units[places == place].mean(axis=0) for place in np.unique(places)}


def left_over(
    known: Directions, places: Sequence[int], db_uT: Float32[np.ndarray, "f ch"]
) -> Float64[np.ndarray, " f"]:
    """Give what amplitudes of 0 or more of these places' directions, fitted row by row, leave of dB, as a share of it.

    This is the least that any two strengths can leave: how hard each place was pressed is not known.
    """
    basis = np.stack([known[place] for place in places], axis=1)
    rows_uT = db_uT.astype(np.float64)
    return np.array([nnls(basis, row_uT)[1] for row_uT in rows_uT]) / np.linalg.norm(rows_uT, axis=1)


def explain_pair(known: Directions, pair: tuple[int, int], db_uT: Float32[np.ndarray, "f ch"]) -> dict[str, Any]:
    """Say how much of the field of two touches the sum of theirs leaves, beside one place's and all other pairs'."""
    left = {of: float(np.median(left_over(known, of, db_uT))) for of in combinations(sorted(known), 2)}
    alone = {place: float(np.median(left_over(known, (place,), db_uT))) for place in known}
    least = min(alone, key=lambda place: alone[place])
    others = [share for of, share in left.items() if of != pair]
    return {
        "places": list(pair), "rows_n": len(db_uT), "left_over_pct": 100 * left[pair],
        "weaker_alone_pct": 100 * max(alone[place] for place in pair),
        "stronger_alone_pct": 100 * min(alone[place] for place in pair),
        "best_alone_pct": 100 * alone[least], "best_alone": least,
        "other_pairs_pct": 100 * float(np.mean(others)), "rank": 1 + sum(share < left[pair] for share in others),
        "pairs_n": len(left),
    }  # fmt: skip


def oddness(known_uT: Float32[np.ndarray, "a ch"], known: Directions, asked_uT: Float32[np.ndarray, "f ch"]) -> Scores:
    """Score rows by the detectors of question contacts that need no network, and by what one place leaves over."""
    alone = [left_over(known, (place,), asked_uT) for place in known]
    return {
        "direction and length": neighbour_distance(shape(known_uT), shape(asked_uT)),
        "direction above noise": direction_distance(known_uT, asked_uT),
        "left over by one place": np.min(alone, axis=0),
    }


def limits_of(aside: Scores, false_alarm_fraction: float) -> dict[str, float]:
    """Set each detector's threshold so that it calls odd so many of the single touches kept aside."""
    return {name: float(np.quantile(scores, 1 - false_alarm_fraction)) for name, scores in aside.items()}


def called_pct(scores: Scores, limits: Mapping[str, float]) -> dict[str, float]:
    """Give the share of rows above each detector's threshold, in percent."""
    return {name: 100 * float((scores[name] > limit).mean()) for name, limit in limits.items()}


def areas(single: Scores, double: Scores) -> dict[str, float]:
    """Give each detector's area under the ROC curve, of single touches against double ones."""
    return {name: roc_area(single[name], double[name]) for name in single}


def is_one_of(answers: Float64[np.ndarray, " f"], places: Sequence[int]) -> Bool[np.ndarray, " f"]:
    """Mark the answers that name one of the touched places."""
    return np.isin(answers, list(places))
