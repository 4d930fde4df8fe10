"""Reference methods for a new board without calibration (not in the paper).

The methods use the folds and test rows of experiment `labels`:

- Regressors and networks that are trained on known boards. Fields of the new board differ from fields of known boards.
  This difference is reduced with unlabelled pokes of the new board (presses at unknown places), or with a few labelled
  pokes.
- The universal model, and the inversion of a physical model that is fitted to unlabelled pokes. Both methods receive
  unlabelled pokes of the new skin, or no pokes, or (as a control) pokes of another skin.
- Alarms: the residual of a fitted physical model may show that readings come from a foreign board, which is a board to
  which the model was not fitted.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int64
from pydantic import Field

from pipeline.experiments.detection import roc_area
from pipeline.experiments.known_boards import read_known_boards
from pipeline.experiments.results import write_results
from pipeline.formatting import COLUMNS, FORCE_METRICS, n_of, scores, show, show_difference, tabulate
from pipeline.provenance import SECONDS
from pipeline.scores import AS_LABELLED, REGISTERED, by_skin, rows_of_cards
from pipeline.settings import Row, SectionWithRows, Settings, take
from pipeline.stage import say
from pipeline.statistics import over_boards, paired, statistic, tally
from pipeline.training.jobs import SceneData, score_test
from pipeline.training.universal import (
    ASSUMED_POWER,
    EXPERIMENT,
    METHODS,
    WAYS,
    Powers,
    calibrate,
    estimate,
    pool_of,
    pool_rows,
)
from pipeline.training.universal_variants import KnownBoards, Variant, Variants, read_variants
from reskin import io
from reskin.data.rows import Rows
from reskin.data.splits import Fold
from reskin.errors import ParamsError
from reskin.metrics import ACCURACY_LIMIT_MM
from reskin.models.adversarial import Domains, train_adversarial
from reskin.models.alignment import choose_ridge, coral, direct, match_channels
from reskin.models.classical import Classical, fit
from reskin.models.inputs import FIT, VIEW
from reskin.models.job import COLLAPSED, Weights
from reskin.models.network import Predictor
from reskin.models.recipe import Name, Recipe
from reskin.models.runner import MAX_ATTEMPTS_N
from reskin.seeds import rng_for
from reskin.universal.calibration import LabelledPresses
from reskin.universal.inversion import Chart, chart, fit_unlabelled, search
from reskin.universal.law import Setup
from reskin.universal.model import PriorModel

OWN, NONE, FOREIGN = "its own", "none", "another skin's"  # the skin whose unlabelled pokes a method receives
Key = tuple[str, str, int]  # name of a method, one of OWN, NONE and FOREIGN, and number of labels
Point = dict[str, Any]  # scores of one method on one fold
# Name of the random streams. It is an earlier name of this experiment, which is kept so that results do not change.
RNG = "rivals"


class ReferenceMethods(SectionWithRows):
    """Settings section `reference_methods`.

    - labels_n: numbers of labelled pokes with which methods are tested.
    - methods: regressors that are trained on known boards.
    - recipe: recipe of the network that is trained on known boards.
    - adversarial_weight: weight of the adversarial term in the loss of this network.
    - false_alarm_fraction: fraction of the readings of the right board for which an alarm may be raised.
    """

    labels_n: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]
    methods: dict[Name, Classical]
    recipe: Recipe
    adversarial_weight: Annotated[float, Field(gt=0)]
    false_alarm_fraction: Annotated[float, Field(gt=0, lt=1)]

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        recipe = settings.row("recipes", section, "recipe", where)
        recipe |= {"inputs": take(section, "inputs", where), "steps_n": take(section, "steps_n", where)}
        methods = settings.row("methods", section, "methods", where)
        return section | {"recipe": recipe, "methods": methods}


def reference_methods(
    settings: Settings, section: ReferenceMethods, indentations: Path, folds: Path, models: Path, results: Path
) -> None:
    """Score the reference methods on every held-out board, on the test rows of experiment `labels`."""
    known = read_known_boards(settings, indentations, folds)
    data, of_labels = known.data, known.data.folds_of(EXPERIMENT)

    points: list[Point] = []
    trainings: list[dict[str, Any]] = []
    unpaired_n = 0
    for fold in of_labels:
        for method in section.methods.values():
            points += score_regressor(data, fold, method, section.labels_n)
        adversarial_points, records = score_adversarial(data, fold, section.recipe, section.adversarial_weight)
        points, trainings = points + adversarial_points, trainings + records
        paired_uT = pairs_uT(data.rows, fold.train, pool_rows(data, fold)[: max(section.labels_n)])
        unpaired_n += int(np.isnan(paired_uT).any(axis=1).sum())
        say(f"{data.scene} reference_methods: scored the methods with aligned inputs on {fold.name}")

    variants = read_variants(known, models)
    seconds: list[Seconds] = []
    for fold in of_labels:
        unlabelled_points, fold_seconds = score_unlabelled(known, of_labels, fold, variants)
        points, seconds = points + unlabelled_points, seconds + fold_seconds
        say(f"{settings.scene} reference_methods: scored the methods with unlabelled pokes on {fold.name}")

    alarm, flagged = evaluate_alarm(known, of_labels, section.false_alarm_fraction)
    numbers: dict[str, Any] = {
        "methods": summarise(points, alignment_controls(section.methods, section.labels_n) | unlabelled_controls()),
        "unpaired_n": unpaired_n,
        "flagged": [*flag_by_universal(known, variants.nominal, of_labels, section.false_alarm_fraction), flagged],
        "alarm": alarm,
    }
    write_results(results, numbers, {}, trainings=tally(trainings))
    io.write_json(SECONDS / settings.scene / "reference_methods.json", [asdict(record) for record in seconds])


# --- Folds, pokes, points ---


def next_board(fold: Fold, folds: Iterable[Fold]) -> Fold:
    """Return the fold of another board in the same random draw, whose pokes serve as the pokes of another skin."""
    same_draw = [candidate for candidate in folds if candidate.draw_i == fold.draw_i]
    names = [candidate.name for candidate in same_draw]
    return same_draw[(names.index(fold.name) + 1) % len(same_draw)]


def first_folds(folds: Sequence[Fold]) -> dict[str, Fold]:
    """Return the first fold of each board, by board name."""
    return dict(sorted({fold.board: fold for fold in reversed(folds)}.items()))


def means_uT(data: SceneData, pokes: Sequence[Int64[np.ndarray, " r"]]) -> Float[np.ndarray, "m ch"]:
    """Return the mean change of field of each poke, in the chips' axes; `pokes` has the row numbers of each poke."""
    return np.array([data.rows.db_uT[row].mean(axis=0, dtype=np.float64) for row in pokes])


