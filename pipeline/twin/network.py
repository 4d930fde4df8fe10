"""A network that is told which skin it reads: field at rest and pokes of a skin -> code; readings and code -> places.

The pokes' places are not told (DeepSets: their order does not matter); the code scales and shifts the layers of the
regressor (FiLM). In PyTorch, to be trained; once it is, `opinion` asks it. In uT, mm and N, board's frame and axes.
Refuses to know training, maps and files.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from pipeline.core.reproducible import affine
from pipeline.twin.opinion import DIRECTION_GAIN, FULL_SET_N, LAYERS_N, LOG_SD, LENGTH_MIN_uT, LOG_uT, REST_uT, Weights

SET_WIDTH, CODE_WIDTH, WIDTH = 160, 64, 192
FILM_SD = 0.02  # of first weights: a code changes little at first
ANSWERS_N = 6  # x, y, log F, and the log sd of each


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
        return affine(values, self.weights[f"{name}_weight"].mT, self.weights[f"{name}_bias"][None])


def inputs(db_uT: Float[torch.Tensor, "b n ch"], rest_uT: Float[torch.Tensor, "b ch"]) -> Float[torch.Tensor, "b n i"]:
    """Return direction and log length of each change of field, and the skin's field at rest; scaled to about 1.

    Computed in NumPy, as `torch.log` differs between processors; gradients do not reach the readings.
    """
    db, rest = db_uT.numpy(), rest_uT.numpy() / np.float32(REST_uT)
    length_uT = np.maximum(np.linalg.norm(db, axis=-1, keepdims=True), np.float32(LENGTH_MIN_uT))
    shape = (*db.shape[:2], rest.shape[-1])
    parts = [DIRECTION_GAIN * db / length_uT, np.log(length_uT) - LOG_uT, np.broadcast_to(rest[:, None], shape)]
    return torch.from_numpy(np.concatenate(parts, axis=-1))


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
