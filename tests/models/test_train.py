"""Tests of the training loop for a stack, which consists of several networks that are trained together."""

from dataclasses import replace
from itertools import chain, pairwise

import numpy as np
import pytest
import torch
from torch import nn

from reskin.models.batches import BatchSampler, LabelledRows, PreparedJob
from reskin.models.job import LossWeights, Weights, curve_steps
from reskin.models.network import Stack, paper_layers
from reskin.models.recipe import Recipe
from reskin.models.train import BLOCK_STEPS_N, Monitor, Outcome, clip_gradients, train
from reskin.seeds import rng_for
from tests.models.example_jobs import recipe, some_job, some_weights
from tests.models.plain import plain_net, plain_train

ALL_TERMS = LossWeights(0.5, unlabelled=0.7, few_labels=0.3)
NO_TERMS = LossWeights(0.0)
# Tolerance for weights, relative to their distance from the initial weights. Sums differ by 6e-8 of a term if the order
# of terms, the processor or the memory alignment changes. Such a difference can make a ReLU positive for one more row.
# Then all weights of this unit change by a whole step, because AdamW divides a gradient by its size. One of 200 units
# changes the distance from the initial weights by at most 7 %. A missing loss term changes this distance by more.
DISTANCE_MAX = 2e-2


def run(jobs: list[PreparedJob], schedule: Recipe, terms: LossWeights = NO_TERMS) -> list[Outcome]:
    return train(jobs, "paper", schedule, terms, "cpu")


def same(one: Outcome, other: Outcome) -> bool:
    weights = all((one.weights[name] == other.weights[name]).all() for name in one.weights)
    return weights and one.curve == other.curve and one.stopped_step == other.stopped_step


