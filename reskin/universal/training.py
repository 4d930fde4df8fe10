"""Train the networks of the universal model on simulated skins and, if available, on recorded boards."""

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.nn.functional import huber_loss

from reskin.models.reproducible import affine, exp
from reskin.seeds import rng_for
from reskin.universal.batches import Batch, Batches, SkinPrior, TrainingSettings
from reskin.universal.network import (
    DIRECTION_GAIN,
    FULL_SET_N,
    LAYERS_N,
    LOG_SD,
    LENGTH_MIN_uT,
    LOG_uT,
    REST_uT,
    Weights,
    draw_weights,
)
from reskin.universal.population import Population, draw_population

# AdamW with a one-cycle schedule: largest rate, weight decay, share of steps with a rising rate, limit of the gradient.
RATE_MAX, WEIGHT_DECAY, WARM_UP, GRADIENT_NORM_MAX = 2.5e-3, 1e-4, 0.15, 1.0
# Loss: threshold and weight of the Huber loss, and weight of the likelihood that trains the standard deviations.
HUBER_DELTA, HUBER_WEIGHT, SD_WEIGHT = 0.1, 4.0, 0.02


class Network(nn.Module):
    """Set encoder and regressor in PyTorch; the names of the weights are those from `draw_weights`."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.weights = nn.ParameterDict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})

    def encode(
        self, db_uT: Float[torch.Tensor, "b c ch"], rest_uT: Float[torch.Tensor, "b ch"],
        kept: Float[torch.Tensor, "b c"],
    ) -> Float[torch.Tensor, "b 64"]:  # fmt: skip
        """Compute the code of each skin from the presses for which `kept` is 1.

        If there are no such presses, the pooled features are 0.
        """
        features = torch.relu(self._linear("set1", inputs(db_uT, rest_uT)))
        features = torch.relu(self._linear("set2", features)) * kept[..., None]
        kept_n = kept.sum(1, keepdim=True)
        pooled = features.sum(1) / kept_n.clamp_min(1)
        return torch.relu(self._linear("code", torch.cat([pooled, kept_n / FULL_SET_N], 1)))

    def forward(
        self, db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"],
        code: Float[torch.Tensor, "b 64"],
    ) -> tuple[Float[torch.Tensor, "b n 3"], Float[torch.Tensor, "b n 3"]]:  # fmt: skip
        """Return scaled x, y and log F, and their log standard deviations."""
        values = inputs(db_uT, rest_uT)
        for i in range(LAYERS_N):
            gain, shift = self._linear(f"film{i}", code)[:, None].chunk(2, -1)
            values = torch.relu(self._linear(f"layer{i}", values) * (1 + gain) + shift)
        mean, log_sd = self._linear("answer", values).chunk(2, -1)
        return mean, log_sd.clamp(*LOG_SD)

    def _linear(self, name: str, values: torch.Tensor) -> torch.Tensor:
        return affine(values, self.weights[f"{name}_weight"].mT, self.weights[f"{name}_bias"][None])


def inputs(db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"]) -> Float[torch.Tensor, "b n i"]:
    """Return direction and log magnitude of each field change, and the skin's no-load field, scaled to about 1.

    NumPy is used because the results of `torch.log` differ between processors. The result has no gradients; training
    needs none, because inputs do not depend on weights.
    """
    db, rest = db_uT.numpy(), rest_uT.numpy() / np.float32(REST_uT)
    length_uT = np.maximum(np.linalg.norm(db, axis=-1, keepdims=True), np.float32(LENGTH_MIN_uT))
    shape = (*db.shape[:2], rest.shape[-1])
    parts = [DIRECTION_GAIN * db / length_uT, np.log(length_uT) - LOG_uT, np.broadcast_to(rest[:, None], shape)]
    return torch.from_numpy(np.concatenate(parts, axis=-1))


def train_networks(prior: SkinPrior, settings: TrainingSettings, seed: int) -> list[dict[str, np.ndarray]]:
    """Simulate skins of a prior, train networks on them one after the other, and return the networks' weights."""
    rng = rng_for(seed, "universal", prior.name, "skins")
    skins = draw_population(prior.centre, prior.spreads, prior.setup, settings.skins_n, rng, prior.forces)
    names = ("universal", prior.name, "network")
    return [train(skins, prior, settings.steps_n, rng_for(seed, *names, i)) for i in range(settings.seeds_n)]


def train(skins: Population, prior: SkinPrior, steps_n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Train one network and return its weights."""
    torch.set_num_threads(1)  # with several threads, the order of summation and thus the result would vary
    network = Network(draw_weights(skins.rest_uT.shape[1], rng))
    optimizer = torch.optim.AdamW(network.parameters(), RATE_MAX, weight_decay=WEIGHT_DECAY, fused=True)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE_MAX, total_steps=steps_n, pct_start=WARM_UP)
    batches = Batches(skins, prior)
    for _ in range(steps_n):
        loss = loss_of(network, batches.draw(rng))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_NORM_MAX)
        optimizer.step()
        rate.step()
    return {name: value.detach().numpy().copy() for name, value in network.weights.items()}


def loss_of(network: Network, batch: Batch) -> torch.Tensor:
    """Return the loss of a batch: Huber loss of the means plus Gaussian negative log likelihood."""
    db_uT, rest_uT = torch.from_numpy(batch.db_uT), torch.from_numpy(batch.rest_uT)
    target, kept = torch.from_numpy(batch.target), torch.from_numpy(batch.kept)
    set_n = kept.shape[1]
    mean, log_sd = network(db_uT[:, set_n:], rest_uT, network.encode(db_uT[:, :set_n], rest_uT, kept))
    error = HUBER_WEIGHT * huber_loss(mean, target, delta=HUBER_DELTA)
    # The likelihood trains only the standard deviations. If it also trained the means, presses with large errors would
    # have little influence on the means, because the network would predict large standard deviations for these presses.
    deviation = (mean - target).detach()
    return error + SD_WEIGHT * (log_sd + 0.5 * deviation**2 * exp(-2 * log_sd)).mean()
