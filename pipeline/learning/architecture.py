"""The paper's five-layer perceptron on paper: widths, ReLUs, first weights. In: how many inputs and outputs.

Out: layers, arrays. Refuses to know how it is run and trained.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

HIDDEN_N = 200
FEATURES_N = 40  # the bottleneck that the triplet term acts on (paper section 4)
FEATURE_LAYERS_N = 3
OUTPUTS_N = 3  # x, y, F; five where shear is answered too: x, y, Fx, Fy, Fz

Weights = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Layer:
    """A linear layer, and whether a ReLU follows it."""

    in_n: int
    out_n: int
    relu: bool


def paper_layers(inputs_n: int, outputs_n: int = OUTPUTS_N) -> tuple[Layer, ...]:
    """B(15) -> MLP+ReLU(200) -> MLP(200) -> MLP(40) -> MLP+ReLU(200) -> MLP+ReLU(200) -> xyF(3), as printed."""
    return _layers(inputs_n, outputs_n, relus=(True, False, False, True, True, False))


def released_layers(inputs_n: int, outputs_n: int = OUTPUTS_N) -> tuple[Layer, ...]:
    """The network that the authors released: also a ReLU after layer 2 and one on the output."""
    return _layers(inputs_n, outputs_n, relus=(True, True, False, True, True, True))


LAYERS = {"paper": paper_layers, "released": released_layers}


def draw_weights(layers: Sequence[Layer], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw first weights as PyTorch does by default for linear layers: uniform within 1/sqrt(fan in)."""
    weights = {}
    for i, layer in enumerate(layers, 1):
        limit = layer.in_n**-0.5
        for part, shape in (("weight", (layer.out_n, layer.in_n)), ("bias", (layer.out_n,))):
            weights[f"layer{i}.{part}"] = rng.uniform(-limit, limit, shape).astype(np.float32)
    return weights


def _layers(inputs_n: int, outputs_n: int, relus: tuple[bool, ...]) -> tuple[Layer, ...]:
    widths = (inputs_n, HIDDEN_N, HIDDEN_N, FEATURES_N, HIDDEN_N, HIDDEN_N, outputs_n)
    return tuple(Layer(in_n, out_n, relu) for (in_n, out_n), relu in zip(pairwise(widths), relus, strict=True))
