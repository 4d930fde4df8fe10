"""A network that is told which skin it reads: field at rest and pokes of a skin -> code; readings and code -> places.

The pokes' places are not told (DeepSets: their order does not matter); the code scales and shifts the layers of the
regressor (FiLM). In uT, mm and N, board's frame and axes. Refuses to know training, maps and files.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.nn.functional import linear

Weights = Mapping[str, np.ndarray]

SET_WIDTH, CODE_WIDTH, WIDTH, LAYERS_N = 160, 64, 192, 3
FILM_SD = 0.02  # of first weights: a code changes little at first
DIRECTION_GAIN, LOG_uT, REST_uT = 4.0, 6.5, 1500.0  # bring inputs to about 1: dB/|dB|, log|dB|, field at rest
PLACE_MM, LOG_N = 8.0, 3.0  # of an answer of 1
LOG_SD = (-5.0, 2.0)  # an answer's log sd is held between
FULL_SET_N = 65.0  # pokes that count as a full set
ANSWERS_N = 6  # x, y, log F, and the log sd of each


@dataclass(frozen=True)
class Opinion:
    """What a network says of readings: places and logarithms of forces, and their standard deviations."""

    place_mm: Float[np.ndarray, "n 2"]
    sd_mm: Float[np.ndarray, "n 2"]
    log_N: Float[np.ndarray, " n"]
    sd_log_N: Float[np.ndarray, " n"]

    def __getitem__(self, rows: slice) -> "Opinion":
        """Take the opinion of some readings."""
        return Opinion(self.place_mm[rows], self.sd_mm[rows], self.log_N[rows], self.sd_log_N[rows])


class Network(nn.Module):
    """Set encoder and regressor of weights as `draw_weights` names them."""

    def __init__(self, weights: Weights) -> None:
        super().__init__()
        self.weights = nn.ParameterDict({name: torch.from_numpy(np.array(value)) for name, value in weights.items()})

    def encode(
        self, db_uT: Float[torch.Tensor, "b c ch"], rest_uT: Float[torch.Tensor, "b ch"],
        kept: Float[torch.Tensor, "b c"],
    ) -> Float[torch.Tensor, "b 64"]:  # fmt: skip
        """Give the code of each skin from the pokes that are kept (1, else 0); with none, zeros are pooled."""
        each = torch.relu(self._linear("set1", inputs(db_uT, rest_uT)))
        each = torch.relu(self._linear("set2", each)) * kept[..., None]
        kept_n = kept.sum(1, keepdim=True)
        pooled = each.sum(1) / kept_n.clamp_min(1)
        return torch.relu(self._linear("code", torch.cat([pooled, kept_n / FULL_SET_N], 1)))

    def forward(
        self, db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"],
        code: Float[torch.Tensor, "b 64"],
    ) -> tuple[Float[torch.Tensor, "b n 3"], Float[torch.Tensor, "b n 3"]]:  # fmt: skip
        """Give scaled x, y, log F, and the log sd of each."""
        values = inputs(db_uT, rest_uT)
        for i in range(LAYERS_N):
            gain, shift = self._linear(f"film{i}", code)[:, None].chunk(2, -1)
            values = torch.relu(self._linear(f"layer{i}", values) * (1 + gain) + shift)
        answer, log_sd = self._linear("answer", values).chunk(2, -1)
        return answer, log_sd.clamp(*LOG_SD)

    def _linear(self, name: str, values: torch.Tensor) -> torch.Tensor:
        return linear(values, self.weights[f"{name}_weight"], self.weights[f"{name}_bias"])


def inputs(db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"]) -> Float[torch.Tensor, "b n i"]:
    """Give direction and log length of each change of field, and the skin's field at rest; scaled to about 1."""
    length_uT = db_uT.norm(dim=-1, keepdim=True).clamp_min(1.0)
    rest = (rest_uT / REST_uT)[:, None].expand(-1, db_uT.shape[1], -1)
    return torch.cat([DIRECTION_GAIN * db_uT / length_uT, torch.log(length_uT) - LOG_uT, rest], -1)


def draw_weights(channels_n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw first weights as PyTorch does for linear layers: uniform within 1/sqrt(fan in); of FiLM, near zero."""
    inputs_n = 2 * channels_n + 1
    shapes = {"set1": (SET_WIDTH, inputs_n), "set2": (SET_WIDTH, SET_WIDTH), "code": (CODE_WIDTH, SET_WIDTH + 1)}
    shapes |= {f"layer{i}": (WIDTH, WIDTH if i else inputs_n) for i in range(LAYERS_N)}
    shapes["answer"] = (ANSWERS_N, WIDTH)
    weights = {}
    for name, (out_n, in_n) in shapes.items():
        limit = in_n**-0.5
        weights[f"{name}_weight"] = rng.uniform(-limit, limit, (out_n, in_n)).astype(np.float32)
        weights[f"{name}_bias"] = rng.uniform(-limit, limit, out_n).astype(np.float32)
    for i in range(LAYERS_N):
        weights[f"film{i}_weight"] = (FILM_SD * rng.standard_normal((2 * WIDTH, CODE_WIDTH))).astype(np.float32)
        weights[f"film{i}_bias"] = np.zeros(2 * WIDTH, np.float32)
    return weights


@torch.no_grad()
def predict(
    networks: Sequence[Weights],
    db_uT: Float[np.ndarray, "n ch"],
    rest_uT: Float[np.ndarray, " ch"],
    pokes_uT: Float[np.ndarray, "c ch"],
) -> Opinion:
    """Ask networks about readings of one skin, told its field at rest and so many unlabelled pokes (none will do).

    Of several, the mean; what they differ by counts as uncertainty.
    """
    torch.set_num_threads(1)  # the same sums in the same order, however many processes run beside this one
    read, rest, pokes = (torch.from_numpy(part.astype(np.float32))[None] for part in (db_uT, rest_uT, pokes_uT))
    answers, variances = [], []
    for weights in networks:
        network = Network(weights)
        answer, log_sd = network(read, rest, network.encode(pokes, rest, torch.ones(1, len(pokes_uT))))
        answers.append(answer[0].numpy().astype(float))
        variances.append(np.exp(2.0 * log_sd[0].numpy().astype(float)))
    mean, sd = np.mean(answers, axis=0), np.sqrt(np.mean(variances, axis=0) + np.var(answers, axis=0))
    return Opinion(PLACE_MM * mean[:, :2], PLACE_MM * sd[:, :2], LOG_N * mean[:, 2], LOG_N * sd[:, 2])