def block_sizes(steps_n: int) -> list[int]:
    return [BLOCK_STEPS_N] * (steps_n // BLOCK_STEPS_N) + [steps_n % BLOCK_STEPS_N] * (steps_n % BLOCK_STEPS_N > 0)


def test_gradients_of_each_network_are_clipped_separately():
    net = Stack(paper_layers(15), [some_weights(i) for i in range(3)])
    lengths = torch.tensor([0.0, 0.5, 70.0])
    for parameter in net.parameters():
        gradient = torch.from_numpy(rng_for(0, "gradient", str(tuple(parameter.shape))).normal(size=parameter.shape))
        parameter.grad = gradient.float()
    whole = torch.cat([one.grad.flatten(1) for one in net.parameters()], dim=1).norm(dim=1)
    for parameter in net.parameters():
        parameter.grad *= (lengths / whole)[:, None, None]
    before = [parameter.grad.clone() for parameter in net.parameters()]
    clip_gradients(list(net.parameters()), 1.0)
    after = torch.cat([one.grad.flatten(1) for one in net.parameters()], dim=1)
    torch.testing.assert_close(after.norm(dim=1), torch.tensor([0.0, 0.5, 1.0]))
    torch.testing.assert_close(after[2] * 70, torch.cat([one.flatten(1) for one in before], dim=1)[2])


@pytest.mark.parametrize(("terms", "batch_n"), [(NO_TERMS, 1), (ALL_TERMS, 16), (NO_TERMS, 128)])
def test_networks_trained_in_a_stack_equal_networks_trained_alone(terms, batch_n):
    schedule = recipe(steps_n=60, rate_max=5e-4, batch_n=batch_n)
    together = run([some_job(i, terms=True) for i in range(3)], schedule, terms)
    for i in range(3):
        (alone,) = run([some_job(i, terms=True)], schedule, terms)
        assert (
            relative_distance(together[i].weights, alone.weights, some_job(i, terms=True).initial_weights)
            < DISTANCE_MAX
        )
        np.testing.assert_allclose(together[i].curve, alone.curve, rtol=1e-3)


@pytest.mark.parametrize(  # Weight decay does not depend on the loss terms, so only some of the cases use it.
    ("terms", "decay"),
    [
        (NO_TERMS, 0.0),
        (LossWeights(0.5), 10.0),
        (LossWeights(0.0, unlabelled=0.7), 0.0),
        (LossWeights(0.0, few_labels=0.3), 10.0),
        (ALL_TERMS, 10.0),
    ],
    ids=str,
)
def test_network_trained_in_a_stack_equals_a_plain_pytorch_loop(terms, decay):
    schedule, steps_n = recipe(steps_n=70, rate_max=5e-4, weight_decay=decay), 70
    (outcome,) = run([some_job(terms=True)], schedule, terms)
    feed = BatchSampler([some_job(terms=True)], schedule.batch_n, "cpu")
    batches = chain.from_iterable(feed.sample(n) for n in block_sizes(steps_n))
    truth = plain_train(some_job().initial_weights, batches, schedule, terms)
    assert relative_distance(outcome.weights, truth, some_job(terms=True).initial_weights) < DISTANCE_MAX


def relative_distance(weights: Weights, truth: Weights, start: Weights) -> float:
    """Return the distance of the weights from `truth`, divided by the distance of the initial weights from `truth`."""
    off, start_off = (
        np.concatenate([(truth[name] - other[name]).ravel() for name in truth]) for other in (weights, start)
    )
    return float(np.linalg.norm(off) / np.linalg.norm(start_off))


@pytest.mark.parametrize("name", ["triplet", "unlabelled", "few_labels"])
def test_each_loss_term_changes_the_weights(name):
    schedule = recipe(steps_n=10)
    job = some_job(terms=True)
    (with_it,) = run([job], schedule, replace(NO_TERMS, **{name: 0.5}))
    (without,) = run([some_job(terms=True)], schedule)
    assert not same(with_it, without)
    stripped = PreparedJob(
        job.initial_weights, some_job().rng, LabelledRows(job.labelled.inputs, job.labelled.targets, None)
    )
    assert same(without, run([stripped], schedule)[0])


def test_unlabelled_pokes_train_the_feature_layers_only():
    # One large step. Gradients are not clipped, because clipping would scale the gradients of all layers.
    far = recipe(steps_n=1, rate_max=1e-2, gradient_norm_max=1e12)
    (outcome,) = run([some_job(terms=True)], far, LossWeights(0.0, unlabelled=1e6))
    (plain,) = run([some_job(terms=True)], far)
    for i in range(1, 7):
        name = f"layer{i}.weight"
        assert (outcome.weights[name] != plain.weights[name]).any() == (i <= 3)


@pytest.mark.parametrize("steps_n", [1, 2, 49, 50, 51, 120])
def test_points_of_the_loss_curve_are_mean_losses_since_the_previous_point(steps_n):
    schedule = recipe(steps_n=steps_n, rate_max=1e-12)  # The learning rate is so low that weights hardly change.
    job = some_job()
    (outcome,) = run([job], schedule)
    feed, net, losses = BatchSampler([some_job()], schedule.batch_n, "cpu"), plain_net("paper", job.initial_weights), []
    for n in block_sizes(steps_n):
        losses += [nn.functional.mse_loss(net(b["inputs"][0]), b["targets"][0]).item() for b in feed.sample(n)]
    means = [sum(losses[start:end]) / (end - start) for start, end in pairwise([0, *curve_steps(steps_n)])]
    assert outcome.curve == pytest.approx(means, rel=1e-5)  # The tolerance is the rounding of sums in single precision.


@pytest.mark.parametrize(("n", "batch_n"), [(1, 1), (1, 16), (3, 16), (17, 1), (32, 100)])
def test_training_works_for_any_number_of_rows_and_any_batch_size(n, batch_n):
    (outcome,) = run([some_job(n=n)], recipe(steps_n=3, batch_n=batch_n))
    assert np.isfinite(outcome.curve).all()
    assert outcome.stopped_step is None


def scale_inputs(job: PreparedJob, times: float) -> PreparedJob:
    return replace(job, labelled=replace(job.labelled, inputs=(job.labelled.inputs * times).astype(np.float32)))


def test_divergence_restores_the_weights_of_the_previous_block(monkeypatch):
    """Row 0 makes the network diverge. It is drawn for the first time in the second block of steps."""
    n, schedule = 60, recipe(steps_n=170, batch_n=1)
    seed = next(seed for seed in range(1000) if first_step_of_row_0(n, seed) // BLOCK_STEPS_N == 1)
    broken, sound = some_job(n=n, draws=seed), some_job(n=n, draws=seed)
    broken.labelled.inputs[0] = 1e30
    checks, look = [], Monitor.check
    monkeypatch.setattr(
        Monitor, "check", lambda self, *found: checks.append(self.net.weights_of(0)) or look(self, *found)
    )
    (whole,) = run([sound], schedule)
    (outcome,) = run([broken], schedule)
    # The first training run makes a check after each block. The second run makes only two checks, because it then has
    # no network left to train.
    assert len(checks) == len(block_sizes(170)) + 2
    assert outcome.stopped_step == 2 * BLOCK_STEPS_N
    assert outcome.curve == whole.curve[: sum(step <= BLOCK_STEPS_N for step in curve_steps(170))]
    assert all((outcome.weights[name] == checks[0][name]).all() for name in checks[0])
    assert any((outcome.weights[name] != broken.initial_weights[name]).any() for name in checks[0])


def first_step_of_row_0(n: int, seed: int) -> int:
    job = some_job(n=n, draws=seed)
    feed = BatchSampler([job], 1, "cpu")
    steps = chain.from_iterable(feed.sample(BLOCK_STEPS_N) for _ in range(2))
    steps_with_row_0 = [
        i for i, step in enumerate(steps) if (step["inputs"][0, 0].numpy() == job.labelled.inputs[0]).all()
    ]
    return steps_with_row_0[0] if steps_with_row_0 else -1


def test_network_that_diverges_does_not_affect_others_of_the_stack():
    schedule = recipe(steps_n=BLOCK_STEPS_N + 10)
    well = run([some_job(i, terms=True) for i in range(3)], schedule, ALL_TERMS)
    jobs = [some_job(i, terms=True) for i in range(3)]
    first, ill, last = run([jobs[0], scale_inputs(jobs[1], 1e30), jobs[2]], schedule, ALL_TERMS)
    assert same(first, well[0])
    assert same(last, well[2])
    assert ill.stopped_step == BLOCK_STEPS_N
    assert ill.curve == []
    assert len(first.curve) == len(curve_steps(schedule.steps_n))
