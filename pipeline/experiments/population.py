"""The universal model, built from simulated skins alone and tested on held-out skins of a simulated scene.

The model consists of a map, which compares a reading with simulated fields, and of networks. It is calibrated to each
tested skin with the skin's no-load field (field without contact), with unlabelled presses (at unknown places), and with
labelled presses. In addition, the estimated forces are corrected with one known weight, which is put on the skin.
Networks that were trained on different numbers of simulated skins show how the error depends on this number.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from pydantic import Field
from scipy.constants import mega, milli
from scipy.spatial.transform import Rotation

import reskin.universal
from pipeline.experiments.results import read_captures, write_results
from pipeline.formatting import n_of, scores, tabulate
from pipeline.plot import COLOURS, MARKERS, drawing, svg
from pipeline.settings import Settings
from pipeline.simulation import simulation_settings
from pipeline.stage import say
from pipeline.statistics import summarise
from pipeline.training.jobs import SceneData, read_data
from pipeline.training.universal import BOARD_POWERS, coverage
from pipeline.training.universal_variants import Frame
from reskin import io
from reskin.code import digest, imported
from reskin.config import Strict
from reskin.data.grid import CENTRE_MM
from reskin.data.splits import Fold
from reskin.errors import ParamsError, SchemaError
from reskin.metrics import score
from reskin.physics.skin import SkinDesign
from reskin.physics.slide import force_at
from reskin.seeds import rng_for
from reskin.simulation.settings import BoardKind
from reskin.universal.batches import NOISE_uT, SkinPrior
from reskin.universal.calibration import CalibrationData, LabelledPresses
from reskin.universal.law import Law, Setup
from reskin.universal.map import RIG_SPREADS, Estimate, Tables, new_map
from reskin.universal.map import tabulate as tabulate_map
from reskin.universal.model import Evaluation, PriorModel
from reskin.universal.network import Weights, draw_weights
from reskin.universal.population import PLACES_N, Forces, Population, draw_population

EXPERIMENT = "lobo"  # experiment whose folds are used; their pools contain the unlabelled pokes
POOL_MAX_N = 65  # largest number of presses for calibration: one press at each place of the paper's grid, at any depth
TESTED_MAX_N = 2000  # at most this number of test rows per skin, drawn at random
CALIBRATION_SKINS_N = 16  # simulated skins that determine likelihood powers and weight shares (see `Calibration`)
FRESH_N = 32  # number of further simulated skins, which are used to measure the coverage of intervals
BY = ("way", "pokes_n", "labels_n")
# Ways to estimate place and force: with the map alone, with the map and the networks, with the networks alone.
WAYS = ("map", "universal", "network")
# Force of the known weight (500 g). It is put on the skin's middle, which is the place that is most informative about
# forces at other places.
WEIGHT_N = 5.0
# Standard deviation of log(assumed force / true force) of the known weight. The two forces differ because of friction
# in the weight's guide, and because of an error of its mass.
WEIGHT_SD = 0.02
LOG_FORCE_MIN_N = 0.2  # errors of log F are computed without presses of less force, which hardly change the field

PACKAGE = Path(reskin.universal.__file__).parent
TRAINING_MODULE = "reskin.universal.training"
PART_N = 100  # number of skins in one cached array
LOG_FORCE_STEP = 0.6  # largest difference of log F between two successive forces in the map's tables
# The smallest and the largest force of the design are multiplied by these factors, because skins differ from the
# design.
FORCE_SHARES = (0.7, 1.5)


class CalibrationSize(NamedTuple):
    """Numbers of unlabelled presses and of labels for calibration."""

    presses_n: int
    labels_n: int


class PopulationSettings(Strict):
    """Settings section `population`.

    - skins_n: numbers of simulated skins, for each of which one network is trained. One population of skins is drawn,
      and a network for n skins is trained on the first n skins of the population.
    - steps_n: number of steps of each training run.
    - unlabelled_n: numbers of unlabelled presses to which the model is calibrated.
    - labels_n: numbers of labelled presses to which the model is calibrated.
    """

    skins_n: Annotated[tuple[Annotated[int, Field(ge=1, le=100_000)], ...], Field(min_length=1)]
    steps_n: Annotated[int, Field(ge=2, le=1_000_000)]
    unlabelled_n: Annotated[tuple[Annotated[int, Field(ge=0, le=POOL_MAX_N)], ...], Field(min_length=1)]
    labels_n: tuple[Annotated[int, Field(ge=1, le=POOL_MAX_N)], ...]

    def sizes(self) -> list[CalibrationSize]:
        """List the amounts of calibration data that are tested.

        First, every number of unlabelled presses is listed without labels. Then, the largest number of unlabelled
        presses is listed with every number of labels.
        """
        most_n = max(self.unlabelled_n)
        return [CalibrationSize(n, 0) for n in self.unlabelled_n] + [CalibrationSize(most_n, n) for n in self.labels_n]


@dataclass(frozen=True)
class DesignedSkins:
    """A distribution of simulated skins that vary around the design of a scene's skins.

    - prior: the distribution.
    - forces_N: smallest and largest force of a press on these skins, at the depths of the scene.
    - seed: seed of all random draws.
    """

    prior: SkinPrior
    forces_N: tuple[float, float]
    seed: int

    def draw(self, name: str, which: slice, weight_N: float | None = None) -> Population:
        """Draw some skins of the population `name`: the skins whose indices are in the slice `which`.

        If `weight_N` is given, the last press on each skin is the press of a weight with this force.
        """
        prior, rng = self.prior, rng_for(self.seed, "population", name)
        return draw_population(prior.centre, prior.spreads, prior.setup, which, rng, Forces(*self.forces_N, weight_N))

    def tables(self) -> Tables:
        """Compute the map's tables for skins around the design."""
        first, last = np.log(self.forces_N)
        forces_N = np.exp(np.linspace(first, last, 1 + int(np.ceil((last - first) / LOG_FORCE_STEP))))
        return tabulate_map(self.prior.centre, self.prior.spreads, self.prior.setup, forces_N)


