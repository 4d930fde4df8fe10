"""Question universal: what is known of boards -> scores of a map and of a network with it on a held-out board.

With recorded boards of the rig (`rig`), and with none (`nominal`): a law's nominal numbers and their spreads alone.
Places and fields are turned to the board's frame first. Refuses to know files and how networks are trained.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from pipeline.twin.opinion import Opinion, Weights, predict
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
from pipeline.twin.sure import by_misfit, by_residuals, left_out, ratios
from pipeline.twin.tables import FORCES_N

QUESTION = "labels"  # whose folds these are
METHODS = ("universal map, ", "universal, ")  # the map alone; with networks
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
REACH = 1.645  # standard deviations to either side of a 90 % interval
TEMPERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
ASSUMED_TEMPER = 0.5  # of the map's places, and where nothing tells how sure it is: as if channels erred in pairs
BLOCK_N = 200  # readings at a time, to bound memory
FORCE_MIN_N = float(FORCES_N[0])  # of a labelled poke: below, the map is not tabulated

Tempers = tuple[float, float]  # of the map alone, and of the map with networks


@dataclass(frozen=True)
class Bench:
    """All that folds share: rows, how boards lie under labels, what is known of each board, experts that know none."""

    data: SceneData
    frame: Frame
    seen: Mapping[str, Seen]
    nominal: Experts
    tempers: Mapping[str, Mapping[int, Tempers]]
    sureness: Mapping[int, Tempers]  # of experts that know no board, at a misfit of 1


@dataclass(frozen=True)
class Pokes:
    """Pokes of one board, the mean of their readings each, in the board's frame and axes; in the order of labelling."""

    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, " m"]
    db_uT: Float[np.ndarray, "m ch"]

    def __getitem__(self, which: slice | Int64[np.ndarray, " k"]) -> "Pokes":
        """Take some of them."""
        return Pokes(self.place_mm[which], self.force_N[which], self.db_uT[which])


@dataclass(frozen=True)
class Told:
    """Experts that have seen a board's field at rest and its unlabelled pokes."""

    skin: SkinMap
    networks: Sequence[Weights]
    rest_uT: Float[np.ndarray, " ch"]
    pool: Pokes
    pool_mm: Float[np.ndarray, "m 2"]  # where the networks say that these are
    misfit: float  # of these, the median: chi^2 a channel, about 1 where the law errs as the map expects

    def opinion(self, db_uT: Float[np.ndarray, "n ch"], labels_n: int) -> Opinion:
        """Ask the networks, centred by the pool and shifted by its first labels."""
        said = predict(self.networks, db_uT, self.rest_uT, self.pool.db_uT)
        said_mm = self.pool_mm[:labels_n] - off_middle_mm(self.pool_mm, labels_n)
        return shift(centre(said, self.pool_mm, labels_n), Labels(said_mm, self.pool.place_mm[:labels_n]))

    def tempers(self, sureness: Tempers) -> Tempers:
        """Believe experts that know no board the less the worse the pokes fit."""
        of_map, of_both = (by_misfit(one, self.misfit) for one in sureness)
        return of_map, of_both

    def first(self, which: Int64[np.ndarray, " k"]) -> "Told":
        """Put some of the pool's pokes first: they are labelled next."""
        order = np.concatenate([which, np.setdiff1d(np.arange(len(self.pool.force_N)), which)])
        return replace(self, pool=self.pool[order], pool_mm=self.pool_mm[order])


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
        told = tell(experts, rest_uT, pool)
        for n in labels_n:
            tempers = bench.tempers[board][n] if way == "rig" else told.tempers(bench.sureness[n])
            (tempers,) = by_own_labels(told, n, [tempers]) if way == "nominal" else [tempers]
            ((alone, both),) = read_both(ready(told, n), test_uT, [tempers])
            for name, temper, found in zip(METHODS, tempers, (alone, both), strict=True):
                words = {"method": f"{name}{WAYS[way]}", "labels_n": n, "fold": fold.name.rsplit("-draw", 1)[0]}
                words |= {"inputs": "map" if "map" in name else "map and network", "temper": temper}
                words |= {"seed_i": int(fold.name.rsplit("-draw", 1)[1]), "misfit": told.misfit}
                points.append(words | {"scores": scored(bench, fold.test, found)})
    return points


