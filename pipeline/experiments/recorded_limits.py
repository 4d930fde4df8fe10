"""Three limits of the recorded boards: rigid registration, shear force, and the smallest detected force.

- *Registration*: a model that was trained on one board estimates places on another board. A few presses at known
  places on this other board determine a rotation and a shift that correct the estimates. This is the procedure that was
  published for skins that are mounted again. The corrected estimates are scored on other presses of the same board.
- *Shear*: how much of the recorded sideways force can be estimated from the field.
- *Detection*: the smallest field change, and the smallest force, that can be distinguished from no-load readings
  (readings without contact).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Float32, Int64
from pydantic import Field
from scipy.spatial.distance import pdist

from pipeline.experiments.detection import thresholds
from pipeline.experiments.known_boards import read_known_boards
from pipeline.experiments.random_presses import (
    SPACING_MM,
    BoardPresses,
    board_presses,
    mean_by,
    place_scores,
    raise_forces,
)
from pipeline.experiments.results import read_captures, write_results
from pipeline.formatting import show, show_digits, tabulate
from pipeline.plot import COLOURS, drawing, svg
from pipeline.settings import Row, SectionWithRows, Settings
from pipeline.stage import say
from pipeline.statistics import DECIMALS, statistic
from pipeline.training.universal import WAYS
from pipeline.training.universal_variants import KnownBoards, Variants, read_variants
from reskin.data.contact import CONTACT_SDS
from reskin.data.rows import SHEAR_TARGETS, Rows, Selection, gather
from reskin.errors import SchemaError
from reskin.models.classical import Classical, fit
from reskin.models.inputs import VIEW
from reskin.models.recipe import Name
from reskin.models.trained import networks_held_out
from reskin.recordings.fault_policy import FaultPolicy
from reskin.recordings.ingest import read_header
from reskin.recordings.readers import lab
from reskin.schema import Readings
from reskin.seeds import rng_for
from reskin.universal.calibration import CalibrationData, no_labels
from reskin.universal.model import CalibratedModel, PriorModel

Fraction = Annotated[float, Field(gt=0, lt=1)]


class RecordedLimits(SectionWithRows):
    """Settings section `recorded_limits`.

    - known_n: number of presses at known places in each random draw.
    - presses_n: number of unlabelled presses in each random draw.
    - draws_n: number of random draws of these presses.
    - methods: regressors that are trained on the other boards.
    - folds_n: number of folds in the cross-validation over places.
    - false_alarm_fraction: fraction of the no-load readings that may be above the threshold of detection.
    - detected_fraction: a force counts as detected if at least this fraction of the readings in contact are above the
      threshold.
    """

    known_n: Annotated[int, Field(ge=2)]
    presses_n: Annotated[int, Field(ge=1, le=65)]
    draws_n: Annotated[int, Field(ge=2)]
    methods: dict[Name, Classical]
    folds_n: Annotated[int, Field(ge=2)]
    false_alarm_fraction: Fraction
    detected_fraction: Fraction

    @classmethod
    def expand(cls, section: Row, settings: Settings, where: str) -> Row:
        return section | {"methods": settings.row("methods", section, "methods", where)}


def recorded_limits(
    settings: Settings,
    section: RecordedLimits,
    indentations: Path,
    raw: Path,
    folds: Path,
    networks: Path,
    models: Path,
    results: Path,
) -> None:
    """Compute the three limits of a scene's recorded boards (see the module's docstring), and write the results."""
    known = read_known_boards(settings, indentations, folds)
    captures = read_captures(indentations, tuple(settings.captures_in(indentations)))
    policy = settings.shared_section(FaultPolicy, "faults")
    recordings = [read_recording(readings, raw / readings.capture, policy) for readings in captures]
    detection, drawn = evaluate_detection(recordings, section)
    say(f"{settings.scene} recorded_limits: computed the thresholds of detection")
    rows = gather(captures, settings.section(Selection, "selection"), targets=SHEAR_TARGETS)
    shear = evaluate_shear(rows, section, settings.seed)
    say(f"{settings.scene} recorded_limits: scored the estimates of shear force")
    variants = read_variants(known, models)
    scores: list[dict[str, Any]] = []
    for board in known.presses:
        regressors = predict_by_regressors(known, board, section.methods, networks)
        for draw_i in range(section.draws_n):
            scores += score_draw(board_presses(known, board), regressors, variants, section, settings.seed, draw_i)
        say(f"{settings.scene} recorded_limits: scored the registration of board {board}")
    settings_used = {
        name: getattr(section, name)
        for name in ("known_n", "presses_n", "draws_n", "folds_n", "false_alarm_fraction", "detected_fraction")
    }
    registration = {"rows": summarise_draws(scores), "seed": settings.seed}
    numbers = {"registration": registration, "shear": shear, "detection": detection} | settings_used
    write_results(results, numbers, drawn)


def number_places(place_mm: Float[np.ndarray, "m 2"]) -> Int64[np.ndarray, " m"]:
    """Assign a number to the place of each press, starting at 0.

    Places are rounded to a grid with spacing `SPACING_MM`. Presses at the same point of this grid get the same number.
    """
    return np.unique(np.rint(place_mm / SPACING_MM), axis=0, return_inverse=True)[1].ravel()


# --- Rigid registration with presses at known places ---

# Number of random sets of places that are drawn. Of these sets, the one whose two closest places are furthest apart is
# used.
CANDIDATES_N = 100
# Names of the ways in which the presses at known places are used.
UNCHANGED, SHIFT, RIGID, LABELS = "not used", "shift only", "rigid registration", "as labels of the model"
NETWORK = "network of the paper, other board"


@dataclass(frozen=True)
class RigidMotion:
    """A rotation about the middle of the skin, followed by a shift."""

    rotation: Float[np.ndarray, "2 2"]
    shift_mm: Float[np.ndarray, "2"]

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation, positive from x to y."""
        return float(np.degrees(np.arctan2(self.rotation[1, 0], self.rotation[0, 0])))

    def apply(self, place_mm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return the places after the rotation and the shift."""
        return place_mm @ self.rotation.T + self.shift_mm


def fit_shift(from_mm: Float[np.ndarray, "m 2"], to_mm: Float[np.ndarray, "m 2"]) -> RigidMotion:
    """Fit a shift without rotation, which is the mean difference between `to_mm` and `from_mm`."""
    return RigidMotion(np.eye(2), (to_mm - from_mm).mean(axis=0))


def fit_rigid(from_mm: Float[np.ndarray, "m 2"], to_mm: Float[np.ndarray, "m 2"]) -> RigidMotion:
    """Fit a rotation and a shift that move the places `from_mm` as close as possible to the places `to_mm`.

    The sum of squared distances is minimised by Kabsch's algorithm. Reflections are excluded.
    """
    from_middle_mm, to_middle_mm = from_mm.mean(axis=0), to_mm.mean(axis=0)
    left, _, right = np.linalg.svd((to_mm - to_middle_mm).T @ (from_mm - from_middle_mm))
    rotation = left @ np.diag([1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return RigidMotion(rotation, to_middle_mm - rotation @ from_middle_mm)


@dataclass(frozen=True)
class Draw:
    """A random division of a board's presses into three sets.

    - known: indices of the presses at known places.
    - unlabelled: indices of the presses that the model receives without places and forces.
    - tested: indices of the readings on which the estimates are scored.
    """

    known: Int64[np.ndarray, " k"]
    unlabelled: Int64[np.ndarray, " n"]
    tested: Int64[np.ndarray, " t"]


def draw_presses(board: BoardPresses, section: RecordedLimits, seed: int, draw_i: int) -> Draw:
    """Draw presses at known places that are far from each other, and unlabelled presses anywhere on the skin.

    All other presses are tested, except those at one of the known places. Raises SchemaError if the board has too few
    presses.
    """
    rng = rng_for(seed, "recorded limits", "known presses", board.board, draw_i)
    place_i = number_places(board.presses.place_mm)
    places_n, n = int(place_i.max()) + 1, len(board.presses)
    if places_n <= section.known_n or n <= section.presses_n:
        needed = f"more than {section.presses_n} presses at more than {section.known_n} places are needed"
        what = f"board {board.board} has {n} presses at {places_n} places, but {needed}"
        raise SchemaError(f"recorded_limits: {what}. Reduce presses_n or known_n of recorded_limits in the scene.")
    place_mm = mean_by(place_i, board.presses.place_mm)
    candidates = [rng.permutation(places_n)[: section.known_n] for _ in range(CANDIDATES_N)]
    chosen = max(candidates, key=lambda places: float(pdist(place_mm[places]).min()))
    known = np.array([rng.choice(np.flatnonzero(place_i == i)) for i in chosen])
    unlabelled = rng.permutation(n)[: section.presses_n]
    tested = ~np.isin(place_i, chosen) & ~np.isin(np.arange(n), unlabelled)
    return Draw(known, unlabelled, np.flatnonzero(tested[board.press_i]))


class Predictions(NamedTuple):
    """Places that one method predicts for all readings of a board, in the board's coordinates.

    A method may have several models (for example, networks with different seeds); `place_mm` has one array per model.
    """

    method: str
    place_mm: Sequence[Float[np.ndarray, "f 2"]]


def predict_by_regressors(
    known: KnownBoards, board: str, methods: Mapping[str, Classical], networks: Path
) -> list[Predictions]:
    """Predict the places of a board's presses by models that were trained on the other boards.

    The models are the networks of stage train_multi, one per seed, and the regressors `methods`.
    """
    data, rows = known.data, known.data.rows
    own = np.flatnonzero((rows.board == board) & (rows.target[:, 2] > 0))  # the same rows as in `board_presses`
    others = np.flatnonzero(rows.board != board)

    def places(predicted: Float32[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 2"]:
        return known.frame.place(predicted[:, :2].astype(float))

    trained = networks_held_out(networks, board)
    predictions = [Predictions(NETWORK, [places(network(rows.db_uT[own])) for network in trained])]
    for method in methods.values():
        name, view = f"{method.title} ({method.inputs}), other board", VIEW[method.inputs]
        rng = rng_for(data.settings.seed, "recorded limits", name, board)
        fitted = fit(method, view(rows.db_uT[others]), rows.target[others], rng, weight=None)
        predictions.append(Predictions(name, [places(fitted.predict(view(rows.db_uT[own])))]))
    return predictions


def score_draw(
    board: BoardPresses,
    regressors: Sequence[Predictions],
    variants: Variants,
    section: RecordedLimits,
    seed: int,
    draw_i: int,
) -> list[dict[str, Any]]:
    """Score the estimated places of all methods for one draw, with and without use of the presses at known places."""
    draw = draw_presses(board, section, seed, draw_i)
    true_mm, known_mm = board.readings.place_mm[draw.tested], board.presses.place_mm[draw.known]
    where = {"board": board.board, "draw_i": draw_i}
    rows = []
    for method, predictions in regressors:
        for place_mm in predictions:
            keys = where | {"method": method, "presses_n": 0}
            estimated_mm = mean_by(board.press_i, place_mm)[draw.known]
            rows += [keys | scores for scores in score_motions(place_mm[draw.tested], true_mm, estimated_mm, known_mm)]
    for way, variant in {"rig": variants.rig[board.board], "nominal": variants.nominal}.items():
        for unlabelled in (draw.unlabelled[:0], draw.unlabelled):
            keys = where | {"method": f"universal, {WAYS[way]}", "presses_n": len(unlabelled)}
            rows += [keys | scores for scores in score_universal(variant.model, board, draw, unlabelled)]
    return rows


def score_universal(
    model: PriorModel, board: BoardPresses, draw: Draw, unlabelled: Int64[np.ndarray, " n"]
) -> list[dict[str, Any]]:
    """Score the universal model in four ways of using the presses at known places.

    The four ways are: the presses are not used; a shift of the estimated places is fitted to them; a rotation and a
    shift of the estimated places are fitted to them; and the model is conditioned on them as labels.
    """
    true_mm, tested_uT = board.readings.place_mm[draw.tested], board.readings.db_uT[draw.tested]
    known, presses_uT = raise_forces(board.presses[draw.known]), board.presses.db_uT[unlabelled]
    calibration = model.calibrate(CalibrationData(board.rest_uT, presses_uT, area_uT=presses_uT))
    without, labelled = calibration.with_labels(no_labels()), calibration.with_labels(known)
    estimated_mm = estimate_places(without, known.db_uT)
    scores = score_motions(estimate_places(without, tested_uT), true_mm, estimated_mm, known.place_mm)
    error_mm = estimate_places(labelled, tested_uT) - true_mm
    return [*scores, {"known": LABELS} | place_scores(error_mm)]


def estimate_places(model: CalibratedModel, db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n 2"]:
    """Estimate places with the universal model.

    The model requires a likelihood power (an exponent that widens or narrows its distribution of places). We pass 1.0,
    because the estimates themselves do not depend on this power.
    """
    return model.estimate(db_uT, [1.0])[0].place_mm


def score_motions(
    place_mm: Float[np.ndarray, "t 2"],
    true_mm: Float[np.ndarray, "t 2"],
    estimated_mm: Float[np.ndarray, "k 2"],
    known_mm: Float[np.ndarray, "k 2"],
) -> list[dict[str, Any]]:
    """Score the estimated places of the tested readings, before and after they are moved by a shift or a rigid motion.

    The motions are fitted to the presses at known places: they move the estimated places `estimated_mm` of these
    presses to the known places `known_mm`. The score `rigid_limit_mm2` is the smallest mean squared error that any
    rigid motion can reach. It is computed by fitting a motion to the tested readings themselves.
    """
    best_mm = fit_rigid(place_mm, true_mm).apply(place_mm)
    limit = {"rigid_limit_mm2": float(((best_mm - true_mm) ** 2).mean())}
    rows: list[dict[str, Any]] = [{"known": UNCHANGED} | place_scores(place_mm - true_mm) | limit]
    for name, fit_motion in {SHIFT: fit_shift, RIGID: fit_rigid}.items():
        motion = fit_motion(estimated_mm, known_mm)
        size = {"shift_mm": float(np.linalg.norm(motion.shift_mm))}
        size |= {"angle_deg": abs(motion.angle_deg)} if name == RIGID else {}
        rows.append({"known": name} | place_scores(motion.apply(place_mm) - true_mm) | size)
    return rows


GROUP = ("method", "presses_n", "known")


def summarise_draws(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Average scores over models and draws, then compute statistics over boards.

    `sd_draws_pct` is the standard deviation of the accuracy over draws, averaged over boards.
    """
    frame = pd.DataFrame(rows)
    metrics = [str(name) for name in frame if name not in (*GROUP, "board", "draw_i")]
    summary: list[dict[str, Any]] = []
    for key, group in frame.groupby(list(GROUP), sort=False):
        by_draw = group.groupby(["board", "draw_i"])[metrics].mean()
        by_board = by_draw.groupby("board").mean()
        scores: dict[str, Any] = {
            name: statistic(by_board[name].to_numpy(), boards=True) for name in metrics if by_board[name].notna().all()
        }
        scores["sd_draws_pct"] = {"mean": float(by_draw["accuracy_pct"].groupby("board").std().mean())}
        summary.append({**dict(zip(GROUP, key, strict=True)), **scores})
    return summary


# --- Shear force ---

FX, FY, FZ = "Fx", "Fy", "Fz"
FORCES = (FX, FY, FZ)
FIELD, PLACE_AND_FORCE, CONSTANT = "field change", "true place and normal force", "none (mean of the training presses)"
OTHER_BOARD, OTHER_PLACES = "other board", "other places of the same board"


@dataclass(frozen=True)
class ForcePresses:
    """The presses of all boards, with one row per press; values are means over the readings of the press.

    - board, capture: board and capture (recorded file) that contain the press.
    - place_mm: place, as labelled in the recording.
    - force_N: components Fx, Fy and Fz of the force on the skin.
    - sd_N: standard deviation of each force component over the readings of the press.
    - db_uT: field change.
    """

    board: np.ndarray
    capture: np.ndarray
    place_mm: Float[np.ndarray, "m 2"]
    force_N: Float[np.ndarray, "m 3"]
    sd_N: Float[np.ndarray, "m 3"]
    db_uT: Float32[np.ndarray, "m ch"]


def force_presses(rows: Rows) -> ForcePresses:
    """Average the readings of each press.

    The targets of `rows` must be `SHEAR_TARGETS` (place and three force components). Raises SchemaError if a force is
    unknown.
    """
    if np.isnan(rows.target).any():
        raise SchemaError(
            "recorded_limits: there are readings without Fx, Fy or Fz. Remove recorded_limits from the scene."
        )
    _, first, press_i = np.unique(rows.indentation, return_index=True, return_inverse=True)
    target = mean_by(press_i, rows.target)
    sd_N = np.sqrt(mean_by(press_i, (rows.target - target[press_i])[:, 2:] ** 2))
    db_uT = mean_by(press_i, rows.db_uT).astype(np.float32)
    return ForcePresses(rows.board[first], rows.capture[first], target[:, :2], target[:, 2:], sd_N, db_uT)


def evaluate_shear(rows: Rows, section: RecordedLimits, seed: int) -> dict[str, Any]:
    """Describe the recorded forces, and score regressors that estimate the three force components."""
    presses = force_presses(rows)
    lines = [describe_forces(presses, str(capture)) for capture in np.unique(presses.capture)]
    scored = []
    for board in np.unique(presses.board):
        own, others = np.flatnonzero(presses.board == board), np.flatnonzero(presses.board != board)
        splits = {OTHER_BOARD: [(others, own)], OTHER_PLACES: split_places(presses, own, section.folds_n, seed)}
        for trained_on, folds in splits.items():
            for inputs, method in shear_regressors(section.methods):
                predicted = np.full((len(presses.board), 3), np.nan)
                for train, test in folds:
                    predicted[test] = predict_forces(presses, inputs, method, train, test, seed)
                keys = {"board": board, "trained_on": trained_on, "inputs": inputs}
                keys["method"] = "–" if method is None else method.title
                keys["method"] += f" ({method.inputs})" if method is not None and inputs == FIELD else ""
                scored.append(keys | score_forces(presses, own, predicted[own], inputs))
    return {"forces": lines, "rows": summarise_shear(scored)}


def shear_regressors(methods: Mapping[str, Classical]) -> list[tuple[str, Classical | None]]:
    """List the pairs of an input and a regressor that are compared.

    A regressor of None stands for the mean force of the training presses, which needs no input.
    """
    first = next(iter(methods.values()))
    return [(CONSTANT, None), *((FIELD, method) for method in methods.values()), (PLACE_AND_FORCE, first)]


def describe_forces(presses: ForcePresses, capture: str) -> dict[str, Any]:
    """Describe the forces of one recording.

    Returns the mean and the standard deviation of each component, and the ratio of sideways force to normal force.
    """
    own = presses.capture == capture
    force_N, sd_N = presses.force_N[own], presses.sd_N[own]
    ratio = np.hypot(force_N[:, 0], force_N[:, 1]) / force_N[:, 2]
    line: dict[str, Any] = {"board": str(presses.board[own][0]), "recording": capture, "presses_n": int(own.sum())}
    for i, name in enumerate(FORCES):
        line[name] = {
            "mean_N": float(force_N[:, i].mean()), "sd_N": float(force_N[:, i].std()),
            "sd_in_press_N": float(np.sqrt((sd_N[:, i] ** 2).mean())),
        }  # fmt: skip
    return line | {"ratio_median": float(np.median(ratio)), "ratio_max": float(ratio.max())}


def split_places(
    presses: ForcePresses, own: Int64[np.ndarray, " a"], folds_n: int, seed: int
) -> list[tuple[Int64[np.ndarray, " b"], Int64[np.ndarray, " c"]]]:
    """Split the presses of a board for cross-validation.

    All presses at one place are in the same fold. Returns the indices of the training and test presses of each fold.
    """
    place_i = number_places(presses.place_mm[own])
    fold_of_place = rng_for(seed, "recorded limits", "places").permutation(int(place_i.max()) + 1) % folds_n
    fold = fold_of_place[place_i]
    return [(own[fold != i], own[fold == i]) for i in range(folds_n) if (fold == i).any()]


def predict_forces(
    presses: ForcePresses,
    inputs: str,
    method: Classical | None,
    train: Int64[np.ndarray, " a"],
    test: Int64[np.ndarray, " b"],
    seed: int,
) -> Float[np.ndarray, "b 3"]:
    """Predict Fx, Fy and Fz of the tested presses by a regressor that is fitted to the training presses."""
    if method is None:
        return np.broadcast_to(presses.force_N[train].mean(axis=0), (len(test), 3))
    values = VIEW[method.inputs](presses.db_uT)
    if inputs == PLACE_AND_FORCE:
        values = np.column_stack([presses.place_mm, presses.force_N[:, 2]]).astype(np.float32)
    rng = rng_for(seed, "recorded limits", "shear")
    fitted = fit(method, values[train], presses.force_N[train].astype(np.float32), rng, weight=None)
    return fitted.predict(values[test]).astype(float)


def score_forces(
    presses: ForcePresses, own: Int64[np.ndarray, " a"], predicted: Float[np.ndarray, "a 3"], inputs: str
) -> dict[str, float]:
    """Return R² of each force component of a board, in two versions.

    `r2_*` compares all presses of the board. `r2_within_*` compares presses only with presses of the same recording.
    """
    scores = {}
    _, capture_i = np.unique(presses.capture[own], return_inverse=True)
    for i, name in enumerate(FORCES):
        if name != FZ or inputs != PLACE_AND_FORCE:
            true_N = presses.force_N[own, i]
            scores[f"r2_{name}"] = explained(true_N, predicted[:, i], np.zeros_like(capture_i))
            scores[f"r2_within_{name}"] = explained(true_N, predicted[:, i], capture_i)
    return scores


def explained(
    true: Float[np.ndarray, " n"], predicted: Float[np.ndarray, " n"], group: Int64[np.ndarray, " n"]
) -> float:
    """Return R², which is 1 - mean squared error / variance.

    If there are several groups, the mean over each group is first subtracted from the true values of the group and from
    the errors of the group. If there is only one group, the mean error is not subtracted. R² is then negative if the
    prediction is worse than the mean of the true values.
    """
    error = predicted - true
    if group.max() > 0:
        error = error - mean_by(group, error[:, None])[group, 0]
    spread = true - mean_by(group, true[:, None])[group, 0]
    return 1 - round(float((error**2).mean() / (spread**2).mean()), DECIMALS)


def summarise_shear(scored: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Summarise R² over boards."""
    frame = pd.DataFrame(scored)
    keys = ["trained_on", "inputs", "method"]
    metrics = [str(name) for name in frame if name not in (*keys, "board")]
    summary: list[dict[str, Any]] = []
    for key, group in frame.groupby(keys, sort=False):
        known = [name for name in metrics if group[name].notna().all()]
        scores = {name: statistic(group[name].to_numpy(), boards=True) for name in known}
        summary.append({**dict(zip(keys, key, strict=True)), **scores})
    return summary


# --- Smallest detected force ---

EACH, PREVIOUS, START = "before each press", "before the previous press", "at the start of the recording"
BASELINES = (EACH, PREVIOUS, START)  # baselines (subtracted no-load readings), named by when they were taken
BY_RATE, BY_LIVE = "set by false alarms", "as in reskin live"  # names of the rules that set the threshold


@dataclass(frozen=True)
class Recording:
    """The no-load readings and the readings in contact of one capture.

    `press_i` is the number of the press to which each reading in contact belongs. `noload_press_i` is the number of the
    press before which each no-load reading was taken.
    """

    board: str
    noload_press_i: Int64[np.ndarray, " a"]
    noload_uT: Float[np.ndarray, "a ch"]
    press_i: Int64[np.ndarray, " f"]
    b_uT: Float[np.ndarray, "f ch"]
    place_mm: Float[np.ndarray, "f 2"]
    force_N: Float[np.ndarray, " f"]


def read_recording(readings: Readings, raw: Path, policy: FaultPolicy) -> Recording:
    """Combine the readings of a capture with its individual no-load readings, which are read from the raw file.

    `readings` contains only the mean of the no-load readings before each press.
    """
    header = read_header(raw)
    if header.layout != "lab":
        needed = "only layout lab contains individual no-load readings"
        what = f"capture {readings.capture} has layout {header.layout}, but {needed}"
        raise SchemaError(f"recorded_limits: {what}. Remove recorded_limits from the scene.")
    press_i, noload_uT = lab.read_noload(raw, header, policy)
    place_mm = np.column_stack([readings.x_mm, readings.y_mm]).astype(float)
    return Recording(
        readings.board, press_i, noload_uT, readings.indentation.astype(np.int64), readings.b_uT.astype(float),
        place_mm, readings.Fz_N.astype(float),
    )  # fmt: skip


class Changes(NamedTuple):
    """Field changes relative to one kind of baseline.

    - setting: no-load readings before presses with odd numbers, which set the thresholds.
    - verifying: no-load readings before presses with even numbers, which verify the thresholds.
    - contact: readings in contact.
    - force_N: force of each reading in contact.
    """

    setting: Float[np.ndarray, "a ch"]
    verifying: Float[np.ndarray, "b ch"]
    contact: Float[np.ndarray, "f ch"]
    force_N: Float[np.ndarray, " f"]


def changes(recording: Recording, baseline: str) -> Changes:
    """Subtract a baseline from the readings of a recording.

    With baseline `EACH`, every press has its own baseline: the mean of the no-load readings before the press. From a
    no-load reading, the mean of only the other no-load readings before the same press is subtracted, so that the
    reading is not compared with itself. This is impossible if a press has only one no-load reading, so this reading is
    omitted.

    With the other baselines, the first press is omitted, because no earlier press provides a baseline.
    """
    mean_uT = mean_by(recording.noload_press_i, recording.noload_uT)
    base_uT = {EACH: mean_uT, PREVIOUS: np.roll(mean_uT, 1, axis=0), START: np.broadcast_to(mean_uT[0], mean_uT.shape)}
    noload_uT = recording.noload_uT - base_uT[baseline][recording.noload_press_i]
    contact_uT = recording.b_uT - base_uT[baseline][recording.press_i]
    used, pressed, odd = recording.noload_press_i > 0, recording.press_i > 0, recording.noload_press_i % 2 == 1
    if baseline == EACH:
        count_n = np.bincount(recording.noload_press_i)[recording.noload_press_i]
        noload_uT *= (count_n / np.maximum(count_n - 1, 1))[:, None]
        used, pressed = count_n > 1, np.ones_like(pressed)
    return Changes(noload_uT[odd & used], noload_uT[~odd & used], contact_uT[pressed], recording.force_N[pressed])


def join_changes(parts: Sequence[Changes]) -> Changes:
    """Concatenate the field changes of several recordings."""
    return Changes(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def live_threshold(noload_uT: Float[np.ndarray, "a ch"]) -> float:
    """Return the threshold of |dB| that `reskin live` would set: median of |dB| plus `CONTACT_SDS` times the noise.

    Both are computed from no-load readings; the noise is their root mean square over readings and channels.
    """
    return float(np.median(magnitude(noload_uT)) + CONTACT_SDS * np.sqrt((noload_uT**2).mean()))


def magnitude(db_uT: Float[np.ndarray, "f ch"]) -> Float[np.ndarray, " f"]:
    """Return |dB|, the Euclidean norm over all channels, of each reading."""
    return np.asarray(np.linalg.norm(db_uT, axis=1))


def needed_changes_uT(
    direction: Float[np.ndarray, "m ch"], noise_uT: Float[np.ndarray, "r ch"], threshold_uT: float
) -> Float[np.ndarray, "m r"]:
    """Return how large a field change must be for a reading to exceed the threshold, for each press and each noise.

    A reading is modelled as s u + n, where u is the direction (unit vector) of a press's field change, s is the size of
    the field change, and n is the noise, which is a recorded no-load reading. The norm |s u + n| exceeds the threshold
    for all s above the larger root of a quadratic equation. This root is returned, or 0 if no root is positive.
    """
    along_uT = direction @ noise_uT.T
    beyond = along_uT**2 + threshold_uT**2 - (noise_uT**2).sum(axis=1)
    root_uT = np.sqrt(np.maximum(beyond, 0)) - along_uT
    return np.where(beyond > 0, np.maximum(root_uT, 0), 0.0)


@dataclass(frozen=True)
class PowerLaw:
    """Power law |dB| = a F^b, which gives the size of the field change that a force F causes.

    - exponent: b, which is the same at all places of a board.
    - factor_uT: a, with one value for each place of the board.
    - r2: fraction of variance that the power law explains: of the variance of log |dB| among presses at the same place.
    """

    exponent: float
    factor_uT: Float[np.ndarray, " p"]
    r2: float

    def force_N(
        self, change_uT: Float[np.ndarray, "m r"], place_i: Int64[np.ndarray, " m"]
    ) -> Float[np.ndarray, "m r"]:
        """Return the forces that cause field changes of size `change_uT` at the places with numbers `place_i`.

        The forces are NaN if the exponent is not positive, because the power law then has no inverse.
        """
        if self.exponent <= 0:
            return np.full(change_uT.shape, np.nan)
        return np.asarray((change_uT / self.factor_uT[place_i, None]) ** (1 / self.exponent))


def fit_power_law(
    place_i: Int64[np.ndarray, " m"], force_N: Float[np.ndarray, " m"], change_uT: Float[np.ndarray, " m"]
) -> PowerLaw:
    """Fit the power law to presses by least squares of log |dB|; `place_i` is the number of each press's place."""
    logs = np.log(np.column_stack([force_N, change_uT]))
    mean = mean_by(place_i, logs)
    log_N, log_uT = (logs - mean[place_i]).T
    if not (log_N**2).sum() > 0:
        what = "no place has presses with different forces, so no power law can be fitted"
        raise SchemaError(f"recorded_limits: {what}. Remove recorded_limits from the scene.")
    exponent = float(log_N @ log_uT / (log_N @ log_N))
    r2 = 1 - float(((log_uT - exponent * log_N) ** 2).sum() / (log_uT**2).sum())
    return PowerLaw(exponent, np.exp(mean[:, 1] - exponent * mean[:, 0]), r2)


def evaluate_detection(
    recordings: Sequence[Recording], section: RecordedLimits
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Compute thresholds, false alarms, detected readings and the smallest detected forces of each board.

    Returns the numbers for the tables, and the data for the figure.
    """
    rows, by_force, laws, drawn = [], [], [], {}
    for board in sorted({recording.board for recording in recordings}):
        own = [recording for recording in recordings if recording.board == board]
        presses = contact_presses(own)
        law = fit_power_law(presses.place_i, presses.force_N, presses.change_uT)
        reading_min_N = min(float(each.force_N[each.force_N > 0].min()) for each in own)
        laws.append({"board": board, "exponent": law.exponent, "r2": law.r2} | presses.range())
        laws[-1]["reading_min_N"] = reading_min_N
        by_baseline = {name: join_changes([changes(each, name) for each in own]) for name in BASELINES}
        live_uT = live_threshold(by_baseline[EACH].setting)
        limits_uT = {}
        for name, parts in by_baseline.items():
            by_rate = thresholds({name: magnitude(parts.setting)}, section.false_alarm_fraction)[name]
            limits_uT[name] = by_rate
            for rule, limit_uT in {BY_RATE: by_rate, BY_LIVE: live_uT}.items():
                keys = {"board": board, "baseline": name, "rule": rule, "threshold_uT": limit_uT}
                rows.append(keys | evaluate_threshold(parts, limit_uT, presses, law, section.detected_fraction))
        by_force += [{"board": board} | line for line in detected_by_force(by_baseline, limits_uT)]
        drawn[board] = {
            "force_N": presses.force_N.tolist(), "change_uT": presses.change_uT.tolist(), "threshold_uT": limits_uT,
            "exponent": law.exponent, "factor_uT": float(np.median(law.factor_uT)),
        }  # fmt: skip
    return {"rows": rows, "by_force": by_force, "laws": laws}, drawn


@dataclass(frozen=True)
class ContactPresses:
    """The presses of a board, each averaged over its readings.

    - place_i: number of the place of each press.
    - force_N: mean force of each press.
    - change_uT: size of the mean field change of each press.
    - direction: unit vector of the mean field change of each press.
    """

    place_i: Int64[np.ndarray, " m"]
    force_N: Float[np.ndarray, " m"]
    change_uT: Float[np.ndarray, " m"]
    direction: Float[np.ndarray, "m ch"]

    def proportional_N(self, change_uT: Float[np.ndarray, "m r"], law: PowerLaw) -> Float[np.ndarray, "m r"]:
        """Return the forces that cause field changes of size `change_uT`, without using the power law for weak forces.

        Below the weakest press that was recorded at a place, |dB| is assumed to be proportional to the force. Field
        changes larger than the field change of this weakest press are in the recorded range, where the power law is
        used.
        """
        order = np.lexsort((self.force_N, self.place_i))
        weakest = order[np.unique(self.place_i[order], return_index=True)[1]][self.place_i]
        weakest_N, weakest_uT = self.force_N[weakest, None], self.change_uT[weakest, None]
        below_N = weakest_N * change_uT / weakest_uT
        return np.where(change_uT <= weakest_uT, below_N, law.force_N(change_uT, self.place_i))

    def range(self) -> dict[str, Any]:
        """Return the smallest and the largest force and field change."""
        return {
            "presses_n": len(self.force_N), "force_min_N": float(self.force_N.min()),
            "force_max_N": float(self.force_N.max()), "change_min_uT": float(self.change_uT.min()),
            "change_max_uT": float(self.change_uT.max()),
        }  # fmt: skip


def contact_presses(recordings: Sequence[Recording]) -> ContactPresses:
    """Average the readings of each press of a board.

    Field changes are relative to the no-load reading before the press. Presses whose mean force is not positive are
    left out.
    """
    means = []
    for recording in recordings:
        contact_uT = changes(recording, EACH).contact
        _, press_i = np.unique(recording.press_i, return_inverse=True)
        means.append(mean_by(press_i, np.column_stack([recording.place_mm, recording.force_N, contact_uT])))
    values = np.concatenate(means)
    values = values[values[:, 2] > 0]
    change_uT = magnitude(values[:, 3:])
    return ContactPresses(number_places(values[:, :2]), values[:, 2], change_uT, values[:, 3:] / change_uT[:, None])


def evaluate_threshold(
    parts: Changes, threshold_uT: float, presses: ContactPresses, law: PowerLaw, fraction: float
) -> dict[str, float]:
    """Evaluate one threshold: percentages of false alarms and of detected readings, and the smallest detected force.

    Also returns the field change and the forces that are needed to exceed the threshold. They depend on the direction
    of the field change and on the noise, so they are computed for every pair of a recorded press and a no-load reading.
    The returned values suffice for a fraction `fraction` of the pairs. Results that do not exist (NaN) are left out.
    """
    needed_uT = needed_changes_uT(presses.direction, parts.verifying, threshold_uT)
    detected = np.asarray(magnitude(parts.contact) > threshold_uT)
    found = {
        "false_alarm_pct": 100 * float((magnitude(parts.verifying) > threshold_uT).mean()),
        "detected_pct": 100 * float(detected.mean()),
        "smallest_N": smallest_force_N(parts.force_N, detected, fraction),
        "needed_uT": float(np.quantile(needed_uT, fraction)),
        "power_law_N": float(np.quantile(law.force_N(needed_uT, presses.place_i), fraction)),
        "proportional_N": float(np.quantile(presses.proportional_N(needed_uT, law), fraction)),
    }
    return {"verified_n": len(parts.verifying)} | {name: value for name, value in found.items() if np.isfinite(value)}


def smallest_force_N(force_N: Float[np.ndarray, " f"], detected: Bool[np.ndarray, " f"], fraction: float) -> float:
    """Return the smallest recorded force at and above which at least `fraction` of the readings are detected.

    For each recorded force, the fraction is computed from the readings between this force and twice this force. Returns
    NaN if the fraction is too small even at the largest force.
    """
    order = np.argsort(force_N, kind="stable")
    force_N, before_n = force_N[order], np.concatenate([[0], np.cumsum(detected[order])])
    first, last = np.searchsorted(force_N, force_N, "left"), np.searchsorted(force_N, 2 * force_N, "left")
    enough = before_n[last] - before_n[first] >= fraction * (last - first)
    if not enough[-1]:
        return float("nan")
    failed = np.flatnonzero(~enough)
    return float(force_N[failed[-1] + 1 if len(failed) else 0])


def detected_by_force(by_baseline: Mapping[str, Changes], limits_uT: Mapping[str, float]) -> Iterator[dict[str, Any]]:
    """Yield the percentage of detected readings in each range of the force.

    The upper end of each range is twice its lower end. `limits_uT` contains the threshold for each baseline.
    """
    least_N = min(float(parts.force_N[parts.force_N > 0].min()) for parts in by_baseline.values())
    most_N = max(float(parts.force_N.max()) for parts in by_baseline.values())
    for power in range(int(np.floor(np.log2(least_N))), int(np.floor(np.log2(most_N))) + 1):
        low_N, high_N = 2.0**power, 2.0 ** (power + 1)
        inside = {name: in_range(parts.force_N, low_N, high_N) for name, parts in by_baseline.items()}
        if not all(mask.any() for mask in inside.values()):
            continue
        own_uT = magnitude(by_baseline[EACH].contact[inside[EACH]])
        yield {
            "low_N": low_N, "high_N": high_N, "readings_n": len(own_uT), "median_uT": float(np.median(own_uT)),
            "least_uT": float(own_uT.min()),
            "detected_pct": {
                name: 100 * float((magnitude(parts.contact[inside[name]]) > limits_uT[name]).mean())
                for name, parts in by_baseline.items()
            },
        }  # fmt: skip


def in_range(force_N: Float[np.ndarray, " f"], low_N: float, high_N: float) -> Bool[np.ndarray, " f"]:
    """Return which forces are at least `low_N` and below `high_N`."""
    return np.asarray((force_N >= low_N) & (force_N < high_N))


# --- Report ---

REGISTRATION_TITLES = {
    "accuracy_pct": "within 1 mm, %", "sd_draws_pct": "standard deviation over draws, %",
    "median_mm": "median error, mm", "mse_xy_mm2": "MSE_xy, mm²",
    "rigid_limit_mm2": "least MSE_xy of a rigid motion, mm²", "angle_deg": "rotation, °", "shift_mm": "shift, mm",
}  # fmt: skip
REGISTRATION_MEANING = (
    "Each number is the mean over {draws_n} random draws (seed {seed}), then over boards; (a; b) are the values of the "
    "boards. Each draw selects {known_n} presses at known places that are far from each other, and {presses_n} "
    "unlabelled presses. All rows are tested on the same readings: readings of presses that are not among the "
    "unlabelled presses of the draw, and not at one of its known places. Column `known places` states how the presses "
    "at known places are used. Rigid registration: all estimated places are rotated and shifted, without reflection. "
    "Rotation and shift are fitted by least squares, so that the estimated places of the {known_n} presses agree best "
    "with their known places. Shift only: all estimated places are shifted by the mean difference between the known "
    "and the estimated places of the {known_n} presses. As labels of the model: the universal model is conditioned on "
    "the {known_n} presses, with their forces. Least MSE_xy of a rigid motion: the error after the rotation and the "
    "shift that are fitted to the tested readings themselves. No rigid registration can have a smaller error, so this "
    "is a limit and not a result. Rotation, shift: mean absolute angle of the rotation, and mean length of the shift "
    "of the skin's middle. Standard deviation over draws: of the percentage within 1 mm."
)
FORCES_MEANING = (
    "Each cell contains the mean ± standard deviation over the presses of a recording. In brackets is the standard "
    "deviation of the readings within a press. Fx and Fy act along the axes of the labels. A recording contains all "
    "presses of a board at one depth. The last column is the sideways force divided by the normal force: the median "
    "over presses and, in brackets, the maximum."
)
SHEAR_MEANING = (
    "R² over the presses of a board: 1 is a perfect estimate, 0 is as good as the mean force of the tested presses, "
    "and negative values are worse than this mean. (a; b) are the values of the boards. Trained on other places of the "
    "same board: cross-validation with {folds_n} folds, in which all presses at one place are in the same fold. R² "
    "within recordings: before R² is computed, the mean of each recording is subtracted from the true forces and from "
    "the errors, so that presses are compared only with presses at the same depth. Input `true place and normal force` "
    "uses no field: it shows how much of the sideways force follows from where and how hard the rig presses. An "
    "estimate from the field shows that the field contains information about shear only if it is better than the "
    "estimate from this input."
)
DETECTION_MEANING = (
    "A reading is detected if the size |dB| of its field change, over all channels, is above the threshold. Baseline: "
    "the no-load reading (reading without contact) that is subtracted. The earlier the baseline was taken, the larger "
    "is the drift since then. Threshold `set by false alarms`: {false_alarm_pct:g} % of the no-load readings before "
    "presses with odd numbers are above this threshold. Threshold `as in reskin live`: the median of |dB| of these "
    "no-load readings plus {sds:g} times their noise, both relative to the other no-load readings before the same "
    "press. False alarms: percentage of the no-load readings before presses with even numbers that are above the "
    "threshold; column `no-load readings` is their number. All no-load readings before one press have the same drift, "
    "so percentages near {false_alarm_pct:g} % are uncertain. Smallest force: the smallest recorded force at and above "
    "which {detected_pct:g} % of the readings are detected, counted in every range from a force to twice this force; ≤ "
    "marks the smallest recorded force of the board. Needed field change: detected in {detected_pct:g} % of the cases "
    "if it has the direction of a recorded field change, and the noise and drift of a recorded no-load reading are "
    "added. Last two columns: the force that is large enough for detection in {detected_pct:g} % of the cases. The "
    "power law is |dB| = a F^b (table `limits_law`). The proportional law assumes that, below the weakest press at a "
    "place, the field change is proportional to the force. Extrapolated forces are not measured. The power law cannot "
    "hold down to such small forces, because its slope at 0 N is infinite. Forces that are extrapolated by the power "
    "law are therefore too small. –: not shown, because more than {alarm_max_pct:g} % of the no-load readings cause "
    "false alarms."
)
BY_FORCE_MEANING = (
    "Percentage of the readings in contact that are detected, in ranges of the force. The thresholds are those that "
    "are `set by false alarms` in table `limits_detection`. The median and the smallest field change are relative to "
    "the no-load reading before each press."
)
LAW_MEANING = (
    "The power law |dB| = a F^b has one exponent b for each board and one factor a for each place. It is fitted to the "
    "means of the presses. R²: fraction of the variance of log |dB| among the presses at one place that the power law "
    "explains."
)
# Forces that are large enough for detection, according to two laws of the field change against the force.
IMPLIED = {"power_law_N": "force by power law, N", "proportional_N": "force by proportional law, N"}
# A table shows the smallest forces only if the fraction of false alarms is at most this multiple of the intended
# fraction of false alarms, which the settings state.
ALARMS_MAX = 10


def tables(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Tabulate registration, shear and detection."""
    return {
        "limits_registration": tabulate_registration(numbers, source),
        "limits_forces": tabulate(
            [force_line(line) | {"source": source} for line in numbers["shear"]["forces"]], meaning=FORCES_MEANING
        ),
        "limits_shear": tabulate(
            [shear_line(row) | {"source": source} for row in numbers["shear"]["rows"]],
            meaning=SHEAR_MEANING.format(folds_n=numbers["folds_n"]),
        ),
        **tabulate_detection(numbers, source),
    }


def tabulate_registration(numbers: Mapping[str, Any], source: str) -> pd.DataFrame:
    """Tabulate the scores of all methods without and with the presses at known places."""
    lines = []
    for row in numbers["registration"]["rows"]:
        line = {"method": row["method"], "unlabelled presses": row["presses_n"], "known places": row["known"]}
        line |= {title: show(row.get(name)) for name, title in REGISTRATION_TITLES.items()}
        lines.append(line | {"source": source})
    used = {name: numbers[name] for name in ("draws_n", "known_n", "presses_n")}
    used["seed"] = numbers["registration"]["seed"]
    return tabulate(lines, meaning=REGISTRATION_MEANING.format(**used))


def show_force(force_N: float | None, least_N: float, mark: str) -> str:
    """Format a force for a table.

    A force that is not above `least_N`, the smallest recorded force, is written in the format `mark`.
    """
    if force_N is None:
        return "–"
    return mark.format(f"{force_N:.3g}") if force_N <= least_N else f"{force_N:.3g}"


def force_line(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells of the table of forces for one recording."""
    cells = {"board": line["board"], "recording": line["recording"], "presses": line["presses_n"]}
    for name in FORCES:
        force = line[name]
        cells[f"{name}, N"] = f"{force['mean_N']:.3f} ± {force['sd_N']:.3f} ({force['sd_in_press_N']:.4f})"
    return cells | {"sideways / normal force": f"{line['ratio_median']:.2f} ({line['ratio_max']:.2f})"}


def shear_line(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells of the table of R² for one regressor."""
    cells = {"trained on": row["trained_on"], "input": row["inputs"], "regressor": row["method"]}
    columns = {f"r2_{name}": f"R² of {name}" for name in FORCES}
    columns |= {f"r2_within_{name}": f"R² of {name} within recordings" for name in (FX, FY)}
    return cells | {title: show_digits(row[name], 2) if name in row else "–" for name, title in columns.items()}


def tabulate_detection(numbers: Mapping[str, Any], source: str) -> dict[str, pd.DataFrame]:
    """Return three tables: thresholds with smallest forces, detected readings by range of force, and power laws."""
    detection, fraction = numbers["detection"], numbers["detected_fraction"]
    alarm_max_pct = 100 * ALARMS_MAX * numbers["false_alarm_fraction"]
    least_N = {law["board"]: law["reading_min_N"] for law in detection["laws"]}
    lines = []
    for row in detection["rows"]:
        cells = {"board": row["board"], "baseline": row["baseline"], "rule for the threshold": row["rule"]}
        cells |= {"threshold, µT": f"{row['threshold_uT']:.3g}", "false alarms, %": f"{row['false_alarm_pct']:.3g}"}
        cells |= {"no-load readings": row["verified_n"], "detected, %": f"{row['detected_pct']:.4g}"}
        known = row if row["false_alarm_pct"] <= alarm_max_pct else {}
        cells["smallest force, N"] = show_force(known.get("smallest_N"), least_N[row["board"]], "≤ {}")
        cells["needed field change, µT"] = f"{known['needed_uT']:.3g}" if known else "–"
        for name, title in IMPLIED.items():
            cells[title] = show_force(known.get(name), least_N[row["board"]], "{} (extrapolated)")
        lines.append(cells | {"source": source})
    meaning = DETECTION_MEANING.format(
        false_alarm_pct=100 * numbers["false_alarm_fraction"], detected_pct=100 * fraction, sds=CONTACT_SDS,
        alarm_max_pct=alarm_max_pct,
    )  # fmt: skip
    by_force = [
        {
            "board": line["board"], "force, N": f"{line['low_N']:g} to {line['high_N']:g}",
            "readings": line["readings_n"], "median field change, µT": f"{line['median_uT']:.0f}",
            "smallest field change, µT": f"{line['least_uT']:.0f}",
        }
        | {f"detected, %, baseline {name}": f"{pct:.4g}" for name, pct in line["detected_pct"].items()}
        | {"source": source}
        for line in detection["by_force"]
    ]  # fmt: skip
    laws = [
        {
            "board": law["board"], "presses": law["presses_n"],
            "force, N": f"{law['force_min_N']:.3g} to {law['force_max_N']:.3g}",
            "field change, µT": f"{law['change_min_uT']:.3g} to {law['change_max_uT']:.4g}",
            "exponent b": f"{law['exponent']:.3f}", "R²": f"{law['r2']:.2f}", "source": source,
        }
        for law in detection["laws"]
    ]  # fmt: skip
    return {
        "limits_detection": tabulate(lines, meaning=meaning),
        "limits_by_force": tabulate(by_force, meaning=BY_FORCE_MEANING),
        "limits_law": tabulate(laws, meaning=LAW_MEANING),
    }


def figures(numbers: Mapping[str, Any], drawn: Mapping[str, Any], source: str) -> dict[str, str]:
    """Plot the field change of each press against the force, with the thresholds of detection.

    Two lines extrapolate the field change to forces that are weaker than those of all presses. One line extrapolates by
    the power law. The other line assumes that the field change is proportional to the force.
    """
    with drawing(3.8 * len(drawn), 4.4) as figure:
        panels = figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0]
        for axes, (board, of_board) in zip(panels, drawn.items(), strict=True):
            force_N, change_uT = np.array(of_board["force_N"]), np.array(of_board["change_uT"])
            axes.scatter(force_N, change_uT, s=6, color=COLOURS[1], label="presses")
            recorded_N = np.array([force_N.min(), force_N.max()])
            smaller_N = np.array([FIGURE_MIN_N, force_N.min()])
            law = of_board["factor_uT"], of_board["exponent"]
            axes.plot(recorded_N, law[0] * recorded_N ** law[1], color=COLOURS[0], label="power law, median of places")
            axes.plot(smaller_N, law[0] * smaller_N ** law[1], ":", color=COLOURS[0], label="power law, extrapolated")
            weakest_uT = law[0] * force_N.min() ** law[1]
            proportional_uT = weakest_uT * smaller_N / force_N.min()
            axes.plot(smaller_N, proportional_uT, "--", color="0.5", label="proportional law, extrapolated")
            for colour, (name, threshold_uT) in zip(COLOURS[2:], of_board["threshold_uT"].items(), strict=False):
                axes.axhline(threshold_uT, color=colour, linewidth=1, label=f"threshold, baseline {name}")
            axes.set(xscale="log", yscale="log", xlabel="force / N", title=board)
        panels[0].set(ylabel="|dB| / µT", ylim=(10, None))
        figure.legend(*panels[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=2)
        figure.suptitle(
            f"Field change of presses, and thresholds of detection ({source})", x=0.01, ha="left", fontsize=11
        )
        return {"recorded_limits.svg": svg(figure)}


FIGURE_MIN_N = 0.01  # smallest force in the figure