def point(
    data: SceneData, fold: Fold, predicted: Float[np.ndarray, "b 3"], *, method: str, pokes: str, labels_n: int = 0
) -> Point:
    """Score predictions for the test rows of a fold; the columns are x and y in the labels' axes, and the force F."""
    keys = {"method": method, "name": pokes, "labels_n": labels_n, "fold": fold.board, "seed_i": fold.draw_i}
    return keys | {"scores": score_test(data, fold.test, predicted.astype(np.float32))}


def summarise(points: Sequence[Point], controls: Mapping[Key, Key]) -> list[dict[str, Any]]:
    """Summarise the scores of every method over boards.

    If `controls` names a control of a method, the summary of the method also contains the difference between the method
    and its control, paired by board.
    """
    table = rows_of_cards([], {"rivals": points})
    table["labels_n"] = table["labels_n"].astype(int)
    groups: dict[Any, Any] = dict(iter(table.groupby(["method", "recipe", "labels_n"], sort=False)))
    rows = []
    for key, group in groups.items():
        row = dict(zip(("method", "pokes", "labels_n"), key, strict=True))
        row |= {places: over_boards(group, places) for places in (AS_LABELLED, REGISTERED)}
        if key in controls:
            over = paired(by_skin(group), by_skin(groups[controls[key]]))
            row["over"] = dict(zip(("method", "pokes", "labels_n"), controls[key], strict=True)) | over
        rows.append(row)
    return rows


# --- Models of known boards with aligned inputs ---

EVERY_N = 10  # the readings of a labelled poke differ only by noise, so only every tenth becomes a training row
SAME_MM = 0.5  # pokes that are closer to each other than this count as pokes at the same place
ALIGNMENTS = {"channels matched": match_channels, "CORAL": coral}
DIRECT, AS_ROWS = "direct standardisation", "labels as rows"
ADVERSARIAL, CONTROL = "network, domain-adversarial", "network, trained as long without adversarial loss"


