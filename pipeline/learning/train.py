"""The one training loop, for a stack of networks. In: trials of equal settings, rows. Out: a finished training of each.

Read it from top to bottom. Networks of a stack never touch each other. Below it stand AdamW and its one-cycle rate, as
torch.optim has them, bit for bit: that imports torch's compiler at its first optimizer, two seconds of every process
that trains. Refuses to know files, processes and scores.
"""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float

from pipeline.core.errors import TrainingError
from pipeline.core.executors import device, median_s
from pipeline.learning.inputs import VIEW, Scaler
from pipeline.learning.job import UNLABELLED, Feed, Job, make_job
from pipeline.learning.model import LAYERS, Predictor, Stack
from pipeline.learning.recipe import Schedule
from pipeline.learning.trial import Measured, Terms, Trained, Trial, Weights

BLOCK_STEPS_N = 50  # batches drawn at once, and how often the loss is looked at
LOST = 1e8  # mean squared error past which a network is lost, where predicting the mean has 1; few come back from it
JUDGED_STEPS_N = 200  # a shorter training from random weights may not have left its start
JUDGED_ROWS_N = 2000  # of the training rows, evenly spaced


def train_stack(trials: Sequence[Trial], rows: Measured) -> list[Trained]:
    """Train trials of equal settings side by side, and predict their test rows."""
    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    start_s, on, first = time.monotonic(), device(), trials[0]
    if on == "cuda" and not torch.cuda.is_available():
        raise TrainingError("RESKIN_DEVICE", "cuda", "there", "none that torch finds", "Unset it for cpu.")
    jobs, scalers = zip(*(make_job(trial, rows) for trial in trials), strict=True)
    architecture = first.recipe.architecture
    outcomes = train(jobs, architecture, first.schedule, first.terms, on)
    seconds = (time.monotonic() - start_s) / len(trials)
    trained = []
    for trial, scaler, outcome in zip(trials, scalers, outcomes, strict=True):
        view = VIEW[trial.recipe.inputs](rows.db_uT[trial.test])
        predict = Predictor(outcome.weights, architecture, on)
        trained.append(
            Trained(
                key="", weights=outcome.weights, scaler=scaler, curve=outcome.curve,
                predicted=_answer(scaler, predict, view), stopped_step=outcome.stopped_step, seconds=seconds,
                explained_min=_explained(trial, rows, scaler, predict),
                one_reading_s=median_s(partial(_answer, scaler, predict, view[:1])),
            )
        )  # fmt: skip
    return trained


@dataclass(frozen=True)
class Outcome:
    """A trained network, and the mean L2 loss of every block of steps (scaled units).

    `stopped_step` says when a loss or a weight was no longer finite, or the loss past `LOST`; the weights are then the
    last ones before.
    """

    weights: Weights
    curve: list[float]
    stopped_step: int | None


def train(jobs: Sequence[Job], architecture: str, schedule: Schedule, terms: Terms, device: str) -> list[Outcome]:
    """Descend the L2 loss and the terms beside it; AdamW under torch's one-cycle rate and momentum are our choice."""
    layers = LAYERS[architecture](jobs[0].labelled.inputs.shape[1], jobs[0].labelled.targets.shape[1])
    net = Stack(layers, [job.start for job in jobs]).to(device)
    optimizer = AdamW(net.parameters(), schedule.weight_decay)
    feed, watch = Feed(jobs, schedule.batch_n, device), Watch(net)
    for first in range(0, schedule.steps_n, BLOCK_STEPS_N):
        steps_n = min(BLOCK_STEPS_N, schedule.steps_n - first)
        total = torch.zeros(len(jobs), device=device)
        for step_i, batch in enumerate(feed.draw(steps_n), first):
            features = net.features(batch["labelled"])  # [m b 40]
            error = loss = squared_error(net.answer(features), batch["targets"])  # [m]
            if terms.triplet:
                near, far = net.features(batch["near"]), net.features(batch["far"])
                loss = loss + terms.triplet * triplet(features, near, far)
            if terms.unlabelled:
                anchor, near, far = (net.features(batch[name]) for name in UNLABELLED)
                loss = loss + terms.unlabelled * triplet(anchor, near, far)
            if terms.few_labels:
                loss = loss + terms.few_labels * squared_error(net(batch["few_labels"]), batch["few_labels_targets"])
            net.zero_grad()
            loss.sum().backward()  # of a sum, each network's gradient is its own
            clip(net, schedule.gradient_norm_max)  # one step too long can leave all ReLUs of a layer dead for good
            optimizer.step(*one_cycle(step_i, schedule.steps_n, schedule.rate_max))
            total += error.detach()
        if not watch.look(total / steps_n, first + steps_n):
            break
    return watch.outcomes()


def clip(net: Stack, norm_max: float) -> None:
    """Shorten the gradient of each network of a stack, all its weights as one vector, to at most `norm_max`."""
    gradients = [parameter.grad for parameter in net.parameters() if parameter.grad is not None]  # [m i o]
    norm = torch.linalg.vector_norm(
        torch.stack([torch.linalg.vector_norm(gradient, dim=(1, 2)) for gradient in gradients]), dim=0
    )
    part = (norm_max / norm).clamp(max=1.0)[:, None, None]  # of a gradient of 0, 1
    for gradient in gradients:
        gradient.mul_(part)


