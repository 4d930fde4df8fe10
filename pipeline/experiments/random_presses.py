"""The universal model on recorded boards, calibrated to presses at random places and tested at other places.

The unlabelled presses of a held-out board are drawn at random from all places and forces. The model receives their
field changes, but not their places. The places of the board are divided into two parts. Labels, which are presses with
known places and forces, are drawn at random from one part, and all tested presses are in the other part. The experiment
also tests the calibration with one known weight. The only label is then a press in the middle of the skin, as if a user
had put the weight there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int64
from pydantic import Field
from scipy.spatial import cKDTree

from pipeline.experiments.results import write_results
from pipeline.formatting import show, tabulate
from pipeline.settings import Settings
from pipeline.stage import say
from pipeline.statistics import statistic
from pipeline.training.recorded import RecordedBoards, read_boards
from pipeline.training.shipping import coverage
from reskin.config import Strict
from reskin.errors import SchemaError
from reskin.metrics import ACCURACY_LIMIT_MM, interval_score
from reskin.seeds import rng_for
from reskin.universal.calibration import (
    CalibrationData,
    LabelledPresses,
    LikelihoodPowers,
    lower_by_misfit,
    lower_by_residuals,
    variance_inflations,
)
from reskin.universal.force import NORMAL_90, ForceLine, prior_line
from reskin.universal.map import FORCES_N, Estimate, new_map
from reskin.universal.model import (
    Evaluation,
    HeldOutLabels,
    PressCalibration,
    PriorModel,
    line_of_labels,
    load_universal,
)

SPACING_MM = 2.0  # a press belongs to the nearest place of a grid with this spacing
MIDDLE_MM = 1.0  # a press is in the middle of the skin if |x| and |y| are below this
# The two ways to divide the places into a part for labels and a part for tests. Either the places are coloured like the
# squares of a checkerboard, labels are at places of one colour, and tests are at places of the other colour. Or labels
# are on one half of the skin, and tests are on the other half. Each name says where the tested presses are.
CHECKERBOARD, HALVES = "places without labels (checkerboard)", "half of the skin without labels"
# Names of the random streams. They are earlier names of the two ways, which are kept so that results do not change.
STREAMS = {CHECKERBOARD: "other colour of a checkerboard", HALVES: "other half of the skin"}
WAYS = {"rig": "boards of the rig", "nominal": "simulated alone"}
FORCE_MIN_N = float(FORCES_N[0])  # labelled presses with smaller forces are set to this force
WEIGHT = "weight"
NEAREST = "nearest label"


class Variants(NamedTuple):
    """The shipped model, and for each held-out board the model that was made from the other boards."""

    nominal: PriorModel
    rig: Mapping[str, PriorModel]


class RandomPresses(Strict):
    """Settings section `random_presses`: numbers of unlabelled presses, numbers of labels, and number of draws."""

    presses_n: Annotated[tuple[Annotated[int, Field(ge=1, le=65)], ...], Field(min_length=1)]
    labels_n: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    draws_n: Annotated[int, Field(ge=1)]


@dataclass(frozen=True)
class BoardPresses:
    """The presses of one recorded board and all their readings, in the coordinates of the board.

    - rest_uT: field without contact.
    - presses: the presses, each as the mean over its readings.
    - readings: the readings of all presses.
    - press_i: index of the press to which each reading belongs.
    """

    board: str
    rest_uT: Float[np.ndarray, " ch"]
    presses: LabelledPresses
    readings: LabelledPresses
    press_i: Int64[np.ndarray, " f"]

    @property
    def middle(self) -> Bool[np.ndarray, " m"]:
        """Whether each press is in the middle of the skin."""
        return (np.abs(self.presses.place_mm) < MIDDLE_MM).all(axis=1)

    def part(self, split: str, draw_i: int) -> Int64[np.ndarray, " m"]:
        """Return the part of the skin to which each press belongs.

        The value is 1 in the part for labels, -1 in the part for tests, and 0 for presses on the line between two
        halves. From one draw to the next, the two parts are exchanged.
        """
        if split == CHECKERBOARD:
            colour = np.rint(self.presses.place_mm / SPACING_MM).astype(int).sum(axis=1) % 2
            return np.array((-1) ** (colour + draw_i))
        along_mm = self.presses.place_mm[:, draw_i // 2 % 2] * (-1) ** draw_i
        return np.where(np.abs(along_mm) < SPACING_MM / 2, 0, np.sign(along_mm)).astype(int)


@dataclass(frozen=True)
class Draw:
    """A random selection of a board's presses.

    - unlabelled: indices of the unlabelled presses.
    - labels: indices of the presses that may be labels, in random order.
    - weight: index of the press that serves as the press of the known weight.
    - tested: indices of the tested readings.
    """

    unlabelled: Int64[np.ndarray, " n"]
    labels: Int64[np.ndarray, " m"]
    weight: Int64[np.ndarray, "1"]
    tested: Int64[np.ndarray, " t"]


def random_presses(settings: Settings, section: RandomPresses, indentations: Path, models: Path, results: Path) -> None:
    """Score the universal model on every held-out board, with presses and labels at random places."""
    known, shipped = read_boards(settings, indentations), load_universal()
    rig = {board: load_universal(file=models / f"{board}.safetensors") for board in known.presses}
    powers, (nominal, *of_rig) = (
        shipped.powers,
        [PriorModel(new_map(model.tables, model.residual), model.networks) for model in (shipped, *rig.values())],
    )
    variants = Variants(nominal, dict(zip(rig, of_rig, strict=True)))
    rows: list[dict[str, Any]] = []
    for board in known.presses:
        presses = board_presses(known, board)
        for draw_i in range(section.draws_n):
            rows += score_draw(presses, variants, powers, section, settings.seed, draw_i)
        say(f"{settings.scene} random_presses: scored board {board}")
    write_results(results, {"rows": summarise_rows(rows), "draws_n": section.draws_n}, {})


def mean_by(group: Int64[np.ndarray, " f"], values: Float[np.ndarray, "f c"]) -> Float[np.ndarray, "m c"]:
    """Average rows with equal group numbers, which are counted from 0."""
    sums = np.stack([np.bincount(group, column) for column in values.T.astype(float)], axis=1)
    return sums / np.bincount(group)[:, None]


def board_presses(known: RecordedBoards, board: str) -> BoardPresses:
    """Return the presses of a board that have a force."""
    rows, frame = known.rows, known.axes
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))
    press_i = np.unique(rows.indentation[own], return_inverse=True)[1]
    place_mm, force_N = frame.place(rows.target[own, :2].astype(float)), rows.target[own, 2].astype(float)
    readings = LabelledPresses(place_mm, force_N, frame.field(rows.db_uT[own]))

    mean_force_N = mean_by(press_i, force_N[:, None])[:, 0]
    presses = LabelledPresses(mean_by(press_i, place_mm), mean_force_N, mean_by(press_i, readings.db_uT))
    return BoardPresses(board, known.presses[board].rest_uT.ravel(), presses, readings, press_i)


def draw_presses(board: BoardPresses, split: str, presses_n: int, seed: int, draw_i: int) -> Draw:
    """Draw unlabelled presses, labels and the press of known weight at random.

    The tested presses are all other presses in the part of the skin without labels, except those in the middle. Raises
    SchemaError if no press is in the middle of the skin, or if no press is left for labels or for tests.
    """
    rng = rng_for(seed, "random presses", STREAMS[split], presses_n, draw_i)
    n, middle = len(board.presses), np.flatnonzero(board.middle)
    if not len(middle):
        raise SchemaError(
            f"random_presses: board {board.board} has no press within {MIDDLE_MM:g} mm of the middle. "
            "Remove random_presses from the scene."
        )
    unlabelled, weight = rng.permutation(n)[:presses_n], rng.choice(middle, 1)
    part = board.part(split, draw_i)
    tested = (part == -1) & ~board.middle & ~np.isin(np.arange(n), [*unlabelled, *weight])
    if not tested.any() or not (part == 1).any():
        raise SchemaError(
            f"random_presses: board {board.board} has too few presses ({n}): none is left for labels or for tests. "
            "Remove random_presses from the scene."
        )
    return Draw(unlabelled, rng.permutation(np.flatnonzero(part == 1)), weight, np.flatnonzero(tested[board.press_i]))


def score_draw(
    board: BoardPresses, variants: Variants, powers: LikelihoodPowers, section: RandomPresses, seed: int, draw_i: int
) -> list[dict[str, Any]]:
    """Score two variants of the universal model, and the reference method, for each split and number of presses.

    One variant is trained on simulated skins alone, and the other is also trained on the other boards of the rig. For
    each split and each number of unlabelled presses, one random selection of presses is used.
    """
    rows = []
    most_n = max(section.presses_n)
    for split in (CHECKERBOARD, HALVES):
        for presses_n in section.presses_n if split == CHECKERBOARD else (most_n,):
            draw = draw_presses(board, split, presses_n, seed, draw_i)
            tested = board.readings[draw.tested]
            where = {"board": board.board, "tested": split, "presses_n": presses_n, "draw_i": draw_i}
            for way, variant in {"rig": variants.rig[board.board], "nominal": variants.nominal}.items():
                model = calibrate(variant, board, draw)
                for labels, name in label_sets(board, draw, section.labels_n if presses_n == most_n else (0,)):
                    scored = model.score(labels, tested, powers, presses_n)
                    rows.append(where | {"method": f"universal, {WAYS[way]}", "labels": name} | scored)
            for labels, name in label_sets(board, draw, section.labels_n if presses_n == most_n else ()):
                if len(labels) and name != WEIGHT:
                    rows.append(where | {"method": NEAREST, "labels": name} | score_nearest(labels, tested))
    return rows


def label_sets(board: BoardPresses, draw: Draw, labels_n: Sequence[int]) -> list[tuple[LabelledPresses, str]]:
    """Return the sets of labels to which the model is calibrated, each with its name.

    There is one set for each number of labels. If one of these numbers is 0, the set with only the known weight follows
    it.
    """
    if max(labels_n, default=0) > len(draw.labels):
        what = f"board {board.board} has {len(draw.labels)} presses for labels, but labels_n asks for {max(labels_n)}"
        raise SchemaError(f"random_presses: {what}. Reduce random_presses.labels_n in the scene.")
    sets = []
    for n in labels_n:
        sets.append((raise_forces(board.presses[draw.labels[:n]]), str(n)))
        if n == 0:
            sets.append((raise_forces(board.presses[draw.weight]), WEIGHT))
    return sets


def raise_forces(labels: LabelledPresses) -> LabelledPresses:
    """Replace forces below the smallest force of the map by this smallest force."""
    return replace(labels, force_N=np.maximum(labels.force_N, FORCE_MIN_N))


@dataclass(frozen=True)
class CalibratedBoard:
    """A variant of the universal model, calibrated to a board's no-load field and unlabelled presses.

    `misfit` is the median misfit of the unlabelled presses, which tells how well the variant explains this board.
    """

    calibration: PressCalibration
    misfit: float

    def score(
        self, labels: LabelledPresses, tested: LabelledPresses, powers: LikelihoodPowers, presses_n: int
    ) -> dict[str, float]:
        """Calibrate to labels and score the tested readings, both with calibrated and with uncalibrated forces."""
        folds, power = self._held_out(labels, powers, presses_n)
        model = self.calibration.with_labels(labels)
        line = line_of_labels(folds)

        def with_and_without_line(evaluation: Evaluation) -> list[Estimate]:
            raw = replace(evaluation, line=prior_line(), few=None)
            return [replace(evaluation, line=line).combined(power), raw.combined(power)]

        calibrated, raw = model.estimate_by(with_and_without_line, tested.db_uT)
        log_N, _ = line_of_combined(folds).apply(np.log(raw.force_N))
        scores = score_estimate(calibrated, tested)
        return scores | {"r2_line_f": r2(np.exp(log_N), tested.force_N), "r2_raw_f": r2(raw.force_N, tested.force_N)}

    def estimate(
        self, labels: LabelledPresses, db_uT: Float[np.ndarray, "t ch"], powers: LikelihoodPowers, presses_n: int
    ) -> Estimate:
        """Calibrate to labels and estimate places and forces of readings."""
        folds, power = self._held_out(labels, powers, presses_n)
        model = replace(self.calibration.with_labels(labels), line=line_of_labels(folds))
        return model.estimate(db_uT, [power])[0]

    def _held_out(
        self, labels: LabelledPresses, powers: LikelihoodPowers, presses_n: int
    ) -> tuple[list[HeldOutLabels], float]:
        """Evaluate the labels by cross-validation; return the result, and the likelihood power that follows from it.

        The likelihood power is an exponent of the likelihood; a smaller power gives wider intervals.
        """
        folds = list(self.calibration.held_out(labels))
        power = lower_by_misfit(powers.power_for(presses_n, len(labels), even=False), self.misfit)
        held_out = [([fold.evaluation.combined(power)], fold.labels.place_mm) for fold in folds]
        return folds, lower_by_residuals(power, *variance_inflations(1, held_out))


def line_of_combined(folds: Sequence[HeldOutLabels]) -> ForceLine:
    """Fit the calibration line to the combined force estimates, without selecting one estimator."""
    if not folds:
        return prior_line()
    log_N = np.concatenate([fold.evaluation.log_forces()[0] for fold in folds])
    return prior_line().condition(log_N, np.log(np.concatenate([fold.labels.force_N for fold in folds])))


def calibrate(model: PriorModel, board: BoardPresses, draw: Draw) -> CalibratedBoard:
    """Calibrate a variant to the no-load field and the unlabelled presses."""
    db_uT = board.presses.db_uT[draw.unlabelled]
    return calibrate_board(model, CalibrationData(board.rest_uT, db_uT, area_uT=db_uT))


def calibrate_board(model: PriorModel, data: CalibrationData) -> CalibratedBoard:
    """Calibrate a variant to the data of a board, and compute the median misfit of its unlabelled presses."""
    calibration = model.calibrate(data)
    return CalibratedBoard(calibration, float(np.median(calibration.skin.evaluator.evaluate(data.presses_uT).misfit())))


def score_nearest(labels: LabelledPresses, tested: LabelledPresses) -> dict[str, float]:
    """Score the reference method: place and force of the label with the most similar field change.

    Two field changes are similar if their features have a small Euclidean distance. The features are the direction of
    the field change, and the logarithm of its magnitude. `r2_line_f` is the R² of a constant prediction, which is the
    mean force of the labels.
    """
    magnitude_uT = [np.linalg.norm(part.db_uT, axis=1, keepdims=True) for part in (labels, tested)]
    pairs = zip((labels, tested), magnitude_uT, strict=True)
    features = [np.hstack([part.db_uT / length_uT, np.log(length_uT)]) for part, length_uT in pairs]
    nearest = cKDTree(features[0]).query(features[1])[1]
    error_mm = labels.place_mm[nearest] - tested.place_mm
    constant = np.full(len(tested), labels.force_N.mean())
    scores = place_scores(error_mm) | force_scores(labels.force_N[nearest], tested.force_N)
    return scores | {"r2_line_f": r2(constant, tested.force_N)}


def place_scores(error_mm: Float[np.ndarray, "t 2"]) -> dict[str, float]:
    """Return scores of places from their errors."""
    return {
        "accuracy_pct": 100 * float((np.abs(error_mm) <= ACCURACY_LIMIT_MM).all(axis=1).mean()),
        "median_mm": float(np.median(np.linalg.norm(error_mm, axis=1))),
        "mse_xy_mm2": float((error_mm**2).mean()),
    }


def force_scores(force_N: Float[np.ndarray, " t"], true_N: Float[np.ndarray, " t"]) -> dict[str, float]:
    """Return scores of forces."""
    error_N = force_N - true_N
    return {
        "r2_f": r2(force_N, true_N),
        "mse_f_N2": float((error_N**2).mean()),
        "median_error_N": float(np.median(np.abs(error_N))),
    }


def score_estimate(estimate: Estimate, tested: LabelledPresses) -> dict[str, float]:
    """Score estimates of tested readings, with coverage and interval score of their 90 % intervals."""
    error_mm, half_width_mm = estimate.place_mm - tested.place_mm, NORMAL_90 * estimate.sd_mm
    error_log = np.log(estimate.force_N / tested.force_N)
    scores = place_scores(error_mm) | force_scores(estimate.force_N, tested.force_N)
    return scores | {
        "coverage_pct": 100 * coverage(estimate, tested.place_mm),
        "interval_score_mm": interval_score(error_mm, -half_width_mm, half_width_mm),
        "half_width_mm": NORMAL_90 * float(np.median(estimate.sd_mm)),
        "coverage_f_pct": 100 * float((np.abs(error_log) <= NORMAL_90 * estimate.sd_log_N).mean()),
        "half_width_f_factor": float(np.exp(NORMAL_90 * np.median(estimate.sd_log_N))),
    }


def r2(force_N: Float[np.ndarray, " t"], true_N: Float[np.ndarray, " t"]) -> float:
    """Return the coefficient of determination of forces."""
    var = float(true_N.var())
    return 1 - float(((force_N - true_N) ** 2).mean()) / var if var else float("nan")


GROUP = ("tested", "presses_n", "method", "labels")


def summarise_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Average the scores over draws, then summarise them over boards."""
    frame = pd.DataFrame(rows)
    metrics = [str(name) for name in frame if name not in (*GROUP, "board", "draw_i")]
    summary: list[dict[str, Any]] = []
    for key, group in frame.groupby(list(GROUP), sort=False):
        by_board = group.groupby("board")[metrics].mean()
        known = [name for name in metrics if by_board[name].notna().all()]
        scores: dict[str, Any] = {name: statistic(by_board[name].to_numpy(), boards=True) for name in known}
        summary.append({**dict(zip(GROUP, key, strict=True)), **scores})
    return summary


