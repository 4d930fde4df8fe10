"""Training of the network of the universal model, with PyTorch.

The network is trained on random episodes of simulated skins and, if there are any, of recorded boards
(`reskin.universal.episodes`). `reskin.universal.network` describes the network, and evaluates it without PyTorch. This
training is not exact to the bit: the file of a trained model is an input of everything that uses it.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.nn.functional import hardswish, huber_loss, layer_norm, linear, scaled_dot_product_attention
from tqdm import tqdm

from reskin.universal.episodes import Episodes, RecordedBoard, draw_episodes
from reskin.universal.network import (
    DIRECTION_GAIN,
    HEAD,
    HEADS_N,
    LAYERS_N,
    LOG_SD,
    WIDTH,
    EXTERNAL_uT,
    LENGTH_MIN_uT,
    LOG_uT,
    REST_uT,
    Weights,
    shapes,
)
from reskin.universal.population import Population

# Settings of the optimiser AdamW: largest learning rate, which rises in the first steps and then falls like a cosine,
# weight decay, and largest norm of the gradient (larger gradients are scaled down).
RATE_MAX, WARM_UP_N, WEIGHT_DECAY, GRADIENT_NORM_MAX = 1.2e-3, 300, 1e-4, 1.0
RATE_OF_TUNING = 3e-4  # largest learning rate if a trained network is trained further
# The loss is the sum of a Huber loss, which trains the estimates, and a likelihood, which trains the standard
# deviations. These are the threshold of the Huber loss, its weight, and the weight of the likelihood.
HUBER_DELTA, HUBER_WEIGHT, SD_WEIGHT = 0.1, 4.0, 0.02


class SkinReader:
    """The network of `reskin.universal.network` in PyTorch, with weights of the same names."""

    def __init__(self, weights: Weights) -> None:
        self.weights = {name: torch.tensor(value, dtype=torch.float32) for name, value in weights.items()}
        self.trained = [weight.requires_grad_() for name, weight in self.weights.items() if name != "usual_rest"]

    def __call__(self, episodes: Episodes) -> tuple[Float[torch.Tensor, "b q 3"], Float[torch.Tensor, "b q 3"]]:
        """Estimate scaled x, y and log F of the readings; return means and logarithms of standard deviations."""
        rest = torch.from_numpy(episodes.rest_uT)
        sign = torch.where(rest @ self.weights["usual_rest"] < 0, -1.0, 1.0)[:, None]
        ambient = sign * rest / REST_uT
        ambient = torch.cat([ambient, torch.full_like(sign, math.log1p(episodes.external_uT / EXTERNAL_uT))], 1)
        context, query = (
            self._embed(sign[:, None] * torch.from_numpy(fields), ambient)
            for fields in (episodes.context_uT, episodes.query_uT)
        )
        labels = torch.from_numpy(episodes.labels)
        labels_n = labels.shape[1]
        of_labels = self._linear("label2", hardswish(self._linear("label1", labels)))
        empty = self.weights["empty"].expand(len(rest), 1, WIDTH)
        context = torch.cat([empty, context[:, :labels_n] + of_labels, context[:, labels_n:]], 1)
        for i in range(LAYERS_N):
            source = self._norm(f"layer{i}.norm1", context)
            key, value = (self._heads(self._linear(f"layer{i}.{name}", source)) for name in ("key", "value"))
            query = self._read(i, query, self._norm(f"layer{i}.norm1", query), key, value)
            if i < LAYERS_N - 1:
                context = self._read(i, context, source, key, value)
        values = hardswish(self._linear("out1", self._norm("norm", query)))
        mean, log_sd = self._linear("out2", values).chunk(2, -1)
        return mean, log_sd.clamp(*LOG_SD)

    def _embed(self, db: torch.Tensor, ambient: torch.Tensor) -> torch.Tensor:
        length = db.norm(dim=-1, keepdim=True).clamp_min(LENGTH_MIN_uT)
        shared = ambient[:, None].expand(*db.shape[:2], ambient.shape[-1])
        inputs = torch.cat([DIRECTION_GAIN * db / length, length.log() - LOG_uT, shared], -1)
        return self._linear("embed2", hardswish(self._linear("embed1", inputs)))

    def _read(
        self, i: int, tokens: torch.Tensor, normed: torch.Tensor, key: torch.Tensor, value: torch.Tensor
    ) -> torch.Tensor:
        query = self._heads(self._linear(f"layer{i}.query", normed))
        read = scaled_dot_product_attention(query, key, value).transpose(1, 2).reshape(tokens.shape)
        tokens = tokens + self._linear(f"layer{i}.mix", read)
        hidden = hardswish(self._linear(f"layer{i}.mlp1", self._norm(f"layer{i}.norm2", tokens)))
        return tokens + self._linear(f"layer{i}.mlp2", hidden)

    def _heads(self, values: torch.Tensor) -> torch.Tensor:
        return values.view(*values.shape[:2], HEADS_N, HEAD).transpose(1, 2)

    def _linear(self, name: str, values: torch.Tensor) -> torch.Tensor:
        return linear(values, self.weights[f"{name}.weight"], self.weights[f"{name}.bias"])

    def _norm(self, name: str, values: torch.Tensor) -> torch.Tensor:
        return layer_norm(values, (WIDTH,), self.weights[f"{name}.weight"], self.weights[f"{name}.bias"])


def draw_weights(usual_rest_uT: Float[np.ndarray, " ch"], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw the weights with which a training begins. Labels have no effect at first."""
    weights = {}
    for name, shape in shapes(len(usual_rest_uT)).items():
        kind = name.rpartition(".")[2]
        if kind == "weight" and len(shape) == 2:
            value = rng.uniform(-1, 1, shape) / math.sqrt(shape[1])
        elif kind == "weight":
            value = np.ones(shape)
        else:
            value = np.zeros(shape)
        weights[name] = value.astype(np.float32)
    weights["label2.weight"][:] = 0
    return weights | {"usual_rest": usual_rest_uT.astype(np.float32)}