def squared_error(
    predicted: Float[torch.Tensor, "m b t"], truth: Float[torch.Tensor, "m b t"]
) -> Float[torch.Tensor, " m"]:
    """Mean of squared errors over all known targets of a batch; an unknown target (NaN) has no gradient."""
    known = ~torch.isnan(truth)
    # Filled before it is squared: NaN times zero is NaN, in the gradient too.
    difference = torch.where(known, predicted - truth, 0.0)
    return (difference**2).sum((1, 2)) / known.sum((1, 2))


def triplet(
    anchor: Float[torch.Tensor, "m b d"], positive: Float[torch.Tensor, "m b d"], negative: Float[torch.Tensor, "m b d"]
) -> Float[torch.Tensor, " m"]:
    """Batch mean of max(0, |a - p|^2 - |a - n|^2), squared distances of features without a margin (section 5).

    Squares, not roots: the gradient of identical points is 0 and finite.
    """
    nearer = ((anchor - positive) ** 2).sum(-1)
    farther = ((anchor - negative) ** 2).sum(-1)
    return torch.relu(nearer - farther).mean(-1)


class Watch:
    """Remembers each network's curve and its last finite weights."""

    def __init__(self, net: Stack) -> None:
        self.net = net
        self.last = [net.member(i) for i in range(net.members_n)]
        self.curves: list[list[float]] = [[] for _ in self.last]
        self.stopped: dict[int, int] = {}

    def look(self, error: Float[torch.Tensor, " m"], step: int) -> bool:
        """Note a block's mean errors; false when no network of the stack is finite any more."""
        sound = (self.net.finite() & (error <= LOST)).tolist()  # of NaN, nothing is true
        for i in set(range(len(sound))) - set(self.stopped):
            if sound[i]:
                self.curves[i].append(float(error[i]))
                self.last[i] = self.net.member(i)
            else:
                self.stopped[i] = step
        return len(self.stopped) < len(sound)

    def outcomes(self) -> list[Outcome]:
        parts = zip(self.last, self.curves, strict=True)
        return [Outcome(weights, curve, self.stopped.get(i)) for i, (weights, curve) in enumerate(parts)]


def _explained(
    trial: Trial, rows: Measured, scaler: Scaler, predict: Callable[[np.ndarray], np.ndarray]
) -> float | None:
    """Give the least explained variance (R2) over the known targets, on training rows."""
    if trial.schedule.steps_n < JUDGED_STEPS_N:
        return None
    some = trial.train[:: -(-len(trial.train) // JUDGED_ROWS_N)]
    target = rows.target[some].astype(np.float64)
    off = _answer(scaler, predict, VIEW[trial.recipe.inputs](rows.db_uT[some])) - target
    known = np.flatnonzero(~np.isnan(target).all(axis=0))
    varying = [i for i in known if np.nanvar(target[:, i]) > 0]
    return min((float(1 - np.nanmean(off[:, i] ** 2) / np.nanvar(target[:, i])) for i in varying), default=None)


def _answer(scaler: Scaler, predict: Callable[[np.ndarray], np.ndarray], view: np.ndarray) -> np.ndarray:
    return scaler.decode(predict(scaler.encode(view)))


# Defaults of torch.optim.lr_scheduler.OneCycleLR: the rate rises to its peak, then falls to nearly nothing; the first
# momentum falls meanwhile, then rises.
RISING = 0.3  # of all steps
FIRST_RATE, LAST_RATE = 1 / 25, 1e-4  # of the peak; of the first
MOMENTUM_MAX, MOMENTUM_MIN = 0.95, 0.85
BETA2, EPS = 0.999, 1e-8  # defaults of torch.optim.AdamW


def one_cycle(step_i: int, steps_n: int, rate_max: float) -> tuple[float, float]:
    """Give rate and first momentum of a step: two half cosines.

    >>> [round(one_cycle(i, 10, 25.0)[0], 4) for i in (0, 2, 9)]
    [1.0, 25.0, 0.0001]
    """
    steps_n = max(steps_n, 2)
    peak_i = RISING * steps_n - 1
    first = rate_max * FIRST_RATE
    if step_i <= peak_i:
        part = step_i / peak_i
        return _cosine(first, rate_max, part), _cosine(MOMENTUM_MAX, MOMENTUM_MIN, part)
    part = (step_i - peak_i) / (steps_n - 1 - peak_i)
    return _cosine(rate_max, first * LAST_RATE, part), _cosine(MOMENTUM_MIN, MOMENTUM_MAX, part)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2.0 * (math.cos(math.pi * part) + 1)


class AdamW:
    """Remembers the moments of each weight's gradient."""

    def __init__(self, weights: Iterable[torch.Tensor], weight_decay: float) -> None:
        self.weights, self.weight_decay = list(weights), weight_decay
        self.first, self.second = ([torch.zeros_like(weight) for weight in self.weights] for _ in range(2))
        self.steps_n = [torch.zeros((), device=weight.device) for weight in self.weights]

    @torch.no_grad()
    def step(self, rate: float, momentum: float) -> None:
        """Move all weights by their gradients; torch raises if one has none."""
        gradients = [weight.grad for weight in self.weights if weight.grad is not None]
        torch._foreach_add_(self.steps_n, 1)
        torch._fused_adamw_(
            self.weights, gradients, self.first, self.second, [], self.steps_n, amsgrad=False, lr=rate,
            beta1=momentum, beta2=BETA2, weight_decay=self.weight_decay, eps=EPS, maximize=False,
        )  # fmt: skip
