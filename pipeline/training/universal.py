"""The universal model on held-out boards: choose its likelihood powers, calibrate it, and score it.

The model combines a map with networks. The map is a Gaussian model of the reading for each place and force, and gives
the likelihood of each place and force for a reading. Errors of the channels are not independent, so the likelihood
itself would usually be too certain. It is therefore raised to a power, the likelihood power. In this module, the
likelihood power affects only the standard deviations of estimates, and thus the width of their 90 % intervals.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from pipeline.training.jobs import SceneData, score_test
from pipeline.training.universal_variants import KnownBoards, Variant
from reskin.data.splits import Fold, labelling_order
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from reskin.universal.batches import ERROR_OF_NOMINAL, NOISE_uT, SkinPrior, add_error
from reskin.universal.calibration import (
    CalibrationData,
    HeldOut,
    LabelledPresses,
    folds_of_labels,
    lower_by_misfit,
    lower_by_residuals,
    variance_inflations,
)
from reskin.universal.force import FEW_N, NORMAL_90, ForceLine, prior_line
from reskin.universal.map import FORCES_N, Estimate, condition_on_labels
from reskin.universal.model import (
    CalibratedModel,
    Evaluation,
    HeldOutLabels,
    PressCalibration,
    PriorModel,
    line_of_labels,
    network_offsets_mm,
)
from reskin.universal.population import PLACES_N, Population, draw_population

EXPERIMENT = "labels"  # experiment whose folds are scored
# Beginning of the name of a method in tables, for the map alone, and for the map together with the networks.
METHODS = ("universal map, ", "universal, ")
# End of the name of a method in tables, by variant of the model. Variant `rig` is made with the other boards of the
# same rig, and variant `nominal` is made from simulated skins alone.
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
BOARD_POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)  # candidate likelihood powers of variant `rig`
# Candidate likelihood powers of variant `nominal`, for a board on which the misfit of the map is 1.
NOMINAL_POWERS = tuple(np.geomspace(0.1, 1.6, 13).tolist())
# Likelihood power with which the map alone estimates places and forces. The value 0.5 would be exact if the channels
# formed pairs with equal errors.
ASSUMED_POWER = 0.5
# Smallest force of the map; labelled presses with smaller forces are set to this force
FORCE_MIN_N = float(FORCES_N[0])


class Powers(NamedTuple):
    """Likelihood powers of the map alone, and of map and networks."""

    map: float
    combined: float


class Estimates(NamedTuple):
    """Estimates of the same readings by the map alone, and by map and networks."""

    map: Estimate
    combined: Estimate


@dataclass(frozen=True)
class Benchmark:
    """Data, models and likelihood powers that are the same for all folds.

    - known: the recorded boards of the scene.
    - nominal: variant `nominal` of the model, made from simulated skins alone.
    - board_powers: likelihood powers of variant `rig`, by held-out board and number of labels.
    - nominal_powers: likelihood powers of variant `nominal` for a misfit of 1, by number of labels.
    """

    known: KnownBoards
    nominal: Variant
    board_powers: Mapping[str, Mapping[int, Powers]]
    nominal_powers: Mapping[int, Powers]


@dataclass(frozen=True)
class PoolCalibration:
    """A model that is calibrated to a board's no-load field and to the presses of its pool, without labels.

    The pool is the set of presses that are reserved for calibration and not tested. Its first presses may also be used
    with their labels.
    """

    presses: PressCalibration
    pool: LabelledPresses
    pool_mm: Float[np.ndarray, "m 2"]  # places of the pool's presses, estimated by the networks
    misfit: float  # median misfit (chi^2 per channel) of the pool's presses

    def with_labels(self, labels_n: int) -> CalibratedModel:
        """Condition the model on the labels of the first `labels_n` presses of the pool."""
        labels = self.pool[:labels_n]
        force_N = np.maximum(labels.force_N, FORCE_MIN_N)
        skin = condition_on_labels(self.presses.skin, labels.place_mm, force_N, labels.db_uT)
        centre_mm = -self.pool_mm.mean(axis=0) if len(self.pool) else np.zeros(2)
        offsets_mm = network_offsets_mm(centre_mm, self.pool_mm[:labels_n], labels.place_mm)
        return CalibratedModel(skin, self.presses.layers, offsets_mm)

    def nominal_powers(self, powers: Powers) -> Powers:
        """Adapt the likelihood powers of the nominal variant to the misfit of this pool's presses.

        A likelihood power is the exponent of a likelihood, 1 or less, which reduces overconfidence. `powers` are those
        for a misfit of 1. They are divided by the misfit, and results above 1 are replaced by 1.
        """
        return Powers(*(lower_by_misfit(power, self.misfit) for power in powers))

    def reordered(self, first: Int64[np.ndarray, " k"]) -> "PoolCalibration":
        """Return this calibration with a reordered pool, in which the presses with indices `first` come first."""
        order = np.concatenate([first, np.setdiff1d(np.arange(len(self.pool)), first)])
        pool = self.pool[order]
        # Condition the networks again. A network adds up the features of all presses of the pool, and the rounding of
        # this sum depends on the order of the presses.
        presses = replace(self.presses, data=CalibrationData(self.presses.data.rest_uT, pool.db_uT, pool.db_uT))
        return replace(self, presses=presses, pool=pool, pool_mm=self.pool_mm[order])


def calibrate(model: PriorModel, rest_uT: Float[np.ndarray, " ch"], pool: LabelledPresses) -> PoolCalibration:
    """Calibrate a model to a board's no-load field and to its pool, whose presses are spread evenly over the skin."""
    presses = model.calibrate(CalibrationData(rest_uT, pool.db_uT, pool.db_uT))
    misfit = float(np.median(presses.skin.evaluator.evaluate(pool.db_uT).misfit())) if len(pool) else 1.0
    return PoolCalibration(presses, pool, presses.even_mm, misfit)


