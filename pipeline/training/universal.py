"""The universal model on held-out boards: train it on other boards and simulated skins, calibrate it, score it.

Two variants: `rig` knows the recorded boards that are not held out, `nominal` simulated skins alone.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from pipeline.executors import make_executor
from pipeline.training.jobs import SceneData, score_test
from reskin import io
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.seeds import rng_for
from reskin.universal.calibration import (
    CalibrationData,
    HeldOut,
    LabelledPresses,
    folds_of_labels,
    lower_by_misfit,
    lower_by_residuals,
    variance_inflations,
)
from reskin.universal.law import TEN, AlignedPresses, Law, Setup, fit, simulate_uT
from reskin.universal.map import (
    FORCES_N,
    NOMINAL,
    NOMINAL_SPREADS,
    RIG_SPREADS,
    Estimate,
    Residual,
    condition_on_labels,
    fit_residual,
    mean_law,
    new_map,
    tabulate,
)
from reskin.universal.model import CalibratedModel, Evaluation, PressCalibration, PriorModel, network_offsets_mm
from reskin.universal.network import Weights, from_tensors, to_tensors
from reskin.universal.population import PLACES_N, Population, draw_population
from reskin.universal.training import (
    ERROR_OF_NOMINAL,
    NOMINAL_NAME,
    NOISE_uT,
    RecordedBoard,
    SkinPrior,
    TrainingSettings,
    add_error,
    train_networks,
)

READINGS_N = 100  # of each press of a recorded board, for training
FORMAT = "reskin-universal-1"


@dataclass(frozen=True)
class Frame:
    """How boards lie under their labels: chips' axes, and labels' middle and direction of y."""

    turn: Float[np.ndarray, "k 3 3"]
    middle_mm: tuple[float, float]
    mirrored: bool

    def field(self, b_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n ch"]:
        """Turn readings from the chips' axes to the board's."""
        of_chips = b_uT.astype(float).reshape(len(b_uT), -1, 3)
        return np.einsum("kij,nkj->nki", self.turn, of_chips).reshape(len(b_uT), -1)

    def place(self, label_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn labels to places in the board's frame."""
        return (label_mm - self.middle_mm) * (1, -1 if self.mirrored else 1)

    def label(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Turn places in the board's frame to labels."""
        return place_mm * (1, -1 if self.mirrored else 1) + self.middle_mm


@dataclass(frozen=True)
class KnownBoards:
    """The scene's recorded boards, before one is held out: `presses` by board, in the board's frame."""

    data: SceneData
    frame: Frame
    setup: Setup
    presses: Mapping[str, AlignedPresses]


@dataclass(frozen=True)
class Variant:
    """The model before calibration to a board, and the skins that it was made from."""

    prior: SkinPrior
    model: PriorModel


class Variants(NamedTuple):
    """The variant that knows no board, and by held-out board the variant that knows the others."""

    nominal: Variant
    rig: Mapping[str, Variant]


def make_variants(known: KnownBoards, settings: TrainingSettings) -> Variants:
    """Fit laws to the known boards, tabulate maps and train networks."""
    with make_executor(imports="reskin.universal.training") as executor:
        priors = _priors(known, executor)
        tables = [executor.submit(tabulate, prior.centre, prior.spreads, known.setup) for prior in priors]
        networks = [executor.submit(train_networks, prior, settings, known.data.settings.seed) for prior in priors]
        variants = [
            Variant(prior, PriorModel(new_map(of_map.result(), prior.residual), of_networks.result()))
            for prior, of_map, of_networks in zip(priors, tables, networks, strict=True)
        ]
    return Variants(variants[0], dict(zip(known.presses, variants[1:], strict=True)))


def read_variants(known: KnownBoards, models: Path) -> Variants:
    """Read the networks that `write_networks` wrote; fit laws and tabulate maps anew."""
    with make_executor(imports="reskin.universal.map") as executor:
        priors = _priors(known, executor)
        tables = [executor.submit(tabulate, prior.centre, prior.spreads, known.setup) for prior in priors]
        variants = [
            Variant(prior, PriorModel(new_map(of_map.result(), prior.residual), read_networks(models, prior.name)))
            for prior, of_map in zip(priors, tables, strict=True)
        ]
    return Variants(variants[0], dict(zip(known.presses, variants[1:], strict=True)))


def _priors(known: KnownBoards, executor: Executor) -> list[SkinPrior]:
    """Return the nominal prior, and for each board the prior when it is held out."""
    boards, setup = known.presses, known.setup
    laws = dict(
        zip(boards, executor.map(fit, boards.values(), [setup] * len(boards), [TEN] * len(boards)), strict=True)
    )
    nominal = SkinPrior(NOMINAL_NAME, NOMINAL, NOMINAL_SPREADS, setup)
    return [nominal, *(prior_without(known, laws, board) for board in boards)]


def prior_without(known: KnownBoards, laws: Mapping[str, Law], board: str) -> SkinPrior:
    """Return the prior that knows all boards but one: their laws, the laws' errors, and their readings."""
    others = {other: own for other, own in known.presses.items() if other != board}
    rows, frame = known.data.rows, known.frame
    recorded = [recorded_board(rows, frame, other, own.rest_uT.ravel()) for other, own in others.items()]
    centre, residual = mean_law([laws[other] for other in others]), residual_of(others, laws, known.setup)
    return SkinPrior(f"without {board}", centre, RIG_SPREADS, known.setup, recorded, residual)


def residual_of(presses: Mapping[str, AlignedPresses], laws: Mapping[str, Law], setup: Setup) -> Residual:
    """Fit the residual to the laws' errors on the boards that they were fitted to."""
    errors = []
    for board, own in presses.items():
        simulated_uT = simulate_uT(laws[board], setup, own.place_mm, own.recorded.force_N)
        simulated_uT = simulated_uT.reshape(len(simulated_uT), -1)
        off_uT = own.db_uT.reshape(simulated_uT.shape) - simulated_uT
        errors.append(off_uT / np.linalg.norm(simulated_uT, axis=1, keepdims=True))
    boards = list(presses.values())
    return fit_residual([own.place_mm for own in boards], [own.recorded.force_N for own in boards], errors)


def recorded_board(rows: Rows, frame: Frame, board: str, rest_uT: Float[np.ndarray, " ch"]) -> RecordedBoard:
    """Select a board's readings for training: equally many of each press with a force."""
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    _, first, counts = np.unique(rows.indentation[own], return_index=True, return_counts=True)
    each = own[first[:, None] + np.arange(READINGS_N) % counts[:, None]]  # the readings of a press are adjacent
    db_uT = frame.field(rows.db_uT[each.ravel()]).reshape(*each.shape, -1)
    place_mm = frame.place(rows.target[each[:, 0], :2].astype(float))
    parts = db_uT, rest_uT, place_mm, rows.target[each, 2]
    return RecordedBoard(*(part.astype(np.float32) for part in parts))


def write_networks(models: Path, variants: Variants, settings: TrainingSettings, seed: int) -> None:
    """Write the networks of each variant, with a card."""
    with io.replacing(models) as folder:
        folder.mkdir()
        for variant in (variants.nominal, *variants.rig.values()):
            name = _file_name(variant.prior.name)
            io.write_tensors(folder / f"{name}.safetensors", to_tensors(variant.model.networks), {"format": FORMAT})
            io.write_json(folder / f"{name}.json", card_of(variant, settings, seed))


def read_networks(models: Path, name: str) -> list[Weights]:
    """Read the networks of a prior, by its name."""
    return from_tensors(io.read_tensors(models / f"{_file_name(name)}.safetensors")[0])


def _file_name(name: str) -> str:
    return name.replace(" ", "-")


def card_of(variant: Variant, settings: TrainingSettings, seed: int) -> dict[str, object]:
    """Describe networks: the skins they were trained on, and what they are not for."""
    prior = variant.prior
    return {
        "format": FORMAT, "method": f"universal, {prior.name}", "seed": seed,
        "skins_n": settings.skins_n, "steps_n": settings.steps_n, "networks_n": len(variant.model.networks),
        "centre": asdict(prior.centre), "spreads": dict(prior.spreads), "recorded_boards_n": len(prior.recorded),
        "inputs": "change of field (uT, board's axes), field at rest, any number of unlabelled pokes",
        "outputs": "x, y over 8 mm; log F over 3; log sd of each",
        "not_for": "other boards' layouts, skins of another polarity, two contacts at once, shear",
    }  # fmt: skip


EXPERIMENT = "labels"  # whose folds are scored
METHODS = ("universal map, ", "universal, ")  # the map alone; map and networks
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
REACH = 1.645  # standard deviations to either side of a 90 % interval
BOARD_POWERS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)  # candidates, calibrated on other boards
NOMINAL_POWERS = tuple(
    np.geomspace(0.1, 1.6, 13).tolist()
)  # candidates at a misfit of 1, calibrated on simulated skins
ASSUMED_POWER = 0.5  # of the map's estimates, and where none is calibrated: as if channels erred in pairs
FORCE_MIN_N = float(FORCES_N[0])  # of a labelled press: the map is not tabulated below


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
    """What all folds share.

    board_powers: by board and number of labels. nominal_powers: by number of labels, at a misfit of 1.
    """

    data: SceneData
    frame: Frame
    presses: Mapping[str, AlignedPresses]
    nominal: Variant
    board_powers: Mapping[str, Mapping[int, Powers]]
    nominal_powers: Mapping[int, Powers]


