"""Calibrate the universal model to held-out boards, choose its likelihood powers, and score it.

The following terms are used in this module:

- The map is a probabilistic model of one skin. It gives a normal distribution of the reading for each place and force
  (`reskin.universal.map`).
- The networks estimate place and force from a reading. The universal model can estimate with the map alone, or it can
  combine the map with the networks.
- A likelihood power is an exponent to which the likelihoods of places and forces are raised. A smaller power gives
  larger standard deviations, and thus wider intervals. In this module, the power changes only the standard deviations
  of an estimate; the estimated places and forces stay the same.
- The pool of a board is the set of presses that are reserved for calibration and not tested.
- The misfit of a press is chi^2 per channel. It is near 1 if the model describes the press within the expected errors.
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
# The name of a method consists of two parts. METHODS has the first part for the map alone, and for map and networks
# together. WAYS has the last part for each variant of the model.
METHODS = ("universal map, ", "universal, ")
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
# Candidates for the likelihood powers of variant `rig`. The choice for a held-out board is made on the other boards.
BOARD_POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
# Candidates for the likelihood powers of variant `nominal`. A chosen power applies to skins with a misfit of 1. For
# other skins, it is divided by the misfit.
NOMINAL_POWERS = tuple(np.geomspace(0.1, 1.6, 13).tolist())
# Likelihood power with which the map alone estimates places and forces. The value 0.5 would be exact if the channels
# formed pairs, and both channels of each pair always had the same error.
ASSUMED_POWER = 0.5
# Smallest force in the map. If a labelled press has a smaller force, this force is used instead.
FORCE_MIN_N = float(FORCES_N[0])


class Powers(NamedTuple):
    """Two likelihood powers: one for estimates by the map alone, and one for estimates by map and networks together."""

    map: float
    combined: float


class Estimates(NamedTuple):
    """Two estimates of the same readings: one by the map alone, and one by map and networks together."""

    map: Estimate
    combined: Estimate


@dataclass(frozen=True)
class Benchmark:
    """The inputs that are the same for all folds: the recorded boards, variant `nominal`, and the likelihood powers.

    known: the recorded boards of the scene.
    nominal: the variant of the model that was made from simulated skins alone.
    board_powers: the likelihood powers of variant `rig`, for each held-out board and each number of labels.
    nominal_powers: the likelihood powers of variant `nominal` for a misfit of 1, for each number of labels.
    """

    known: KnownBoards
    nominal: Variant
    board_powers: Mapping[str, Mapping[int, Powers]]
    nominal_powers: Mapping[int, Powers]


@dataclass(frozen=True)
class PoolCalibration:
    """A model that is calibrated to a board's no-load field and to the presses of the board's pool.

    This calibration does not use the labels of the presses. `with_labels` continues it with the labels of the first
    presses of the pool.
    """

    presses: PressCalibration
    pool: LabelledPresses
    pool_mm: Float[np.ndarray, "m 2"]  # places of the pool's presses, as the networks estimate them
    misfit: float  # median of the misfit over the presses of the pool

    def with_labels(self, labels_n: int) -> CalibratedModel:
        """Return the model after it is also conditioned on the labels of the first `labels_n` presses of the pool."""
        labels = self.pool[:labels_n]
        force_N = np.maximum(labels.force_N, FORCE_MIN_N)
        skin = condition_on_labels(self.presses.skin, labels.place_mm, force_N, labels.db_uT)
        centre_mm = -self.pool_mm.mean(axis=0) if len(self.pool) else np.zeros(2)
        offsets_mm = network_offsets_mm(centre_mm, self.pool_mm[:labels_n], labels.place_mm)
        return CalibratedModel(skin, self.presses.layers, offsets_mm)

    def nominal_powers(self, powers: Powers) -> Powers:
        """Convert the powers of variant `nominal`, which are valid for a misfit of 1, to the misfit of this pool.

        Each power is divided by the misfit. The result is at most 1.
        """
        return Powers(*(lower_by_misfit(power, self.misfit) for power in powers))

    def reordered(self, first: Int64[np.ndarray, " k"]) -> "PoolCalibration":
        """Return this calibration with a reordered pool, in which the presses with indices `first` come first."""
        order = np.concatenate([first, np.setdiff1d(np.arange(len(self.pool)), first)])
        pool = self.pool[order]
        # The networks are conditioned again, because they add up values over the presses of the pool. The last bits of
        # such a sum depend on the order of the presses.
        presses = replace(self.presses, data=CalibrationData(self.presses.data.rest_uT, pool.db_uT, pool.db_uT))
        return replace(self, presses=presses, pool=pool, pool_mm=self.pool_mm[order])


def calibrate(model: PriorModel, rest_uT: Float[np.ndarray, " ch"], pool: LabelledPresses) -> PoolCalibration:
    """Calibrate a model to a board's no-load field, and to the presses of the board's pool without their labels.

    The presses of the pool must be spread evenly over the skin.
    """
    presses = model.calibrate(CalibrationData(rest_uT, pool.db_uT, pool.db_uT))
    misfit = float(np.median(presses.skin.evaluator.evaluate(pool.db_uT).misfit())) if len(pool) else 1.0
    return PoolCalibration(presses, pool, presses.even_mm, misfit)


def estimate(model: CalibratedModel, db_uT: Float[np.ndarray, "n ch"], powers: Sequence[Powers]) -> list[Estimates]:
    """Estimate the places and forces of readings, once for each pair of likelihood powers.

    The estimates for different powers have the same places and forces. Only their standard deviations differ.
    """

    def by_powers(evaluation: Evaluation) -> list[Estimate]:
        assumed = evaluation.by_map(ASSUMED_POWER)
        by_map = [with_deviation_of(assumed, evaluation.by_map(power)) for power, _ in powers]
        return [*by_map, *(evaluation.combined(power) for _, power in powers)]

    estimates = model.estimate_by(by_powers, db_uT)
    return [Estimates(*pair) for pair in zip(estimates[: len(powers)], estimates[len(powers) :], strict=True)]


def with_deviation_of(estimate: Estimate, other: Estimate) -> Estimate:
    """Return a copy of `estimate` whose standard deviations are derived from the distribution in `other`.

    `other` gives a mean and a standard deviation for the true place. If the true place follows this distribution, the
    place in `estimate` has a certain rms error. This rms error is the new standard deviation.
    """
    return replace(estimate, sd_mm=np.hypot(other.sd_mm, other.place_mm - estimate.place_mm))


def lower_by_labels(calibration: PoolCalibration, labels_n: int, powers: Sequence[Powers]) -> list[Powers]:
    """Lower likelihood powers if the errors at held-out labels are larger than the estimated standard deviations.

    The errors are found by cross-validation over the first `labels_n` presses of the pool: the model is calibrated to
    some of the labels, and tested on the others. Each power is divided by the resulting variance inflation (see
    `reskin.universal.calibration.variance_inflation`). The result is at most 1.
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
    """Fit the line that converts estimated forces to true forces (`reskin.universal.force`).

    The line is fitted to labelled presses of the pool. The force of each press is estimated by a model that is not
    calibrated to the label of this press (cross-validation). If there are fewer than `FEW_N` labels, the line of the
    prior is returned.
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

    Both variants of the model are scored, each with the map alone and with map and networks together. The result has
    one entry for each of these methods and each number of labels.
    """
    known, data = benchmark.known, benchmark.known.data
    board = str(data.rows.board[fold.test[0]])
    # If a board has several skins, the keys of `presses` consist of the names of board and skin, so the board's own
    # name is not a key.
    if board not in known.presses:
        what = f"boards of one skin each are needed; got {', '.join(known.presses)}"
        raise ParamsError(f"fold {fold.name}: {what}. Remove the experiment from the scene.")
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
    """Return the fraction of the true coordinates x and y that are inside the 90 % intervals of the estimate."""
    return float((np.abs(estimate.place_mm - place_mm) <= NORMAL_90 * estimate.sd_mm).mean())