def tell(experts: Experts, rest_uT: Float[np.ndarray, " ch"], pool: Pokes) -> Told:
    """Tell experts what a new board gives without a label: its field at rest, and pokes all over it."""
    skin = see_pokes(see_rest(new_map(experts.tables, experts.residual), rest_uT), pool.db_uT)
    pool_mm = predict(experts.networks, pool.db_uT, rest_uT, pool.db_uT).place_mm
    skin = see_even(skin, pool.db_uT)
    misfit = float(np.median(Reader(skin).weigh(pool.db_uT).misfit()))
    return Told(skin, experts.networks, rest_uT, pool, pool_mm, misfit)


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
    ready: Ready, db_uT: Float[np.ndarray, "n ch"], tempers: Sequence[Tempers]
) -> list[tuple[Estimate, Estimate]]:
    """Read places by the map alone, and by it and the networks; under other tempers intervals alone differ."""
    opinion, alone, both = ready.told.opinion(db_uT, ready.labels_n), [], []
    for first in range(0, len(db_uT), BLOCK_N):
        here = slice(first, first + BLOCK_N)
        weighed = ready.reader.weigh(db_uT[here])
        answer = ready.reader.answer(weighed, ASSUMED_TEMPER)
        alone.append([about(answer, ready.reader.answer(weighed, of_map)) for of_map, _ in tempers])
        both.append([multiply(ready.reader, weighed, opinion[here], of_both) for _, of_both in tempers])
    by_temper = zip(zip(*alone, strict=True), zip(*both, strict=True), strict=True)
    return [(joined(of_map), joined(of_both)) for of_map, of_both in by_temper]


def by_own_labels(told: Told, labels_n: int, tempers: Sequence[Tempers]) -> list[Tempers]:
    """Believe experts by how far labelled pokes are off that they were not told, under each temper."""
    of_map: list[tuple[list[Estimate], Any]] = []
    of_both: list[tuple[list[Estimate], Any]] = []
    for kept, left in left_out(min(labels_n, len(told.pool.force_N))):
        found = read_both(ready(told.first(kept), len(kept)), told.pool.db_uT[left], tempers)
        for parts, of_way in zip((of_map, of_both), zip(*found, strict=True), strict=True):
            parts.append((list(of_way), told.pool.place_mm[left]))
    of_ways = zip(tempers, *(ratios(len(tempers), parts) for parts in (of_map, of_both)), strict=True)
    return [(by_residuals(alone, of_alone), by_residuals(both, of)) for (alone, both), of_alone, of in of_ways]


def about(answer: Estimate, likely: Estimate) -> Estimate:
    """Give an answer how far what is likely spreads about it."""
    return replace(answer, sd_mm=np.hypot(likely.sd_mm, likely.place_mm - answer.place_mm))


def coverages(told: Told, asked: Pokes, labels_n: int, tempers: Sequence[Tempers]) -> Float[np.ndarray, "t 2"]:
    """Give what 90 % intervals of pokes hold under each temper, of the map alone and with networks."""
    both = read_both(ready(told, labels_n), asked.db_uT, tempers)
    return np.array([[covered(found, asked.place_mm) for found in pair] for pair in both])


def covered(estimate: Estimate, place_mm: Float[np.ndarray, "n 2"]) -> float:
    """Give the part of coordinates that lie in their 90 % intervals."""
    return float((np.abs(estimate.place_mm - place_mm) <= REACH * estimate.sd_mm).mean())


def scored(bench: Bench, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates as every method's, and count what their 90 % intervals hold."""
    label_mm = bench.frame.label(estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(bench.data, test, predicted)
    true_mm = bench.frame.place(bench.data.rows.target[test, :2].astype(float))
    half_width_mm = REACH * float(np.median(estimate.sd_mm))
    coverage = {"coverage_pct": 100 * covered(estimate, true_mm), "half_width_mm": half_width_mm}
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
