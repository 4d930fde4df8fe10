"""The one training loop, for a stack of networks. In: what each learns from, a schedule. Out: weights and curves.

Read it from top to bottom. Networks of a stack never touch each other. Refuses to know folds, files and scores.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float

from pipeline.learning.architecture import LAYERS, Weights
from pipeline.learning.feed import Feed
from pipeline.learning.job import Job, Terms
from pipeline.learning.losses import squared_error, triplet
from pipeline.learning.model import Stack
from pipeline.learning.recipe import Schedule

BLOCK_STEPS_N = 50  # batches drawn at once, and how often the loss is looked at
LOST = 1e8  # mean squared error past which a network is lost, where answering the mean has 1; few come back from it


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
    """Descend the L2 loss and what stands beside it; AdamW under torch's one-cycle rate and momentum are our choice."""
    layers = LAYERS[architecture](jobs[0].labelled.inputs.shape[1], jobs[0].labelled.targets.shape[1])
    net = Stack(layers, [job.start for job in jobs]).to(device)
    optimizer = torch.optim.AdamW(net.parameters(), schedule.rate_max, weight_decay=schedule.weight_decay, fused=True)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, schedule.rate_max, total_steps=max(schedule.steps_n, 2))
    feed, watch = Feed(jobs, schedule.batch_n, device), Watch(net)
    for first in range(0, schedule.steps_n, BLOCK_STEPS_N):
        steps_n = min(BLOCK_STEPS_N, schedule.steps_n - first)
        total = torch.zeros(len(jobs), device=device)
        for batch in feed.draw(steps_n):
            features = net.features(batch["labelled"])  # [m b 40]
            error = loss = squared_error(net.answer(features), batch["targets"])  # [m]
            if terms.triplet:
                near, far = net.features(batch["near"]), net.features(batch["far"])
                loss = loss + terms.triplet * triplet(features, near, far)
            if terms.unlabelled:
                poked, near, far = (net.features(batch[name]) for name in ("poked", "poked_near", "poked_far"))
                loss = loss + terms.unlabelled * triplet(poked, near, far)
            if terms.own:
                loss = loss + terms.own * squared_error(net(batch["own"]), batch["own_targets"])
            optimizer.zero_grad()
            loss.sum().backward()  # of a sum, each network's gradient is its own
            clip(net, schedule.gradient_norm_max)  # one step too long can leave all ReLUs of a layer dead for good
            optimizer.step()
            rate.step()
            total += error.detach()
        if not watch.look(total / steps_n, first + steps_n):
            break
    return watch.outcomes()


def clip(net: Stack, norm_max: float) -> None:
    """Shorten the gradient of each network of a stack, all its weights as one vector, to at most `norm_max`."""
    gradients = [parameter.grad for parameter in net.parameters() if parameter.grad is not None]  # [m i o]
    norm = torch.linalg.vector_norm(
        torch.stack([torch.linalg.vector_norm(one, dim=(1, 2)) for one in gradients]), dim=0
    )
    part = (norm_max / norm).clamp(max=1.0)[:, None, None]  # of a gradient of 0, 1
    for one in gradients:
        one.mul_(part)


class Watch:
    """Remembers each network's curve and its last sound weights."""

    def __init__(self, net: Stack) -> None:
        self.net = net
        self.last = [net.member(i) for i in range(net.members_n)]
        self.curves: list[list[float]] = [[] for _ in self.last]
        self.stopped: dict[int, int] = {}

    def look(self, error: Float[torch.Tensor, " m"], step: int) -> bool:
        """Note a block's mean errors; false when no network of the stack is sound any more."""
        sound = (self.net.finite() & (error <= LOST)).tolist()  # of NaN, nothing is true
        for i in set(range(len(sound))) - set(self.stopped):
            if sound[i]:
                self.curves[i].append(float(error[i]))
                self.last[i] = self.net.member(i)
            else:
                self.stopped[i] = step
        return len(self.stopped) < len(sound)

    def outcomes(self) -> list[Outcome]:
        """Give every network as it was when it was last sound."""
        parts = zip(self.last, self.curves, strict=True)
        return [Outcome(weights, curve, self.stopped.get(i)) for i, (weights, curve) in enumerate(parts)]