def coverages(
    calibration: PoolCalibration, tested: LabelledPresses, labels_n: int, powers: Sequence[Powers]
) -> Float[np.ndarray, "t 2"]:
    """Return the coverage of 90 % intervals on the tested presses, with one row for each pair of powers.

    The first column is the coverage of estimates by the map alone. The second column is the coverage of estimates by
    map and networks together.
    """
    estimates = estimate(calibration.with_labels(labels_n), tested.db_uT, powers)
    return np.array([[coverage(each, tested.place_mm) for each in pair] for pair in estimates])


def score_estimates(known: KnownBoards, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates on test rows.

    The scores are the metrics that all methods have in common (`reskin.metrics`), and two scores of the 90 % intervals
    of places: `coverage_pct`, the percentage of true coordinates inside their intervals, and `half_width_mm`, the
    median half width of the intervals.
    """
    label_mm = known.frame.label(estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(known.data, test, predicted)
    true_mm = known.frame.place(known.data.rows.target[test, :2].astype(float))
    half_width_mm = NORMAL_90 * float(np.median(estimate.sd_mm))
    intervals = {"coverage_pct": 100 * coverage(estimate, true_mm), "half_width_mm": half_width_mm}
    skins = {name: own | intervals for name, own in scores["by_skin"].items()} if len(scores["by_skin"]) == 1 else {}
    return scores | {"all": scores["all"] | intervals} | ({"by_skin": skins} if skins else {})


def pool_rows(data: SceneData, fold: Fold) -> list[Int64[np.ndarray, " r"]]:
    """Return the row numbers of each press in a fold's pool.

    The presses are in the order in which experiment `labels` uses their labels: n labels are those of the first n
    presses.
    """
    indentation = data.rows.indentation[fold.pool]
    return [fold.pool[indentation == press] for press in labelling_order(data.rows, fold, data.settings.seed)]


def pool_of(known: KnownBoards, fold: Fold) -> LabelledPresses:
    """Return the presses of a fold's pool, in the order of `pool_rows`.

    The place, force and field change of a press are means over the rows of the press.
    """
    rows, presses = known.data.rows, pool_rows(known.data, fold)
    target = np.array([rows.target[press_rows].mean(axis=0) for press_rows in presses], float)
    db_uT = np.array([rows.db_uT[press_rows].mean(axis=0) for press_rows in presses], float)
    return LabelledPresses(known.frame.place(target[:, :2]), target[:, 2], known.frame.field(db_uT))


# The powers of variant `nominal` are chosen on simulated skins: on this number of skins for each kind of error in
# CALIBRATION_ERRORS.
CALIBRATION_SKINS_N = 24

# Coverage of 90 % intervals on one skin. There is one row for each candidate power. The first column is for the map
# alone, the second one for map and networks together.
Coverages = Float[np.ndarray, "t 2"]
# A function that returns the field changes of simulated skins after adding random errors of the law to them.
LawError = Callable[[Population, np.random.Generator], np.ndarray]


def law_error(scale: float = 1.0) -> LawError:
    """Return a function that adds random errors of the law to the field changes of simulated skins.

    The law is the simulation of a skin on which the map is based (`reskin.universal.law`). Real skins deviate from it,
    and the added errors imitate these deviations. They are `scale` times as large as the errors that are added when the
    networks are trained.
    """
    least, most = ERROR_OF_NOMINAL

    def add(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (scale * least, scale * most), rng)

    return add


# Skins have two further errors that the map does not model, and whose size can hardly be determined from presses.
# Memory of the skin: after a press, a fraction of its field change remains for some time, and is therefore part of the
# no-load reading of the next press. On the recordings of scenes lab and eflesh, this fraction is 5 to 8 %. MEMORY_MAX
# is the largest fraction that is simulated.
# Differences between equal presses: two presses at the same place and with the same force do not have the same field
# change. The difference has heavy tails: it is drawn from Student's t distribution, times the field change's rms over
# the channels. DIFFERENCE_MAX is the largest scale of this distribution, an assumed value. With 15 channels, the median
# length of the difference, relative to the length of the field change, is 1.4 times the scale.
MEMORY_MAX, DIFFERENCE_MAX = 0.15, 0.3
HEAVY_TAILS = 3  # degrees of freedom of Student's t distribution


def unmodelled_error(scale: float = 1.0) -> LawError:
    """Return a function that adds three kinds of errors to the field changes of simulated skins.

    These are errors of the law (see `law_error`), which are `scale` times as large as in training, the memory of
    another press, and differences between equal presses. For each skin, the remaining fraction of another press's field
    change is drawn uniformly from 0 to `MEMORY_MAX`, and the scale of the differences uniformly from 0 to
    `DIFFERENCE_MAX`.
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


# Likelihood powers are chosen on simulated skins with these kinds of errors. The names of the errors are also used to
# seed the random generators.
AS_TRAINED = "further"
CALIBRATION_ERRORS = {AS_TRAINED: unmodelled_error(), "further, missed twice": unmodelled_error(2.0)}


def calibrate_on_boards(benchmark: Benchmark, labels_n: Sequence[int]) -> dict[str, dict[int, Powers]]:
    """Choose the likelihood powers of variant `rig`, for each held-out board and each number of labels.

    The chosen powers are those with the best coverage on the other boards (see `best_powers`), so that the held-out
    board does not affect the choice.
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
    """Choose the likelihood powers of variant `nominal` for a misfit of 1, for each number of labels.

    The chosen powers are those with the best coverage on simulated skins (see `best_powers`). When the model is later
    used on a board, these powers are divided by the board's misfit (Birge's ratio) and by the variance inflation of the
    board's labels.

    The simulated skins have errors of the law that are as large as in training, and the other errors of
    `unmodelled_error`. For numbers of labels above 0, skins whose errors of the law are twice as large are added. The
    residuals of labels show how large the errors of a skin are: on skins with larger errors, the variance inflation is
    larger and lowers the powers further.
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
    """Choose the candidates for which the coverage of 90 % intervals, averaged over skins, is closest to 90 %.

    The power for the map alone and the power for map and networks are chosen separately.
    """
    map_i, combined_i = np.abs(np.mean(of_skins, axis=0) - 0.9).argmin(axis=0)
    return Powers(candidates[map_i], candidates[combined_i])


