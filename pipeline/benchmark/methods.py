"""Our own methods for the benchmark: predict with them, score the predictions, and write the scores as entries.

    python -m pipeline.benchmark.methods PREDICTIONS [DATASET ...]

The command writes the files of predictions to folder PREDICTIONS, and the entries to benchmark/entries. By default, it
does so for all datasets. The recordings must be in data/fetched, where `reskin fetch lab` and `reskin fetch eflesh` put
them. Each method receives only the arrays of `pipeline.benchmark.tasks`, as other people's methods do. However, some
choices in the universal model, such as the form of its physical model (the law), were made after results on both boards
of dataset lab were known (docs/learning.md).
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int64

import reskin
from pipeline.benchmark.entries import entry_file, write_entry
from pipeline.benchmark.folds import Presses, Task, join_presses, tasks
from pipeline.benchmark.predictions import write
from pipeline.benchmark.scoring import About, score_file
from pipeline.executors import make_executor
from pipeline.experiments.compare import Compare, chip_rotations, make_setup, to_board_axes
from pipeline.experiments.random_presses import calibrate_board, raise_forces
from pipeline.settings import read_settings
from pipeline.stages.universal import UniversalSection
from pipeline.training.jobs import SceneData
from pipeline.training.universal_variants import Frame, KnownBoards, prior_without
from reskin.code import ROOT
from reskin.config import parse, read_yaml
from reskin.data.rows import Rows
from reskin.models.job import FineTuning, Pretrained, TrainingData, TrainingJob, TrainingResult
from reskin.models.recipe import FineTuningRecipe, Recipe
from reskin.models.runner import run_jobs
from reskin.physics.skin import SkinDesign
from reskin.seeds import rng_for
from reskin.universal.calibration import CalibrationData, LabelledPresses
from reskin.universal.force import NORMAL_90
from reskin.universal.law import TEN, fit
from reskin.universal.map import Estimate, new_map, tabulate
from reskin.universal.model import PriorModel
from reskin.universal.presses import RecordedPresses

LAB = read_settings("lab", ROOT)  # coordinates of the lab's boards, and settings of networks and universal models
SEED = 2021
DATASETS = ("lab", "eflesh", "simulated")
SEEDS_N = 3  # number of networks for each set of training boards
ROWS_MAX_N = 2000  # kernel ridge regression on other boards is fitted to at most this number of random presses
# The scene, and its section, from which the settings of the network are taken, by dataset. Dataset `simulated` has no
# scene, so the settings of scene lab are used.
NETWORK_SETTINGS = {
    "lab": ("lab", "few_labels"),
    "simulated": ("lab", "few_labels"),
    "eflesh": ("eflesh", "train_single"),
}
Tasks = Sequence[Task]
Fitted = Callable[[Float[np.ndarray, "n ch"]], Float[np.ndarray, "n c"]]


def features(db_uT: Float[np.ndarray, "n ch"]) -> Float[np.ndarray, "n c"]:
    """Return the direction of each field change and the logarithm of its magnitude."""
    magnitude_uT = np.linalg.norm(db_uT, axis=1, keepdims=True)
    return np.hstack([db_uT / magnitude_uT, np.log(magnitude_uT)])


def targets(presses: Presses) -> Float[np.ndarray, "n c"]:
    """Return x, y and, if forces are known, the logarithm of the force."""
    if np.isnan(presses.force_N).any():
        return presses.place_mm
    return np.column_stack([presses.place_mm, np.log(presses.force_N)])


def rows_of(task: Task, predicted: Float[np.ndarray, "t c"]) -> pa.Table:
    """Return the rows of predictions of the targets in `targets`."""
    return task.predictions(predicted[:, :2], np.exp(predicted[:, 2]) if predicted.shape[1] == 3 else None)


def nearest_label(all_tasks: Tasks) -> Iterator[pa.Table]:
    """Predict that each test has the place and the force of the label with the most similar field change."""
    from sklearn.neighbors import KNeighborsRegressor

    for task in all_tasks:
        if task.labels_n:
            model = KNeighborsRegressor(n_neighbors=1).fit(features(task.labels.db_uT), targets(task.labels))
            yield rows_of(task, model.predict(features(task.tests_uT)))


def fit_ridge(presses: Presses) -> Fitted:
    """Fit a linear ridge regression, whose penalty is chosen by leave-one-out cross-validation over the presses."""
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    model = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 3, 13)))
    model.fit(features(presses.db_uT), targets(presses))
    return lambda db_uT: model.predict(features(db_uT))


def fit_kernel_ridge(presses: Presses) -> Fitted:
    """Fit a ridge regression with a Gaussian kernel; its settings are chosen by cross-validation over the presses."""
    from sklearn.compose import TransformedTargetRegressor
    from sklearn.kernel_ridge import KernelRidge
    from sklearn.model_selection import GridSearchCV, KFold
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    kernel = TransformedTargetRegressor(KernelRidge(kernel="rbf"), transformer=StandardScaler())
    grid = {"alpha": [1e-3, 1e-2, 1e-1, 1.0], "gamma": [0.003, 0.01, 0.03, 0.1, 0.3]}
    prefix = "transformedtargetregressor__regressor__"
    model = GridSearchCV(
        make_pipeline(StandardScaler(), kernel),
        {f"{prefix}{name}": values for name, values in grid.items()},
        scoring="neg_mean_squared_error",
        cv=KFold(5, shuffle=True, random_state=0),
    )
    model.fit(features(presses.db_uT), targets(presses))
    return lambda db_uT: model.predict(features(db_uT))


def ridge_on_labels(all_tasks: Tasks) -> Iterator[pa.Table]:
    for task in all_tasks:
        if task.labels_n:
            yield rows_of(task, fit_ridge(task.labels)(task.tests_uT))


def kernel_ridge_on_labels(all_tasks: Tasks) -> Iterator[pa.Table]:
    for task in all_tasks:
        if task.labels_n:
            yield rows_of(task, fit_kernel_ridge(task.labels)(task.tests_uT))


def kernel_ridge_on_other_boards(all_tasks: Tasks) -> Iterator[pa.Table]:
    """For tasks without labels, fit kernel ridge regression to at most `ROWS_MAX_N` presses of the training boards."""
    for group in by_training_boards(all_tasks).values():
        train = group[0].train
        first = rng_for(SEED, "benchmark", "kernel ridge").permutation(len(train))[:ROWS_MAX_N]
        fitted = fit_kernel_ridge(train[first])
        for task in group:
            if not task.labels_n:
                yield rows_of(task, fitted(task.tests_uT))


def by_training_boards(all_tasks: Tasks) -> dict[tuple[str, ...], list[Task]]:
    """Group tasks that have the same training boards."""
    groups: dict[tuple[str, ...], list[Task]] = {}
    for task in all_tasks:
        groups.setdefault(tuple(dict.fromkeys(task.train.board.tolist())), []).append(task)
    return groups


def network(all_tasks: Tasks) -> Iterator[pa.Table]:
    """Train the paper's network on the readings of the training boards, and fine-tune it on the labels.

    If there are no training boards, the network is trained on the labels instead. For each set of training boards,
    `SEEDS_N` networks with different seeds are trained. Successive draws use different networks, so that the mean over
    draws is also a mean over seeds.
    """
    scene, section = NETWORK_SETTINGS[all_tasks[0].fold.split(".")[1]]
    settings = read_yaml(ROOT / f"pipeline/scenes/{scene}.yaml")[section]
    recipe = parse(Recipe, recipes("recipes", settings["recipe"], steps_n=settings["steps_n"]), scene)
    for boards, group in by_training_boards(all_tasks).items():
        data, rows = training_rows(group)
        tests = np.concatenate([rows[task.fold, "tests"] for task in group])
        train = rows["train"] if boards else rows[group[0].fold, "labels"]
        job = TrainingJob("benchmark", settings["recipe"], recipe, "+".join(boards), SEED, 0, train, tests)
        by_seed = train_networks([replace(job, seed_i=i) for i in range(SEEDS_N if boards else 1)], data)
        predicted, tunings = {}, {}
        for i, draw in enumerate(dict.fromkeys(task.fold.rpartition(".")[0] for task in group)):
            trained = by_seed[i % len(by_seed)]
            for task in (task for task in group if task.fold.rpartition(".")[0] == draw):
                predicted[task.fold] = trained.predicted[np.searchsorted(tests, rows[task.fold, "tests"])]
                if boards and task.labels_n:
                    own = replace(job, seed_i=i % len(by_seed), test=rows[task.fold, "tests"])
                    tunings[task.fold] = fine_tuning(own, trained, rows[task.fold, "labels"])
        results = train_networks(list(tunings.values()), data)
        predicted |= {fold: result.predicted for fold, result in zip(tunings, results, strict=True)}
        known = bool(np.isfinite(data.target[train, 2]).all())
        for task in group:
            own_rows = predicted[task.fold]
            yield task.predictions(own_rows[:, :2], own_rows[:, 2] if known else None)


def recipes(section: str, name: str, **changes: Any) -> dict[str, Any]:
    """Return a recipe of params.yaml with changes."""
    return {**read_yaml(ROOT / "params.yaml")[section][name], **changes}


def fine_tuning(job: TrainingJob, trained: TrainingResult, labels: Int64[np.ndarray, " m"]) -> TrainingJob:
    """Return the job that fine-tunes a trained network on labels, with the settings of scene lab."""
    settings = dict(read_yaml(ROOT / "pipeline/scenes/lab.yaml")["few_labels"]["labelling"])
    recipe = parse(FineTuningRecipe, recipes("labellings", settings.pop("labelling"), **settings), "labelling")
    start = Pretrained(trained.key, trained.weights, trained.scaler)
    return replace(job, tuning=FineTuning(start, recipe, labels))


def training_rows(group: Tasks) -> tuple[TrainingData, dict[Any, Int64[np.ndarray, " r"]]]:
    """Stack the readings of the training boards, and the labels and tests of tasks that share these boards.

    Returns the rows, and row numbers by role. The roles are `train` and, for each fold, (fold, "labels") and
    (fold, "tests"). Targets of tests are NaN.
    """
    parts, start = [group[0].train_readings], len(group[0].train_readings)
    rows: dict[Any, np.ndarray] = {"train": np.arange(start)}
    for task in group:
        press, unknown = np.arange(len(task.tests_uT)), np.full((len(task.tests_uT), 2), np.nan)
        board, rest_uT = np.full(len(press), task.board), np.zeros_like(task.tests_uT)
        tests = Presses(board, press, np.zeros_like(press), unknown, unknown[:, 0], rest_uT, task.tests_uT)
        for role, presses in (("labels", task.labels), ("tests", tests)):
            rows[task.fold, role] = np.arange(start, start + len(presses))
            parts.append(presses)
            start += len(presses)
    stacked = join_presses(parts)
    target = np.column_stack([stacked.place_mm, stacked.force_N]).astype(np.float32)
    return TrainingData(stacked.db_uT.astype(np.float32), target, stacked.board), rows


def train_networks(jobs: Sequence[TrainingJob], data: TrainingData) -> list[TrainingResult]:
    with TemporaryDirectory() as cache, make_executor(len(jobs), imports="reskin.models.train") as executor:
        return run_jobs(jobs, data, executor=executor, cache=Path(cache), log=lambda line: None) if jobs else []


def universal(all_tasks: Tasks) -> Iterator[pa.Table]:
    """Calibrate the shipped universal model to the no-load field, the unlabelled presses and the labels.

    In dataset lab, y of the labels points opposite to y of the board.
    """
    mirrored = all_tasks[0].fold.split(".")[1] == "lab" and LAB.section(Compare, "compare").labels_mirrored
    model = reskin.load_universal()
    frame = Frame(np.zeros((0, 3, 3)), model.layout.centre_mm, mirrored)
    centre_mm = np.array(model.layout.centre_mm)
    for task in all_tasks:
        rest_uT = task.noload_uT
        model.zero(rest_uT).see(rest_uT + task.unlabelled_uT, area=True)
        if task.labels_n:
            place_mm = centre_mm + frame.place(task.labels.place_mm)
            model.label(place_mm, task.labels.force_N, rest_uT + task.labels.db_uT)
        found = model.estimate(rest_uT + task.tests_uT)
        yield rows_of_estimate(task, replace(found, place_mm=frame.label(found.place_mm - centre_mm)))


def universal_of_rig(all_tasks: Tasks) -> Iterator[pa.Table]:
    """Make universal models from simulated skins and the training boards, and calibrate them to each tested board.

    The calibration is the same as in experiment `random_presses`.
    """
    section = LAB.section(Compare, "compare")
    frame = Frame(chip_rotations(section), section.labels_middle_mm, section.labels_mirrored)
    powers = reskin.load_universal().powers
    for group in by_training_boards(all_tasks).values():
        model = make_rig_model(group[0], frame)
        for task in group:
            db_uT, labels = frame.field(task.unlabelled_uT), task.labels
            rest_uT = frame.field(task.noload_uT[None])[0]
            board = calibrate_board(model, CalibrationData(rest_uT, db_uT, area_uT=db_uT))
            placed = LabelledPresses(frame.place(labels.place_mm), labels.force_N, frame.field(labels.db_uT))
            found = board.estimate(raise_forces(placed), frame.field(task.tests_uT), powers, len(db_uT))
            yield rows_of_estimate(task, replace(found, place_mm=frame.label(found.place_mm)))


def make_rig_model(task: Task, frame: Frame) -> PriorModel:
    """Make a universal model from simulated skins and the training boards of a task, with the settings of scene lab."""
    from reskin.universal.training import train_networks as train_universal  # imported here, because it imports torch

    section = LAB.section(Compare, "compare")
    setup = make_setup(section, LAB.shared_section(SkinDesign, "skin"))
    boards = dict.fromkeys(map(str, task.train.board))
    presses = {board: to_board_axes(recorded_presses(task, board), section) for board in boards}
    known = KnownBoards(SceneData(LAB.scene, LAB, rows_of_readings(task.train_readings), []), frame, setup, presses)
    laws = {board: fit(own, setup, TEN) for board, own in presses.items()}
    prior = prior_without(known, laws, task.board)
    networks = train_universal(prior, LAB.section(UniversalSection, "universal"), LAB.seed)
    return PriorModel(new_map(tabulate(prior.centre, prior.spreads, setup), prior.residual), networks)


def recorded_presses(task: Task, board: str) -> RecordedPresses:
    """Return the presses of a training board, grouped by recording."""
    own = task.train[task.train.board == board]
    readings = task.train_readings[task.train_readings.board == board]
    noise_uT = (readings.db_uT - own.db_uT[readings.press]).reshape(len(readings), -1, 3).std(axis=(0, 1))
    groups = tuple(f"recording {i}" for i in np.unique(own.recording))
    db_uT, noload_uT = (values.reshape(len(own), -1, 3) for values in (own.db_uT, own.noload_uT))
    return RecordedPresses(
        board, groups, own.recording, own.recording, own.place_mm, own.force_N, db_uT, noload_uT, noise_uT, 0
    )


def rows_of_readings(readings: Presses) -> Rows:
    """Return readings as rows for training, with one skin on each board."""
    press = np.unique(readings.board, return_inverse=True)[1] * (1 + readings.press.max()) + readings.press
    target = np.column_stack([readings.place_mm, readings.force_N]).astype(np.float32)
    board, passes = readings.board, np.zeros(len(readings), np.int32)
    return Rows(board, board, board, readings.db_uT.astype(np.float32), target, passes, press, {})


def rows_of_estimate(task: Task, found: Estimate) -> pa.Table:
    """Return the rows of predictions of an estimate of the universal model, with its 90 % intervals."""
    half_mm, factor = NORMAL_90 * found.sd_mm, np.exp(NORMAL_90 * found.sd_log_N)
    low = np.column_stack([found.place_mm - half_mm, found.force_N / factor])
    high = np.column_stack([found.place_mm + half_mm, found.force_N * factor])
    return task.predictions(found.place_mm, found.force_N, interval_90=np.stack([low, high], axis=2))


class Method(NamedTuple):
    """A method of the benchmark.

    - predict: function that yields the predictions for a list of tasks.
    - datasets: names of the datasets for which the method predicts.
    - trained_on: description of its training data, as written in its entries.
    """

    predict: Callable[[Tasks], Iterator[pa.Table]]
    datasets: tuple[str, ...]
    trained_on: str


BOTH = ("lab", "simulated")
METHODS = {
    "nearest label": Method(nearest_label, DATASETS, "labels"),
    "ridge regression": Method(ridge_on_labels, DATASETS, "labels"),
    "kernel ridge regression": Method(kernel_ridge_on_labels, DATASETS, "labels"),
    "kernel ridge regression on other boards": Method(kernel_ridge_on_other_boards, BOTH, "other boards"),
    "network of the paper": Method(network, BOTH, "other boards, labels"),
    "network of the paper, trained on labels": Method(network, ("eflesh",), "labels"),
    "universal, boards of the rig": Method(universal_of_rig, ("lab",), "other boards, simulated skins, labels"),
    "universal, simulated alone": Method(universal, BOTH, "its own simulated skins, labels"),
}


def enter(predictions: Path, datasets: Sequence[str] = DATASETS) -> None:
    """Predict with every method; write the files of predictions and the entries."""
    for dataset in datasets:
        dataset_tasks = tasks(dataset)
        for name, method in METHODS.items():
            if dataset not in method.datasets:
                continue
            about = About(
                method=name, by="this project", trained_on=method.trained_on, code="pipeline/benchmark/methods.py"
            )
            file = predictions / f"{entry_file(dataset, about.method).stem}.csv"
            write(list(method.predict(dataset_tasks)), file)
            print(f"{file}: {write_entry(score_file(file, about))}")


if __name__ == "__main__":
    enter(Path(sys.argv[1]), sys.argv[2:] or DATASETS)