def estimate(model: CalibratedModel, db_uT: Float[np.ndarray, "n ch"], powers: Sequence[Powers]) -> list[Estimates]:
    """Estimate places and forces for each pair of powers; only the standard deviations depend on the powers."""

    def by_powers(evaluation: Evaluation) -> list[Estimate]:
        assumed = evaluation.by_map(ASSUMED_POWER)
        by_map = [with_deviation_of(assumed, evaluation.by_map(power)) for power, _ in powers]
        return [*by_map, *(evaluation.combined(power) for _, power in powers)]

    estimates = model.estimate_by(by_powers, db_uT)
    return [Estimates(*pair) for pair in zip(estimates[: len(powers)], estimates[len(powers) :], strict=True)]


def with_deviation_of(estimate: Estimate, other: Estimate) -> Estimate:
    """Return the places of `estimate` with standard deviations that are derived from another estimate.

    The true place is assumed to be distributed as `other` states. The standard deviations of `estimate` are replaced by
    the rms errors that its places then have.
    """
    return replace(estimate, sd_mm=np.hypot(other.sd_mm, other.place_mm - estimate.place_mm))


def lower_by_labels(calibration: PoolCalibration, labels_n: int, powers: Sequence[Powers]) -> list[Powers]:
    """Divide likelihood powers by the variance inflation of the labels, and limit them to 1.

    The variance inflation is the factor by which the squared errors at held-out labels exceed the variances that the
    model states. It is computed by cross-validation over the first `labels_n` labels of the pool.
    """
    by_map: list[HeldOut] = []
    combined: list[HeldOut] = []
    for kept, held_out in folds_of_labels(min(labels_n, len(calibration.pool))):
        model = calibration.reordered(kept).with_labels(len(kept))
        estimates = estimate(model, calibration.pool.db_uT[held_out], powers)
        true_mm = calibration.pool.place_mm[held_out]
        by_map.append(([pair.map for pair in estimates], true_mm))
        combined.append(([pair.combined for pair in estimates], true_mm))
    inflations = [variance_inflations(len(powers), folds) for folds in (by_map, combined)]
    return [
        Powers(lower_by_residuals(power.map, of_map), lower_by_residuals(power.combined, of_both))
        for power, of_map, of_both in zip(powers, *inflations, strict=True)
    ]


