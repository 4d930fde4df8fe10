"""The network of the universal model: it reads a skin from presses on it, and then estimates places and forces.

The network is a transformer. Its inputs are presses, each with the no-load field of the skin. Each press becomes one
token. The presses that are known of a skin are the context; a labelled press also has a place and, if it is known, a
force. Context tokens attend to the context, and so does the reading that is to be estimated. Readings do not attend to
one another. Therefore, the keys and values of the context are computed once per skin (`read_skin`), and a reading
costs only its own token (`estimate`).

This module evaluates a trained network with NumPy and Numba. `reskin.universal.training` trains it with PyTorch. The
context is computed in double precision. A reading is computed in single precision, always in the same order of
operations, so that processors agree to 1e-5 mm.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32
from numba import njit

from reskin.universal.calibration import SkinData

WIDTH, HIDDEN, HEADS_N, LAYERS_N = 96, 288, 4, 3  # numbers of values in a token and in a hidden layer, heads, layers
HEAD = WIDTH // HEADS_N
LABEL_INPUTS_N, OUTPUTS_N = 5, 6
# Scales of inputs and outputs, so that they are about 1. Inputs for a field change dB are its direction times a gain,
# and log |dB| minus an offset. Field changes shorter than 1 uT count as 1 uT.
DIRECTION_GAIN, LOG_uT, LENGTH_MIN_uT, REST_uT = 4.0, 6.5, 1.0, 1500.0
PLACE_MM, LOG_N = 8.0, 3.0
EXTERNAL_uT = 30.0  # the external field e is an input as log(1 + e / EXTERNAL_uT)
LOG_SD = (-5.0, 2.0)  # limits of the logarithm of the scaled standard deviations
NORM_EPS = 1e-5  # is added to the variance in layer normalisations

Weights = Mapping[str, np.ndarray]


class Normals(NamedTuple):
    """Normal distributions of the place and of the logarithm of the force of readings."""

    place_mm: Float[np.ndarray, "n 2"]
    log_N: Float[np.ndarray, " n"]
    sd_mm: Float[np.ndarray, "n 2"]
    sd_log_N: Float[np.ndarray, " n"]


class Context(NamedTuple):
    """What the network knows of a skin: the keys and values of its context, and the inputs that all readings share.

    `shared` is what no-load field and external field add to the first layer. `sign` is the sign by which all fields are
    multiplied first (see `sign_of`).
    """

    keys: Float32[np.ndarray, "l w c"]
    values: Float32[np.ndarray, "l c w"]
    shared: Float32[np.ndarray, " w2"]
    sign: float


class Compiled(NamedTuple):
    """The weights of a network as the compiled code needs them: in single precision, with one row per input."""

    embed: tuple[np.ndarray, ...]
    query: tuple[np.ndarray, ...]
    mix: tuple[np.ndarray, ...]
    mlp: tuple[np.ndarray, ...]
    norms: np.ndarray
    out: tuple[np.ndarray, ...]


def shapes(channels_n: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of weights, for a board with this number of channels."""
    linear: dict[str, tuple[int, ...]] = {"embed1": (2 * WIDTH, 2 * channels_n + 2), "embed2": (WIDTH, 2 * WIDTH)}
    linear |= {"label1": (WIDTH, LABEL_INPUTS_N), "label2": (WIDTH, WIDTH)}
    norms = []
    for i in range(LAYERS_N):
        sizes: dict[str, tuple[int, ...]] = {
            "query": (WIDTH, WIDTH),
            "key": (WIDTH, WIDTH),
            "value": (WIDTH, WIDTH),
            "mix": (WIDTH, WIDTH),
        }
        sizes |= {"mlp1": (HIDDEN, WIDTH), "mlp2": (WIDTH, HIDDEN)}
        linear |= {f"layer{i}.{name}": size for name, size in sizes.items()}
        norms += [f"layer{i}.norm1", f"layer{i}.norm2"]
    linear |= {"out1": (2 * WIDTH, WIDTH), "out2": (OUTPUTS_N, 2 * WIDTH)}
    of_linear: dict[str, tuple[int, ...]] = {f"{name}.weight": size for name, size in linear.items()}
    of_linear |= {f"{name}.bias": size[:1] for name, size in linear.items()}
    of_norms: dict[str, tuple[int, ...]] = {
        f"{name}.{part}": (WIDTH,) for name in (*norms, "norm") for part in ("weight", "bias")
    }
    return of_linear | of_norms | {"empty": (WIDTH,), "usual_rest": (channels_n,)}