def score_regressor(data: SceneData, fold: Fold, method: Classical, labels_n: Sequence[int]) -> list[Point]:
    """Score a regressor on a new board, in several variants of using the pokes of this board.

    The variants are:
    - the regressor, fitted to known boards, without any use of pokes,
    - alignment of the inputs with the new board by means of unlabelled pokes,
    - direct standardisation, which maps the inputs to those of known boards by means of labelled pokes,
    - labelled pokes as additional training rows of the regressor.
    """
    rows, view, pokes = data.rows, VIEW[method.inputs], pool_rows(data, fold)
    known, new, test = (view(rows.db_uT[side]) for side in (fold.train, fold.pool, fold.test))
    target, name = rows.target[fold.train], f"{method.title} ({method.inputs})"
    draws = partial(rng_for, data.settings.seed, RNG, name, fold.name)
    score = partial(point, data, fold)
    plain = fit(method, known, target, draws("plain"), weight=None)
    points = [score(plain.predict(test), method=name, pokes=NONE)]
    for alignment, align in ALIGNMENTS.items():
        moved = align(known.astype(float), new.astype(float))(known.astype(float)).astype(np.float32)
        fitted = fit(method, moved, target, draws(alignment), weight=None)
        points.append(score(fitted.predict(test), method=f"{name}, {alignment}", pokes=OWN))
    for n in labels_n:
        back_uT = standardised_uT(data, fold, pokes[:n])
        points.append(score(plain.predict(view(back_uT)), method=f"{name}, {DIRECT}", pokes=NONE, labels_n=n))
        added = np.concatenate([row[::EVERY_N] for row in pokes[:n]])
        weight = np.concatenate([np.ones(len(known)), np.full(len(added), len(known) / len(added))]).astype(np.float32)
        extended = np.concatenate([known, view(rows.db_uT[added])]), np.concatenate([target, rows.target[added]])
        fitted = fit(method, *extended, draws(AS_ROWS, n), weight=weight)
        points.append(score(fitted.predict(test), method=f"{name}, {AS_ROWS}", pokes=NONE, labels_n=n))
    return points


def standardised_uT(data: SceneData, fold: Fold, pokes: Sequence[np.ndarray]) -> Float[np.ndarray, "b ch"]:
    """Map the test fields of a new board to the fields that known boards would read (direct standardisation).

    The map is linear, and is fitted by ridge regression to pairs of fields. A pair consists of the field of a labelled
    poke on the new board, and the mean field of known boards at the same place and force. Both fields are divided by
    the size of the first, so that weak and strong pokes have the same weight. The ridge penalty is chosen on the same
    pairs.
    """
    new_uT, old_uT = means_uT(data, pokes), pairs_uT(data.rows, fold.train, pokes)
    paired = np.isfinite(old_uT).all(axis=1)
    if not paired.any():
        what = f"no labelled poke is within {SAME_MM} mm of a poke on the known boards"
        remedy = "Record the known boards at the same places, or remove reference_methods from the scene."
        raise ParamsError(f"fold {fold.name}: {what}. {remedy}")
    length_uT = np.linalg.norm(new_uT[paired], axis=1, keepdims=True)
    new, old = new_uT[paired] / length_uT, old_uT[paired] / length_uT
    moved = direct(new, old, choose_ridge(new, old))(data.rows.db_uT[fold.test].astype(float))
    return moved.astype(np.float32)


def pairs_uT(
    rows: Rows, train: Int64[np.ndarray, " a"], pokes: Sequence[Int64[np.ndarray, " r"]]
) -> Float[np.ndarray, "m ch"]:
    """Return the mean field of the known boards at the place and force of each poke of a new board.

    Pokes of known boards have other forces F than the poke of the new board. The field of a known board at the force
    of the new board's poke is therefore interpolated linearly in log F, channel by channel. Beyond the recorded forces,
    it is constant. A row is NaN if no known board was poked at this place.
    """
    old_uT = np.full((len(pokes), rows.db_uT.shape[1]), np.nan)
    boards = [_poke_means(rows, train[rows.board[train] == board]) for board in np.unique(rows.board[train])]
    for i, row in enumerate(pokes):
        x_mm, y_mm, force_N = rows.target[row].mean(axis=0, dtype=np.float64)
        fields_uT = [_interpolate(*known, (x_mm, y_mm), float(force_N)) for known in boards]
        if fields_uT := [field_uT for field_uT in fields_uT if field_uT is not None]:
            old_uT[i] = np.mean(fields_uT, axis=0)
    return old_uT