@dataclass(frozen=True)
class PoolCalibration:
    """A model calibrated to a board's no-load field and to its pool of presses, of which the first may be labelled."""

    presses: PressCalibration
    pool: LabelledPresses
    pool_mm: Float[np.ndarray, "m 2"]  # the pool's places as the networks estimate them
    misfit: float  # median over the pool

    def with_labels(self, labels_n: int) -> CalibratedModel:
        """Condition on the first presses of the pool as labels."""
        labels = self.pool[:labels_n]
        force_N = np.maximum(labels.force_N, FORCE_MIN_N)
        skin = condition_on_labels(self.presses.skin, labels.place_mm, force_N, labels.db_uT)
        offsets_mm = network_offsets_mm(self.pool_mm, self.pool_mm[:labels_n], labels.place_mm)
        return CalibratedModel(skin, self.presses.layers, offsets_mm)

    def nominal_powers(self, powers: Powers) -> Powers:
        """Lower the powers of a model that knows no board by the misfit."""
        return Powers(*(lower_by_misfit(power, self.misfit) for power in powers))

    def reordered(self, first: Int64[np.ndarray, " k"]) -> "PoolCalibration":
        """Put some of the pool's presses first."""
        order = np.concatenate([first, np.setdiff1d(np.arange(len(self.pool)), first)])
        pool = self.pool[order]
        # The networks are conditioned again: their sums run in the order of the pool, which moves the last bits.
        presses = replace(self.presses, data=CalibrationData(self.presses.data.rest_uT, pool.db_uT, pool.db_uT))
        return replace(self, presses=presses, pool=pool, pool_mm=self.pool_mm[order])


