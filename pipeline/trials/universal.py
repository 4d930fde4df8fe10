"""Question universal: what is known of boards -> scores of a map and of a network with it on a held-out board.

With recorded boards of the rig (`rig`), and with none (`nominal`): a law's nominal numbers and their spreads alone.
Places and fields are turned to the board's frame first. Refuses to know files and how networks are trained.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from pipeline.core.errors import ParamsError
from pipeline.core.seeds import rng_for
from pipeline.dataset.splits import Fold
from pipeline.trials.experts import Experts, Frame
from pipeline.trials.training import SceneData, score_test
from pipeline.twin.experts import Labels, centre, multiply, off_middle_mm, shift
from pipeline.twin.fit import Seen
from pipeline.twin.network import Opinion, Weights, predict
from pipeline.twin.skin_map import (
    Estimate,
    Reader,
    SkinMap,
    joined,
    new_map,
    see_even,
    see_labelled,
    see_pokes,
    see_rest,
)

QUESTION = "labels"  # whose folds these are
METHODS = ("universal map, ", "universal, ")  # the map alone; with networks
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
REACH = 1.645  # standard deviations to either side of a 90 % interval
TEMPERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
ASSUMED_TEMPER = 0.5  # where no board is known that it could be told on: of two experts on one reading, the mean
BLOCK_N = 200  # readings at a time, to bound memory
FORCE_MIN_N = 0.3  # of a labelled poke: below, the map is not tabulated

Tempers = tuple[float, float]  # of the map alone, and of the map with networks


@dataclass(frozen=True)
class Bench:
    """All that folds share: rows, how boards lie under labels, what is known of each board, experts that know none."""

    data: SceneData
    frame: Frame
    seen: Mapping[str, Seen]
    nominal: Experts
    tempers: Mapping[str, Mapping[int, Tempers]]


@dataclass(frozen=True)
class Pokes:
    """Pokes of one board, the mean of their readings each, in the board's frame and axes; in the order of labelling."""

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    db_uT: Float[np.ndarray, "m ch"]


@dataclass(frozen=True)
class Told:
    """Experts that have seen a board's field at rest and its unlabelled pokes."""

    skin: SkinMap
    networks: Sequence[Weights]
    rest_uT: Float[np.ndarray, " ch"]
    pool: Pokes
    pool_mm: Float[np.ndarray, "m 2"]  # where the networks say that these are

    def opinion(self, db_uT: Float[np.ndarray, "n ch"], labels_n: int) -> Opinion:
        """Ask the networks, centred by the pool and shifted by its first labels."""
        said = predict(self.networks, db_uT, self.rest_uT, self.pool.db_uT)
        said_mm = self.pool_mm[:labels_n] - off_middle_mm(self.pool_mm, labels_n)
        return shift(centre(said, self.pool_mm, labels_n), Labels(said_mm, self.pool.place_mm[:labels_n]))


def score_fold(bench: Bench, fold: Fold, rig: Mapping[str, Experts], labels_n: Sequence[int]) -> list[dict[str, Any]]:
    """Score the map alone and both experts on one fold: how sure they are is told on boards that are not held out."""
    board = str(bench.data.rows.board[fold.test[0]])
    if board not in bench.seen:  # they are named by board and skin where a board has several
        rule = "boards of one skin each"
        raise ParamsError(f"fold {fold.name}", "the boards", rule, ", ".join(bench.seen), "Do not ask it.")
    pool, rest_uT = pool_of(bench, fold), bench.seen[board].rest_uT.ravel()
    test_uT = bench.frame.field(bench.data.rows.db_uT[fold.test])
    points = []
    for way, experts in {"rig": rig[board], "nominal": bench.nominal}.items():
        start_s = time.monotonic()
        told = tell(experts, rest_uT, pool)
        took_s = time.monotonic() - start_s
        for n in labels_n:
            tempers = bench.tempers[board][n] if way == "rig" else (ASSUMED_TEMPER, ASSUMED_TEMPER)
            alone, both = read_both(ready(told, n), test_uT, *tempers)
            for name, temper, found in zip(METHODS, tempers, (alone, both), strict=True):
                words = {"method": f"{name}{WAYS[way]}", "labels_n": n, "fold": fold.name.rsplit("-draw", 1)[0]}
                words |= {"inputs": "map" if "map" in name else "map and network", "temper": temper}
                words |= {"seed_i": int(fold.name.rsplit("-draw", 1)[1]), "seconds": took_s}
                points.append(words | {"scores": scored(bench, fold.test, found)})
    return points