def train(
    skins: Population,
    steps_n: int,
    rng: np.random.Generator,
    recorded: Sequence[RecordedBoard] = (),
    start: Weights | None = None,
) -> dict[str, np.ndarray]:
    """Train a network and return its weights.

    Parameters
    ----------
    skins : simulated skins
    steps_n : number of training steps
    rng : generator of the episodes
    recorded : recorded boards, which are mixed into the episodes
    start : weights of a trained network that is trained further. By default, a new network is trained.
    """
    threads_n = torch.get_num_threads()
    torch.set_num_threads(1)  # two threads on two busy cores are slower than one
    try:
        return _train(skins, steps_n, rng, recorded, start)
    finally:
        torch.set_num_threads(threads_n)


def _train(
    skins: Population, steps_n: int, rng: np.random.Generator, recorded: Sequence[RecordedBoard], start: Weights | None
) -> dict[str, np.ndarray]:
    rate_max = RATE_MAX if start is None else RATE_OF_TUNING
    network = SkinReader(draw_weights(skins.rest_uT.mean(axis=0), rng) if start is None else start)
    optimizer = torch.optim.AdamW(network.trained, lr=rate_max, weight_decay=WEIGHT_DECAY)
    for step_i in tqdm(range(steps_n), desc="training", mininterval=10, disable=steps_n < 1000):
        warm = min(1.0, (step_i + 1) / min(WARM_UP_N, steps_n / 4))
        rate = rate_max * warm * 0.5 * (1 + math.cos(math.pi * step_i / steps_n)) + 1e-6
        for group in optimizer.param_groups:
            group["lr"] = rate
        loss = loss_of(network, draw_episodes(skins, recorded, rng))
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.trained, GRADIENT_NORM_MAX)
        optimizer.step()
    return {name: weight.detach().numpy() for name, weight in network.weights.items()}


def loss_of(network: SkinReader, episodes: Episodes) -> torch.Tensor:
    """Return the loss: Huber loss of the estimates, and negative log likelihood of their errors, which are normal.

    The likelihood trains only the standard deviations. If it also trained the means, presses with large errors would
    have little influence on the means, because the network would state large standard deviations for them.
    """
    mean, log_sd = network(episodes)
    target = torch.from_numpy(episodes.target)
    error = HUBER_WEIGHT * huber_loss(mean, target, delta=HUBER_DELTA)
    deviation = (mean - target).detach()
    return error + SD_WEIGHT * (log_sd + 0.5 * deviation**2 * torch.exp(-2 * log_sd)).mean()