def compile_weights(weights: Weights) -> Compiled:
    """Arrange the weights of a network for the compiled code."""

    def pair(name: str) -> tuple[np.ndarray, np.ndarray]:
        weight = np.ascontiguousarray(weights[f"{name}.weight"].T, np.float32)
        return weight, weights[f"{name}.bias"].astype(np.float32)

    def stacked(*names: str) -> tuple[np.ndarray, ...]:
        layers = [[array for name in names for array in pair(f"layer{i}.{name}")] for i in range(LAYERS_N)]
        return tuple(np.stack(arrays) for arrays in zip(*layers, strict=True))

    channels_n = len(weights["usual_rest"])
    norms = [name for i in range(LAYERS_N) for name in (f"layer{i}.norm1", f"layer{i}.norm2")]
    norm = np.stack([[weights[f"{name}.weight"], weights[f"{name}.bias"]] for name in (*norms, "norm")])
    first, _ = pair("embed1")
    embed = np.ascontiguousarray(first[: channels_n + 1]), *pair("embed2")
    out = *pair("out1"), *pair("out2")
    return Compiled(embed, stacked("query"), stacked("mix"), stacked("mlp1", "mlp2"), norm.astype(np.float32), out)


def sign_of(weights: Weights, rest_uT: Float[np.ndarray, " ch"]) -> float:
    """Return the sign by which the fields of a skin are multiplied, so that its magnets have the usual polarity.

    All fields of a skin have the opposite sign if its polarity is reversed or if a checkerboard is turned by a quarter.
    """
    return -1.0 if float(rest_uT @ weights["usual_rest"]) < 0 else 1.0


def read_skin(weights: Weights, data: SkinData, external_uT: float = 0.0) -> Context:
    """Compute the context of a skin from its no-load field and its presses.

    `external_uT` is the standard deviation of external fields that readings contain.
    """
    rest_uT, labels = data.rest_uT, data.labels
    sign = sign_of(weights, rest_uT)
    weight, bias = _linear(weights, "embed1")
    own_n = len(rest_uT) + 1  # the first inputs are those of a press
    ambient = np.append(sign * rest_uT / REST_uT, math.log1p(external_uT / EXTERNAL_uT))
    shared = weight[:, own_n:] @ ambient + bias
    db_uT = sign * np.concatenate([labels.db_uT, data.presses_uT])
    length_uT = np.maximum(np.linalg.norm(db_uT, axis=1, keepdims=True), LENGTH_MIN_uT)
    inputs = np.hstack([DIRECTION_GAIN * db_uT / length_uT, np.log(length_uT) - LOG_uT])
    tokens = _apply(weights, "embed2", _bend(inputs @ weight[:, :own_n].T + shared))
    known = np.isfinite(labels.force_N)
    log_N = np.log(np.where(known, labels.force_N, 1.0)) / LOG_N
    of_labels = np.column_stack([labels.place_mm / PLACE_MM, log_N, np.ones(len(known)), known])
    tokens[: len(known)] += _apply(weights, "label2", _bend(_apply(weights, "label1", of_labels)))
    tokens = np.vstack([weights["empty"].astype(float), tokens])
    keys, values = [], []
    for i in range(LAYERS_N):
        normed = _norm(weights, f"layer{i}.norm1", tokens)
        key, value = (_apply(weights, f"layer{i}.{name}", normed) for name in ("key", "value"))
        keys.append(key.T / math.sqrt(HEAD))
        values.append(value)
        if i < LAYERS_N - 1:  # the tokens that follow the last layer are not needed
            query = _apply(weights, f"layer{i}.query", normed)
            q, k, v = (part.reshape(-1, HEADS_N, HEAD).transpose(1, 0, 2) for part in (query, key, value))
            score = q @ k.transpose(0, 2, 1) / math.sqrt(HEAD)
            share = np.exp(score - score.max(axis=2, keepdims=True))
            read = (share / share.sum(axis=2, keepdims=True)) @ v
            tokens = tokens + _apply(weights, f"layer{i}.mix", read.transpose(1, 0, 2).reshape(-1, WIDTH))
            hidden = _bend(_apply(weights, f"layer{i}.mlp1", _norm(weights, f"layer{i}.norm2", tokens)))
            tokens = tokens + _apply(weights, f"layer{i}.mlp2", hidden)
    return Context(
        np.ascontiguousarray(keys, np.float32), np.ascontiguousarray(values, np.float32), shared.astype(np.float32),
        sign,
    )  # fmt: skip


def estimate(compiled: Compiled, context: Context, db_uT: Float[np.ndarray, "n ch"]) -> Normals:
    """Estimate places, relative to the centre of the board, and forces of readings from their field changes."""
    output = np.empty((len(db_uT), OUTPUTS_N))
    embed, query, mix, mlp, norms, out = compiled
    _estimate(
        np.ascontiguousarray(db_uT, float), context.sign, context.shared, context.keys, context.values, embed, query,
        mix, mlp, norms, out, output,
    )  # fmt: skip
    scaled, log_sd = output[:, :3], np.clip(output[:, 3:], *LOG_SD)
    # NaN in a reading reaches all of its outputs: clip keeps it.
    sd = np.exp(log_sd)
    return Normals(PLACE_MM * scaled[:, :2], LOG_N * scaled[:, 2], PLACE_MM * sd[:, :2], LOG_N * sd[:, 2])