def fit_force_line(calibration: PoolCalibration, labels_n: int) -> ForceLine:
    """Fit the calibration line, which corrects estimated forces, by cross-validation over the labels.

    Returns the prior line, which is used without labels, if there are fewer than `FEW_N` labels.
    """
    labels_n = min(labels_n, len(calibration.pool))
    if labels_n < FEW_N:
        return prior_line()
    folds = []
    for kept, held_out in folds_of_labels(labels_n):
        model, labels = calibration.reordered(kept).with_labels(len(kept)), calibration.pool[held_out]
        folds.append(HeldOutLabels(labels, model.evaluate(labels.db_uT)))
    return line_of_labels(folds)


def score_fold(
    benchmark: Benchmark, fold: Fold, rig: Mapping[str, Variant], labels_n: Sequence[int]
) -> list[dict[str, Any]]:
    """Score the universal model on the test rows of a fold, for every number of labels.

    Both variants (`rig` and `nominal`) are scored, each as the map alone, and as the map with networks.
    """
    known, data = benchmark.known, benchmark.known.data
    board = str(data.rows.board[fold.test[0]])
    if board not in known.presses:  # if a board has several skins, the keys of `presses` name both board and skin
        what = f"experiment universal needs boards with one skin each, but the scene has {', '.join(known.presses)}"
        raise ParamsError(f"fold {fold.name}: {what}. Remove this experiment from the scene.")
    pool, rest_uT = pool_of(known, fold), known.presses[board].rest_uT.ravel()
    test_uT = known.frame.field(data.rows.db_uT[fold.test])
    points = []
    for way, variant in {"rig": rig[board], "nominal": benchmark.nominal}.items():
        calibration = calibrate(variant.model, rest_uT, pool)
        for n in labels_n:
            if way == "rig":
                powers = benchmark.board_powers[board][n]
            else:
                (powers,) = lower_by_labels(calibration, n, [calibration.nominal_powers(benchmark.nominal_powers[n])])
            model = replace(calibration.with_labels(n), line=fit_force_line(calibration, n))
            (by_method,) = estimate(model, test_uT, [powers])
            for name, estimates in zip(METHODS, by_method, strict=True):
                points.append({
                    "method": f"{name}{WAYS[way]}", "labels_n": n, "fold": fold.board, "seed_i": fold.draw_i,
                    "inputs": "map" if "map" in name else "map and network",
                    "scores": score_estimates(known, fold.test, estimates),
                })  # fmt: skip
    return points


def coverage(estimate: Estimate, place_mm: Float[np.ndarray, "n 2"]) -> float:
    """Return the fraction of true coordinates that are inside the 90 % intervals of the estimate."""
    return float((np.abs(estimate.place_mm - place_mm) <= NORMAL_90 * estimate.sd_mm).mean())


def coverages(
    calibration: PoolCalibration, tested: LabelledPresses, labels_n: int, powers: Sequence[Powers]
) -> Float[np.ndarray, "t 2"]:
    """Return the coverage of 90 % intervals on the tested presses, for each pair of powers.

    The columns are the map alone, and map and networks.
    """
    estimates = estimate(calibration.with_labels(labels_n), tested.db_uT, powers)
    return np.array([[coverage(each, tested.place_mm) for each in pair] for pair in estimates])