def tell(experts: Experts, rest_uT: Float[np.ndarray, " ch"], pool: Pokes) -> Told:
    """Tell experts what a new board gives without a label: its field at rest, and pokes all over it."""
    skin = see_pokes(see_rest(new_map(experts.tables, experts.residual), rest_uT), pool.db_uT)
    pool_mm = predict(experts.networks, pool.db_uT, rest_uT, pool.db_uT).place_mm
    return Told(see_even(skin, pool.db_uT), experts.networks, rest_uT, pool, pool_mm)


@dataclass(frozen=True)
class Ready:
    """Experts with so many labels, ready to read."""

    reader: Reader
    told: Told
    labels_n: int


def ready(told: Told, labels_n: int) -> Ready:
    """Tell a map the first labels."""
    first = slice(labels_n)
    force_N = np.maximum(told.pool.force_N[first], FORCE_MIN_N)
    skin = see_labelled(told.skin, told.pool.place_mm[first], force_N, told.pool.db_uT[first])
    return Ready(Reader(skin), told, labels_n)


def read_both(
    ready: Ready, db_uT: Float[np.ndarray, "n ch"], map_temper: float, both_temper: float
) -> tuple[Estimate, Estimate]:
    """Read places by the map alone, and by it and the networks."""
    opinion, alone, both = ready.told.opinion(db_uT, ready.labels_n), [], []
    for first in range(0, len(db_uT), BLOCK_N):
        here = slice(first, first + BLOCK_N)
        weighed = ready.reader.weigh(db_uT[here])
        alone.append(ready.reader.answer(weighed, map_temper))
        both.append(multiply(ready.reader, weighed, opinion[here], both_temper))
    return joined(alone), joined(both)


def tell_tempers(bench: Bench, labels_n: Sequence[int]) -> dict[str, dict[int, Tempers]]:
    """Find, for each board that is held out, how much experts are to be believed: as was best on the other boards."""
    held = {board: coverages(bench, board, labels_n) for board in bench.seen}
    found: dict[str, dict[int, Tempers]] = {}
    for board in held:
        found[board] = {}
        for n in labels_n:
            mean = np.mean([own[n] for other, own in held.items() if other != board], axis=0)
            of_map, of_both = np.abs(mean - 0.9).argmin(axis=0)
            found[board][n] = TEMPERS[of_map], TEMPERS[of_both]
    return found


def coverages(bench: Bench, board: str, labels_n: Sequence[int]) -> dict[int, Float[np.ndarray, "t 2"]]:
    """Give what 90 % intervals hold under each temper, of the map alone and with networks, by number of labels.

    The board is read by the nominal experts, which know no board, with labels of its own, on its other pokes.
    """
    seen = bench.seen[board]
    order = rng_for(bench.data.settings.seed, "universal", board).permutation(len(seen.pokes))
    pool_n = len(order) // 3
    db_uT = seen.db_uT.reshape(len(order), -1)[order]
    place_mm, force_N = seen.place_mm[order], seen.pokes.force_N[order]
    told = tell(bench.nominal, seen.rest_uT.ravel(), Pokes(place_mm[:pool_n], force_N[:pool_n], db_uT[:pool_n]))
    held = {}
    for n in labels_n:
        experts = ready(told, min(n, pool_n))
        both = [read_both(experts, db_uT[pool_n:], temper, temper) for temper in TEMPERS]
        held[n] = np.array([[covered(found, place_mm[pool_n:]) for found in pair] for pair in both])
    return held


def covered(estimate: Estimate, place_mm: Float[np.ndarray, "n 2"]) -> float:
    """Give the part of coordinates that lie in their 90 % intervals."""
    return float((np.abs(estimate.place_mm - place_mm) <= REACH * estimate.sd_mm).mean())


def scored(bench: Bench, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates as every method's, and count what their 90 % intervals hold."""
    label_mm = bench.frame.label(estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(bench.data, test, predicted)
    true_mm = bench.frame.place(bench.data.rows.target[test, :2].astype(float))
    coverage = {"coverage_pct": 100 * covered(estimate, true_mm)}
    skins = {name: own | coverage for name, own in scores["by_skin"].items()} if len(scores["by_skin"]) == 1 else {}
    return scores | {"all": scores["all"] | coverage} | ({"by_skin": skins} if skins else {})


def pool_of(bench: Bench, fold: Fold) -> Pokes:
    """Give the means of the pool's pokes, in the order in which question labels hands out labels."""
    rows, indentation = bench.data.rows, bench.data.rows.indentation[fold.pool]
    order = rng_for(bench.data.settings.seed, "labelled", fold.name).permutation(np.unique(indentation))
    own = [fold.pool[indentation == one] for one in order]
    target = np.array([rows.target[one].mean(axis=0) for one in own], float)
    db_uT = np.array([rows.db_uT[one].mean(axis=0) for one in own], float)
    return Pokes(bench.frame.place(target[:, :2]), target[:, 2], bench.frame.field(db_uT))