def calibrate(model: PriorModel, rest_uT: Float[np.ndarray, " ch"], pool: LabelledPresses) -> PoolCalibration:
    """Calibrate a model to what a board gives without labels: its no-load field, and presses evenly over the skin."""
    presses = model.calibrate(CalibrationData(rest_uT, pool.db_uT, pool.db_uT))
    misfit = float(np.median(presses.skin.evaluator.evaluate(pool.db_uT).misfit())) if len(pool) else 1.0
    return PoolCalibration(presses, pool, presses.even_mm, misfit)


def estimate(model: CalibratedModel, db_uT: Float[np.ndarray, "n ch"], powers: Sequence[Powers]) -> list[Estimates]:
    """Estimate places and forces, once for each pair of powers: only standard deviations depend on them."""

    def by_powers(evaluation: Evaluation) -> list[Estimate]:
        assumed = evaluation.by_map(ASSUMED_POWER)
        by_map = [about(assumed, evaluation.by_map(power)) for power, _ in powers]
        return [*by_map, *(evaluation.combined(power) for _, power in powers)]

    found = model.estimate_by(by_powers, db_uT)
    return [Estimates(*pair) for pair in zip(found[: len(powers)], found[len(powers) :], strict=True)]


def about(estimate: Estimate, other: Estimate) -> Estimate:
    """Return an estimate with the standard deviations of another one about its places."""
    return replace(estimate, sd_mm=np.hypot(other.sd_mm, other.place_mm - estimate.place_mm))


def lower_by_labels(calibration: PoolCalibration, labels_n: int, powers: Sequence[Powers]) -> list[Powers]:
    """Lower powers by the variance inflation of cross-validated labels."""
    by_map: list[HeldOut] = []
    combined: list[HeldOut] = []
    for kept, held_out in folds_of_labels(min(labels_n, len(calibration.pool))):
        model = calibration.reordered(kept).with_labels(len(kept))
        found, true_mm = estimate(model, calibration.pool.db_uT[held_out], powers), calibration.pool.place_mm[held_out]
        by_map.append(([one.map for one in found], true_mm))
        combined.append(([one.combined for one in found], true_mm))
    inflations = [variance_inflations(len(powers), folds) for folds in (by_map, combined)]
    return [
        Powers(lower_by_residuals(power.map, of_map), lower_by_residuals(power.combined, of_both))
        for power, of_map, of_both in zip(powers, *inflations, strict=True)
    ]


