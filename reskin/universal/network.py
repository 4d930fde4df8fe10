"""The network of the universal model: a code of the skin from calibration data, and estimates given that code."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float32
from numba import njit
from torch import nn

from reskin.models.reproducible import affine

Weights = Mapping[str, np.ndarray]

LAYERS_N = 3
DIRECTION_GAIN, LOG_uT, REST_uT = 4.0, 6.5, 1500.0  # bring inputs to about 1: dB/|dB|, log|dB|, field at rest
LENGTH_MIN_uT = 1.0  # shorter changes of field have no direction
PLACE_MM, LOG_N = 8.0, 3.0  # of an answer of 1
LOG_SD = (-5.0, 2.0)  # an answer's log sd is held between
FULL_SET_N = 65  # pokes that count as a full set: more were never shown


class Layers(NamedTuple):
    """A network that is ready for a skin: weights and biases, layer by layer."""

    weight: tuple[Float32[np.ndarray, "_ _"], ...]
    bias: tuple[Float32[np.ndarray, " _"], ...]


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


def predict(
    networks: Sequence[Weights],
    db_uT: Float[np.ndarray, "n ch"],
    rest_uT: Float[np.ndarray, " ch"],
    pokes_uT: Float[np.ndarray, "c ch"],
) -> Opinion:
    """Ask networks about readings of one skin, told its field at rest and so many unlabelled pokes (none will do)."""
    return ask([tell(weights, rest_uT, pokes_uT) for weights in networks], db_uT)


def tell(weights: Weights, rest_uT: Float[np.ndarray, " ch"], pokes_uT: Float[np.ndarray, "c ch"]) -> Layers:
    """Make a network ready for a skin."""
    rest = (rest_uT / REST_uT).astype(np.float32)
    code, told_n = _code(weights, rest, pokes_uT), len(rest) + 1
    each_weight, each_bias = [], []
    for i in range(LAYERS_N):
        weight, bias = _of(weights, f"layer{i}")
        film, film_bias = _of(weights, f"film{i}")
        gain, shift = np.split(film @ code + film_bias, 2)
        if i == 0:
            weight, bias = weight[:, :told_n], bias + weight[:, told_n:] @ rest
        each_weight.append(np.ascontiguousarray((weight * (1 + gain)[:, None]).T))
        each_bias.append(bias * (1 + gain) + shift)
    weight, bias = _of(weights, "answer")
    return Layers((*each_weight, np.ascontiguousarray(weight.T)), (*each_bias, bias))


def ask(networks: Sequence[Layers], db_uT: Float[np.ndarray, "n ch"]) -> Opinion:
    """Ask networks that are ready; of several, the mean, and what they differ by counts as uncertainty."""
    found = np.empty((len(networks), len(db_uT), 6))
    for layers, of_one in zip(networks, found, strict=True):
        _ask(db_uT, *layers, of_one)
    if len(networks) == 1:
        of_all = found[0]
    else:
        var = (found[..., 3:] ** 2).mean(axis=0) + found[..., :3].var(axis=0)
        of_all = np.concatenate([found[..., :3].mean(axis=0), np.sqrt(var)], axis=1)
    return Opinion(of_all[:, :2], of_all[:, 3:5], of_all[:, 2], of_all[:, 5])


def moved(layers: Layers, by_mm: Float[np.ndarray, "2"]) -> Layers:
    """Move all places that a network will say."""
    *biases, last = layers.bias
    by = np.zeros_like(last)
    by[:2] = by_mm / PLACE_MM
    return Layers(layers.weight, (*biases, last + by))


def to_tensors(networks: Sequence[Weights]) -> dict[str, np.ndarray]:
    """Name the weights of several networks as a file holds them."""
    return {f"{i}.{name}": value for i, weights in enumerate(networks) for name, value in weights.items()}


def of_tensors(tensors: Mapping[str, np.ndarray]) -> list[Weights]:
    """Give the networks of a file, in their order."""
    networks: dict[int, dict[str, np.ndarray]] = {}
    for key, value in tensors.items():
        i, _, name = key.partition(".")
        networks.setdefault(int(i), {})[name] = value
    return [networks[i] for i in sorted(networks)]


def _code(
    weights: Weights, rest: Float32[np.ndarray, " ch"], pokes_uT: Float[np.ndarray, "c ch"]
) -> Float32[np.ndarray, " o"]:
    each = np.empty((len(pokes_uT), 2 * len(rest) + 1), np.float32)
    each[:, len(rest) + 1 :] = rest
    for poke_uT, shown in zip(pokes_uT, each, strict=True):
        _show(poke_uT, shown)
    for name in ("set1", "set2"):
        weight, bias = _of(weights, name)
        each = np.maximum(each @ weight.T + bias, 0)
    weight, bias = _of(weights, "code")
    pooled = np.append(each.sum(axis=0) / max(len(each), 1), np.float32(len(each) / FULL_SET_N))
    return np.maximum(weight @ pooled.astype(np.float32) + bias, 0)


def _of(weights: Weights, name: str) -> tuple[np.ndarray, np.ndarray]:
    return weights[f"{name}_weight"], weights[f"{name}_bias"]


@njit(cache=True, error_model="numpy")
@no_type_check
def _show(db_uT, shown):
    # Direction and log length of a change of field, scaled to about 1.
    length2 = 0.0
    for i in range(len(db_uT)):
        length2 += db_uT[i] ** 2
    length_uT = LENGTH_MIN_uT if length2 < LENGTH_MIN_uT**2 else math.sqrt(length2)
    for i in range(len(db_uT)):
        shown[i] = DIRECTION_GAIN * db_uT[i] / length_uT
    shown[len(db_uT)] = math.log(length_uT) - LOG_uT


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _ask(db_uT, weight, bias, found):
    for r in range(len(db_uT)):
        values = np.empty(db_uT.shape[1] + 1, np.float32)
        _show(db_uT[r], values)
        for layer in range(len(weight)):
            given, values = values, bias[layer].copy()
            for i in range(len(given)):
                if layer == 0 or not given[i] <= 0:  # what is no number shall be seen
                    for o in range(len(values)):
                        values[o] += given[i] * weight[layer][i, o]
        for i in range(3):
            scale = LOG_N if i == 2 else PLACE_MM
            found[r, i] = scale * values[i]
            found[r, 3 + i] = scale * math.exp(min(max(values[3 + i], LOG_SD[0]), LOG_SD[1]))


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
