"""The training loop for a stack of networks, which are trained together (see `reskin.models.network`).

The optimiser is AdamW, with a one-cycle schedule of the learning rate. The networks of a stack do not affect each
other: each network has its own batches, loss and gradient.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float

from reskin.errors import TrainingError
from reskin.models.batches import BatchSampler, PreparedJob, prepare
from reskin.models.inputs import VIEW, Scaler
from reskin.models.job import (
    LossWeights,
    TrainingData,
    TrainingJob,
    TrainingResult,
    Weights,
    curve_steps,
    median_call_s,
)
from reskin.models.losses import squared_error, triplet_loss
from reskin.models.network import LAYERS, Predictor, Stack
from reskin.models.optimiser import AdamW, one_cycle
from reskin.models.recipe import Schedule
from reskin.numerics import device

# Number of steps in a block. The batches of a block are drawn together, and the loss is checked at the end of a block.
BLOCK_STEPS_N = 50
# Training is stopped if the mean squared error exceeds this value, because networks hardly ever recover from such an
# error. The error is in scaled units, in which a network that always predicts the mean has an error of 1.
DIVERGED = 1e8
# A network has collapsed if it predicts nearly the same value for all inputs. This is checked only after this number of
# steps or more, because after fewer steps, the network may not have learned anything yet.
CHECKED_STEPS_N = 200
CHECKED_ROWS_N = 2000  # approximate number of training rows, evenly spaced, on which collapse is checked


@dataclass(frozen=True)
class Outcome:
    """The outcome of training one network.

    weights: the weights of the trained network.
    curve: the loss curve, in scaled units. Point i is the mean squared error over the steps after
        `curve_steps(steps_n)[i - 1]`, up to `curve_steps(steps_n)[i]`.
    stopped_step: None if training did not diverge.

    Training diverges in a block of steps if a loss or a weight is not finite, or if the mean loss exceeds `DIVERGED`.
    In this case, `stopped_step` is the last step of the block, and the weights and the curve are those after the
    previous block.
    """

    weights: Weights
    curve: list[float]
    stopped_step: int | None


def train_stack(jobs: Sequence[TrainingJob], data: TrainingData) -> list[TrainingResult]:
    """Train jobs with equal settings together, and predict the targets of their test rows."""
    # Use one thread, so that the order of summation does not depend on the number of other processes.
    torch.set_num_threads(1)
    started_s, start_s, on, first = time.time(), time.monotonic(), device(), jobs[0]
    if on == "cuda" and not torch.cuda.is_available():
        raise TrainingError(
            "RESKIN_DEVICE is cuda, but torch finds no CUDA device. To train on the CPU, unset RESKIN_DEVICE."
        )
    prepared, scalers = zip(*(prepare(job, data) for job in jobs), strict=True)
    architecture = first.recipe.architecture
    outcomes = train(prepared, architecture, first.schedule, first.loss_weights, on)
    seconds = (time.monotonic() - start_s) / len(jobs)
    results = []
    for job, scaler, outcome in zip(jobs, scalers, outcomes, strict=True):
        network, view = Predictor(outcome.weights, architecture, on), VIEW[job.recipe.inputs](data.db_uT[job.test])
        results.append(
            TrainingResult(
                key="", weights=outcome.weights, scaler=scaler, curve=outcome.curve,
                predicted=_predict(network, scaler, view), stopped_step=outcome.stopped_step, seconds=seconds,
                started_s=started_s,
                explained_min=_explained_min(job, data, network, scaler),
                one_reading_s=median_call_s(partial(_predict, network, scaler, view[:1])),
            )
        )  # fmt: skip
    return results


def train(
    jobs: Sequence[PreparedJob], architecture: str, schedule: Schedule, loss_weights: LossWeights, device: str
) -> list[Outcome]:
    """Train a stack of networks, and return the outcome for each network.

    The loss is the squared error on labelled rows, plus the other loss terms, each multiplied by its weight in
    `loss_weights`. The paper specifies neither the optimiser nor the schedule. This implementation uses AdamW with
    PyTorch's one-cycle schedule of learning rate and momentum.
    """
    layers = LAYERS[architecture](jobs[0].labelled.inputs.shape[1], jobs[0].labelled.targets.shape[1])
    net = Stack(layers, [job.initial_weights for job in jobs]).to(device)
    parameters = list(net.parameters())
    optimizer = AdamW(parameters, schedule.weight_decay)
    batches, monitor = BatchSampler(jobs, schedule.batch_n, device), Monitor(net)
    for first_step in range(0, schedule.steps_n, BLOCK_STEPS_N):
        steps_n = min(BLOCK_STEPS_N, schedule.steps_n - first_step)
        errors = torch.empty((steps_n, len(jobs)), device=device)
        for step_i, batch in enumerate(batches.sample(steps_n), first_step):
            features = net.features(batch["inputs"])  # [m b 40]
            error = loss = squared_error(net.head(features), batch["targets"])  # [m]
            if loss_weights.triplet:
                positive, negative = net.features(batch["positive"]), net.features(batch["negative"])
                loss = loss + loss_weights.triplet * triplet_loss(features, positive, negative)
            if loss_weights.unlabelled:
                anchor = net.features(batch["unlabelled"])
                positive = net.features(batch["unlabelled_positive"])
                negative = net.features(batch["unlabelled_negative"])
                loss = loss + loss_weights.unlabelled * triplet_loss(anchor, positive, negative)
            if loss_weights.few_labels:
                predicted = net(batch["few_labels"])
                loss = loss + loss_weights.few_labels * squared_error(predicted, batch["few_labels_targets"])
            for parameter in parameters:  # faster than `net.zero_grad()`, which goes through all modules
                parameter.grad = None
            # The losses of all networks are added, but the gradient of a network depends only on its own loss.
            loss.sum().backward()
            # Gradients are clipped, because a single large step can make all ReLUs of a layer output 0 forever.
            clip_gradients(parameters, schedule.gradient_norm_max)
            optimizer.step(*one_cycle(step_i, schedule.steps_n, schedule.rate_max))
            errors[step_i - first_step] = error.detach()
        if not monitor.check(errors, first_step + steps_n):
            break
    return monitor.outcomes(schedule.steps_n)


def clip_gradients(parameters: Sequence[torch.Tensor], norm_max: float) -> None:
    """Clip the gradient of each network to a norm of at most `norm_max`.

    The norm is computed over all parameters of the network. A gradient with a larger norm is scaled down.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]  # [m i o]
    norm = torch.linalg.vector_norm(
        torch.stack([torch.linalg.vector_norm(gradient, dim=(1, 2)) for gradient in gradients]), dim=0
    )
    # If the norm is 0, the quotient is infinite and is limited to 1.
    scale = (norm_max / norm).clamp(max=1.0)[:, None, None]
    for gradient in gradients:
        gradient.mul_(scale)


