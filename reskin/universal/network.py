"""Estimates by the network of the universal model, in NumPy: from its weights and a code of the skin."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numba import njit

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
