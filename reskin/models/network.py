"""The networks: their architectures, their initial weights, and their computation in stacks.

There are two architectures: the one that the paper describes, and the one that the paper's authors released.

A stack is a set of m networks that are computed together. For each layer, the weights of all m networks are in one
tensor, so that one batched product replaces m small products. This is faster, because the networks are so small that
the overhead of a call takes longer than the arithmetic.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import nn

from reskin.models.job import Weights
from reskin.models.reproducible import affine_layers

HIDDEN_N = 200
FEATURES_N = 40  # width of the bottleneck layer, on whose output the triplet loss is computed (paper section 4)
FEATURE_LAYERS_N = 3
OUTPUTS_N = 3  # number of outputs: x, y, F. With shear forces, there are five outputs: x, y, Fx, Fy, Fz.
BLOCK_ROWS_N = 65_536  # largest number of rows in a forward pass, to limit the use of memory


@dataclass(frozen=True)
class Layer:
    """The description of a linear layer: its numbers of inputs and outputs, and whether a ReLU follows it."""

    in_n: int
    out_n: int
    relu: bool


def paper_layers(inputs_n: int, outputs_n: int = OUTPUTS_N) -> tuple[Layer, ...]:
    """Return the layers of the network that the paper describes.

    The description in the paper is: B(15) -> MLP+ReLU(200) -> MLP(200) -> MLP(40) -> MLP+ReLU(200) -> MLP+ReLU(200) ->
    xyF(3).
    """
    return _layers(inputs_n, outputs_n, relus=(True, False, False, True, True, False))


def released_layers(inputs_n: int, outputs_n: int = OUTPUTS_N) -> tuple[Layer, ...]:
    """Return the layers of the network that the paper's authors released.

    Compared with the network that the paper describes, it has two more ReLUs: after the second layer and at the end.
    """
    return _layers(inputs_n, outputs_n, relus=(True, True, False, True, True, True))


LAYERS = {"paper": paper_layers, "released": released_layers}


def draw_weights(layers: Sequence[Layer], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw initial weights in the same way as PyTorch's linear layers: uniformly between -1/sqrt(n) and 1/sqrt(n).

    n is the number of inputs of the layer.
    """
    weights = {}
    for i, layer in enumerate(layers, 1):
        limit = layer.in_n**-0.5
        for part, shape in (("weight", (layer.out_n, layer.in_n)), ("bias", (layer.out_n,))):
            weights[f"layer{i}.{part}"] = rng.uniform(-limit, limit, shape).astype(np.float32)
    return weights


def _layers(inputs_n: int, outputs_n: int, relus: tuple[bool, ...]) -> tuple[Layer, ...]:
    widths = (inputs_n, HIDDEN_N, HIDDEN_N, FEATURES_N, HIDDEN_N, HIDDEN_N, outputs_n)
    return tuple(Layer(in_n, out_n, relu) for (in_n, out_n), relu in zip(pairwise(widths), relus, strict=True))


class Stack(nn.Module):
    """A stack: independent networks of the same architecture that are computed together (see the module's docstring).

    `members` contains the weights of each network.
    """

    def __init__(self, layers: Sequence[Layer], members: Sequence[Weights]) -> None:
        super().__init__()
        self.relus = [layer.relu for layer in layers]
        self.members_n = len(members)
        numbers = range(1, len(layers) + 1)
        # The transposed weights are copied to contiguous tensors. With transposed views instead, autograd and AdamW
        # would have to copy the gradients.
        self.weights = nn.ParameterList(_stacked(members, f"layer{i}.weight").mT.contiguous() for i in numbers)
        self.biases = nn.ParameterList(_stacked(members, f"layer{i}.bias")[:, None] for i in numbers)

    def features(self, inputs: Float[torch.Tensor, "m b c"]) -> Float[torch.Tensor, "m b 40"]:
        """Return the output of the first three layers, on which the triplet loss is computed."""
        return self._run(inputs, 0, FEATURE_LAYERS_N)

    def head(self, features: Float[torch.Tensor, "m b 40"]) -> Float[torch.Tensor, "m b t"]:
        """Return the output of the remaining layers, given the output of the first three layers."""
        return self._run(features, FEATURE_LAYERS_N, len(self.relus))

    def forward(self, inputs: Float[torch.Tensor, "m b c"]) -> Float[torch.Tensor, "m b t"]:
        return self.head(self.features(inputs))

    def weights_of(self, i: int) -> dict[str, np.ndarray]:
        """Return copies of the weights of network `i`, by name: `layer1.weight` [out in], `layer1.bias` [out], ..."""
        weights = {}
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True), 1):
            weights[f"layer{k}.weight"] = weight.detach()[i].T.contiguous().cpu().numpy().copy()
            weights[f"layer{k}.bias"] = bias.detach()[i, 0].cpu().numpy().copy()
        return weights

    def is_finite(self) -> Bool[torch.Tensor, " m"]:
        return torch.stack([torch.isfinite(values.detach()).flatten(1).all(1) for values in self.parameters()]).all(0)

    def _run(self, values: torch.Tensor, first: int, last: int) -> torch.Tensor:
        weights, biases = list(self.weights)[first:last], list(self.biases)[first:last]
        return affine_layers(values, weights, biases, self.relus[first:last])


class Predictor:
    """A trained network that can be called like a function. It converts scaled inputs to scaled outputs.

    Many inputs are processed in blocks of rows, to limit the use of memory.
    """

    def __init__(self, weights: Weights, architecture: str, device: str) -> None:
        inputs_n, outputs_n = weights["layer1.weight"].shape[1], len(weights[f"layer{len(weights) // 2}.bias"])
        layers = LAYERS[architecture](inputs_n, outputs_n)
        self.net, self.device = Stack(layers, [weights]).to(device), device

    @torch.no_grad()
    def __call__(self, inputs: Float32[np.ndarray, "n c"]) -> Float32[np.ndarray, "n t"]:
        blocks = torch.from_numpy(inputs).split(BLOCK_ROWS_N)
        return torch.cat([self.net(block[None].to(self.device))[0].cpu() for block in blocks]).numpy()


def _stacked(members: Sequence[Weights], name: str) -> torch.Tensor:
    return torch.from_numpy(np.stack([member[name] for member in members]))