class Monitor:
    """Records the training of each network of a stack, and detects divergence.

    A monitor keeps the errors of all steps. It also keeps the weights of each network after the last block of steps in
    which its training had not diverged.
    """

    def __init__(self, net: Stack) -> None:
        self.net = net
        self.weights = [net.weights_of(i) for i in range(net.members_n)]
        self.sound_steps_n = [0 for _ in self.weights]
        self.errors: list[torch.Tensor] = []
        self.stopped_step: dict[int, int] = {}

    def check(self, errors: Float[torch.Tensor, "s m"], step: int) -> bool:
        """Record the errors of a block of steps that ends at `step`.

        Returns False if the training of all networks has diverged, so that it can be stopped.
        """
        self.errors.append(errors)
        # The comparison is False if the mean error is NaN.
        is_sound = (self.net.is_finite() & (errors.mean(dim=0) <= DIVERGED)).tolist()
        for i in set(range(len(is_sound))) - set(self.stopped_step):
            if is_sound[i]:
                self.sound_steps_n[i] = step
                self.weights[i] = self.net.weights_of(i)
            else:
                self.stopped_step[i] = step
        return len(self.stopped_step) < len(is_sound)

    def outcomes(self, steps_n: int) -> list[Outcome]:
        """Return the outcome of each network. `steps_n` is the number of steps that were planned."""
        errors = torch.cat(self.errors).double().cpu().numpy()
        outcomes = []
        for i, (weights, sound_n) in enumerate(zip(self.weights, self.sound_steps_n, strict=True)):
            edges = [0, *(step for step in curve_steps(steps_n) if step <= sound_n)]
            curve = [float(errors[start:end, i].mean()) for start, end in pairwise(edges)]
            outcomes.append(Outcome(weights, curve, self.stopped_step.get(i)))
        return outcomes


def _explained_min(
    job: TrainingJob, data: TrainingData, network: Callable[[np.ndarray], np.ndarray], scaler: Scaler
) -> float | None:
    """Return the smallest explained variance (R2) among the targets, computed on training rows.

    Targets that are unknown or constant are left out. After a training run of fewer than `CHECKED_STEPS_N` steps, the
    result is None.
    """
    if job.schedule.steps_n < CHECKED_STEPS_N:
        return None
    rows = job.train[:: -(-len(job.train) // CHECKED_ROWS_N)]
    target = data.target[rows].astype(np.float64)
    error = _predict(network, scaler, VIEW[job.recipe.inputs](data.db_uT[rows])) - target
    known = np.flatnonzero(~np.isnan(target).all(axis=0))
    varying = [i for i in known if np.nanvar(target[:, i]) > 0]
    return min((float(1 - np.nanmean(error[:, i] ** 2) / np.nanvar(target[:, i])) for i in varying), default=None)


def _predict(network: Callable[[np.ndarray], np.ndarray], scaler: Scaler, view: np.ndarray) -> np.ndarray:
    return scaler.decode(network(scaler.encode(view)))
