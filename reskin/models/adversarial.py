"""Domain-adversarial training (Ganin et al., JMLR 2016), with which the paper's adaptation to new skins is compared.

Two networks are trained together. The first network estimates place and force. The second network, the discriminator,
predicts from the features of the first network (the output of its bottleneck layer) whether a reading is from a known
skin or from the new skin. The first network is trained so that the discriminator fails, because its features are then
alike on all skins. In a control experiment, the gradient of the discriminator has weight 0, so that it does not affect
the features.

This module has its own training loop, because `reskin.models.train` supports neither batches from two sets of skins nor
a second network.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch.nn.functional import binary_cross_entropy_with_logits

from reskin.models.job import Weights
from reskin.models.losses import squared_error
from reskin.models.network import FEATURES_N, Layer, Stack, draw_weights, paper_layers
from reskin.models.optimiser import AdamW, one_cycle
from reskin.models.recipe import Schedule
from reskin.models.train import clip_gradients

DISCRIMINATOR_WIDTH = 64  # number of units in a hidden layer of the discriminator; this number is assumed
MOMENTUM = 0.5  # with a larger value, the two opposing networks oscillate (Radford et al., ICLR 2016)
RAMP_RATE = 10.0  # the factor 10 in the formula of `ramp` (Ganin et al.)
# Widths of the discriminator's layers. The third layer has `FEATURES_N` outputs, because the class `Stack` requires it.
DISCRIMINATOR_WIDTHS = (FEATURES_N, DISCRIMINATOR_WIDTH, DISCRIMINATOR_WIDTH, FEATURES_N, 1)
DISCRIMINATOR = tuple(Layer(in_n, out_n, out_n > 1) for in_n, out_n in pairwise(DISCRIMINATOR_WIDTHS))


@dataclass(frozen=True)
class Domains:
    """The training data of both networks, in scaled units.

    known: the inputs of readings of the known skins.
    target: the targets of these readings.
    new: the inputs of unlabelled readings of the new skin.
    """

    known: Float32[np.ndarray, "n c"]
    target: Float32[np.ndarray, "n t"]
    new: Float32[np.ndarray, "u c"]


def train_adversarial(domains: Domains, schedule: Schedule, weight: float, rng: np.random.Generator) -> Weights:
    """Train a network together with its discriminator, from random initial weights; return the network's weights.

    Each batch has equal numbers of readings from the known skins and from the new skin. The gradient of the
    discriminator's loss is reversed before it reaches the features, so that the features change in the direction that
    makes the discriminator worse. This gradient is also multiplied by a factor that rises to `weight` during training.
    """
    # Use one thread, so that the order of summation does not depend on the number of other processes.
    torch.set_num_threads(1)
    layers = paper_layers(domains.known.shape[1], domains.target.shape[1])
    net = Stack(layers, [draw_weights(layers, rng)])
    discriminator = Stack(DISCRIMINATOR, [draw_weights(DISCRIMINATOR, rng)])
    optimizer = AdamW([*net.parameters(), *discriminator.parameters()], schedule.weight_decay)
    known, target, new = (torch.from_numpy(rows)[None] for rows in (domains.known, domains.target, domains.new))
    is_new = torch.cat([torch.zeros(schedule.batch_n), torch.ones(schedule.batch_n)])[None, :, None]
    for step_i in range(schedule.steps_n):
        row = torch.from_numpy(rng.integers(known.shape[1], size=schedule.batch_n))
        new_row = torch.from_numpy(rng.integers(new.shape[1], size=schedule.batch_n))
        features = net.features(known[:, row])
        both = torch.cat([features, net.features(new[:, new_row])], dim=1)
        is_new_logit = discriminator(reverse_gradient(both, weight * ramp(step_i / schedule.steps_n)))
        loss = squared_error(net.head(features), target[:, row]).sum()
        loss = loss + binary_cross_entropy_with_logits(is_new_logit, is_new)
        net.zero_grad()
        discriminator.zero_grad()
        loss.backward()
        clip_gradients(list(net.parameters()), schedule.gradient_norm_max)
        clip_gradients(list(discriminator.parameters()), schedule.gradient_norm_max)
        optimizer.step(one_cycle(step_i, schedule.steps_n, schedule.rate_max)[0], MOMENTUM)
    return net.weights_of(0)


def reverse_gradient(values: Float[torch.Tensor, "m b d"], weight: float) -> Float[torch.Tensor, "m b d"]:
    """Return the values unchanged, but multiply their gradient by -`weight`."""
    return (1 + weight) * values.detach() - weight * values


def ramp(fraction: float) -> float:
    """Return the factor by which the weight of the discriminator's gradient is multiplied.

    After a fraction p of the training, the factor is 2 / (1 + exp(-10 p)) - 1. It starts at 0, so that the network
    first learns features that predict the targets.

    >>> [round(ramp(fraction), 2) for fraction in (0.0, 0.1, 1.0)]
    [0.0, 0.46, 1.0]
    """
    return float(2 / (1 + np.exp(-RAMP_RATE * fraction)) - 1)
