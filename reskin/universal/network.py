"""The network of the universal model, evaluated in NumPy.

A set encoder computes a code from a skin's no-load field and unlabelled presses. This code conditions a regressor,
which estimates the place and the force of readings. `reskin.universal.training` trains the weights with PyTorch.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numba import njit

Weights = Mapping[str, np.ndarray]

LAYERS_N = 3
DIRECTION_GAIN, LOG_uT, REST_uT = 4.0, 6.5, 1500.0  # scale the inputs dB/|dB|, log|dB| and no-load field to about 1
LENGTH_MIN_uT = 1.0  # if |dB| is smaller, dB is divided by this value instead, so that tiny changes have no direction
PLACE_MM, LOG_N = 8.0, 3.0  # scales of the outputs: place in mm, log force
LOG_SD = (-5.0, 2.0)  # bounds of the log standard deviations of scaled outputs
OUTPUTS_N = 6  # x, y, log F, and the log standard deviation of each
FILM_SD = 0.02  # standard deviation of initial FiLM weights; small, so that the code has little effect at first
FULL_SET_N = 65  # a network is conditioned on at most this number of unlabelled presses


class Layers(NamedTuple):
    """Weights and biases of the layers of a network that is conditioned on a skin."""

    weight: tuple[Float32[np.ndarray, "_ _"], ...]
    bias: tuple[Float32[np.ndarray, " _"], ...]


@dataclass(frozen=True)
class NetworkEstimate:
    """Estimates of places and log forces for readings, with standard deviations."""

    place_mm: Float[np.ndarray, "n 2"]
    sd_mm: Float[np.ndarray, "n 2"]
    log_N: Float[np.ndarray, " n"]
    sd_log_N: Float[np.ndarray, " n"]


def draw_weights(channels_n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw initial weights uniformly within 1/sqrt(fan in), as PyTorch does; FiLM weights are close to zero."""
    inputs_n = 2 * channels_n + 1
    shapes = {"set1": (SET_WIDTH, inputs_n), "set2": (SET_WIDTH, SET_WIDTH), "code": (CODE_WIDTH, SET_WIDTH + 1)}
    shapes |= {f"layer{i}": (WIDTH, WIDTH if i else inputs_n) for i in range(LAYERS_N)}
    shapes["answer"] = (OUTPUTS_N, WIDTH)
    weights = {}
    for name, (out_n, in_n) in shapes.items():
        limit = in_n**-0.5
        weights[f"{name}_weight"] = rng.uniform(-limit, limit, (out_n, in_n)).astype(np.float32)
        weights[f"{name}_bias"] = rng.uniform(-limit, limit, out_n).astype(np.float32)
    for i in range(LAYERS_N):
        weights[f"film{i}_weight"] = (FILM_SD * rng.standard_normal((2 * WIDTH, CODE_WIDTH))).astype(np.float32)
        weights[f"film{i}_bias"] = np.zeros(2 * WIDTH, np.float32)
    return weights


def condition(weights: Weights, rest_uT: Float[np.ndarray, " ch"], presses_uT: Float[np.ndarray, "c ch"]) -> Layers:
    """Condition a network on a skin's no-load field and on unlabelled presses (possibly none)."""
    rest = (rest_uT / REST_uT).astype(np.float32)
    code, reading_n = _encode(weights, rest, presses_uT), len(rest) + 1
    layer_weights, layer_biases = [], []
    for i in range(LAYERS_N):
        weight, bias = _linear(weights, f"layer{i}")
        film, film_bias = _linear(weights, f"film{i}")
        gain, shift = np.split(film @ code + film_bias, 2)
        if i == 0:
            weight, bias = weight[:, :reading_n], bias + weight[:, reading_n:] @ rest
        layer_weights.append(np.ascontiguousarray((weight * (1 + gain)[:, None]).T))
        layer_biases.append(bias * (1 + gain) + shift)
    weight, bias = _linear(weights, "answer")
    return Layers((*layer_weights, np.ascontiguousarray(weight.T)), (*layer_biases, bias))


