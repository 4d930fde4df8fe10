"""Two contacts at once, as sums of two single changes of field, and detectors that tell them from one. Numbers only.

The sum bears the noise of two readings. Refuses to know networks, and whether fields add (`superposition`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int64

from pipeline.report.statistics import statistic
from reskin.data.rows import Rows
from reskin.errors import ParamsError
from reskin.metrics import ACCURACY_LIMIT_MM

NEIGHBOURS_N = 5  # assumed, of both detectors that ask neighbours
NOISE_uT = 15.0  # of all channels of a reading together (a channel's is 3 to 5 uT, FACTS 3): what lies below is not odd


def neighbour_distance(known: Float[np.ndarray, "a c"], asked: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    """Give the mean distance to the nearest known rows, each column in units of its deviation among these."""
    scale = np.maximum(known.std(axis=0), 1e-12)
    return _neighbour_distance(known / scale, asked / scale)


def direction_distance(
    known_uT: Float[np.ndarray, "a ch"], asked_uT: Float[np.ndarray, "f ch"]
) -> Float[np.ndarray, " f"]:
    """Give the mean distance to the nearest known directions dB / (|dB| + noise): a weak reading's weighs less."""
    known, asked = (db_uT / (np.linalg.norm(db_uT, axis=1, keepdims=True) + NOISE_uT) for db_uT in (known_uT, asked_uT))
    return _neighbour_distance(known, asked)


def _neighbour_distance(known: Float[np.ndarray, "a c"], asked: Float[np.ndarray, "f c"]) -> Float[np.ndarray, " f"]:
    from sklearn.neighbors import NearestNeighbors  # late: it takes a second, and scenes are checked without it

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
    from sklearn.neighbors import KNeighborsRegressor  # late, as above

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


TOLERANCE_MM = 0.5  # assumed: a pair's distance may differ by so much from what is asked, as places lie on a grid
PLACE_DECIMALS = 2  # places nearer than 0.01 mm are one


@dataclass(frozen=True)
class Pairs:
    """Row numbers of two pokes of one skin; the weaker one by force, or by |dB| where a force is unknown."""

    weaker: Int64[np.ndarray, " p"]
    stronger: Int64[np.ndarray, " p"]

    def sum_uT(self, db_uT: Float32[np.ndarray, "f ch"]) -> Float32[np.ndarray, "p ch"]:
        """Add the two changes of field."""
        return db_uT[self.weaker] + db_uT[self.stronger]


def draw_pairs(
    rows: Rows, own: Int64[np.ndarray, " a"], separation_mm: float, *, pairs_n: int, rng: np.random.Generator
) -> Pairs:
    """Draw pairs of the rows `own`: two places of a skin so far apart, then a row at each; 0 mm is one place twice."""
    found = [_places_apart(rows, own[rows.skin[own] == skin], separation_mm) for skin in np.unique(rows.skin[own])]
    sides = [(rows_at[i], rows_at[j]) for rows_at, pairs in found for i, j in pairs]
    if not sides:
        rule = f"such that two of one skin lie {separation_mm:g} mm apart, within {TOLERANCE_MM:g} mm"
        raise ParamsError("contacts", "held-out places", rule, "none", "Mend contacts.separations_mm of the scene.")
    drawn = [sides[k] for k in rng.integers(len(sides), size=pairs_n)]
    one, other = (np.array([rng.choice(side) for side in both]) for both in zip(*drawn, strict=True))
    force_N, length_uT = rows.target[:, 2], np.linalg.norm(rows.db_uT, axis=1)
    strength = length_uT if np.isnan(force_N[own]).any() else force_N
    swap = strength[one] > strength[other]
    return Pairs(np.where(swap, other, one), np.where(swap, one, other))


def _places_apart(
    rows: Rows, own: Int64[np.ndarray, " a"], separation_mm: float
) -> tuple[list[Int64[np.ndarray, " b"]], Int64[np.ndarray, "p 2"]]:
    # The rows at each place of a skin, and the pairs of places (by number) that lie so far apart.
    places_mm, at = np.unique(rows.target[own, :2].round(PLACE_DECIMALS), axis=0, return_inverse=True)
    order = np.argsort(at.ravel(), kind="stable")
    rows_at = np.split(own[order], np.cumsum(np.bincount(at.ravel()))[:-1])
    distance_mm = np.linalg.norm(places_mm[:, None] - places_mm, axis=2)
    near = np.abs(distance_mm - separation_mm) <= TOLERANCE_MM
    # One place twice only where that is asked: 0 mm is within the tolerance of small separations too.
    return rows_at, np.argwhere(np.triu(near, k=1) if separation_mm else np.eye(len(places_mm), dtype=bool))


