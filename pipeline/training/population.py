"""Experiment population: experts that were taught simulated skins only, on skins of a scene that these do not contain.

In: a skin at rest, unlabelled pokes, one known weight, a few labels. Out: scores, and what 90 % intervals hold. How
sure experts are is told on further skins of the population. Refuses to know files and how scenes are simulated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.training.universal import REACH, TEMPERS, Pokes
from reskin.metrics import score
from reskin.universal.combine import Labels, multiply, shift
from reskin.universal.map import Estimate, Reader, SkinMap, joined, see_labelled, see_pokes, see_rest
from reskin.universal.network import Opinion, Weights, predict
from reskin.universal.population import PLACES_N, Population
from reskin.universal.training import NOISE_uT

BLOCK_N = 200  # readings at a time, to bound memory
WEIGHT_N = 5.0  # of the one known weight, 500 g in the middle: there and then forces of all places are told best
WEIGHT_SD = 0.02  # of the log of the force that it is taken for: friction where it is guided, and its mass
FELT_N = 0.2  # a smaller force is felt so little that its logarithm tells nothing
WAYS = ("map", "universal", "network")

Told = tuple[int, int]  # so many unlabelled pokes, so many labels


@dataclass(frozen=True)
class Weight:
    """A press of the skin's middle by a weight: its change of field, and the force that it is taken for."""

    db_uT: Float[np.ndarray, " ch"]
    force_N: float


@dataclass(frozen=True)
class Case:
    """A skin that is asked about, in its board's frame and axes."""

    board: str
    rest_uT: Float[np.ndarray, " ch"]
    pool: Pokes  # in the order in which they are shown, or labelled
    weight: Weight
    test_uT: Float[np.ndarray, "n ch"]
    true: Float[np.ndarray, "n 3"]  # x, y in mm from the board's middle, F in N


@dataclass(frozen=True)
class Experts:
    """A map that has seen no skin, and networks."""

    nominal: SkinMap
    networks: Sequence[Weights]


@dataclass(frozen=True)
class Trust:
    """What further skins of the population tell, way by way: tempers, and how far one weight moves all forces."""

    temper: Mapping[str, float]
    weight_share: Mapping[str, float]


def cases_of(skins: Population, rng: np.random.Generator) -> list[Case]:
    """Take skins of a population as ones that are asked about: pokes on the grid are shown, the others read.

    The last press of each skin is the weight's.
    """
    found = []
    for i in range(len(skins)):
        db_uT = skins.db_uT[i] + np.tile(NOISE_uT, 5) * rng.standard_normal(skins.db_uT[i].shape)
        order, place_mm, force_N = rng.permutation(PLACES_N), skins.place_mm[i], skins.force_N[i]
        pool = Pokes(place_mm[order].astype(float), force_N[order].astype(float), db_uT[order])
        true = np.column_stack([place_mm, force_N])[PLACES_N:-1].astype(float)
        weight = weight_of(db_uT[-1], float(force_N[-1]), rng)
        found.append(Case(f"population {i}", skins.rest_uT[i].astype(float), pool, weight, db_uT[PLACES_N:-1], true))
    return found


def weight_of(db_uT: Float[np.ndarray, " ch"], force_N: float, rng: np.random.Generator) -> Weight:
    """Take a press as that of a weight: its force is known as well as a weight's is."""
    return Weight(db_uT, force_N * float(np.exp(WEIGHT_SD * rng.standard_normal())))


@dataclass(frozen=True)
class Ready:
    """A map and networks that have been told of a skin, and what they are asked: its rows, and the weight at last."""

    reader: Reader
    opinion: Opinion
    read_uT: Float[np.ndarray, "n ch"]

    def answers(self, tempers: Mapping[str, float]) -> dict[str, Estimate]:
        """Give places and forces by the map, by the networks, and by both."""
        alone, both = [], []
        for first in range(0, len(self.read_uT), BLOCK_N):
            here = slice(first, first + BLOCK_N)
            weighed = self.reader.weigh(self.read_uT[here])
            alone.append(self.reader.answer(weighed, tempers["map"]))
            both.append(multiply(self.reader, weighed, self.opinion[here], tempers["universal"]))
        return {"map": joined(alone), "universal": joined(both), "network": _said(self.opinion, tempers["network"])}