def designed_skins(design: SkinDesign, kind: BoardKind, depths_mm: tuple[float, ...], seed: int) -> DesignedSkins:
    """Return the distribution of skins around a design; boards do not vary, but are exactly as designed."""
    if design.hold is None:
        what = "hold of section skin is null, but experiment population needs a skin that slides on its base"
        raise ParamsError(f"nominal.yaml: {what}. Set skin.hold, or run the experiment in a scene that sets it.")
    modulus_MPa = design.modulus_kPa * 1e-3
    law = Law(
        0.0, 0.0, 0.0, kind.design.gap_mm, 1.0, 0.0, 0.0, modulus_MPa, design.hold.away_um_mm,
        *design.hold.give_um, lets_go_N=design.hold.lets_go_mm2 * modulus_MPa,
        grip_N_mm=design.hold.springs_N_mm / design.hold.friction,
    )  # fmt: skip
    chips_mm = np.array(kind.design.places_mm)
    setup = Setup(design, chips_mm, kind.design.gap_mm, kind.skin_mm, design.flipped, design.tip_radius_mm)
    depths_m = 1e-3 * np.array([min(depths_mm), max(depths_mm)])
    tip_m = design.tip_radius_mm * milli
    ends_N = FORCE_SHARES * force_at(
        depths_m, modulus_Pa=mega * modulus_MPa, thickness_m=setup.thickness_m, tip_radius_m=tip_m
    )
    prior = SkinPrior("as designed", law, RIG_SPREADS, setup, follows_law=True)
    return DesignedSkins(prior, (float(ends_N[0]), float(ends_N[1])), seed)