TITLES = {
    "accuracy_pct": "within 1 mm, %", "median_mm": "median error, mm", "mse_xy_mm2": "MSE_xy, mm²", "r2_f": "R² of F",
    "mse_f_N2": "MSE_F, N²", "median_error_N": "median error of force, N",
    "coverage_pct": "place in 90 % interval, %", "half_width_mm": "half-width of the interval, mm",
    "interval_score_mm": "interval score, mm", "coverage_f_pct": "force in 90 % interval, %",
    "half_width_f_factor": "half-width of the force's interval, factor", "r2_line_f": "R² of F, always with line",
    "r2_raw_f": "R² of F, without line",
}  # fmt: skip
MEANING = (
    "Each number is the mean over {draws_n} random draws of presses and labels, then over boards; (a; b) are the "
    "values of the boards. The model is calibrated to unlabelled presses at random places and forces. The places of a "
    "board are divided into two parts: either they are coloured like the squares of a checkerboard, and each colour is "
    "one part, or each half of the skin is one part. Labels are drawn from one part. The tested presses are in the "
    "other part, and were not used for the calibration. Choices that were made on these boards are listed in "
    "docs/learning.md. Label `weight`: the only label is one press with a known force in the middle of the skin, where "
    "no press is tested. The model estimates the force with a map of simulated fields and with networks, and corrects "
    "this force with a calibration line, which is fitted to the labels. Cross-validation over the labels selects how "
    "the force is corrected. Two columns show R² for fixed choices: for `always with line`, a line corrects the "
    "combined force of map and networks; for `without line`, this combined force is not corrected. In rows `nearest "
    "label`, `always with line` is the R² of a constant, which is the mean force of the labels."
)


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate the scores for each split, number of presses, method and number of labels."""
    lines = []
    for row in numbers["rows"]:
        line = {"tested places": row["tested"], "unlabelled presses": row["presses_n"]}
        line |= {name: row[name] for name in ("method", "labels")}
        scores = {title: show(row[name]) if name in row else "–" for name, title in TITLES.items()}
        lines.append(line | scores | {"source": source})
    return {"random_presses": tabulate(lines, meaning=MEANING.format(draws_n=numbers["draws_n"]))}