def draw_prior_skins(prior: SkinPrior, skins_n: int, seed: int, name: str, error: LawError) -> Population:
    """Draw skins from a prior and simulate presses on them; add errors (by calling `error`) and noise to the fields."""
    rng = rng_for(seed, "universal", prior.name, name)
    skins = draw_population(prior.centre, prior.spreads, prior.setup, skins_n, rng, prior.forces)
    db_uT = error(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def calibrate_to_simulated(
    model: PriorModel, skins: Population, i: int, seed: int
) -> tuple[PoolCalibration, LabelledPresses]:
    """Calibrate a model to the presses in the pool of simulated skin `i`.

    Returns the calibration, and the presses of the skin that are not in the pool, for testing.
    """
    pool, tested = split_presses(skins, i, seed)
    return calibrate(model, skins.rest_uT[i].astype(float), pool), tested


def split_presses(skins: Population, i: int, seed: int) -> tuple[LabelledPresses, LabelledPresses]:
    """Split the presses of simulated skin `i` at random into a pool for calibration, and presses for testing."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    parts = (skins.place_mm, skins.force_N, skins.db_uT)
    presses = LabelledPresses(*(part[i][order].astype(float) for part in parts))
    return presses[:PLACES_N], presses[PLACES_N:]


def _simulated_coverages(calibration: PoolCalibration, tested: LabelledPresses, labels_n: int) -> Coverages:
    candidates = [calibration.nominal_powers(Powers(power, power)) for power in NOMINAL_POWERS]
    return coverages(calibration, tested, labels_n, lower_by_labels(calibration, labels_n, candidates))


def _board_coverages(benchmark: Benchmark, board: str, labels_n: Sequence[int]) -> dict[int, Coverages]:
    """Compute the coverage of variant `nominal` on a board with each candidate power, for each number of labels.

    A random third of the board's presses is the pool, to which the model is calibrated. All other presses are tested.
    """
    own = benchmark.known.presses[board]
    order = rng_for(benchmark.known.data.settings.seed, "universal", board).permutation(len(own.recorded))
    db_uT = own.db_uT.reshape(len(order), -1)
    presses = LabelledPresses(own.place_mm[order], own.recorded.force_N[order], db_uT[order])
    pool_n = len(order) // 3
    calibration = calibrate(benchmark.nominal.model, own.rest_uT.ravel(), presses[:pool_n])
    powers = [Powers(power, power) for power in BOARD_POWERS]
    return {n: coverages(calibration, presses[pool_n:], min(n, pool_n), powers) for n in labels_n}