def _linear(weights: Weights, name: str) -> tuple[np.ndarray, np.ndarray]:
    return weights[f"{name}.weight"].astype(float), weights[f"{name}.bias"].astype(float)


def _apply(weights: Weights, name: str, values: Float[np.ndarray, "n i"]) -> Float[np.ndarray, "n o"]:
    weight, bias = _linear(weights, name)
    return values @ weight.T + bias


def _bend(values: np.ndarray) -> np.ndarray:
    """Apply the activation function hard swish, x min(max(x + 3, 0), 6) / 6."""
    return values * np.clip(values + 3, 0, 6) / 6


def _norm(weights: Weights, name: str, values: Float[np.ndarray, "n w"]) -> Float[np.ndarray, "n w"]:
    centred = values - values.mean(axis=1, keepdims=True)
    scaled = centred / np.sqrt((centred**2).mean(axis=1, keepdims=True) + NORM_EPS)
    return scaled * weights[f"{name}.weight"] + weights[f"{name}.bias"]


# The functions below add products in loops over outputs, so that the compiler can use vector instructions without
# changing the order of additions. With fastmath={"contract"}, it may fuse a multiplication and an addition, which every
# processor with AVX2 can.
@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _add_product(values, weight, result):
    for i in range(len(values)):
        value = values[i]
        for o in range(len(result)):
            result[o] += value * weight[i, o]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _bend_in_place(values):
    for i in range(len(values)):
        values[i] = values[i] * min(max(values[i] + np.float32(3), np.float32(0)), np.float32(6)) / np.float32(6)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _normalise(values, norm, result):
    mean = np.float32(0)
    for i in range(len(values)):
        mean += values[i]
    mean /= np.float32(len(values))
    variance = np.float32(0)
    for i in range(len(values)):
        variance += (values[i] - mean) ** 2
    factor = np.float32(1) / np.sqrt(variance / np.float32(len(values)) + np.float32(NORM_EPS))
    for i in range(len(values)):
        result[i] = (values[i] - mean) * factor * norm[0, i] + norm[1, i]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
@no_type_check
def _estimate(db_uT, sign, shared, keys, values, embed, query, mix, mlp, norms, out, output):
    layers_n, width, context_n = keys.shape
    channels_n = db_uT.shape[1]
    inputs = np.empty(channels_n + 1, np.float32)
    normed = np.empty(width, np.float32)
    asked, read, token = np.empty_like(normed), np.empty_like(normed), np.empty_like(normed)
    hidden, wide = np.empty(mlp[0].shape[2], np.float32), np.empty(len(shared), np.float32)
    share, result = np.empty(context_n, np.float32), np.empty(output.shape[1], np.float32)
    for r in range(len(db_uT)):
        length2 = 0.0
        for i in range(channels_n):
            length2 += db_uT[r, i] ** 2
        length_uT = LENGTH_MIN_uT if length2 < LENGTH_MIN_uT**2 else math.sqrt(length2)
        for i in range(channels_n):
            inputs[i] = sign * DIRECTION_GAIN * db_uT[r, i] / length_uT
        inputs[channels_n] = math.log(length_uT) - LOG_uT
        wide[:] = shared
        _add_product(inputs, embed[0], wide)
        _bend_in_place(wide)
        token[:] = embed[2]
        _add_product(wide, embed[1], token)
        for layer in range(layers_n):
            _normalise(token, norms[2 * layer], normed)
            asked[:] = query[1][layer]
            _add_product(normed, query[0][layer], asked)
            read[:] = 0
            for head in range(HEADS_N):
                share[:] = 0
                for d in range(head * HEAD, (head + 1) * HEAD):
                    value = asked[d]
                    for c in range(context_n):
                        share[c] += value * keys[layer, d, c]
                most = share.max()
                total = np.float32(0)
                for c in range(context_n):
                    share[c] = math.exp(share[c] - most)
                    total += share[c]
                for c in range(context_n):
                    weight = share[c] / total
                    for d in range(head * HEAD, (head + 1) * HEAD):
                        read[d] += weight * values[layer, c, d]
            for i in range(width):
                token[i] += mix[1][layer, i]
            _add_product(read, mix[0][layer], token)
            _normalise(token, norms[2 * layer + 1], normed)
            hidden[:] = mlp[1][layer]
            _add_product(normed, mlp[0][layer], hidden)
            _bend_in_place(hidden)
            for i in range(width):
                token[i] += mlp[3][layer, i]
            _add_product(hidden, mlp[2][layer], token)
        _normalise(token, norms[2 * layers_n], normed)
        wide[:] = out[1]
        _add_product(normed, out[0], wide)
        _bend_in_place(wide)
        result[:] = out[3]
        _add_product(wide, out[2], result)
        for o in range(len(result)):
            output[r, o] = result[o]