def score_fold(
    benchmark: Benchmark, fold: Fold, rig: Mapping[str, Variant], labels_n: Sequence[int]
) -> list[dict[str, Any]]:
    """Score both variants on one fold, by the map alone and with networks, for every number of labels."""
    board = str(benchmark.data.rows.board[fold.test[0]])
    if board not in benchmark.presses:  # they are named by board and skin if a board has several
        rule = "boards of one skin each"
        names = ", ".join(benchmark.presses)
        raise ParamsError(f"fold {fold.name}", "the boards", rule, names, "Do not run this experiment.")
    pool, rest_uT = pool_of(benchmark, fold), benchmark.presses[board].rest_uT.ravel()
    test_uT = benchmark.frame.field(benchmark.data.rows.db_uT[fold.test])
    points = []
    for way, variant in {"rig": rig[board], "nominal": benchmark.nominal}.items():
        calibration = calibrate(variant.model, rest_uT, pool)
        for n in labels_n:
            if way == "rig":
                powers = benchmark.board_powers[board][n]
            else:
                (powers,) = lower_by_labels(calibration, n, [calibration.nominal_powers(benchmark.nominal_powers[n])])
            (found,) = estimate(calibration.with_labels(n), test_uT, [powers])
            for name, power, estimates in zip(METHODS, powers, found, strict=True):
                draw = fold.name.rsplit("-draw", 1)
                points.append({
                    "method": f"{name}{WAYS[way]}", "labels_n": n, "fold": draw[0],
                    "inputs": "map" if "map" in name else "map and network", "temper": power, "seed_i": int(draw[1]),
                    "misfit": calibration.misfit, "scores": scored(benchmark, fold.test, estimates),
                })  # fmt: skip
    return points


def coverage(estimate: Estimate, place_mm: Float[np.ndarray, "n 2"]) -> float:
    """Return the share of coordinates that lie in their 90 % intervals."""
    return float((np.abs(estimate.place_mm - place_mm) <= REACH * estimate.sd_mm).mean())


def coverages(
    calibration: PoolCalibration, tested: LabelledPresses, labels_n: int, powers: Sequence[Powers]
) -> Float[np.ndarray, "t 2"]:
    """Return the coverage of 90 % intervals for each pair of powers, of the map alone and with networks."""
    found = estimate(calibration.with_labels(labels_n), tested.db_uT, powers)
    return np.array([[coverage(one, tested.place_mm) for one in pair] for pair in found])


def scored(benchmark: Benchmark, test: Int64[np.ndarray, " b"], estimate: Estimate) -> dict[str, Any]:
    """Score estimates as every method's, and the coverage of their 90 % intervals."""
    label_mm = benchmark.frame.label(estimate.place_mm)
    predicted = np.column_stack([label_mm, estimate.force_N]).astype(np.float32)
    scores = score_test(benchmark.data, test, predicted)
    true_mm = benchmark.frame.place(benchmark.data.rows.target[test, :2].astype(float))
    half_width_mm = REACH * float(np.median(estimate.sd_mm))
    intervals = {"coverage_pct": 100 * coverage(estimate, true_mm), "half_width_mm": half_width_mm}
    skins = {name: own | intervals for name, own in scores["by_skin"].items()} if len(scores["by_skin"]) == 1 else {}
    return scores | {"all": scores["all"] | intervals} | ({"by_skin": skins} if skins else {})


def pool_of(benchmark: Benchmark, fold: Fold) -> LabelledPresses:
    """Return the mean readings of the pool's presses, in the order in which experiment labels takes them as labels."""
    rows, indentation = benchmark.data.rows, benchmark.data.rows.indentation[fold.pool]
    order = rng_for(benchmark.data.settings.seed, "labelled", fold.name).permutation(np.unique(indentation))
    own = [fold.pool[indentation == one] for one in order]
    target = np.array([rows.target[one].mean(axis=0) for one in own], float)
    db_uT = np.array([rows.db_uT[one].mean(axis=0) for one in own], float)
    return LabelledPresses(benchmark.frame.place(target[:, :2]), target[:, 2], benchmark.frame.field(db_uT))


CALIBRATION_SKINS_N = 24  # simulated, with each error of the law, for the powers of the nominal variant

Coverages = Float[np.ndarray, "t 2"]  # by power; of the map alone, and with networks
LawError = Callable[[Population, np.random.Generator], np.ndarray]  # changes of field with errors of the law


def law_error(times: float = 1.0) -> LawError:
    """Return errors of the law that are as large as in training, or so many times larger."""
    least, most = ERROR_OF_NOMINAL

    def add(skins: Population, rng: np.random.Generator) -> Float32[np.ndarray, "s m ch"]:
        return add_error(skins.db_uT, skins.place_mm, np.log(skins.force_N), (times * least, times * most), rng)

    return add


