"""Training of the networks of the universal model, with PyTorch.

The networks are trained on simulated skins and, if available, on recorded boards (`reskin.universal.batches`).
`reskin.universal.network` describes the network, and evaluates it without PyTorch.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.nn.functional import huber_loss

from reskin.models.optimiser import AdamW, one_cycle
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

# Settings of the optimiser AdamW with a one-cycle schedule: largest learning rate, weight decay, fraction of the steps
# in which the learning rate rises, and largest norm of the gradient (larger gradients are scaled down).
RATE_MAX, WEIGHT_DECAY, WARM_UP, GRADIENT_NORM_MAX = 2.5e-3, 1e-4, 0.15, 1.0
# The loss is the sum of a Huber loss, which trains the estimates, and a likelihood, which trains the standard
# deviations. These are the threshold of the Huber loss, its weight, and the weight of the likelihood.
HUBER_DELTA, HUBER_WEIGHT, SD_WEIGHT = 0.1, 4.0, 0.02


class Network(nn.Module):
    """The set encoder and the regressor of `reskin.universal.network` as a PyTorch module.

    The weights have the names that `draw_weights` gives them.
    """

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.weights = nn.ParameterDict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})

    def encode(
        self, db_uT: Float[torch.Tensor, "b c ch"], rest_uT: Float[torch.Tensor, "b ch"],
        kept: Float[torch.Tensor, "b c"],
    ) -> Float[torch.Tensor, "b 64"]:  # fmt: skip
        """Compute the code of each skin from its no-load field and from those presses for which `kept` is 1.

        The features of these presses are averaged. If there are no such presses, the averages are 0.
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
        """Estimate scaled values of x, y and log F for presses on skins with these codes.

        Returns the estimates and the logarithms of their standard deviations.
        """
        values = inputs(db_uT, rest_uT)
        for i in range(LAYERS_N):
            gain, shift = self._linear(f"film{i}", code)[:, None].chunk(2, -1)
            values = torch.relu(self._linear(f"layer{i}", values) * (1 + gain) + shift)
        mean, log_sd = self._linear("answer", values).chunk(2, -1)
        return mean, log_sd.clamp(*LOG_SD)

    def _linear(self, name: str, values: torch.Tensor) -> torch.Tensor:
        return affine(values, self.weights[f"{name}_weight"].mT, self.weights[f"{name}_bias"][None])


def inputs(db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"]) -> Float[torch.Tensor, "b n i"]:
    """Compute the inputs of the network, which are scaled to values of about 1.

    The inputs for a press are the direction of its field change, the logarithm of the magnitude, and the no-load field
    of the skin. They are computed with NumPy, because the results of `torch.log` differ between processors. The result
    has no gradients, but training needs none, because the inputs do not depend on weights.
    """
    db, rest = db_uT.numpy(), rest_uT.numpy() / np.float32(REST_uT)
    length_uT = np.maximum(np.linalg.norm(db, axis=-1, keepdims=True), np.float32(LENGTH_MIN_uT))
    shape = (*db.shape[:2], rest.shape[-1])
    parts = [DIRECTION_GAIN * db / length_uT, np.log(length_uT) - LOG_uT, np.broadcast_to(rest[:, None], shape)]
    return torch.from_numpy(np.concatenate(parts, axis=-1))


def train_networks(prior: SkinPrior, settings: TrainingSettings, seed: int) -> list[dict[str, np.ndarray]]:
    """Simulate skins, train `settings.seeds_n` networks on them one after the other, and return their weights.

    `prior` is the distribution of the skins.
    """
    rng = rng_for(seed, "universal", prior.name, "skins")
    skins = draw_population(prior.centre, prior.spreads, prior.setup, settings.skins_n, rng, prior.forces)
    names = ("universal", prior.name, "network")
    return [train(skins, prior, settings.steps_n, rng_for(seed, *names, i)) for i in range(settings.seeds_n)]


def train(skins: Population, prior: SkinPrior, steps_n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Train one network and return its weights."""
    # With several threads, the order in which numbers are added would vary, and thus the result.
    torch.set_num_threads(1)
    network = Network(draw_weights(skins.rest_uT.shape[1], rng))
    optimizer = AdamW(network.parameters(), WEIGHT_DECAY)
    batches = Batches(skins, prior)
    for step_i in range(steps_n):
        loss = loss_of(network, batches.draw(rng))
        network.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_NORM_MAX)
        optimizer.step(*one_cycle(step_i, steps_n, RATE_MAX, WARM_UP))
    return {name: value.detach().numpy().copy() for name, value in network.weights.items()}


def loss_of(network: Network, batch: Batch) -> torch.Tensor:
    """Return the loss of a batch.

    The loss is the sum of the Huber loss of the estimates and the negative log likelihood of their errors, which are
    assumed to be normally distributed.
    """
    db_uT, rest_uT = torch.from_numpy(batch.db_uT), torch.from_numpy(batch.rest_uT)
    target, kept = torch.from_numpy(batch.target), torch.from_numpy(batch.kept)
    set_n = kept.shape[1]
    mean, log_sd = network(db_uT[:, set_n:], rest_uT, network.encode(db_uT[:, :set_n], rest_uT, kept))
    error = HUBER_WEIGHT * huber_loss(mean, target, delta=HUBER_DELTA)
    # The likelihood trains only the standard deviations. If it also trained the means, presses with large errors would
    # have little influence on the means, because the network would predict large standard deviations for these presses.
    deviation = (mean - target).detach()
    return error + SD_WEIGHT * (log_sd + 0.5 * deviation**2 * exp(-2 * log_sd)).mean()