def draw(designed: DesignedSkins, skins_n: int, report: Callable[[str], None]) -> Population:
    """Draw a population of `skins_n` training skins.

    The skins are drawn in parts. Each part is cached, and `report` is called when the part is complete.
    """
    parts = []
    for first in range(0, skins_n, PART_N):
        which = slice(first, min(first + PART_N, skins_n))
        parts.append(_cached(designed, f"skins {which}", partial(_skins_array, designed, which)))
        report(f"{which.stop} of {skins_n} skins drawn")
    channels_n = (parts[0].shape[2] - 3) // 2
    stacked = np.split(np.concatenate(parts), (channels_n, 2 * channels_n, -1), axis=2)
    db_uT, rest_uT, place_mm, force_N = stacked
    return Population(db_uT, rest_uT[:, 0], place_mm, force_N[..., 0])


def train_network(designed: DesignedSkins, skins: Population, skins_n: int, steps_n: int) -> Weights:
    """Train a network on the first skins of a population, or load it from the cache."""
    from reskin.universal.training import train  # imported late, because it imports PyTorch

    first = Population(*(getattr(skins, name)[:skins_n] for name in Population.__annotations__))
    # skins_n is not part of the name, so that all networks have the same initial weights.
    rng_name = (designed.seed, "population", "network")
    empty = draw_weights(skins.rest_uT.shape[1], rng_for(*rng_name))

    def make() -> Float[np.ndarray, " w"]:
        weights = train(first, designed.prior, steps_n, rng_for(*rng_name))
        return np.concatenate([weights[name].ravel() for name in empty])

    flat, by_name, start = _cached(designed, f"network of {skins_n} skins, {steps_n} steps", make), {}, 0
    for name, value in empty.items():
        by_name[name] = flat[start : start + value.size].reshape(value.shape)
        start += value.size
    return by_name


