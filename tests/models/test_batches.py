"""Tests of the batches of networks that are trained together as a stack.

The loss of a network can have several terms. Each term has a batch of its own in each training step.
"""

import numpy as np
import torch

from reskin.models.batches import Batch, BatchSampler, PreparedJob
from tests.models.example_jobs import some_job

STEPS_N, BATCH_N = 20, 16
UNLABELLED = ("unlabelled", "unlabelled_positive", "unlabelled_negative")


def batches(jobs: list[PreparedJob], steps_n: int = STEPS_N, batch_n: int = BATCH_N) -> list[Batch]:
    return list(BatchSampler(jobs, batch_n, "cpu").sample(steps_n))


def rows_of(batch: torch.Tensor, rows: np.ndarray) -> list[int]:
    """Return the numbers of the rows in the batch of a network.

    No two rows are equal, so rows are identified by content.
    """
    (found,) = [np.argmax((rows[None] == batch.numpy()[:, None]).all(axis=2), axis=1)]
    assert (rows[found] == batch.numpy()).all()
    return found.tolist()


def test_every_step_has_a_batch_for_each_term():
    steps = batches([some_job(i, terms=True) for i in range(3)])
    assert len(steps) == STEPS_N
    for step in steps:
        assert {name: tuple(values.shape) for name, values in step.items()} == {
            name: (3, BATCH_N, 3 if name.endswith("targets") else 15)
            for name in ("inputs", "targets", "positive", "negative", *UNLABELLED, "few_labels", "few_labels_targets")
        }


def test_targets_in_a_batch_belong_to_the_inputs_of_the_same_row():
    jobs = [some_job(i, n=n, terms=True) for i, n in enumerate((12, 32, 17))]
    for step in batches(jobs):
        for i, job in enumerate(jobs):
            chosen = rows_of(step["inputs"][i], job.labelled.inputs)
            assert (step["targets"][i].numpy() == job.labelled.targets[chosen]).all()
            labelled_rows = rows_of(step["few_labels"][i], job.few_labels.inputs)
            assert (step["few_labels_targets"][i].numpy() == job.few_labels.targets[labelled_rows]).all()
            rows_of(step["unlabelled"][i], job.unlabelled.inputs)


def test_positive_is_nearer_than_the_negative_in_labelled_triplets():
    job = some_job(terms=True)
    place, group = job.labelled.points.place, job.labelled.points.group
    for step in batches([job]):
        three = zip(
            *(rows_of(step[name][0], job.labelled.inputs) for name in ("inputs", "positive", "negative")), strict=True
        )
        for anchor, near, far in three:
            assert group[anchor] == group[near] == group[far]
            assert ((place[anchor] - place[near]) ** 2).sum() < ((place[anchor] - place[far]) ** 2).sum()


def test_triplets_of_unlabelled_pokes_are_ordered_along_one_line():
    """In a triplet, the positive poke must be nearer to the anchor than the negative poke.

    As rows can be on two lines, this must hold on one of the lines.
    """
    job = some_job(terms=True)
    points, row = job.unlabelled.points, job.unlabelled.row
    lines_of = {r: {(points.group[q], points.place[q, 0]) for q in np.flatnonzero(row == r)} for r in range(20)}
    met = set()
    for step in batches([job], 40):
        for three in zip(*(rows_of(step[name][0], job.unlabelled.inputs) for name in UNLABELLED), strict=True):
            on_one_line = [
                (line, abs(a - p), abs(a - n))
                for line, a in lines_of[three[0]] for of_p, p in lines_of[three[1]] for of_n, n in lines_of[three[2]]
                if line == of_p == of_n
            ]  # fmt: skip
            assert any(near < far for _, near, far in on_one_line)
            met |= {line for line, _, _ in on_one_line}
    assert met == {0, 1, 2}


def test_rows_are_drawn_with_equal_probability():
    job, n = some_job(n=8), 400 * BATCH_N
    rows = np.concatenate([rows_of(step["inputs"][0], job.labelled.inputs) for step in batches([job], 400)])
    # The tolerance is six standard deviations of a binomial distribution.
    assert (np.abs(np.bincount(rows, minlength=8) - n / 8) < 6 * (n * 7 / 64) ** 0.5).all()


def test_batches_of_other_terms_stay_the_same_if_a_loss_term_is_added():
    """Methods are compared on equal batches.

    Therefore, in every block of training steps, adding a loss term must not change the random draws for other terms.
    """
    full = some_job(terms=True)
    without = {
        "triplet": PreparedJob(
            full.initial_weights, some_job().rng, some_job().labelled, full.unlabelled, full.few_labels
        ),
        "unlabelled": PreparedJob(full.initial_weights, some_job().rng, full.labelled, None, full.few_labels),
        "few_labels": PreparedJob(full.initial_weights, some_job().rng, full.labelled, full.unlabelled),
    }
    feed = BatchSampler([full], BATCH_N, "cpu")
    blocks = [list(feed.sample(STEPS_N)) for _ in range(3)]
    for job in without.values():
        less = BatchSampler([job], BATCH_N, "cpu")
        for block in blocks:
            for one, other in zip(less.sample(STEPS_N), block, strict=True):
                assert all(torch.equal(one[name], other[name]) for name in one)
