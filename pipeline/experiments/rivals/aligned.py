"""Baselines: regressors and networks of known boards on a new one, its inputs aligned with theirs in four ways.

By its unlabelled pokes: channels matched, CORAL, domain-adversarial training; by labelled ones: direct standardisation,
beside the same labels as training rows. Refuses to know laws and maps.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from pipeline.experiments.rivals.points import NONE, OWN, Key, Point, means_uT, point, pokes_of
from pipeline.training.trainings import SceneData
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.models.adversarial import Domains, train_adversarial
from reskin.models.alignment import choose_ridge, coral, direct, match_channels
from reskin.models.classical import Classical, fit
from reskin.models.grid import ATTEMPTS_MAX_N
from reskin.models.inputs import FIT, VIEW
from reskin.models.network import Predictor
from reskin.models.recipe import Recipe
from reskin.models.trial import COLLAPSED, Weights
from reskin.seeds import rng_for

EVERY_N = 10  # of a labelled poke's readings, one is a row: they differ by noise alone
SAME_MM = 0.5  # so near to each other two pokes lie at one place
WAYS = {"channels matched": match_channels, "CORAL": coral}
DIRECT, AS_ROWS = "direct standardisation", "labels as rows"
ADVERSARIAL, CONTROL = "network, domain-adversarial", "network, trained as long without it"


def score_regressor(data: SceneData, fold: Fold, method: Classical, labels_n: Sequence[int]) -> list[Point]:
    """Score a regressor of known boards as it is, aligned in every way, and with labels as rows."""
    rows, view, pokes = data.rows, VIEW[method.inputs], pokes_of(data, fold)
    known, new, test = (view(rows.db_uT[at]) for at in (fold.train, fold.pool, fold.test))
    target, name = rows.target[fold.train], f"{method.title} ({method.inputs})"
    draws = partial(rng_for, data.settings.seed, "rivals", name, fold.name)
    plain = fit(method, known, target, draws("plain"), weight=None)
    told = partial(point, data, fold)
    points = [told(plain.predict(test), method=name, pokes=NONE)]
    for way, align in WAYS.items():
        moved = align(known.astype(float), new.astype(float))(known.astype(float)).astype(np.float32)
        fitted = fit(method, moved, target, draws(way), weight=None)
        points.append(told(fitted.predict(test), method=f"{name}, {way}", pokes=OWN))
    for n in labels_n:
        back_uT = standardised_uT(data, fold, pokes[:n])
        points.append(told(plain.predict(view(back_uT)), method=f"{name}, {DIRECT}", pokes=NONE, labels_n=n))
        own = np.concatenate([row[::EVERY_N] for row in pokes[:n]])
        weight = np.concatenate([np.ones(len(known)), np.full(len(own), len(known) / len(own))]).astype(np.float32)
        more = np.concatenate([known, view(rows.db_uT[own])]), np.concatenate([target, rows.target[own]])
        fitted = fit(method, *more, draws(AS_ROWS, n), weight=weight)
        points.append(told(fitted.predict(test), method=f"{name}, {AS_ROWS}", pokes=NONE, labels_n=n))
    return points


def standardised_uT(data: SceneData, fold: Fold, pokes: Sequence[np.ndarray]) -> Float[np.ndarray, "b ch"]:
    """Turn a new board's tested fields into the known boards', by labelled pokes that have a pair on these.

    Each pair counts alike, however strong the poke; the ridge is chosen on the pairs.
    """
    new_uT, old_uT = means_uT(data, pokes), pairs_uT(data.rows, fold.train, pokes)
    kept = np.isfinite(old_uT).all(axis=1)
    if not kept.any():
        remedy = "Record known boards at the same places, or do not ask it."
        raise ParamsError(f"fold {fold.name}", "labelled pokes", f"within {SAME_MM} mm of known ones", "none", remedy)
    length_uT = np.linalg.norm(new_uT[kept], axis=1, keepdims=True)
    new, old = new_uT[kept] / length_uT, old_uT[kept] / length_uT
    moved = direct(new, old, choose_ridge(new, old))(data.rows.db_uT[fold.test].astype(float))
    return moved.astype(np.float32)


def pairs_uT(
    rows: Rows, train: Int64[np.ndarray, " a"], pokes: Sequence[Int64[np.ndarray, " r"]]
) -> Float[np.ndarray, "m ch"]:
    """Give what known boards read at the place and force of each poke, the mean over boards; NaN where none was there.

    Between their pokes at that place: linear in log F, and past the weakest and the strongest as these.
    """
    found = np.full((len(pokes), rows.db_uT.shape[1]), np.nan)
    boards = [_means(rows, train[rows.board[train] == board]) for board in np.unique(rows.board[train])]
    for i, row in enumerate(pokes):
        x_mm, y_mm, force_N = rows.target[row].mean(axis=0, dtype=np.float64)
        there = [_between(*known, (x_mm, y_mm), float(force_N)) for known in boards]
        if there := [one for one in there if one is not None]:
            found[i] = np.mean(there, axis=0)
    return found


def _means(rows: Rows, own: Int64[np.ndarray, " a"]) -> tuple[np.ndarray, np.ndarray]:
    # Targets and fields by poke.
    _, poke, count = np.unique(rows.indentation[own], return_inverse=True, return_counts=True)
    sums = [np.zeros((len(count), values.shape[1])) for values in (rows.target, rows.db_uT)]
    for total, values in zip(sums, (rows.target, rows.db_uT), strict=True):
        np.add.at(total, poke.ravel(), values[own])
    return sums[0] / count[:, None], sums[1] / count[:, None]


def _between(
    target: Float[np.ndarray, "p 3"], db_uT: Float[np.ndarray, "p ch"], place_mm: tuple[float, float], force_N: float
) -> Float[np.ndarray, " ch"] | None:
    apart_mm = np.hypot(*(target[:, :2] - place_mm).T)
    here = np.flatnonzero((apart_mm <= SAME_MM) & (target[:, 2] > 0))
    if not len(here):
        return None
    here = here[np.argsort(target[here, 2])]
    log_N = np.log(target[here, 2])
    return np.array([np.interp(np.log(force_N), log_N, channel) for channel in db_uT[here].T])


def score_adversarial(
    data: SceneData, fold: Fold, recipe: Recipe, weight: float
) -> tuple[list[Point], list[dict[str, Any]]]:
    """Score a network whose features were trained to hide whose skin a reading is of, and its control.

    Beside the points: which of the two collapsed, and how often before.
    """
    view, rows = VIEW[recipe.inputs], data.rows
    scaler = FIT[recipe.scaling](view(rows.db_uT[fold.train]), rows.target[fold.train])
    known, new, test = (scaler.encode(view(rows.db_uT[at])) for at in (fold.train, fold.pool, fold.test))
    domains = Domains(known, scaler.encode_target(rows.target[fold.train]), new)
    points, trainings = [], []
    for method, pokes, by in ((CONTROL, NONE, 0.0), (ADVERSARIAL, OWN, weight)):
        weights, record = trained_again(domains, recipe, by, (data.settings.seed, fold.name))
        answer = scaler.decode(Predictor(weights, recipe.architecture, "cpu")(test))
        points.append(point(data, fold, answer, method=method, pokes=pokes))
        trainings.append(record)
    return points, trainings


def trained_again(
    domains: Domains, recipe: Recipe, weight: float, of: tuple[int, str]
) -> tuple[Weights, dict[str, Any]]:
    """Train with other draws what collapsed, as all networks are: at most so many times in all.

    The draws know no weight, so that of a network and its control only the weight differs.
    """
    seed, fold = of
    for attempt_i in range(ATTEMPTS_MAX_N):
        weights = train_adversarial(domains, recipe, weight, rng_for(seed, "rivals", "network", fold, attempt_i))
        off = Predictor(weights, recipe.architecture, "cpu")(domains.known) - domains.target
        collapsed = bool(np.min(1 - np.nanmean(off**2, axis=0) / np.nanvar(domains.target, axis=0)) < COLLAPSED)
        if not collapsed:
            break
    return weights, {"collapsed": collapsed, "collapsed_before_n": attempt_i}


def controls(methods: Mapping[str, Classical], labels_n: Sequence[int]) -> dict[Key, Key]:
    """Say what each baseline is compared with."""
    found: dict[Key, Key] = {(ADVERSARIAL, OWN, 0): (CONTROL, NONE, 0)}
    for method in methods.values():
        name = f"{method.title} ({method.inputs})"
        found |= {(f"{name}, {way}", OWN, 0): (name, NONE, 0) for way in WAYS}
        found |= {(f"{name}, {way}", NONE, n): (name, NONE, 0) for way in (DIRECT, AS_ROWS) for n in labels_n}
    return found
