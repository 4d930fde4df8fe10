"""What unlabelled pokes are worth to maps, networks and a fitted law: a skin's own, none, and, as a control, another's.

All are asked without a label. Refuses to know how experts were made.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from pipeline.experiments.rivals.points import FOREIGN, INVERSION, NONE, OWN, Key, Point, board_of, next_board, point
from pipeline.training.universal import (
    ASSUMED_TEMPER,
    WAYS,
    Bench,
    Experts,
    Pokes,
    Told,
    pool_of,
    read_both,
    ready,
    tell,
)
from reskin.data.splits import Fold
from reskin.universal.inversion import Chart, chart, fit_unlabelled, search
from reskin.universal.law import Setup
from reskin.universal.map import new_map, see_rest

CENTRED = f"{INVERSION}, centred"
EXPERTS = ("universal map, ", "universal network, ", "universal, ")  # the map, the network, both
NOWHERE_MM = np.zeros((1, 2))  # of no poke: nothing is centred


@dataclass(frozen=True)
class Timed:
    """Processor seconds until a method is ready for a skin, and of one reading of many."""

    name: str
    train_s: float
    one_reading_s: float


def score_told(
    bench: Bench, setup: Setup, folds: Sequence[Fold], fold: Fold, rig: Mapping[str, Experts]
) -> tuple[list[Point], list[Timed]]:
    """Score maps, networks and the inversion with a skin's own pokes, with none and with another skin's."""
    points, took = [], []
    frame, db_uT = bench.frame, bench.data.rows.db_uT
    test_uT, rest_uT = frame.field(db_uT[fold.test]), bench.seen[board_of(fold)].rest_uT.ravel()
    for given, pool in pools(bench, folds, fold).items():
        told = partial(point, bench.data, fold, pokes=given)
        for method, place_mm, force_N, timed in [
            *asked(bench.nominal, rest_uT, pool, test_uT, WAYS["nominal"]),
            *asked(rig[board_of(fold)], rest_uT, pool, test_uT, WAYS["rig"]),
            *inverted(setup, rest_uT, pool, test_uT),
        ]:
            points.append(told(np.column_stack([frame.label(place_mm), force_N]), method=method))
            took += [replace(timed, name=f"{method}.{fold.name}")] if given == OWN else []
    return points, took


def pools(bench: Bench, folds: Sequence[Fold], fold: Fold) -> dict[str, Pokes]:
    """Give the unlabelled pokes that methods are told."""
    own = pool_of(bench, fold)
    none = Pokes(own.place_mm[:0], own.force_N[:0], own.db_uT[:0])
    return {OWN: own, NONE: none, FOREIGN: pool_of(bench, next_board(fold, folds))}


Answer = tuple[str, Float[np.ndarray, "b 2"], Float[np.ndarray, " b"], Timed]


def asked(
    experts: Experts, rest_uT: Float[np.ndarray, " ch"], pool: Pokes, test_uT: Float[np.ndarray, "b ch"], way: str
) -> Iterator[Answer]:
    """Ask a map, a network and both, told some pokes of a skin."""
    start_s = time.process_time()
    told = tell(experts, rest_uT, pool) if len(pool.force_N) else untold(experts, rest_uT, pool)
    experts_ready = ready(told, 0)
    ready_s = time.process_time()
    ((alone, both),) = read_both(experts_ready, test_uT, [(ASSUMED_TEMPER, ASSUMED_TEMPER)])
    read_s = time.process_time()
    opinion = told.opinion(test_uT, 0)
    asked_s = time.process_time()
    timed = Timed("", ready_s - start_s, (read_s - ready_s) / len(test_uT))
    network = Timed("", 0.0, (asked_s - read_s) / len(test_uT))  # it is told its pokes while it reads
    places = alone.place_mm, opinion.place_mm, both.place_mm
    forces = alone.force_N, np.exp(opinion.log_N), both.force_N
    yield from zip([f"{name}{way}" for name in EXPERTS], places, forces, (timed, network, timed), strict=True)


def untold(experts: Experts, rest_uT: Float[np.ndarray, " ch"], none: Pokes) -> Told:
    """Tell experts the field at rest, and no poke."""
    skin = see_rest(new_map(experts.tables, experts.residual), rest_uT)
    return Told(skin, experts.networks, rest_uT, none, NOWHERE_MM, misfit=1.0)


def inverted(
    setup: Setup, rest_uT: Float[np.ndarray, " ch"], pool: Pokes, test_uT: Float[np.ndarray, "b ch"]
) -> Iterator[Answer]:
    """Search a law that was fitted to some pokes; also with places shifted so that these pokes lie about the middle."""
    start_s = time.process_time()
    known = chart(fit_unlabelled(pool.db_uT, rest_uT, setup), setup)
    ready_s = time.process_time()
    found = search(known, test_uT)
    timed = Timed("", ready_s - start_s, (time.process_time() - ready_s) / len(test_uT))
    yield INVERSION, found.place_mm, found.force_N, timed
    yield CENTRED, found.place_mm - middle_mm(known, pool), found.force_N, timed


def middle_mm(known: Chart, pool: Pokes) -> Float[np.ndarray, "2"]:
    """Give where pokes lie on the whole: the middle, of those that lie evenly."""
    return search(known, pool.db_uT).place_mm.mean(axis=0) if len(pool.db_uT) else np.zeros(2)


def controls() -> dict[Key, Key]:
    """Compare every method with itself, told its own pokes."""
    names = [f"{name}{way}" for way in WAYS.values() for name in EXPERTS]
    return {(name, given, 0): (name, OWN, 0) for name in (*names, INVERSION, CENTRED) for given in (NONE, FOREIGN)}
