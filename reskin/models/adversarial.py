"""Domain-adversarial training (Ganin et al., JMLR 2016): known skins' rows, a new skin's fields -> a network's weights.

The paper's network, beside it one that tells from its features whose a reading is; the features are trained to mislead
that one. With a weight of 0 it is the control. A loop of its own: its batches and its second network are no term of the
one in `train`. Refuses to know places of the new skin, files and scores.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch.nn.functional import binary_cross_entropy_with_logits

from reskin.models.network import FEATURES_N, Layer, Stack, draw_weights, paper_layers
from reskin.models.recipe import Schedule
from reskin.models.train import AdamW, clip, one_cycle, squared_error
from reskin.models.trial import Weights

JUDGE_WIDTH = 64  # assumed
MOMENTUM = 0.5  # of two networks against each other: more of it and they swing (Radford et al., ICLR 2016)
RISES = 10.0  # of the weight over the training: 2 / (1 + exp(-10 p)) - 1, as its authors have it
# Its third layer is as wide as the features of any stack.
JUDGE_WIDTHS = (FEATURES_N, JUDGE_WIDTH, JUDGE_WIDTH, FEATURES_N, 1)
JUDGE = tuple(Layer(in_n, out_n, out_n > 1) for in_n, out_n in pairwise(JUDGE_WIDTHS))


@dataclass(frozen=True)
class Domains:
    """Scaled inputs and targets of known skins, and scaled inputs of the new one."""

    known: Float32[np.ndarray, "n c"]
    target: Float32[np.ndarray, "n t"]
    new: Float32[np.ndarray, "u c"]


def train_adversarial(domains: Domains, schedule: Schedule, weight: float, rng: np.random.Generator) -> Weights:
    """Train one network from random weights; batches are as many readings of known skins and of the new one."""
    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    layers = paper_layers(domains.known.shape[1], domains.target.shape[1])
    net = Stack(layers, [draw_weights(layers, rng)])
    judge = Stack(JUDGE, [draw_weights(JUDGE, rng)])
    optimizer = AdamW([*net.parameters(), *judge.parameters()], schedule.weight_decay)
    known, target, new = (torch.from_numpy(part)[None] for part in (domains.known, domains.target, domains.new))
    whose = torch.cat([torch.zeros(schedule.batch_n), torch.ones(schedule.batch_n)])[None, :, None]
    for step_i in range(schedule.steps_n):
        row = torch.from_numpy(rng.integers(known.shape[1], size=schedule.batch_n))
        of_new = torch.from_numpy(rng.integers(new.shape[1], size=schedule.batch_n))
        features = net.features(known[:, row])
        both = torch.cat([features, net.features(new[:, of_new])], dim=1)
        judged = judge(turned_back(both, weight * rising(step_i / schedule.steps_n)))
        loss = squared_error(net.answer(features), target[:, row]).sum()
        loss = loss + binary_cross_entropy_with_logits(judged, whose)
        net.zero_grad()
        judge.zero_grad()
        loss.backward()
        clip(net, schedule.gradient_norm_max)
        clip(judge, schedule.gradient_norm_max)
        optimizer.step(one_cycle(step_i, schedule.steps_n, schedule.rate_max)[0], MOMENTUM)
    return net.member(0)


def turned_back(values: Float[torch.Tensor, "m b d"], weight: float) -> Float[torch.Tensor, "m b d"]:
    """Pass values on as they are, and their gradient times -`weight` back."""
    return (1 + weight) * values.detach() - weight * values


def rising(part: float) -> float:
    """Give the share of the weight after a part of the training: 0 at first, so that features may form.

    >>> [round(rising(part), 2) for part in (0.0, 0.1, 1.0)]
    [0.0, 0.46, 1.0]
    """
    return float(2 / (1 + np.exp(-RISES * part)) - 1)