def ready(experts: Experts, case: Case, told: Told) -> Ready:
    """Tell experts the field at rest, then pokes at unknown places, then labels that are among them."""
    pokes_n, labels_n = told
    shown, labels = case.pool.db_uT[:pokes_n], slice(labels_n)
    skin = see_rest(experts.nominal, case.rest_uT)
    skin = see_pokes(skin, shown) if pokes_n else skin
    force_N = np.maximum(case.pool.force_N, skin.tables.force_N[0])
    skin = see_labelled(skin, case.pool.place_mm[labels], force_N[labels], case.pool.db_uT[labels])
    read_uT = np.concatenate([case.test_uT, case.weight.db_uT[None]])
    opinion = predict(experts.networks, read_uT, case.rest_uT, shown)
    if labels_n:
        said = predict(experts.networks, case.pool.db_uT[labels], case.rest_uT, shown)
        opinion = shift(opinion, Labels(said.place_mm, case.pool.place_mm[labels]))
    return Ready(Reader(skin), opinion, read_uT)


def trust(experts: Experts, cases: Sequence[Case], told: Told) -> Trust:
    """Tell on skins that are not scored how sure each way is, and how far one known weight moves its forces."""
    held = {way: np.zeros((len(TEMPERS), len(cases))) for way in WAYS}
    # Of log F, by temper: how far the weight is off, and the mean of all others.
    off = {way: np.zeros((len(TEMPERS), 2, len(cases))) for way in WAYS}
    for j, case in enumerate(cases):
        told_of = ready(experts, case, told)
        for i, temper in enumerate(TEMPERS):
            for way, found in told_of.answers(dict.fromkeys(WAYS, temper)).items():
                held[way][i, j] = _held(found, case)
                off[way][i, :, j] = _off_log_N(found, case)
    chosen_i = {way: int(np.abs(held[way].mean(axis=1) - 0.9).argmin()) for way in WAYS}
    shares = {way: share_of(*off[way][i]) for way, i in chosen_i.items()}
    return Trust({way: TEMPERS[i] for way, i in chosen_i.items()}, shares)


def share_of(weight_off: Float[np.ndarray, " s"], others_off: Float[np.ndarray, " s"]) -> float:
    """Give what part of how far log F is off for the weight is to be taken from all others, by least squares."""
    return float(weight_off @ others_off / (weight_off @ weight_off))


def scores_of(experts: Experts, case: Case, told: Told, how: Trust) -> list[dict[str, Any]]:
    """Score a skin by each way; forces without and with one known weight."""
    rows = []
    for way, found in ready(experts, case, told).answers(how.temper).items():
        read_N = found.force_N[:-1]
        scores = score(case.true, np.column_stack([found.place_mm[:-1], read_N]))
        weight_off, _ = _off_log_N(found, case)
        weighed_N = read_N * np.exp(how.weight_share[way] * weight_off)
        rows.append(
            {"way": way, "pokes_n": told[0], "labels_n": told[1], "board": case.board}
            | scores
            | {"mse_f_weight_N2": float(((weighed_N - case.true[:, 2]) ** 2).mean())}
            | {"mse_f_factor_N2": _left_by_factor_N2(read_N, case.true[:, 2])}
            | {"coverage_pct": 100 * _held(found, case)}
        )
    return rows


def _left_by_factor_N2(read_N: Float[np.ndarray, " n"], true_N: Float[np.ndarray, " n"]) -> float:
    # What the best factor of all forces of a skin leaves, so what no weight goes below that moves them alike.
    return float(((read_N * (read_N @ true_N) / (read_N @ read_N) - true_N) ** 2).mean())


def fewer(experts: Experts, networks: Sequence[Weights]) -> Experts:
    """Put other networks beside the same map."""
    return replace(experts, networks=networks)


def _off_log_N(found: Estimate, case: Case) -> tuple[float, float]:
    # How far log F is off for the weight, and on average for what is asked, where a force is felt.
    felt = case.true[:, 2] > FELT_N
    weight = np.log(case.weight.force_N / found.force_N[-1])
    return float(weight), float(np.log(case.true[felt, 2] / found.force_N[:-1][felt]).mean())


def _held(found: Estimate, case: Case) -> float:
    off_mm = np.abs(found.place_mm[:-1] - case.true[:, :2])
    return float((off_mm <= REACH * found.sd_mm[:-1]).mean())


def _said(opinion: Opinion, temper: float) -> Estimate:
    # A network's intervals grow as a map's do whose log likelihoods are tempered.
    nothing = np.full(len(opinion.log_N), np.nan)
    return Estimate(opinion.place_mm, opinion.sd_mm / np.sqrt(temper), np.exp(opinion.log_N), nothing)
