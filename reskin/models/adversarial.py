"""Domain-adversarial training (Ganin et al., JMLR 2016), a reference method for adaptation.

A second network, the discriminator, predicts from the features whether a reading is from a known skin or from the new
one, and the features are trained to mislead it. With weight 0, this is the control. The module has its own training
loop, because the two-skin batches and the discriminator cannot be expressed as a loss term in `reskin.models.train`.
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
from reskin.models.recipe import Schedule
from reskin.models.train import AdamW, clip_gradients, one_cycle

DISCRIMINATOR_WIDTH = 64  # assumed
MOMENTUM = 0.5  # with a larger value, the two opposing networks oscillate (Radford et al., ICLR 2016)
RAMP_RATE = (
    10.0  # at fraction p of the training, the weight is multiplied by 2 / (1 + exp(-10 p)) - 1, as in Ganin et al.
)
# A `Stack` requires that the output of its third layer has `FEATURES_N` values.
DISCRIMINATOR_WIDTHS = (FEATURES_N, DISCRIMINATOR_WIDTH, DISCRIMINATOR_WIDTH, FEATURES_N, 1)
DISCRIMINATOR = tuple(Layer(in_n, out_n, out_n > 1) for in_n, out_n in pairwise(DISCRIMINATOR_WIDTHS))


@dataclass(frozen=True)
class Domains:
    """Scaled inputs and targets of the known skins, and scaled inputs of the new skin."""

    known: Float32[np.ndarray, "n c"]
    target: Float32[np.ndarray, "n t"]
    new: Float32[np.ndarray, "u c"]


def train_adversarial(domains: Domains, schedule: Schedule, weight: float, rng: np.random.Generator) -> Weights:
    """Train one network from random weights; half of each batch is from the known skins, half from the new skin."""
    torch.set_num_threads(1)  # so that the order of summation does not depend on the number of other processes
    layers = paper_layers(domains.known.shape[1], domains.target.shape[1])
    net = Stack(layers, [draw_weights(layers, rng)])
    discriminator = Stack(DISCRIMINATOR, [draw_weights(DISCRIMINATOR, rng)])
    optimizer = AdamW([*net.parameters(), *discriminator.parameters()], schedule.weight_decay)
    known, target, new = (torch.from_numpy(part)[None] for part in (domains.known, domains.target, domains.new))
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
        clip_gradients(net, schedule.gradient_norm_max)
        clip_gradients(discriminator, schedule.gradient_norm_max)
        optimizer.step(one_cycle(step_i, schedule.steps_n, schedule.rate_max)[0], MOMENTUM)
    return net.weights_of(0)


def reverse_gradient(values: Float[torch.Tensor, "m b d"], weight: float) -> Float[torch.Tensor, "m b d"]:
    """Return the values unchanged, but multiply their gradient by -`weight`."""
    return (1 + weight) * values.detach() - weight * values


def ramp(part: float) -> float:
    """Return the factor of the weight at a fraction of the training: 0 at first, so that features can form.

    >>> [round(ramp(part), 2) for part in (0.0, 0.1, 1.0)]
    [0.0, 0.46, 1.0]
    """
    return float(2 / (1 + np.exp(-RAMP_RATE * part)) - 1)