def _cached(designed: DesignedSkins, what: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Return an array from the cache, or compute and cache it.

    The key of the cache contains `what`, the prior, the seed, the code of training and the fields of the first skin.
    """
    first_skin = hashlib.sha256(_skins_array(designed, slice(1)).tobytes()).hexdigest()
    spreads = sorted(designed.prior.spreads.items())
    code = [digest(module) for module in imported(TRAINING_MODULE)]
    versions = f"torch {version('torch')}; {code}; {first_skin}"
    name = f"{what}; {versions}; {designed.prior.centre}; {spreads}; {designed.forces_N}; seed {designed.seed}"
    array = io.load_cached_array(PACKAGE, name)
    if array is None:
        array = make()
        io.save_cached_array(PACKAGE, name, array)
    return array


def _skins_array(designed: DesignedSkins, which: slice) -> np.ndarray:
    """Draw skins for training; return all values of each press in one row, so that the cache needs only one array."""
    skins = designed.draw("taught", which)
    rest_uT = np.repeat(skins.rest_uT[:, None], skins.db_uT.shape[1], axis=1)
    return np.concatenate([skins.db_uT, rest_uT, skins.place_mm, skins.force_N[..., None]], axis=2)


@dataclass(frozen=True)
class KnownWeight:
    """A press by a known weight on the skin's middle.

    - db_uT: field change of the press.
    - force_N: force that is assumed for the press, which may differ slightly from the true force.
    """

    db_uT: Float[np.ndarray, " ch"]
    force_N: float


@dataclass(frozen=True)
class TestSkin:
    """A skin on which the model is scored, with places and fields in the coordinates of its board."""

    board: str
    rest_uT: Float[np.ndarray, " ch"]
    pool: LabelledPresses  # presses for calibration; a calibration with n presses uses the first n of them
    weight: KnownWeight
    test_uT: Float[np.ndarray, "n ch"]
    true: Float[np.ndarray, "n 3"]  # x, y in mm from the board's middle, F in N


def scene_skins(data: SceneData, fold: Fold, frame: Frame, rest_uT: Mapping[str, np.ndarray]) -> list[TestSkin]:
    """Return the skins of a held-out board, each with presses for calibration (pool) and with test rows.

    The pool has one press at each place, from the first passes over the skin. Test rows are from later passes.
    """
    rows, skins = data.rows, []
    for skin in np.unique(rows.skin[fold.test]):
        rng = rng_for(data.settings.seed, "population", "asked", str(skin))
        pooled = fold.pool[rows.skin[fold.pool] == skin]
        pool = _pool(data, pooled, frame, rng)
        test = fold.test[rows.skin[fold.test] == skin]
        test = np.sort(rng.permutation(test)[:TESTED_MAX_N])
        place_mm = frame.place(rows.target[test, :2].astype(float))
        true = np.column_stack([place_mm, rows.target[test, 2]])
        noload_uT = frame.field(rest_uT[str(skin)][None])[0]
        weight = find_weight(data, pooled, frame, rng_for(data.settings.seed, "population", "weight", str(skin)))
        skins.append(TestSkin(str(rows.board[test[0]]), noload_uT, pool, weight, frame.field(rows.db_uT[test]), true))
    return skins


def _pool(data: SceneData, own: np.ndarray, frame: Frame, rng: np.random.Generator) -> LabelledPresses:
    """Draw one indentation at each place; return presses, each of which is the mean of an indentation's readings."""
    rows = data.rows
    first = np.unique(rows.indentation[own], return_index=True)[1]
    _, place_i = np.unique(rows.target[own[first], :2].round(2), axis=0, return_inverse=True)
    order = rng.permutation(len(first))
    _, chosen = np.unique(place_i.ravel()[order], return_index=True)
    taken = [own[rows.indentation[own] == rows.indentation[own[first[i]]]] for i in rng.permutation(order[chosen])]
    target = np.array([rows.target[press].mean(axis=0) for press in taken], float)
    db_uT = np.array([rows.db_uT[press].mean(axis=0) for press in taken], float)
    return LabelledPresses(frame.place(target[:, :2]), target[:, 2], frame.field(db_uT))


def find_weight(data: SceneData, own: np.ndarray, frame: Frame, rng: np.random.Generator) -> KnownWeight:
    """Choose a recorded press that is used as if the known weight had caused it.

    Among the presses nearest to the skin's middle, this is the press whose force is nearest to `WEIGHT_N`.
    """
    rows = data.rows
    off_mm = np.linalg.norm(frame.place(rows.target[own, :2].astype(float)), axis=1).round(1)
    middle = own[off_mm == off_mm.min()]
    press_i, first = np.unique(rows.indentation[middle], return_index=True)
    ratio = rows.target[middle[first], 2] / WEIGHT_N
    log_ratio = np.full(len(ratio), np.inf)  # a force gauge may read 0 N or less; such presses are never chosen
    log_ratio[ratio > 0] = np.abs(np.log(ratio[ratio > 0]))
    if np.isinf(log_ratio).all():
        what = f"none of the {len(ratio)} presses near the middle has a force above 0 N"
        raise SchemaError(f"skin {rows.skin[own[0]]}: {what}. Check the sign of this skin's forces.")
    press = middle[rows.indentation[middle] == press_i[log_ratio.argmin()]]
    return known_weight(frame.field(rows.db_uT[press]).mean(axis=0), float(rows.target[press, 2].mean()), rng)


def known_weight(db_uT: Float[np.ndarray, " ch"], force_N: float, rng: np.random.Generator) -> KnownWeight:
    """Return a press as if a known weight had caused it.

    `force_N` is the true force of the press. The force that is assumed for the weight is drawn around it.
    """
    return KnownWeight(db_uT, force_N * float(np.exp(WEIGHT_SD * rng.standard_normal())))


def rest_by_skin(indentations: Path) -> dict[str, np.ndarray]:
    """Return the mean no-load field of each skin's first pass, in the chips' axes."""
    return {
        capture.skin: capture.noload_uT[capture.pass_i == capture.pass_i.min()].mean(axis=0, dtype=float)
        for capture in read_captures(indentations)
    }


def simulated_skins(skins: Population, rng: np.random.Generator) -> list[TestSkin]:
    """Return the skins of a simulated population as test skins, with noise added to their field changes.

    The first `PLACES_N` presses, which are on the grid, are the pool. The last press is the press of the known weight.
    All other presses are test presses.
    """
    tested = []
    for i in range(len(skins)):
        db_uT = skins.db_uT[i] + np.tile(NOISE_uT, 5) * rng.standard_normal(skins.db_uT[i].shape)
        order, place_mm, force_N = rng.permutation(PLACES_N), skins.place_mm[i], skins.force_N[i]
        pool = LabelledPresses(place_mm[order].astype(float), force_N[order].astype(float), db_uT[order])
        true = np.column_stack([place_mm, force_N])[PLACES_N:-1].astype(float)
        weight = known_weight(db_uT[-1], float(force_N[-1]), rng)
        rest_uT = skins.rest_uT[i].astype(float)
        tested.append(TestSkin(f"population {i}", rest_uT, pool, weight, db_uT[PLACES_N:-1], true))
    return tested


def estimate(
    model: PriorModel, skin: TestSkin, size: CalibrationSize, powers: Sequence[Mapping[str, float]]
) -> list[dict[str, Estimate]]:
    """Calibrate a model to a skin, and estimate the test presses of the skin.

    The press by the known weight is estimated as well; it is the last element of each estimate. There are three ways
    of estimation: with the map alone (`map`), with the networks alone (`network`), and with both (`universal`). Each
    element of `powers` contains the likelihood power for each way. (A likelihood power is an exponent of the
    likelihood, which sets how wide the stated uncertainty is.) For each element of `powers`, the result contains the
    estimate of each way.
    """
    labels = skin.pool[: size.labels_n]
    labels = replace(labels, force_N=np.maximum(labels.force_N, model.skin.tables.force_N[0]))
    data = CalibrationData(skin.rest_uT, skin.pool.db_uT[: size.presses_n])
    read_uT = np.concatenate([skin.test_uT, skin.weight.db_uT[None]])

    def in_each_way(evaluation: Evaluation) -> list[Estimate]:
        way = {"map": evaluation.by_map, "universal": evaluation.combined, "network": evaluation.by_network}
        return [way[name](one[name]) for one in powers for name in WAYS]

    estimates = iter(model.calibrate(data).with_labels(labels).estimate_by(in_each_way, read_uT))
    return [{name: next(estimates) for name in WAYS} for _ in powers]


@dataclass(frozen=True)
class Calibration:
    """Settings of each way (map, universal, network) that are chosen on simulated skins.

    - power: likelihood power, an exponent of the likelihood that sets how wide the stated uncertainty is.
    - weight_share: how much of the force error of the known weight is corrected at all other presses. The error
      log(true / estimated F) of the known weight is multiplied by this fraction, and added to log F of all presses.
    """

    power: Mapping[str, float]
    weight_share: Mapping[str, float]


def calibrate_ways(model: PriorModel, skins: Sequence[TestSkin], size: CalibrationSize) -> Calibration:
    """Choose likelihood powers and weight shares on simulated skins that are not scored."""
    covered = {way: np.zeros((len(BOARD_POWERS), len(skins))) for way in WAYS}
    # Errors of log F, by likelihood power (axis 0) and by skin (axis 2). On axis 1, index 0 is the error for the known
    # weight, and index 1 is the mean error over the test presses.
    log_force_errors = {way: np.zeros((len(BOARD_POWERS), 2, len(skins))) for way in WAYS}
    candidates = [dict.fromkeys(WAYS, power) for power in BOARD_POWERS]
    for j, skin in enumerate(skins):
        for i, by_way in enumerate(estimate(model, skin, size, candidates)):
            for way, estimated in by_way.items():
                covered[way][i, j] = _coverage(estimated, skin)
                log_force_errors[way][i, :, j] = _off_log_N(estimated, skin)
    chosen_i = {way: int(np.abs(covered[way].mean(axis=1) - 0.9).argmin()) for way in WAYS}
    shares = {way: weight_share(*log_force_errors[way][i]) for way, i in chosen_i.items()}
    return Calibration({way: BOARD_POWERS[i] for way, i in chosen_i.items()}, shares)


def weight_share(weight_off: Float[np.ndarray, " s"], others_off: Float[np.ndarray, " s"]) -> float:
    """Return how much of the force error of the known weight is, on average, also found at other presses.

    Each skin has two errors of log F: the error of the known weight (`weight_off`), and the mean error of the test
    presses (`others_off`). The result is a factor. The errors of the weight, multiplied by this factor, fit the mean
    errors of the test presses best by least squares.
    """
    return float(weight_off @ others_off / (weight_off @ weight_off))


def score_skin(
    model: PriorModel, skin: TestSkin, size: CalibrationSize, calibration: Calibration
) -> list[dict[str, Any]]:
    """Score each way (map, universal, network) on a skin.

    The error of the forces is computed three times: for the estimated forces, after a correction by the known weight,
    and after multiplication by the factor that fits the true forces best. The last is only a diagnosis, because this
    factor is unknown in practice.
    """
    rows = []
    (by_way,) = estimate(model, skin, size, [calibration.power])
    for way, estimated in by_way.items():
        force_N, true_N = estimated.force_N[:-1], skin.true[:, 2]
        weight_off, _ = _off_log_N(estimated, skin)
        weighed_N = force_N * np.exp(calibration.weight_share[way] * weight_off)
        scaled_N = force_N * (force_N @ true_N) / (force_N @ force_N)
        rows.append(
            {"way": way, "pokes_n": size.presses_n, "labels_n": size.labels_n, "board": skin.board}
            | score(skin.true, np.column_stack([estimated.place_mm[:-1], force_N]))
            | {"mse_f_weight_N2": float(((weighed_N - true_N) ** 2).mean())}
            | {"mse_f_factor_N2": float(((scaled_N - true_N) ** 2).mean())}
            | {"coverage_pct": 100 * _coverage(estimated, skin)}
        )
    return rows


def _off_log_N(estimated: Estimate, skin: TestSkin) -> tuple[float, float]:
    """Return the error log(true / estimated F) of the known weight, and the mean of this error over test presses."""
    felt = skin.true[:, 2] > LOG_FORCE_MIN_N
    weight = np.log(skin.weight.force_N / estimated.force_N[-1])
    return float(weight), float(np.log(skin.true[felt, 2] / estimated.force_N[:-1][felt]).mean())


def _coverage(estimated: Estimate, skin: TestSkin) -> float:
    tested = Estimate(*(getattr(estimated, name)[:-1] for name in Estimate.__annotations__))
    return coverage(tested, skin.true[:, :2])


def score_all(
    designed: DesignedSkins, section: PopulationSettings, tested: Sequence[TestSkin], scene: str
) -> tuple[pd.DataFrame, pd.DataFrame, dict[str, Any]]:
    """Score the model with each amount of calibration data, on the scene's skins and on fresh simulated skins.

    The network that was trained on the largest number of skins is scored with each amount of calibration data. Networks
    that were trained on fewer skins are scored only with all unlabelled presses. Returns rows by amount of calibration
    data, rows by number of training skins, and further numbers.
    """
    skins = draw(designed, max(section.skins_n), lambda line: say(f"{scene} population: {line}"))
    networks: dict[int, Weights] = {}
    for n in section.skins_n:
        networks[n] = train_network(designed, skins, n, section.steps_n)
        say(f"{scene} population: trained the network of {n} skins")
    model = PriorModel(new_map(designed.tables()), [networks[max(section.skins_n)]])
    further = designed.draw("further", slice(CALIBRATION_SKINS_N), WEIGHT_N)
    further_skins = simulated_skins(further, rng_for(designed.seed, "population", "noise"))
    fresh = designed.draw("fresh", slice(FRESH_N), WEIGHT_N)
    fresh_skins = simulated_skins(fresh, rng_for(designed.seed, "population", "fresh noise"))
    full, calibrations = CalibrationSize(max(section.unlabelled_n), 0), {}
    rows, sizes, fresh_rows = [], [], []
    for size in section.sizes():
        calibrations[size] = calibrate_ways(model, further_skins, size)
        rows += [row for skin in tested for row in score_skin(model, skin, size, calibrations[size])]
        fresh_rows += [row for skin in fresh_skins for row in score_skin(model, skin, size, calibrations[size])]
        what = f"{size.presses_n} unlabelled presses and {size.labels_n} labels"
        say(f"{scene} population: scored the model calibrated with {what}")
    for n, weights in networks.items():
        smaller = replace(model, networks=[weights])
        of_n = [row for skin in tested for row in score_skin(smaller, skin, full, calibrations[full])]
        sizes += [row | {"skins_n": n} for row in of_n]
    within = [row for skin in further_skins for row in score_skin(model, skin, full, calibrations[full])]
    numbers = {
        "coverage_further_pct": pd.DataFrame(within).groupby("way")["coverage_pct"].mean().to_dict(),
        "weight_share": calibrations[full].weight_share, "fresh": over_boards(pd.DataFrame(fresh_rows), *BY),
    }  # fmt: skip
    return pd.DataFrame(rows), pd.DataFrame(sizes), numbers


def over_boards(rows: pd.DataFrame, *keys: str) -> list[dict[str, Any]]:
    """Summarise scores over boards for each combination of `keys`; a board's score is the mean over its skins."""
    summaries = []
    for key, own in rows.groupby(list(keys), sort=False):
        boards = own.groupby("board").mean(numeric_only=True).drop(columns=list(set(keys) - {"way"}))
        summaries.append(dict(zip(keys, key, strict=True)) | summarise(boards, boards=True))
    return summaries


def population(settings: Settings, section: PopulationSettings, folds: Path, indentations: Path, results: Path) -> None:
    """Score the universal model, built from simulated skins alone, on every held-out skin of a simulated scene."""
    data, simulation = read_data(settings, indentations, folds), simulation_settings(settings)
    kind, design = simulation.main_boards, settings.shared_section(SkinDesign, "skin")
    designed = designed_skins(design, kind, simulation.main.depths_mm, settings.seed)
    turn = Rotation.from_euler("z", np.array(kind.design.turns_deg)[:, None], degrees=True).as_matrix()
    frame, rest_uT = Frame(turn, (CENTRE_MM, CENTRE_MM), mirrored=False), rest_by_skin(indentations)
    tested = [skin for fold in data.folds_of(EXPERIMENT) for skin in scene_skins(data, fold, frame, rest_uT)]
    rows, sizes, further = score_all(designed, section, tested, settings.scene)
    numbers = {
        "told": over_boards(rows, *BY),
        "scaling": over_boards(sizes, *BY, "skins_n"),
        "skins_asked_n": len(tested), "rows_asked_n": sum(len(skin.true) for skin in tested),
        "pool_n": min(len(skin.pool) for skin in tested), "steps_n": section.steps_n,
        "weight_N": WEIGHT_N, "weight_sd": WEIGHT_SD, **further,
    }  # fmt: skip
    write_results(results, numbers, {})


NAMES = {
    "map": "universal map, skin as designed",
    "universal": "universal, skin as designed",
    "network": "universal network alone, skin as designed",
}
SHORT_NAMES = {"map": "map", "network": "network", "universal": "both"}
COVERAGE = "places in 90 % intervals / %"
FURTHER = {
    "mse_f_weight_N2": "MSE_F with one known weight / N²",
    "mse_f_factor_N2": "MSE_F with the best factor per skin / N²",
    "coverage_pct": COVERAGE,
}


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate errors by amount of calibration data and by number of training skins, and coverage on fresh skins."""
    scaling = [{"method": NAMES[row["way"]], "training skins": str(row["skins_n"])} for row in numbers["scaling"]]
    shown = {
        "population": tabulate([_line(row, source) for row in numbers["told"]], meaning=_meaning(numbers)),
        "population_scaling": tabulate(
            [first | _line(row, source) for first, row in zip(scaling, numbers["scaling"], strict=True)],
            meaning=f"All networks were trained for {numbers['steps_n']} steps, from the same initial weights, on the "
            "first skins of one population. Column `training skins` contains the number of these skins. All rows use "
            "the same map and the same likelihood powers (exponents of the likelihood, which set how wide the stated "
            "intervals are). The powers were chosen with the network that was trained on the most skins.",
        ),
    }
    if "fresh" in numbers:  # absent from results of earlier versions
        meaning = (
            "Coverage on newly drawn skins of the population, which were used neither for training nor for the choice "
            "of likelihood powers. [low, high]: 95 % confidence interval over n skins. The skins of the population "
            f"vary more than the {numbers['skins_asked_n']} skins of the scene."
        )
        shown["population_fresh"] = tabulate(_fresh_lines(numbers["fresh"], source), meaning=meaning)
    return shown


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Draw the percentage of readings with an error above 1 mm against the number of simulated training skins.

    A scene with a single number of training skins has no figure.
    """
    rows = pd.DataFrame(numbers["scaling"])
    if rows["skins_n"].nunique() == 1:
        return {}
    with drawing(6.0, 3.8) as figure:
        axes = figure.subplots()
        for i, way in enumerate(("network", "universal")):
            own = rows[rows["way"] == way]
            wrong_pct = [100 - stat["mean"] for stat in own["accuracy_pct"]]
            sd = [stat.get("sd", 0.0) for stat in own["accuracy_pct"]]
            style = {"color": COLOURS[i], "marker": MARKERS[i], "capsize": 3}
            axes.errorbar(own["skins_n"], wrong_pct, sd, label=NAMES[way], **style)
        axes.set(xscale="log", xlabel="simulated skins that the network was trained on", ylim=(0, None))
        axes.set_ylabel("readings with an error above 1 mm / %")
        axes.legend(frameon=False)
        boards_n = rows["accuracy_pct"].iloc[0]["n"]
        title = f"Networks trained for {numbers['steps_n']} steps, tested on skins of {boards_n} boards ({source})"
        axes.set_title(title, fontsize=9)
        return {"population_scaling.svg": svg(figure)}


def _line(row: Mapping[str, Any], source: str) -> dict[str, str]:
    line = {"method": NAMES[row["way"]], "unlabelled pokes": str(row["pokes_n"]), "labels": str(row["labels_n"])}
    return line | {"source": source} | scores(row) | scores(row, FURTHER) | {"n": n_of(row)}


def _fresh_lines(rows: Sequence[Mapping[str, Any]], source: str) -> list[dict[str, str]]:
    lines: dict[tuple[int, int], dict[str, str]] = {}
    for row in rows:
        size = row["pokes_n"], row["labels_n"]
        first = {"unlabelled pokes": str(size[0]), "labels": str(size[1]), "source": source}
        line = lines.setdefault(size, first)
        line |= scores(row, {"coverage_pct": f"{SHORT_NAMES[row['way']]}: {COVERAGE}"})
    skins_n = n_of(rows[0])
    return [line | {"n": skins_n} for line in lines.values()]


def _meaning(numbers: Mapping[str, Any]) -> str:
    coverage = ", ".join(f"{NAMES[way]} {pct:.3g} %" for way, pct in numbers["coverage_further_pct"].items())
    return (
        "The models are built from simulated skins, which are drawn at random around the skin as designed. None of the "
        f"scene's {numbers['skins_asked_n']} skins is used for building. The models are tested on "
        f"{numbers['rows_asked_n']:,} rows of later passes over the scene's skins. Unlabelled pokes: at most one poke "
        f"at each of the {numbers['pool_n']} places of the grid, at any depth. The labelled pokes are the first of "
        "these pokes. One known weight: a press that is treated as a known weight. Among the presses of the first "
        "passes that are nearest to the skin's middle, it is the press whose force is nearest to "
        f"{numbers['weight_N']:g} N. Its force is assumed to be known to within {100 * numbers['weight_sd']:g} %. Best "
        "factor per skin: the forces are multiplied by the factor that fits all true forces best. This shows how much "
        "any common factor can correct; in practice, the factor is unknown. Two settings were chosen on further "
        "simulated skins: the likelihood powers (exponents of the likelihood, which set how wide the stated intervals "
        "are), and how much of the force error at the known weight is corrected at all other presses. On these further "
        f"skins, the 90 % intervals contain this percentage of the true coordinates: {coverage}."
    )