def score_estimates(known: KnownBoards, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates with the metrics of all methods, and with coverage and half width of the 90 % intervals."""
    label_mm = known.frame.label(estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(known.data, test, predicted)
    true_mm = known.frame.place(known.data.rows.target[test, :2].astype(float))
    half_width_mm = NORMAL_90 * float(np.median(estimate.sd_mm))
    intervals = {"coverage_pct": 100 * coverage(estimate, true_mm), "half_width_mm": half_width_mm}
    skins = {name: own | intervals for name, own in scores["by_skin"].items()} if len(scores["by_skin"]) == 1 else {}
    return scores | {"all": scores["all"] | intervals} | ({"by_skin": skins} if skins else {})


def pool_rows(data: SceneData, fold: Fold) -> list[Int64[np.ndarray, " r"]]:
    """Return the rows of each press in a fold's pool, in the order in which experiment `labels` adds labels."""
    indentation = data.rows.indentation[fold.pool]
    return [fold.pool[indentation == press] for press in labelling_order(data.rows, fold, data.settings.seed)]


def pool_of(known: KnownBoards, fold: Fold) -> LabelledPresses:
    """Return the presses of a fold's pool in the order of `pool_rows`; each is the mean over its rows."""
    rows, presses = known.data.rows, pool_rows(known.data, fold)
    target = np.array([rows.target[press_rows].mean(axis=0) for press_rows in presses], float)
    db_uT = np.array([rows.db_uT[press_rows].mean(axis=0) for press_rows in presses], float)
    return LabelledPresses(known.frame.place(target[:, :2]), target[:, 2], known.frame.field(db_uT))


# Number of skins that are simulated with each of CALIBRATION_ERRORS, to choose the nominal variant's likelihood powers.
CALIBRATION_SKINS_N = 24

Coverages = Float[np.ndarray, "t 2"]  # rows: powers; columns: the map alone, the map with networks
LawError = Callable[[Population, np.random.Generator], np.ndarray]  # returns field changes with errors of the law added


def law_error(scale: float = 1.0) -> LawError:
    """Return a function that adds random errors of the law to field changes.

    The law is the physical model of a skin, from which the map is computed. The errors are `scale` times as large as in
    the training of the model.
    """
    least, most = ERROR_OF_NOMINAL

    def add(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (scale * least, scale * most), rng)

    return add


# Sizes of two errors that the map does not model, and that calibration presses hardly reveal.
# - MEMORY_MAX: largest fraction of an earlier press's field change that remains in the no-load reading. In the
#   recordings of scenes lab and eflesh, 5 to 8 % were measured.
# - DIFFERENCE_MAX: largest scale of the random relative difference between equal presses. The value is assumed. The
#   difference has heavy tails; its median length over 15 channels is 1.4 times the scale.
MEMORY_MAX, DIFFERENCE_MAX = 0.15, 0.3
HEAVY_TAILS = 3  # degrees of freedom of Student's t


def unmodelled_error(scale: float = 1.0) -> LawError:
    """Return a function that adds three kinds of errors to field changes.

    - Errors of the law, which are `scale` times as large as in training.
    - Memory: a fraction of another press's field change remains. For each skin, this fraction is drawn uniformly from 0
      to `MEMORY_MAX`.
    - Differences between equal presses. For each skin, their size is drawn uniformly from 0 to `DIFFERENCE_MAX`.
    """
    add_law_error = law_error(scale)

    def add(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        db_uT = add_law_error(skins, rng)
        skins_n, presses_n, channels_n = db_uT.shape
        other = rng.permuted(np.tile(np.arange(presses_n), (skins_n, 1)), axis=1)
        memory = rng.uniform(0, MEMORY_MAX, (skins_n, 1, 1)) * np.take_along_axis(db_uT, other[..., None], axis=1)
        size_uT = np.linalg.norm(db_uT, axis=2, keepdims=True) / np.sqrt(channels_n)
        difference = rng.uniform(0, DIFFERENCE_MAX, (skins_n, 1, 1)) * rng.standard_t(HEAVY_TAILS, db_uT.shape)
        return (db_uT - memory + size_uT * difference).astype(np.float32)

    return add


# Errors of the simulated skins on which likelihood powers are chosen, by name. The names also select the random
# streams.
AS_TRAINED = "further"
CALIBRATION_ERRORS = {AS_TRAINED: unmodelled_error(), "further, missed twice": unmodelled_error(2.0)}


def calibrate_on_boards(benchmark: Benchmark, labels_n: Sequence[int]) -> dict[str, dict[int, Powers]]:
    """Choose the likelihood powers of variant `rig`, for each held-out board and number of labels.

    For each held-out board, the powers with the best coverage of intervals on the other boards are chosen.
    """
    by_board = {board: _board_coverages(benchmark, board, labels_n) for board in benchmark.known.presses}
    return {
        board: {
            n: best_powers(BOARD_POWERS, [own[n] for other, own in by_board.items() if other != board])
            for n in labels_n
        }
        for board in by_board
    }


def calibrate_on_simulated(nominal: Variant, labels_n: Sequence[int], seed: int) -> dict[int, Powers]:
    """Choose likelihood powers for each number of labels, from the coverage of intervals on simulated skins.

    The chosen powers are valid for a board whose misfit is 1. When the model is used on another board, the powers are
    divided by the misfit of this board (Birge's ratio), and by the variance inflation of its labels.

    The simulated skins have errors of the law that are as large as in training, and errors that the map does not model
    (see `unmodelled_error`). If there are labels, skins whose errors of the law are twice as large are also used. With
    labels, the model can estimate the size of the errors from the residuals at the labels.
    """
    by_labels_n: dict[int, list[Coverages]] = {n: [] for n in labels_n}
    for name, error in CALIBRATION_ERRORS.items():
        skins = draw_prior_skins(nominal.prior, CALIBRATION_SKINS_N, seed, name, error)
        calibrated = [calibrate_to_simulated(nominal.model, skins, i, seed) for i in range(len(skins))]
        for n in labels_n:
            if n or name == AS_TRAINED:
                by_labels_n[n] += [_simulated_coverages(*skin, n) for skin in calibrated]
    return {n: best_powers(NOMINAL_POWERS, by_labels_n[n]) for n in labels_n}


def best_powers(candidates: Sequence[float], of_skins: Sequence[Coverages]) -> Powers:
    """Choose the powers for which the coverage of 90 % intervals, averaged over skins, is closest to 90 %."""
    map_i, combined_i = np.abs(np.mean(of_skins, axis=0) - 0.9).argmin(axis=0)
    return Powers(candidates[map_i], candidates[combined_i])


def draw_prior_skins(prior: SkinPrior, skins_n: int, seed: int, name: str, error: LawError) -> Population:
    """Simulate skins drawn from a prior, with noise and errors of the law in their field changes."""
    rng = rng_for(seed, "universal", prior.name, name)
    skins = draw_population(prior.centre, prior.spreads, prior.setup, skins_n, rng, prior.forces)
    db_uT = error(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def calibrate_to_simulated(
    model: PriorModel, skins: Population, i: int, seed: int
) -> tuple[PoolCalibration, LabelledPresses]:
    """Calibrate a model to the pool of a simulated skin; return the calibration and the skin's test presses."""
    pool, tested = split_presses(skins, i, seed)
    return calibrate(model, skins.rest_uT[i].astype(float), pool), tested


def split_presses(skins: Population, i: int, seed: int) -> tuple[LabelledPresses, LabelledPresses]:
    """Split the presses of a simulated skin at random into a pool for calibration and test presses."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    parts = (skins.place_mm, skins.force_N, skins.db_uT)
    presses = LabelledPresses(*(part[i][order].astype(float) for part in parts))
    return presses[:PLACES_N], presses[PLACES_N:]


def _simulated_coverages(calibration: PoolCalibration, tested: LabelledPresses, labels_n: int) -> Coverages:
    candidates = [calibration.nominal_powers(Powers(power, power)) for power in NOMINAL_POWERS]
    return coverages(calibration, tested, labels_n, lower_by_labels(calibration, labels_n, candidates))


def _board_coverages(benchmark: Benchmark, board: str, labels_n: Sequence[int]) -> dict[int, Coverages]:
    """Compute coverages of the nominal variant on a board, by number of labels.

    A random third of the board's presses is the pool for calibration; all other presses are tested.
    """
    own = benchmark.known.presses[board]
    order = rng_for(benchmark.known.data.settings.seed, "universal", board).permutation(len(own.recorded))
    db_uT = own.db_uT.reshape(len(order), -1)
    presses = LabelledPresses(own.place_mm[order], own.recorded.force_N[order], db_uT[order])
    pool_n = len(order) // 3
    calibration = calibrate(benchmark.nominal.model, own.rest_uT.ravel(), presses[:pool_n])
    powers = [Powers(power, power) for power in BOARD_POWERS]
    return {n: coverages(calibration, presses[pool_n:], min(n, pool_n), powers) for n in labels_n}