def _poke_means(rows: Rows, selected: Int64[np.ndarray, " a"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean target and the mean field of each poke; `selected` are row numbers."""
    _, poke, count = np.unique(rows.indentation[selected], return_inverse=True, return_counts=True)
    sums = [np.zeros((len(count), values.shape[1])) for values in (rows.target, rows.db_uT)]
    for total, values in zip(sums, (rows.target, rows.db_uT), strict=True):
        np.add.at(total, poke.ravel(), values[selected])
    return sums[0] / count[:, None], sums[1] / count[:, None]


def _interpolate(
    target: Float[np.ndarray, "p 3"], db_uT: Float[np.ndarray, "p ch"], place_mm: tuple[float, float], force_N: float
) -> Float[np.ndarray, " ch"] | None:
    distance_mm = np.hypot(*(target[:, :2] - place_mm).T)
    nearby = np.flatnonzero((distance_mm <= SAME_MM) & (target[:, 2] > 0))
    if not len(nearby):
        return None
    nearby = nearby[np.argsort(target[nearby, 2])]
    log_N = np.log(target[nearby, 2])
    return np.array([np.interp(np.log(force_N), log_N, channel) for channel in db_uT[nearby].T])


def score_adversarial(
    data: SceneData, fold: Fold, recipe: Recipe, weight: float
) -> tuple[list[Point], list[dict[str, Any]]]:
    """Score a domain-adversarial network, and the same network without adversarial training (its control).

    Returns the scores, and for each network whether and how often it collapsed.
    """
    view, rows = VIEW[recipe.inputs], data.rows
    scaler = FIT[recipe.scaling](view(rows.db_uT[fold.train]), rows.target[fold.train])
    known, new, test = (scaler.encode(view(rows.db_uT[side])) for side in (fold.train, fold.pool, fold.test))
    domains = Domains(known, scaler.encode_target(rows.target[fold.train]), new)
    points, trainings = [], []
    for method, pokes, own_weight in ((CONTROL, NONE, 0.0), (ADVERSARIAL, OWN, weight)):
        weights, record = train_until_converged(domains, recipe, own_weight, data.settings.seed, fold.name)
        predicted = scaler.decode(Predictor(weights, recipe.architecture, "cpu")(test))
        points.append(point(data, fold, predicted, method=method, pokes=pokes))
        trainings.append(record)
    return points, trainings


def train_until_converged(
    domains: Domains, recipe: Recipe, weight: float, seed: int, fold: str
) -> tuple[Weights, dict[str, Any]]:
    """Train a network, with at most `MAX_ATTEMPTS_N` attempts.

    If a network collapses (it then predicts hardly more than a constant), it is trained again with other random draws.

    The draws do not depend on the adversarial `weight`, so that a network and its control differ only in this weight.
    """
    for attempt_i in range(MAX_ATTEMPTS_N):
        weights = train_adversarial(domains, recipe, weight, rng_for(seed, RNG, "network", fold, attempt_i))
        errors = Predictor(weights, recipe.architecture, "cpu")(domains.known) - domains.target
        collapsed = bool(np.min(1 - np.nanmean(errors**2, axis=0) / np.nanvar(domains.target, axis=0)) < COLLAPSED)
        if not collapsed:
            break
    return weights, {"collapsed": collapsed, "collapsed_before_n": attempt_i}


def alignment_controls(methods: Mapping[str, Classical], labels_n: Sequence[int]) -> dict[Key, Key]:
    """Return the control of each method with aligned inputs, which is the same method without alignment."""
    controls: dict[Key, Key] = {(ADVERSARIAL, OWN, 0): (CONTROL, NONE, 0)}
    for method in methods.values():
        name = f"{method.title} ({method.inputs})"
        controls |= {(f"{name}, {alignment}", OWN, 0): (name, NONE, 0) for alignment in ALIGNMENTS}
        controls |= {(f"{name}, {way}", NONE, n): (name, NONE, 0) for way in (DIRECT, AS_ROWS) for n in labels_n}
    return controls


# --- Methods that receive unlabelled pokes ---

INVERSION = "physics inversion"
CENTRED = f"{INVERSION}, centred"
# The universal model has two estimators: a map of simulated fields, and a network. The names of results begin with
# these texts: of the map alone, of the network alone, and of both together.
UNIVERSAL = ("universal map, ", "universal network, ", "universal, ")
ASSUMED = [Powers(ASSUMED_POWER, ASSUMED_POWER)]


@dataclass(frozen=True)
class Seconds:
    """Processor times of a method, in s.

    `train_s` is the time to calibrate the method to one skin. `one_reading_s` is the time of one estimate. To measure
    it, many readings are estimated in one call, and the time of the call is divided by the number of readings.
    """

    name: str
    train_s: float
    one_reading_s: float


Estimated = tuple[str, Float[np.ndarray, "b 2"], Float[np.ndarray, " b"], Seconds]  # method, places, forces, times


def score_unlabelled(
    known: KnownBoards, folds: Sequence[Fold], fold: Fold, variants: Variants
) -> tuple[list[Point], list[Seconds]]:
    """Score the universal models and the inversion with three sets of unlabelled pokes.

    The sets are: pokes of the test skin, no pokes, and pokes of another skin. Returns the scores with each set, and the
    processor times with pokes of the test skin.
    """
    points, times = [], []
    test_uT = known.frame.field(known.data.rows.db_uT[fold.test])
    rest_uT = known.presses[fold.board].rest_uT.ravel()
    own_pool = pool_of(known, fold)
    pools = {OWN: own_pool, NONE: own_pool[:0], FOREIGN: pool_of(known, next_board(fold, folds))}
    for given, pool in pools.items():
        for method, place_mm, force_N, seconds in [
            *estimate_universal(variants.nominal.model, rest_uT, pool, test_uT, WAYS["nominal"]),
            *estimate_universal(variants.rig[fold.board].model, rest_uT, pool, test_uT, WAYS["rig"]),
            *estimate_inversion(known.setup, rest_uT, pool, test_uT),
        ]:
            predicted = np.column_stack([known.frame.label(place_mm), force_N])
            points.append(point(known.data, fold, predicted, method=method, pokes=given))
            times += [replace(seconds, name=f"{method}.{fold.name}")] if given == OWN else []
    return points, times


def estimate_universal(
    model: PriorModel, rest_uT: Float[np.ndarray, " ch"], pool: LabelledPresses, test_uT: Float[np.ndarray, "b ch"],
    way: str,
) -> Iterator[Estimated]:  # fmt: skip
    """Yield the estimates of the map, of the network and of both combined for the test readings.

    The model is calibrated with the skin's field at rest and the unlabelled pokes of `pool`, which may be empty.
    """
    start_s = time.process_time()
    calibrated = calibrate(model, rest_uT, pool).with_labels(0)
    ready_s = time.process_time()
    ((by_map, combined),) = estimate(calibrated, test_uT, ASSUMED)
    both_s = time.process_time()
    by_network = calibrated.evaluate_networks(test_uT)
    network_s = time.process_time()
    map_seconds = Seconds("", ready_s - start_s, (both_s - ready_s) / len(test_uT))
    # The time of the network's calibration is 0, because the network is calibrated together with the map.
    network_seconds = Seconds("", 0.0, (network_s - both_s) / len(test_uT))
    places = by_map.place_mm, by_network.place_mm, combined.place_mm
    forces = by_map.force_N, np.exp(by_network.log_N), combined.force_N
    names = [f"{name}{way}" for name in UNIVERSAL]
    yield from zip(names, places, forces, (map_seconds, network_seconds, map_seconds), strict=True)


def estimate_inversion(
    setup: Setup, rest_uT: Float[np.ndarray, " ch"], pool: LabelledPresses, test_uT: Float[np.ndarray, "b ch"]
) -> Iterator[Estimated]:
    """Yield the estimates of a physical model that is fitted to unlabelled pokes and inverted for the test readings.

    Each estimate is yielded twice: as it is, and with places shifted so that the mean place of the pokes is the board's
    middle.
    """
    start_s = time.process_time()
    known = chart(fit_unlabelled(pool.db_uT, rest_uT, setup), setup)
    ready_s = time.process_time()
    estimated = search(known, test_uT)
    seconds = Seconds("", ready_s - start_s, (time.process_time() - ready_s) / len(test_uT))
    yield INVERSION, estimated.place_mm, estimated.force_N, seconds
    middle_mm = search(known, pool.db_uT).place_mm.mean(axis=0) if len(pool.db_uT) else np.zeros(2)
    yield CENTRED, estimated.place_mm - middle_mm, estimated.force_N, seconds


def unlabelled_controls() -> dict[Key, Key]:
    """Return the control of each method that receives no pokes or the pokes of another skin.

    The control is the same method with pokes of the tested skin itself.
    """
    names = [f"{name}{way}" for way in WAYS.values() for name in UNIVERSAL]
    return {(name, given, 0): (name, OWN, 0) for name in (*names, INVERSION, CENTRED) for given in (NONE, FOREIGN)}


# --- Alarms ---

TESTED_EVERY_N = 10  # alarms are evaluated on every tenth test reading
OF_RIGHT, OF_STRANGER = "fitted to the right skin", "fitted to the foreign board itself"
ANOTHER = "another skin of the rig"
QUARTER_TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
Chips = Float[np.ndarray, "n k 3"]
# Foreign boards, by what is different. They are made from the readings of a recorded board. These readings are changed
# in the same way as a wrong plug, a wrong driver or a wrong skin would change them.
STRANGERS: Mapping[str, Callable[[Chips], Chips]] = {
    "x axis of every chip mirrored": lambda chips: chips * (-1.0, 1.0, 1.0),
    "two chips exchanged": lambda chips: chips[:, [0, 2, 1, *range(3, chips.shape[1])]],
    "every chip turned by 90 degrees": lambda chips: chips @ QUARTER_TURN,
    "all magnetic poles swapped": lambda chips: -chips,
}
ByBoard = Mapping[str, Float[np.ndarray, "_"]]  # one value per reading, by board


@dataclass(frozen=True)
class Board:
    """Readings of a board, in the axes of its chips.

    - rest_uT: field without contact.
    - pool_uT: field changes of unlabelled pokes.
    - tested_uT: field changes of the test readings.
    """

    rest_uT: Float[np.ndarray, "1 ch"]
    pool_uT: Float[np.ndarray, "m ch"]
    tested_uT: Float[np.ndarray, "b ch"]

    def alter(self, change: Callable[[Chips], Chips]) -> "Board":
        """Return the board with `change` applied to the fields of its chips."""
        fields_uT = self.rest_uT, self.pool_uT, self.tested_uT
        return Board(*(change(b_uT.reshape(len(b_uT), -1, 3)).reshape(b_uT.shape) for b_uT in fields_uT))


def evaluate_alarm(known: KnownBoards, folds: Sequence[Fold], fraction: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Evaluate the residual of the inversion as an alarm for foreign boards, and as a flag for wrong estimates.

    A physical model is fitted to the unlabelled pokes of each board's first fold. It is then inverted for test readings
    of this board and of foreign boards, which gives a residual for each reading. An alarm is raised if the residual is
    above the limit of the board. This limit is set with the readings of all other boards: a fraction `fraction` of
    their residuals is above the limit. The residuals of each of these boards are from the model that is fitted to it.
    """
    data, frame, setup = known.data, known.frame, known.setup
    first = first_folds(folds)
    boards = {}
    for board, fold in first.items():
        rest_uT = known.presses[board].recorded.noload_uT.mean(axis=0).reshape(1, -1)
        tested_uT = data.rows.db_uT[fold.test[::TESTED_EVERY_N]].astype(float)
        boards[board] = Board(rest_uT, means_uT(data, pool_rows(data, fold)), tested_uT)

    def fit_board(board: Board) -> Chart:
        return chart(fit_unlabelled(frame.field(board.pool_uT), frame.field(board.rest_uT)[0], setup), setup)

    def residual(fitted: Chart, board: Board) -> Float[np.ndarray, " b"]:
        return search(fitted, frame.field(board.tested_uT)).residual

    charts = {name: fit_board(board) for name, board in boards.items()}
    inverted = {name: search(charts[name], frame.field(board.tested_uT)) for name, board in boards.items()}
    residuals = {name: estimated.residual for name, estimated in inverted.items()}
    true_mm = {board: data.rows.target[first[board].test[::TESTED_EVERY_N], :2].astype(float) for board in boards}
    off_mm = {name: estimated.place_mm - frame.place(true_mm[name]) for name, estimated in inverted.items()}
    limits = limits_of(residuals, fraction)
    strangers: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    names = list(boards)
    for i, (board, readings) in enumerate(boards.items()):
        other = boards[names[(i + 1) % len(names)]]
        strangers.setdefault((ANOTHER, OF_RIGHT), {})[board] = residual(charts[board], other)
        for name, change in STRANGERS.items():
            stranger = readings.alter(change)
            strangers.setdefault((name, OF_RIGHT), {})[board] = residual(charts[board], stranger)
            strangers.setdefault((name, OF_STRANGER), {})[board] = residual(fit_board(stranger), stranger)
    alarm = {
        "asked_pct": 100 * fraction,
        "limit": statistic(list(limits.values()), boards=True),
        "right": alarm_statistics(residuals, residuals, limits),
        "strangers": [
            {"stranger": stranger, "law": law} | alarm_statistics(stranger_residuals, residuals, limits)
            for (stranger, law), stranger_residuals in strangers.items()
        ],
    }
    return alarm, {"method": INVERSION, "by": "residual of the inversion"} | score_flagged(residuals, off_mm, fraction)


def limits_of(value: ByBoard, fraction: float) -> dict[str, float]:
    """Return a limit for each board, which a fraction `fraction` of the readings of all other boards exceeds."""
    other_values = {board: [values for other, values in value.items() if other != board] for board in value}
    return {board: float(np.quantile(np.concatenate(values), 1 - fraction)) for board, values in other_values.items()}


def alarm_statistics(residuals: ByBoard, own_residuals: ByBoard, limits: Mapping[str, float]) -> dict[str, Any]:
    """Summarise over boards the percentage of alarms, the area under the ROC curve, and the median residual.

    `residuals` are the residuals of the evaluated readings, which are the positives of the ROC curve. `own_residuals`
    are the residuals of each board's own readings, which are the negatives.
    """
    by_board = {
        "alarm_pct": [100 * float((values > limits[board]).mean()) for board, values in residuals.items()],
        "auc": [roc_area(own_residuals[board], values) for board, values in residuals.items()],
        "left_median": [float(np.median(values)) for values in residuals.values()],
    }
    return {name: statistic(values, boards=True) for name, values in by_board.items()}


def score_flagged(value: ByBoard, off_mm: Mapping[str, Float[np.ndarray, "_ 2"]], fraction: float) -> dict[str, Any]:
    """Summarise over boards the errors of flagged readings and of all other readings.

    A reading is flagged if its `value` is above the limit of its board. Boards without flagged readings do not
    contribute to the errors of flagged readings.
    """
    scores_by_name: dict[str, list[float]] = {}
    for board, limit in limits_of(value, fraction).items():
        flagged = value[board] > limit
        scores_by_name.setdefault("flagged_pct", []).append(100 * float(flagged.mean()))
        for name, rows in (("flagged", flagged), ("others", ~flagged)):
            if rows.any():
                errors_mm = np.abs(off_mm[board][rows])
                within = (errors_mm <= ACCURACY_LIMIT_MM).all(axis=1)
                scores_by_name.setdefault(f"accuracy_pct_{name}", []).append(100 * float(within.mean()))
                scores_by_name.setdefault(f"mse_xy_mm2_{name}", []).append(float((errors_mm**2).mean()))
    return {name: statistic(values, boards=True) for name, values in scores_by_name.items()}


def flag_by_universal(
    known: KnownBoards, nominal: Variant, folds: Sequence[Fold], fraction: float
) -> list[dict[str, Any]]:
    """Score two quantities of the universal model as flags for wrong estimates.

    The quantities are the standard deviation that the model states for the place, and the misfit of its map.
    """
    sd_mm, misfit, off_mm = {}, {}, {}
    for board, fold in first_folds(folds).items():
        rows, test = known.data.rows, fold.test[::TESTED_EVERY_N]
        calibration = calibrate(nominal.model, known.presses[board].rest_uT.ravel(), pool_of(known, fold))
        ((_, combined),) = estimate(calibration.with_labels(0), known.frame.field(rows.db_uT[test]), ASSUMED)
        off_mm[board] = combined.place_mm - known.frame.place(rows.target[test, :2].astype(float))
        sd_mm[board], misfit[board] = combined.sd_mm.max(axis=1), combined.misfit
    method = METHODS[1] + WAYS["nominal"]
    by = {"standard deviation of the place": sd_mm, "misfit of the map": misfit}
    return [{"method": method, "by": name} | score_flagged(value, off_mm, fraction) for name, value in by.items()]


# --- Tables ---

DASH = "–"
# What each method can and cannot correct in principle. Whether a method helps in practice is in the table's other
# columns.
WHY = {
    "channels matched": "It corrects the gain of each channel, by equal standard deviations on both boards. It cannot "
    "correct a shifted or rotated skin, which mixes channels. Standard deviations also differ if the forces differ.",
    "CORAL": "It corrects mixed channels as well, by equal covariances on both boards. Many linear maps give these "
    "covariances, and only one of them preserves places.",
    "direct standardisation": "It uses pairs of fields at equal places. The linear map has as many unknowns as the "
    "square of the number of channels, and a shift of the skin does not change the field linearly.",
    "labels as rows": "It adds fields of the new skin to the training rows, but only at the labelled places.",
    "network, domain-adversarial": "It makes the distributions of features equal on both boards. Readings with equal "
    "features can still be from different places.",
}
BASELINES = (
    "Regressors and networks that are trained on the known boards, and tested on the held-out board. To align their "
    "inputs with the held-out board, the methods receive all unlabelled pokes of this board, or the given number of "
    "labelled pokes. Direct standardisation pairs each labelled poke with the field of the known boards at the same "
    "place and force. Labels as rows: labelled pokes are additional training rows. Paired: difference to the control, "
    "board by board. The control of a regressor is the same regressor without alignment and labels. The control of the "
    "domain-adversarial network is a network that is trained as long without the adversarial loss. The ridge penalty "
    "of direct standardisation is chosen by leave-one-out cross-validation over the pairs, because with a single "
    "training board, no other board is left for validation. No other setting was tuned."
)
UNLABELLED = (
    "No label of the held-out board is used. Column `unlabelled pokes` states whose pokes a method receives: pokes of "
    "the tested skin (its own), no pokes, or pokes of the next board (another skin's). In the last case, the method "
    "still receives the held-out board's own field at rest. Paired: difference to the same method with the skin's own "
    "pokes, board by board. Physics inversion: eight parameters of the physical model, and the place and the force of "
    "each poke, are fitted by least squares, starting from nominal parameters. The nominal stiffness and slide are "
    "typical values of recorded boards, including these boards. For each tested reading, the fitted model is then "
    "searched for the place and force that explain the reading best. Centred: places are shifted so that the mean "
    "place of the pokes is the middle of the skin; maps and networks also assume this mean. The stiffness of the model "
    "is nominal, so forces are estimated as if the skin had this stiffness."
)
ALARM = (
    "A physical model is fitted to the unlabelled pokes of a skin. Residual: |dB - simulated| / |dB| at the place and "
    "force that explain a reading best. A reading raises the alarm if its residual is above the limit, which {asked:g} "
    "% of the readings of the other boards exceed; limit {limit}. Area under the ROC curve: 0.5 is chance level, 1 is "
    "perfect. Foreign boards: recorded readings of another board, or readings of the same board whose chips are "
    "changed in software. The physical model is fitted to the right skin, or to the unlabelled pokes and the field at "
    "rest of the foreign board itself. n: number of boards; [low, high]: 95 % confidence interval over boards "
    "(Student's t; it may extend beyond the possible range)."
)
FLAGGED = (
    "Each method receives unlabelled pokes of the right skin, and no label. Flagged: readings for which the quantity "
    "in column `flagged by` is above a limit, which {asked:g} % of the readings of the other boards exceed. n: number "
    "of boards; errors of flagged readings are averaged over the boards with flagged readings. A large misfit means "
    "that dB is unlike any field change that such a skin produces. A large standard deviation means that several "
    "places give similar readings. Only the standard deviation is related to the error of the place."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate methods with aligned inputs, methods with unlabelled pokes, alarms, and errors of flagged readings."""
    unlabelled = [row for row in numbers["methods"] if row["method"].startswith(("universal", INVERSION))]
    aligned = [row for row in numbers["methods"] if row not in unlabelled]
    alarm = numbers["alarm"]
    right_row = {"stranger": "right skin (no foreign board)", "law": OF_RIGHT} | alarm["right"]
    unpaired = f" {numbers['unpaired_n']} labelled pokes had no pair." if numbers["unpaired_n"] else ""
    return {
        "rivals": tabulate(
            [_line(row, source) | {"what it can and cannot correct": _why(row["method"])} for row in aligned],
            meaning=BASELINES + unpaired,
        ),
        "rivals_told": tabulate([_line(row, source) for row in unlabelled], meaning=UNLABELLED),
        "rivals_alarm": tabulate(
            [
                {
                    "readings of": row["stranger"],
                    "physical model": row["law"],
                    "alarm, % of readings": show(row["alarm_pct"]),
                    "area under the ROC curve": show(row["auc"]),
                    "median residual": show(row["left_median"]),
                    "n": str(row["auc"]["n"]),
                    "source": source,
                }
                for row in (right_row, *alarm["strangers"])
            ],
            meaning=ALARM.format(asked=alarm["asked_pct"], limit=show(alarm["limit"])),
        ),
        "rivals_flagged": tabulate(
            [_flagged_line(row, source) for row in numbers["flagged"]],
            meaning=FLAGGED.format(asked=alarm["asked_pct"]),
        ),
    }


def _line(row: Mapping[str, Any], source: str) -> dict[str, str]:
    places = {metric: f"{title} (registered)" for metric, title in COLUMNS.items() if metric not in FORCE_METRICS}
    line = {"method": row["method"], "unlabelled pokes": row["pokes"], "labels": str(row["labels_n"]), "source": source}
    line |= scores(row["as_labelled"]) | scores(row["registered"], places)
    over = row.get("over", {})
    differences = {"paired, accuracy, points": "accuracy_pct", "paired, MSE_xy, mm²": "mse_xy_mm2"}
    line |= {title: show_difference(over.get(name)) for title, name in differences.items()}
    return line | {"n": n_of(row["as_labelled"])}


def _why(method: str) -> str:
    return next((reason for name, reason in WHY.items() if method.endswith(name)), DASH)


def _flagged_line(row: Mapping[str, Any], source: str) -> dict[str, str]:
    line = {"method": row["method"], "flagged by": row["by"], "flagged, %": show(row["flagged_pct"])}
    for metric in ("accuracy_pct", "mse_xy_mm2"):
        for name, readings in (("flagged", "flagged"), ("others", "all others")):
            line[f"{COLUMNS[metric]} ({readings})"] = show(row.get(f"{metric}_{name}"))
    return line | {"n": str(row["flagged_pct"]["n"]), "source": source}
