"""Tests of training with a few labels on a new board: folds, labels, scalers, adaptation, fine-tuning."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.training import few_labels as few
from pipeline.training.few_labels import FewLabels as Settings
from reskin.config import parse
from reskin.data.rows import Rows
from reskin.data.splits import Split, draw_folds
from reskin.errors import ParamsError
from reskin.models.batches import prepare
from reskin.models.classical import ClassicalJob
from reskin.models.job import Adaptation, FineTuning, JobKeys, TrainingData, TrainingJob, TrainingResult
from reskin.seeds import rng_for
from tests.scenes import RECIPE

SKINS = ("b0_s0", "b0_s1", "b1_s0", "b2_s0")
PLACES_N, PASSES_N, READINGS_N = 9, 2, 2
SCHEDULE = {"steps_n": 1, "batch_n": 8, "rate_max": 1e-3, "gradient_norm_max": 1.0, "weight_decay": 0.0}
SETTINGS = {
    "labels_n": [0, 2, 5],
    "recipes": {"plain": RECIPE, "triplet": RECIPE | {"inputs": "shape", "triplet_weight": 0.1}},
    "adapted": ["triplet"],
    "adapting": SCHEDULE | {"unlabelled_weight": 0.1},
    "labelling": SCHEDULE | {"own_weight": 1.0},
    "rows_max_n": 40,
    "methods": {
        "ridge": {"method": "ridge", "inputs": "raw", "alpha": 1.0},
        "knn-shape": {"method": "knn", "inputs": "shape", "neighbours_n": 3},
    },
}
METHODS = [
    ("plain", "raw"), ("triplet", "shape"), ("triplet, adapted", "shape"), ("ridge", "raw"),
    ("k nearest neighbours", "shape"),
]  # fmt: skip


def example_rows() -> Rows:
    """Return rows of two skins on board b0, and of one skin on each other board.

    Each skin has 3 x 3 places, two passes, and two readings per press.
    """
    own_n = PLACES_N * PASSES_N * READINGS_N
    rng, f = rng_for(0, "few labels"), len(SKINS) * own_n
    place_i = np.tile(np.arange(PLACES_N).repeat(READINGS_N), len(SKINS) * PASSES_N)
    target = np.stack([4 * (place_i % 3), 4 * (place_i // 3), rng.uniform(0.5, 3, f)], axis=1)
    skin = np.repeat(SKINS, own_n)
    return Rows(
        np.char.add("c_", skin), np.array([name[:2] for name in skin]), skin,
        rng.normal(0, 50, (f, 15)).astype(np.float32), target.astype(np.float32),
        np.tile(np.arange(PASSES_N).repeat(PLACES_N * READINGS_N), len(SKINS)).astype(np.int32),
        np.arange(f) // READINGS_N, {},
    )  # fmt: skip


ROWS = example_rows()


def study(seed: int = 5, rows: Rows = ROWS, **changes: object) -> few.Study:
    folds = draw_folds(ROWS, ["labels"], Split(labels_pool_n=8, labels_draws_n=2), seed)
    return few.Study(rows, folds, seed, parse(Settings, SETTINGS | changes, "scene: few_labels"))


def training_data(rows: Rows) -> TrainingData:
    return TrainingData(rows.db_uT, rows.target, rows.skin)


def initial_result(job: TrainingJob) -> TrainingResult:
    """Return a result that has the initial weights and the fitted scaler of a job."""
    prepared, scaler = prepare(job, training_data(ROWS))
    return TrainingResult(
        f"key of {job.name}",
        prepared.initial_weights,
        scaler,
        [1.0],
        np.zeros((0, 3), np.float32),
        None,
        None,
        seconds=0.0,
        started_s=0.0,
        one_reading_s=0.0,
    )


def networks_of(tested_study: few.Study) -> list[few.TrainedEntry]:
    """Return all entries of the study with their jobs, and results that are not trained.

    They are in the order of the steps of the stage.
    """
    done: list[few.TrainedEntry] = []
    for step in (few.network_jobs, few.adaptation_jobs, few.fine_tuning_jobs):
        done = [*done, *((entry, job, initial_result(job)) for entry, job in step(tested_study, done))]
    return done


STUDY = study()
NETWORKS = networks_of(STUDY)
TASKS = few.classical_jobs(STUDY)
ADAPTED = [job for _, job, _ in NETWORKS if isinstance(job.tuning, Adaptation)]
LABELLED = [(entry, job) for entry, job, _ in NETWORKS if isinstance(job.tuning, FineTuning)]


def all_entries(
    tested_study: few.Study, networks: list[few.TrainedEntry]
) -> list[tuple[few.Entry, TrainingJob | ClassicalJob]]:
    return [*((entry, job) for entry, job, _ in networks), *few.classical_jobs(tested_study)]


def test_there_is_one_entry_per_method_fold_and_number_of_labels():
    folds = [f"b{board}-draw{draw}" for board in range(3) for draw in range(2)]
    assert [fold.name for fold in STUDY.folds] == folds
    entry = Counter((one.method, one.inputs, one.fold.name, one.labels_n) for one, _ in all_entries(STUDY, NETWORKS))
    assert entry == Counter((*method, fold, n) for method in METHODS for fold in folds for n in (0, 2, 5))


def test_all_jobs_of_the_study_have_different_names():
    names = [one.name for _, one in all_entries(STUDY, NETWORKS)]
    assert len(set(names)) == len(names) == 3 * 2 * 3 * len(METHODS)


def test_all_entries_of_a_fold_have_its_test_and_training_rows():
    for entry, one in all_entries(STUDY, NETWORKS):
        assert (one.test == entry.fold.test).all()
        assert (one.train == entry.fold.train).all()
        assert {*ROWS.board[one.test]} == {entry.fold.name[:2]}
        assert entry.fold.name[:2] not in {*ROWS.board[one.train]}


def labels_of(one: TrainingJob | ClassicalJob) -> np.ndarray:
    return one.few_labels if isinstance(one, ClassicalJob) else one.tuning.row


def with_labels(
    tested_study: few.Study, networks: list[few.TrainedEntry]
) -> list[tuple[few.Entry, TrainingJob | ClassicalJob]]:
    return [(entry, one) for entry, one in all_entries(tested_study, networks) if entry.labels_n]


def test_labels_are_whole_indentations_of_the_pool():
    for entry, one in with_labels(STUDY, NETWORKS):
        labelled_rows = labels_of(one)
        assert {*labelled_rows} <= {*entry.fold.pool}
        labelled = np.unique(ROWS.indentation[labelled_rows])
        assert len(labelled) == entry.labels_n
        # All readings of the labelled indentations are used, and no others.
        assert {*labelled_rows} == {*np.flatnonzero(np.isin(ROWS.indentation, labelled))}
        assert not {*labelled} & {*ROWS.indentation[one.test]}


def test_entries_for_zero_labels_contain_no_labels():
    for entry, one in all_entries(STUDY, NETWORKS):
        if not entry.labels_n:
            assert len(one.few_labels) == 0 if isinstance(one, ClassicalJob) else not isinstance(one.tuning, FineTuning)


def test_labels_of_a_fold_are_the_same_for_all_methods():
    given_labels: dict[tuple[str, int], set[tuple[int, ...]]] = {}
    for entry, one in with_labels(STUDY, NETWORKS):
        given_labels.setdefault((entry.fold.name, entry.labels_n), set()).add(tuple(labels_of(one)))
    assert {len(labels) for labels in given_labels.values()} == {1}
    assert len(set.union(*given_labels.values())) == 3 * 2 * 2


def test_labelled_pokes_are_drawn_for_each_fold():
    numbers = [
        tuple(np.flatnonzero(np.isin(np.unique(ROWS.indentation[fold.pool]), ROWS.indentation[labels_of(one)])))
        for fold in STUDY.folds
        for entry, one in with_labels(STUDY, [])
        if entry.fold is fold and entry.method == "ridge" and entry.labels_n == 5
    ]
    assert len(set(numbers)) == len(numbers) == len(STUDY.folds)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.integers(0, 8), min_size=2, max_size=4, unique=True))
def test_smaller_set_of_labels_is_part_of_each_larger_set(seed, labels_n):
    tested_study = study(seed, labels_n=labels_n)
    tasks = few.classical_jobs(tested_study)
    rows = {(entry.fold.name, entry.labels_n): {*task.few_labels} for entry, task in tasks if "ridge" in task.name}
    for fold in tested_study.folds:
        for less, more in pairwise(sorted(labels_n)):
            assert rows[fold.name, less] < rows[fold.name, more]


def test_labels_depend_on_the_seed_but_not_on_the_order_of_rows():
    first, repeated, other, reordered = (
        [sorted(task.few_labels.tolist()) for entry, task in few.classical_jobs(tested_study) if entry.labels_n == 5]
        for tested_study in (study(), study(), replace(study(), seed=6), study(labels_n=[5, 0]))
    )
    assert first == repeated == reordered
    assert all(one != changed for one, changed in zip(first, other, strict=True))


def with_unknown_targets(what: np.ndarray, rows: Rows = ROWS) -> Rows:
    """Return the rows, with NaN as place and force of the rows `what`."""
    target = rows.target.copy()
    target[what] = np.nan
    return replace(rows, target=target)


def test_scaler_ignores_labels_of_the_new_board():
    pooled = {(entry.method, entry.fold.name): one.scaler for entry, job, one in NETWORKS if job.tuning is None}
    for entry, job in LABELLED:
        changed = training_data(ROWS).db_uT.copy()
        changed[job.tuning.row] += 500
        changed_data = replace(training_data(ROWS), db_uT=changed)
        (prepared, scaler), (other, same) = (prepare(job, data) for data in (training_data(ROWS), changed_data))
        for name, values in pooled[entry.method.removesuffix(", adapted"), entry.fold.name].arrays().items():
            assert (scaler.arrays()[name] == values).all()
            assert (same.arrays()[name] == values).all()
        # Although the scaler ignores the labels, they are used for training.
        assert (other.few_labels.inputs != prepared.few_labels.inputs).any()
        assert len(prepared.few_labels.inputs) == READINGS_N * entry.labels_n


def test_fine_tuning_starts_from_the_network_of_its_fold():
    by_key = {one.key: entry for entry, _, one in NETWORKS}
    for entry, job in LABELLED:
        base = by_key[job.tuning.start.key]
        assert (base.method, base.inputs, base.fold, base.labels_n) == (entry.method, entry.inputs, entry.fold, 0)


def test_only_networks_listed_in_the_settings_are_adapted():
    assert [(job.recipe_name, job.fold) for job in ADAPTED] == [("triplet", fold.name) for fold in STUDY.folds]
    for job, fold in zip(ADAPTED, STUDY.folds, strict=True):
        # All rows of the pool are on a line, because each of the 8 places on the 3 x 3 grid has a neighbour.
        assert {*job.tuning.lines.row} == {*fold.pool}
    assert few.adaptation_jobs(study(adapted=[]), untrained_networks(study(adapted=[]))) == []


def untrained_networks(tested_study: few.Study) -> list[few.TrainedEntry]:
    return [(entry, job, initial_result(job)) for entry, job in few.network_jobs(tested_study, [])]


def test_adaptation_does_not_use_labels_of_the_new_board():
    for job in ADAPTED:
        unlabelled_data = training_data(with_unknown_targets(ROWS.board == job.fold[:2]))
        prepared, other = prepare(job, training_data(ROWS))[0], prepare(job, unlabelled_data)[0]
        assert prepared.few_labels is other.few_labels is None
        assert (prepared.labelled.inputs == other.labelled.inputs).all()
        assert (prepared.labelled.targets == other.labelled.targets).all()
        assert (prepared.unlabelled.inputs == other.unlabelled.inputs).all()
        assert (prepared.unlabelled.row == other.unlabelled.row).all()
        assert prepared.rng.integers(2**63) == other.rng.integers(2**63)
        assert JobKeys(training_data(ROWS)).key(job) == JobKeys(unlabelled_data).key(job)


def test_adaptation_uses_only_the_order_along_lines():
    stretched = replace(ROWS, target=(ROWS.target * np.float32([3, 0.5, 0]) + np.float32([7, -2, 1])))
    done = untrained_networks(STUDY)
    pairs = zip(few.adaptation_jobs(STUDY, done), few.adaptation_jobs(study(rows=stretched), done), strict=True)
    for (_, job), (_, other) in pairs:
        for name, values in vars(job.tuning.lines).items():
            assert (values == getattr(other.tuning.lines, name)).all()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"adapted": ["network"]}, r"adapted must name recipes of few_labels, not \['network'\]"),
        ({"labels_n": []}, "labels_n must"),
        ({"labels_n": [-1]}, "labels_n.0 must be greater than or equal to 0; got -1"),
        ({"rows_max_n": 0}, "rows_max_n must be greater than or equal to 1; got 0"),
        ({"methods": {"tree": {"method": "tree", "inputs": "raw"}}}, "methods.tree must"),
    ],
)
def test_invalid_few_labels_settings_are_an_error(changes, sentence):
    with pytest.raises(ParamsError, match=sentence):
        study(**changes)