AS_TRAINED = "further"  # names are part of seeds
LAW_ERRORS = {AS_TRAINED: law_error(), "further, missed twice": law_error(2.0)}


def calibrate_on_boards(benchmark: Benchmark, labels_n: Sequence[int]) -> dict[str, dict[int, Powers]]:
    """Choose powers for each held-out board, as is best on the other boards."""
    by_board = {board: _board_coverages(benchmark, board, labels_n) for board in benchmark.presses}
    return {
        board: {
            n: best_powers(BOARD_POWERS, [own[n] for other, own in by_board.items() if other != board])
            for n in labels_n
        }
        for board in by_board
    }


def calibrate_on_simulated(nominal: Variant, labels_n: Sequence[int], seed: int) -> dict[int, Powers]:
    """Choose powers at a misfit of 1, by number of labels, on simulated skins.

    A board's powers are these over its misfit (Birge's ratio) and over the variance inflation of its labels. The law's
    errors on these skins are as in training; with labels, skins with errors twice as large count too, as residuals of
    labels are to tell the size of the errors.
    """
    found: dict[int, list[Coverages]] = {n: [] for n in labels_n}
    for name, error in LAW_ERRORS.items():
        skins = draw_prior_skins(nominal.prior, CALIBRATION_SKINS_N, seed, name, error)
        calibrated = [calibrate_to_simulated(nominal.model, skins, i, seed) for i in range(len(skins))]
        for n in labels_n:
            if n or name == AS_TRAINED:
                found[n] += [_simulated_coverages(*one, n) for one in calibrated]
    return {n: best_powers(NOMINAL_POWERS, found[n]) for n in labels_n}


def best_powers(candidates: Sequence[float], found: Sequence[Coverages]) -> Powers:
    """Choose the powers whose 90 % intervals cover 90 %, on the mean over skins."""
    of_map, combined = np.abs(np.mean(found, axis=0) - 0.9).argmin(axis=0)
    return Powers(candidates[of_map], candidates[combined])


def draw_prior_skins(prior: SkinPrior, skins_n: int, seed: int, name: str, error: LawError) -> Population:
    """Draw skins of the prior, with noise and errors of the law."""
    rng = rng_for(seed, "universal", prior.name, name)
    skins = draw_population(prior.centre, prior.spreads, prior.setup, skins_n, rng)
    db_uT = error(skins, rng).reshape(skins.db_uT.shape)
    sd_uT = np.tile(np.array(NOISE_uT), skins.rest_uT.shape[1] // len(NOISE_uT))
    return replace(skins, db_uT=(db_uT + sd_uT * rng.standard_normal(skins.db_uT.shape)).astype(np.float32))


def calibrate_to_simulated(
    model: PriorModel, skins: Population, i: int, seed: int
) -> tuple[PoolCalibration, LabelledPresses]:
    """Calibrate a model to a simulated skin; return it with the presses to test it on."""
    pool, tested = split_presses(skins, i, seed)
    return calibrate(model, skins.rest_uT[i].astype(float), pool), tested


def split_presses(skins: Population, i: int, seed: int) -> tuple[LabelledPresses, LabelledPresses]:
    """Split the presses of a simulated skin at random into a pool and those to test on."""
    order = rng_for(seed, "universal", "pool", i).permutation(skins.db_uT.shape[1])
    parts = (skins.place_mm, skins.force_N, skins.db_uT)
    presses = LabelledPresses(*(part[i][order].astype(float) for part in parts))
    return presses[:PLACES_N], presses[PLACES_N:]


def _simulated_coverages(calibration: PoolCalibration, tested: LabelledPresses, labels_n: int) -> Coverages:
    candidates = [calibration.nominal_powers(Powers(power, power)) for power in NOMINAL_POWERS]
    return coverages(calibration, tested, labels_n, lower_by_labels(calibration, labels_n, candidates))


def _board_coverages(benchmark: Benchmark, board: str, labels_n: Sequence[int]) -> dict[int, Coverages]:
    """Return coverages of the nominal variant on a board, with a third of its presses as pool, on the others."""
    own = benchmark.presses[board]
    order = rng_for(benchmark.data.settings.seed, "universal", board).permutation(len(own.recorded))
    db_uT = own.db_uT.reshape(len(order), -1)
    presses = LabelledPresses(own.place_mm[order], own.recorded.force_N[order], db_uT[order])
    pool_n = len(order) // 3
    calibration = calibrate(benchmark.nominal.model, own.rest_uT.ravel(), presses[:pool_n])
    powers = [Powers(power, power) for power in BOARD_POWERS]
    return {n: coverages(calibration, presses[pool_n:], min(n, pool_n), powers) for n in labels_n}
