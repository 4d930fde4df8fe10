"""Tests of training jobs, and of the keys under which their results are stored in the cache.

A job trains a network on one fold, or adapts a trained network to unlabelled pokes of a new skin, or fine-tunes it to
few labels. A control is trained like an adapted network, but without the unlabelled pokes.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from reskin.data.lines import Lines
from reskin.models import job as job_module
from reskin.models.batches import prepare
from reskin.models.job import JobKeys, TrainingData, TrainingJob, TrainingResult
from reskin.models.recipe import AugmentedRecipe
from reskin.models.train import train_stack
from tests.models.example_jobs import (
    LABELLED,
    POKED,
    ROWS_N,
    TEST,
    TRAIN,
    adaptation,
    example_data,
    fine_tuning,
    lines,
    pooled,
    recipe,
    start,
    with_values,
    without_triplets,
)

NEW = np.arange(24, ROWS_N)  # These are the rows of skins that are not in the training data.
KINDS = {"pooled": pooled, "adapting": adaptation, "few labels": fine_tuning}


def train_job(job: TrainingJob, rows: TrainingData) -> TrainingResult:
    return train_stack([job], rows)[0]


def equal_results(one: TrainingResult, other: TrainingResult) -> bool:
    """Return whether two results have the same weights, scalers and loss curves, bit for bit."""
    weights = all((one.weights[name] == other.weights[name]).all() for name in one.weights)
    scaler, again = one.scaler.arrays(), other.scaler.arrays()
    return weights and one.curve == other.curve and all((scaler[name] == again[name]).all() for name in scaler)


# --- Which data may an adaptation use? ---


@pytest.mark.parametrize("new", [np.nan, 1e3, -7.0], ids=str)
@pytest.mark.parametrize("rows", [POKED, TEST, NEW], ids=["poked", "tested", "all"])
def test_adaptation_ignores_places_and_forces_of_the_new_skin(rows, new):
    once, blind = (
        train_job(adaptation(), example_data()),
        train_job(adaptation(), with_values(example_data(), "target", rows, new)),
    )
    assert equal_results(once, blind)
    assert (once.predicted == blind.predicted).all()


def test_adaptation_depends_on_the_fields_and_the_order_of_the_unlabelled_pokes():
    once, along = train_job(adaptation(), example_data()), lines()
    backwards = replace(along, row=along.row[[0, 2, 4, 1, 3, 5]])
    assert not equal_results(once, train_job(adaptation(along=backwards), example_data()))
    assert not equal_results(once, train_job(adaptation(), with_values(example_data(), "db_uT", POKED[0], 0)))
    assert not equal_results(once, train_job(adaptation(), with_values(example_data(), "target", TRAIN[0], 0)))


def test_unlabelled_pokes_are_scaled_as_for_the_pretrained_network():
    line_i, order_i = np.array([[0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 2, 3]], np.int32)
    along = Lines(np.array([40, 36, 38, 40, 36, 41]), line_i, order_i)
    scaler = replace(start().scaler, input_shift=np.arange(15, dtype=np.float32))
    prepared, used = prepare(
        with_tuning(adaptation(along=along), start=replace(start(), scaler=scaler)), example_data()
    )
    assert used is scaler
    db_uT = example_data().db_uT
    for point, row in enumerate(along.row):
        expected = [(db_uT[row, ch] - scaler.input_shift[ch]) / scaler.input_scale[ch] for ch in range(15)]
        assert prepared.unlabelled.inputs[prepared.unlabelled.row[point]].tolist() == expected
    assert prepared.unlabelled.points.place[:, 0].tolist() == order_i.tolist()
    assert prepared.unlabelled.points.group.tolist() == line_i.tolist()
    assert len(prepared.unlabelled.inputs) == 4


@pytest.mark.parametrize("rows", [POKED, NEW], ids=["poked", "all"])
def test_control_without_unlabelled_pokes_ignores_the_new_skin(rows):
    control = adaptation(unlabelled_weight=0.0)
    once = train_job(control, example_data())
    for part, new in (("db_uT", 1e4), ("target", np.nan)):
        assert equal_results(once, train_job(control, with_values(example_data(), part, rows, new)))
    assert not equal_results(once, train_job(adaptation(), example_data()))


def test_fine_tuning_uses_only_the_given_labels_of_the_new_skin():
    once = train_job(fine_tuning(), example_data())
    others = np.setdiff1d(NEW, LABELLED)
    assert equal_results(once, train_job(fine_tuning(), with_values(example_data(), "target", others, np.nan)))
    assert not equal_results(once, train_job(fine_tuning(), with_values(example_data(), "target", LABELLED, 0)))
    assert not equal_results(once, train_job(fine_tuning(own_weight=0.0), example_data()))


# --- Held-out data must not influence the result. ---


@pytest.mark.parametrize("scaling", ["standard", "released"])
@pytest.mark.parametrize("view", ["raw", "shape"])
def test_trained_network_does_not_depend_on_test_rows(scaling, view):
    job = pooled(scaling=scaling, inputs=view)
    once = train_job(job, example_data())
    planted = with_values(with_values(example_data(), "db_uT", TEST, 1e4), "target", TEST, -1e4)
    again = train_job(job, planted)
    assert equal_results(once, again)
    assert (once.predicted != again.predicted).any()


def test_labelled_triplets_compare_distances_in_mm_on_the_same_skin():
    rows = example_data()
    prepared, _ = prepare(pooled(), rows)
    assert (prepared.labelled.points.place == rows.target[TRAIN, :2]).all()
    assert prepared.labelled.points.group.tolist() == [0] * 12 + [1] * 12
    assert (
        prepare(replace(pooled(), recipe=pooled().recipe.model_copy(update={"triplet_weight": 0.0})), rows)[
            0
        ].labelled.points
        is None
    )


# --- Methods are compared in pairs, so they must be trained on equal batches. ---


# --- Keys, under which training results are stored in the cache ---


def key(job: TrainingJob, rows: TrainingData | None = None) -> str:
    return JobKeys(rows or example_data()).key(job)


def with_tuning(job: TrainingJob, **changes: object) -> TrainingJob:
    return replace(job, tuning=replace(job.tuning, **changes))


def with_row(part: str, row: int, to: object) -> Callable[[], TrainingData]:
    return lambda: with_values(example_data(), part, np.array([row]), to)


INFLUENTIAL_ROWS = {
    "field of a training row": ("pooled", with_row("db_uT", TRAIN[3], 1.0)),
    "target of a training row": ("pooled", with_row("target", TRAIN[3], 1.0)),
    "skin of a training row": ("pooled", with_row("skin", TRAIN[3], "b0_s1")),
    "field of a test row": ("pooled", with_row("db_uT", TEST[3], 1.0)),
    "field of an unlabelled poke": ("adapting", with_row("db_uT", POKED[3], 1.0)),
    "field of a labelled row": ("few labels", with_row("db_uT", LABELLED[1], 1.0)),
    "target of a labelled row": ("few labels", with_row("target", LABELLED[1], 1.0)),
}
OTHER_ROWS = {
    "target of a test row": ("pooled", with_row("target", TEST[3], 1.0)),
    "field of a row that is not used": ("pooled", with_row("db_uT", 30, 1.0)),
    "names of all skins": ("pooled", lambda: replace(example_data(), skin=np.char.add("x", example_data().skin))),
    "skin of a test row": ("pooled", with_row("skin", TEST[3], "b0_s1")),
    "target of an unlabelled poke": ("adapting", with_row("target", POKED[3], np.nan)),
    "target of a row whose label is not used": ("few labels", with_row("target", POKED[5], 1.0)),
}


@pytest.mark.parametrize("what", sorted(INFLUENTIAL_ROWS))
def test_cache_key_changes_if_a_row_that_influences_the_result_changes(what):
    kind, rows = INFLUENTIAL_ROWS[what]
    assert key(KINDS[kind](), rows()) != key(KINDS[kind]())


@pytest.mark.parametrize("what", sorted(OTHER_ROWS))
def test_cache_key_is_unchanged_if_a_row_without_influence_changes(what):
    kind, rows = OTHER_ROWS[what]
    assert key(KINDS[kind](), rows()) == key(KINDS[kind]())


def with_tuning_settings(job: TrainingJob, **changes: object) -> TrainingJob:
    return with_tuning(job, settings=job.tuning.settings.model_copy(update=changes))


def test_different_settings_have_different_cache_keys():
    along = lines()
    jobs = [
        pooled(), adaptation(), fine_tuning(), replace(pooled(), train=TRAIN[1:]), replace(pooled(), test=TEST[1:]),
        *[pooled(**one) for one in (
            {"architecture": "released"}, {"inputs": "shape"}, {"scaling": "released"}, {"steps_n": 5}, {"batch_n": 8},
            {"rate_max": 1e-3}, {"weight_decay": 0.1}, {"gradient_norm_max": 0.5},
        )],
        without_triplets(),
        replace(pooled(), seed=8), replace(pooled(), seed_i=1), replace(pooled(), fold="b0"),
        replace(adaptation(), skin="b1_s0"), with_tuning(adaptation(), start=start("another")),
        with_tuning_settings(adaptation(), steps_n=5),
        with_tuning_settings(adaptation(), unlabelled_weight=0.25), with_tuning_settings(adaptation(), rate_max=1e-4),
        adaptation(along=replace(along, order_i=along.order_i[::-1].copy())),
        adaptation(along=replace(along, line_i=np.array([0, 0, 0, 1, 1, 1], np.int32))),
        adaptation(along=replace(along, row=along.row[::-1].copy())),
        with_tuning(fine_tuning(), row=LABELLED[:2]), with_tuning_settings(fine_tuning(), own_weight=0.25),
    ]  # fmt: skip
    assert len({key(job) for job in jobs}) == len(jobs)


def test_training_is_restarted_after_a_collapse_with_other_weights_and_batches():
    """If a training run collapses to a constant output, it is repeated with other random numbers."""
    again = replace(pooled(), attempt_i=1)
    assert key(again) != key(pooled())
    (one, _), (other, _) = prepare(pooled(), example_data()), prepare(again, example_data())
    assert (one.initial_weights["layer1.weight"] != other.initial_weights["layer1.weight"]).all()
    assert one.rng.integers(1 << 60) != other.rng.integers(1 << 60)


@pytest.mark.parametrize("scaling", ["standard", "released"])
def test_initial_bias_of_the_output_layer_predicts_the_mean_target(scaling):
    job = replace(without_triplets(), recipe=recipe(scaling=scaling))
    rows = with_values(example_data(), "target", np.arange(3), np.nan)
    prepared, scaler = prepare(job, with_values(rows, "target", (slice(None), 2), np.nan))
    predicted = scaler.decode(prepared.initial_weights["layer6.bias"][None])[0]
    np.testing.assert_allclose(predicted[:2], rows.target[TRAIN[3:], :2].mean(axis=0), rtol=1e-5)
    assert prepared.initial_weights["layer6.bias"][2] == 0  # All forces are unknown, so the bias of the force is 0.


def test_cache_key_changes_with_the_code_that_trains(monkeypatch):
    before = key(pooled())
    monkeypatch.setattr(job_module, "digest", lambda name: f"another {name}")
    assert key(pooled()) != before


def test_augmented_copies_have_the_same_targets_and_count_as_new_skins():
    settings = {"copies_n": 2, "gain_sd": 0.0, "lean_sd_deg": 0.0, "noise_uT": 0.0}
    plain = pooled()
    recipe = AugmentedRecipe.model_validate(plain.recipe.model_dump() | {"augmentation": settings})
    (one, _), (more, _) = (prepare(job, example_data()) for job in (plain, replace(plain, recipe=recipe)))
    # Virtual boards whose gains and tilts have no spread do not change the fields. Each row therefore appears three
    # times (the original and two copies) with equal fields and targets.
    np.testing.assert_array_equal(more.labelled.inputs, np.tile(one.labelled.inputs, (3, 1)))
    np.testing.assert_array_equal(more.labelled.targets, np.tile(one.labelled.targets, (3, 1)))
    assert more.labelled.points.group.tolist() == np.repeat(range(6), 12).tolist()
