"""The network of the universal model, evaluated with NumPy and Numba.

The network has two parts. A set encoder computes a code, which is a vector that describes a skin, from the no-load
field and the unlabelled presses of this skin. A regressor estimates the place and the force of a reading. It is
conditioned on the code by FiLM layers, which compute a gain and a shift of each hidden unit from the code.
`reskin.universal.training` trains the weights with PyTorch.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numba import njit

Weights = Mapping[str, np.ndarray]

LAYERS_N = 3  # number of hidden layers of the regressor
# The inputs are the direction dB/|dB| of the field change, log|dB|, and the no-load field. These constants scale them
# to values of about 1: dB/|dB| is multiplied by DIRECTION_GAIN, LOG_uT is subtracted from log|dB|, and the no-load
# field is divided by REST_uT.
DIRECTION_GAIN, LOG_uT, REST_uT = 4.0, 6.5, 1500.0
# If |dB| is smaller than this value, dB is divided by this value instead of |dB|. Otherwise, the direction of tiny
# field changes would consist of noise.
LENGTH_MIN_uT = 1.0
PLACE_MM, LOG_N = 8.0, 3.0  # the outputs are multiplied by these values to get places in mm and log forces
LOG_SD = (-5.0, 2.0)  # smallest and largest log standard deviation of the outputs, before this scaling
OUTPUTS_N = 6  # x, y, log F, and the log standard deviation of each of these three
# Standard deviation of the initial weights of FiLM layers. It is small, so that the code has little effect at first.
FILM_SD = 0.02
FULL_SET_N = 65  # a network is conditioned on at most this number of unlabelled presses


class Layers(NamedTuple):
    """The layers that estimate place and force, after the network was conditioned on one skin.

    `weight` and `bias` contain the weights and the biases of each layer.
    """

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
    """Draw the initial weights of a network.

    Weights and biases are uniformly distributed within +- 1/sqrt(number of inputs), as in PyTorch. Only the weights of
    FiLM layers are close to zero.
    """
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
    """Condition a network on the no-load field and the unlabelled presses of a skin. There may be no presses."""
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
    """Estimate places and forces as means over several networks.

    The more the networks differ, the larger the standard deviations are: the variance over networks is added to the
    mean of the variances that the networks state.
    """
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
    """Condition networks on a skin, and use them to estimate the places and forces of readings."""
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
    """Return the weights of each network from the named arrays of a file that `to_tensors` made."""
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
    # Write the inputs for one field change to `values`: its direction and the logarithm of its magnitude, both scaled.
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
                # ReLU: values at or below 0 of hidden layers are left out. NaN is kept, so that it reaches the outputs.
                if layer == 0 or not previous[i] <= 0:
                    for o in range(len(values)):
                        values[o] += previous[i] * weight[layer][i, o]
        for i in range(3):
            scale = LOG_N if i == 2 else PLACE_MM
            output[r, i] = scale * values[i]
            output[r, 3 + i] = scale * math.exp(min(max(values[3 + i], LOG_SD[0]), LOG_SD[1]))


# Number of units in each layer of the encoder, in the code, and in each hidden layer of the regressor.
SET_WIDTH, CODE_WIDTH, WIDTH = 160, 64, 192
