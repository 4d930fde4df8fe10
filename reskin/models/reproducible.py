"""Differentiable operations whose results are bit-identical on every x86-64 processor with AVX2.

On a CPU, PyTorch computes matrix products, `exp`, `log`, `sqrt` and `erf` with Intel's library MKL. The results of MKL
differ between AMD and Intel processors in the last bits, even if the variable MKL_CBWR is set. Training amplifies such
a difference, so that the predictions of the trained networks may differ by millimetres.

Therefore, the networks do not use these operations of PyTorch. This module computes matrix products with NumPy's
OpenBLAS instead, which uses the code that `reskin.numerics` selects. For layers of this size, OpenBLAS is as fast as
MKL. `exp` is computed with `exp2`, for which PyTorch does not use MKL. Logarithms are computed with NumPy. The other
operations of the networks (sums, ReLU, sigmoid, AdamW) do not use MKL.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch.autograd.function import once_differentiable


def affine(
    values: Float[torch.Tensor, "*n b i"], weight: Float[torch.Tensor, "*m i o"], bias: Float[torch.Tensor, "*m 1 o"]
) -> Float[torch.Tensor, "*n b o"]:
    """Return `values @ weight + bias`.

    If `weight` is 2-D, the same layer is applied to all rows. If `weight` is 3-D, it contains one layer for each
    network of a stack (see `reskin.models.network`).
    """
    if weight.ndim == 2 and values.ndim > 2:
        rows = affine(values.flatten(end_dim=-2), weight, bias)
        return rows.unflatten(0, values.shape[:-1])
    return affine_layers(values, [weight], [bias], [False])


def affine_layers(
    values: Float[torch.Tensor, "*n b i"],
    weights: Sequence[Float[torch.Tensor, "*m _ _"]],
    biases: Sequence[Float[torch.Tensor, "*m 1 _"]],
    relus: Sequence[bool],
) -> Float[torch.Tensor, "*n b o"]:
    """Apply one or more layers, one after the other: `values @ weight + bias`, and then a ReLU where `relus` is True.

    On a CPU, all layers together are one operation for PyTorch's autograd, because the networks are so small that the
    overhead of one operation for each layer would be noticeable. Second derivatives are not available.
    """
    if values.device.type == "cpu":
        result: torch.Tensor = _AffineLayers.apply(values, relus, *weights, *biases)  # type: ignore[no-untyped-call]
        return result
    for weight, bias, relu in zip(weights, biases, relus, strict=True):
        values = values @ weight + bias
        values = torch.relu_(values) if relu else values
    return values


def exp(values: Float[torch.Tensor, "*s"]) -> Float[torch.Tensor, "*s"]:
    """Return e to the power of each value, without `torch.exp`, which uses MKL."""
    return torch.exp2(values * math.log2(math.e))


class _AffineLayers(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, relus: Sequence[bool], *parameters: torch.Tensor) -> torch.Tensor:
        weights, biases = parameters[: len(relus)], parameters[len(relus) :]
        results: list[torch.Tensor] = []
        # NumPy's warnings are turned off. As in PyTorch, an overflow then gives inf without a warning, and the training
        # loop detects it.
        with np.errstate(all="ignore"):
            for weight, bias, relu in zip(weights, biases, relus, strict=True):
                result = _product(results[-1] if results else values, weight).add_(bias)
                results.append(result.relu_() if relu else result)
        # The last result is needed only for the derivative of its ReLU. If it has none, the caller may change it.
        last = results[-1] if relus[-1] else None
        ctx.save_for_backward(values, *results[:-1], last, *weights)
        ctx.relus = relus
        return results[-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,) = gradients
        n = len(ctx.relus)
        inputs, results, weights = ctx.saved_tensors[:n], ctx.saved_tensors[1 : n + 1], ctx.saved_tensors[n + 1 :]
        needs_values, _, *needs = ctx.needs_input_grad
        of_weights: list[torch.Tensor | None] = [None] * n
        of_biases: list[torch.Tensor | None] = [None] * n
        with np.errstate(all="ignore"):
            for i in reversed(range(n)):
                if ctx.relus[i]:
                    gradient = torch.ops.aten.threshold_backward(gradient, results[i], 0)
                if needs[i]:
                    of_weights[i] = _product(inputs[i].mT, gradient)
                if needs[n + i]:
                    of_biases[i] = gradient.sum(-2, keepdim=True)
                if i or needs_values:
                    gradient = _product(gradient, weights[i].mT)
        return gradient if needs_values else None, None, *of_weights, *of_biases


def _product(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))