def keep_aside(rows: Rows, train: Int64[np.ndarray, " a"]) -> tuple[np.ndarray, np.ndarray, str]:
    """Part training rows into those that single contacts are learned from, and those that a threshold is set on.

    Kept aside is the last board, else the last skin, else the last pass: the first of these of which there are two.
    """
    for what, labels in (("board", rows.board), ("skin", rows.skin), ("pass", rows.pass_i)):
        kinds = np.unique(labels[train])
        if len(kinds) > 1:
            last = labels[train] == kinds[-1]
            return train[~last], train[last], what
    raise ParamsError(
        "contacts", "training rows", "of two boards, skins or passes", "one", "Record more, or do not ask."
    )


def where_it_falls(
    weaker: Float32[np.ndarray, "p 3"], stronger: Float32[np.ndarray, "p 3"], answer: Float32[np.ndarray, "p 3"]
) -> dict[str, float]:
    """Compare a single-contact answer (x_mm, y_mm, F_N) with the two true ones; what needs a force may be absent."""
    off_mm = np.stack([answer[:, :2] - side[:, :2] for side in (weaker, stronger)])
    numbers = {
        "near_either_pct": 100 * float((np.abs(off_mm) <= ACCURACY_LIMIT_MM).all(axis=2).any(axis=0).mean()),
        "nearest_mm": float(np.linalg.norm(off_mm, axis=2).min(axis=0).mean()),
    }
    if (np.abs(stronger - weaker)[:, :2] > 0).any(axis=1).all():
        nearer = np.linalg.norm(off_mm[1], axis=1) < np.linalg.norm(off_mm[0], axis=1)
        numbers["nearer_the_stronger_pct"] = 100 * float(nearer.mean())
        numbers["along"] = float(along_the_line(weaker, stronger, answer).mean())
    force_N = np.stack([weaker[:, 2], stronger[:, 2]]).astype(np.float64)
    if not np.isnan(force_N).any():
        predicted_N = float(answer[:, 2].sum(dtype=np.float64))
        numbers["force_over_sum"] = predicted_N / float(force_N.sum())
        numbers["force_over_larger"] = predicted_N / float(force_N.max(axis=0).sum())
    return numbers


def along_the_line(
    weaker: Float32[np.ndarray, "p 3"], stronger: Float32[np.ndarray, "p 3"], answer: Float32[np.ndarray, "p 3"]
) -> Float[np.ndarray, " p"]:
    """Give where an answer's foot on the line through both contacts lies: 0 at the weaker one, 1 at the stronger."""
    line_mm = (stronger - weaker)[:, :2].astype(np.float64)
    return ((answer - weaker)[:, :2] * line_mm).sum(axis=1) / (line_mm**2).sum(axis=1)


def detect(
    aside: Mapping[str, np.ndarray], single: Mapping[str, np.ndarray], double: Mapping[float, Mapping[str, np.ndarray]],
    false_alarm_fraction: float,
) -> dict[str, Any]:  # fmt: skip
    """Call odd what exceeds all but so many of the contacts kept `aside`; by detector, and of pairs by separation."""
    limits = {name: float(np.quantile(scores, 1 - false_alarm_fraction)) for name, scores in aside.items()}
    apart = {
        name: np.concatenate([own[name] for separation_mm, own in double.items() if separation_mm]) for name in aside
    }
    return {
        "false_alarm_pct": {name: _above_pct(single[name], limit) for name, limit in limits.items()},
        "auc": {name: roc_area(single[name], apart[name]) for name in limits},
        "by_separation": {
            separation_mm: {
                "detected_pct": {name: _above_pct(own[name], limit) for name, limit in limits.items()},
                "auc": {name: roc_area(single[name], own[name]) for name in limits},
            }
            for separation_mm, own in double.items()
        },
    }


def _above_pct(scores: np.ndarray, limit: float) -> float:
    return 100 * float((scores > limit).mean())


def summarise_nested(boards: Sequence[Any]) -> Any:
    """Summarise over boards each number of nested mappings, one a board."""
    first = boards[0]
    if isinstance(first, Mapping):
        return {key: summarise_nested([board[key] for board in boards if key in board]) for key in first}
    return statistic(boards, boards=True)