def evaluate(networks: Sequence[Layers], db_uT: Float[np.ndarray, "n ch"]) -> NetworkEstimate:
    """Estimate places and forces as means over networks; the spread of the networks adds to the standard deviations."""
    outputs = np.empty((len(networks), len(db_uT), OUTPUTS_N))
    for layers, output in zip(networks, outputs, strict=True):
        _forward(db_uT, *layers, output)
    if len(networks) == 1:
        combined = outputs[0]
    else:
        var = (outputs[..., 3:] ** 2).mean(axis=0) + outputs[..., :3].var(axis=0)
        combined = np.concatenate([outputs[..., :3].mean(axis=0), np.sqrt(var)], axis=1)
    return NetworkEstimate(combined[:, :2], combined[:, 3:5], combined[:, 2], combined[:, 5])


def predict(
    networks: Sequence[Weights],
    db_uT: Float[np.ndarray, "n ch"],
    rest_uT: Float[np.ndarray, " ch"],
    presses_uT: Float[np.ndarray, "c ch"],
) -> NetworkEstimate:
    """Condition networks on a skin, and estimate places and forces of readings with them."""
    return evaluate([condition(weights, rest_uT, presses_uT) for weights in networks], db_uT)


def shift_places(layers: Layers, by_mm: Float[np.ndarray, "2"]) -> Layers:
    """Shift all places that a network predicts, by changing its last bias (in single precision)."""
    *biases, last = layers.bias
    by = np.zeros_like(last)
    by[:2] = by_mm / PLACE_MM
    return Layers(layers.weight, (*biases, last + by))


def to_tensors(networks: Sequence[Weights]) -> dict[str, np.ndarray]:
    """Return the weights of several networks as named arrays for a file."""
    return {f"{i}.{name}": value for i, weights in enumerate(networks) for name, value in weights.items()}


def from_tensors(tensors: Mapping[str, np.ndarray]) -> list[Weights]:
    """Return the weights of each network from the named arrays of a file, in the networks' order."""
    networks: dict[int, dict[str, np.ndarray]] = {}
    for key, value in tensors.items():
        i, _, name = key.partition(".")
        networks.setdefault(int(i), {})[name] = value
    return [networks[i] for i in sorted(networks)]


def _encode(
    weights: Weights, rest: Float32[np.ndarray, " ch"], presses_uT: Float[np.ndarray, "c ch"]
) -> Float32[np.ndarray, " o"]:
    features = np.empty((len(presses_uT), 2 * len(rest) + 1), np.float32)
    features[:, len(rest) + 1 :] = rest
    for press_uT, values in zip(presses_uT, features, strict=True):
        _fill_inputs(press_uT, values)
    for name in ("set1", "set2"):
        weight, bias = _linear(weights, name)
        features = np.maximum(features @ weight.T + bias, 0)
    weight, bias = _linear(weights, "code")
    pooled = np.append(features.sum(axis=0) / max(len(features), 1), np.float32(len(features) / FULL_SET_N))
    return np.maximum(weight @ pooled.astype(np.float32) + bias, 0)


def _linear(weights: Weights, name: str) -> tuple[np.ndarray, np.ndarray]:
    return weights[f"{name}_weight"], weights[f"{name}_bias"]


@njit(cache=True, error_model="numpy")
@no_type_check
def _fill_inputs(db_uT, values):
    # Write the direction and the log length of a field change to `values`, scaled to about 1.
    length2 = 0.0
    for i in range(len(db_uT)):
        length2 += db_uT[i] ** 2
    length_uT = LENGTH_MIN_uT if length2 < LENGTH_MIN_uT**2 else math.sqrt(length2)
    for i in range(len(db_uT)):
        values[i] = DIRECTION_GAIN * db_uT[i] / length_uT
    values[len(db_uT)] = math.log(length_uT) - LOG_uT


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _forward(db_uT, weight, bias, output):
    for r in range(len(db_uT)):
        values = np.empty(db_uT.shape[1] + 1, np.float32)
        _fill_inputs(db_uT[r], values)
        for layer in range(len(weight)):
            previous, values = values, bias[layer].copy()
            for i in range(len(previous)):
                if layer == 0 or not previous[i] <= 0:  # ReLU that propagates NaN
                    for o in range(len(values)):
                        values[o] += previous[i] * weight[layer][i, o]
        for i in range(3):
            scale = LOG_N if i == 2 else PLACE_MM
            output[r, i] = scale * values[i]
            output[r, 3 + i] = scale * math.exp(min(max(values[3 + i], LOG_SD[0]), LOG_SD[1]))


SET_WIDTH, CODE_WIDTH, WIDTH = 160, 64, 192  # units in the encoder's layers, in the code, in the regressor's layers
