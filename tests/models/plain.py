"""Reference for networks that are trained together in a stack: a single network in plain PyTorch.

It has the layers and the training loop of the paper.
"""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import torch
from torch import nn

from reskin.models.batches import Batch
from reskin.models.job import LossWeights
from reskin.models.recipe import Schedule

UNLABELLED = ("unlabelled", "unlabelled_positive", "unlabelled_negative")
# The layers as printed in section 4 of the paper: B(15) -> MLP+ReLU(200) -> MLP(200) -> MLP(40) -> MLP+ReLU(200) ->
# MLP+ReLU(200) -> xyF(3)
PAPER = ("15-200", "ReLU", "200-200", "200-40", "40-200", "ReLU", "200-200", "ReLU", "200-3")
RELEASED = ("15-200", "ReLU", "200-200", "ReLU", "200-40", "40-200", "ReLU", "200-200", "ReLU", "200-3", "ReLU")
PRINTED = {"paper": PAPER, "released": RELEASED}


def plain_net(architecture: str, weights: Mapping[str, np.ndarray]) -> nn.Sequential:
    """Return a plain PyTorch network with these weights."""
    parts: list[nn.Module] = []
    layer_n = 0
    for word in PRINTED[architecture]:
        if word == "ReLU":
            parts.append(nn.ReLU())
            continue
        layer_n += 1
        linear = nn.Linear(*map(int, word.split("-")))
        linear.load_state_dict({p: torch.tensor(weights[f"layer{layer_n}.{p}"]) for p in ("weight", "bias")})
        parts.append(linear)
    return nn.Sequential(*parts)


def features_of(net: nn.Sequential) -> nn.Sequential:
    """Return the first layers of a plain network, up to the 40 features."""
    forty = next(i for i, part in enumerate(net) if isinstance(part, nn.Linear) and part.out_features == 40)
    return net[: forty + 1]


def weights_of(net: nn.Sequential, gradient: bool = False) -> dict[str, np.ndarray]:
    """Return the weights of a plain network, or the gradients of its weights, under the names that saved models use."""
    linear = [part for part in net if isinstance(part, nn.Linear)]
    return {
        f"layer{i}.{name}": (values.grad if gradient else values.detach()).numpy().copy()
        for i, layer in enumerate(linear, 1)
        for name, values in layer.named_parameters()
    }


def plain_train(
    start: Mapping[str, np.ndarray], batches: Iterable[Batch], schedule: Schedule, terms: LossWeights
) -> dict[str, np.ndarray]:
    """Train a network in a plain loop. `batches` are those of a stack that contains only this network."""
    net = plain_net("paper", start)
    features = features_of(net)
    optimizer = torch.optim.AdamW(net.parameters(), lr=schedule.rate_max, weight_decay=schedule.weight_decay)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=schedule.rate_max, total_steps=schedule.steps_n)
    for stacked in batches:
        batch = {name: values[0] for name, values in stacked.items()}
        loss = nn.functional.mse_loss(net(batch["inputs"]), batch["targets"])
        if terms.triplet:
            loss = loss + terms.triplet * hinge(features, batch["inputs"], batch["positive"], batch["negative"])
        if terms.unlabelled:
            loss = loss + terms.unlabelled * hinge(features, *(batch[name] for name in UNLABELLED))
        if terms.few_labels:
            predicted, targets = net(batch["few_labels"]), batch["few_labels_targets"]
            loss = loss + terms.few_labels * nn.functional.mse_loss(predicted, targets)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), schedule.gradient_norm_max)
        optimizer.step()
        rate.step()
    return weights_of(net)


def hinge(
    features: Callable[[torch.Tensor], torch.Tensor], anchor: torch.Tensor, near: torch.Tensor, far: torch.Tensor
) -> torch.Tensor:
    """Return the triplet loss as printed in the paper: computed row by row, then averaged over the batch."""
    a, p, n = features(anchor), features(near), features(far)
    rows = [torch.clamp((a[i] - p[i]).dot(a[i] - p[i]) - (a[i] - n[i]).dot(a[i] - n[i]), min=0) for i in range(len(a))]
    return torch.stack(rows).mean()
