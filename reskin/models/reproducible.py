"""Differentiable operations whose results are bit-identical on every x86-64 processor with AVX2.

On a CPU, PyTorch passes matrix products, `exp`, `log`, `sqrt` and `erf` to MKL, which computes them differently on AMD
and Intel processors, even if MKL_CBWR is set, and training amplifies a difference in the last bit to millimetres. Here,
products are computed by NumPy's OpenBLAS with the kernels that `reskin.numerics` selects, which is as fast for layers
of this size; `exp` uses `exp2`, which PyTorch implements itself. PyTorch also implements the other operations of the
networks (sums, ReLU, sigmoid, AdamW); logarithms of inputs are computed in NumPy.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float


def affine(
    values: Float[torch.Tensor, "*n b i"], weight: Float[torch.Tensor, "*m i o"], bias: Float[torch.Tensor, "*m 1 o"]
) -> Float[torch.Tensor, "*n b o"]:
    """Return `values @ weight + bias`.

    `weight` has two dimensions for one layer for all rows, or three for one layer per network of a stack.
    """
    if weight.ndim == 2 and values.ndim > 2:
        rows = affine(values.flatten(end_dim=-2), weight, bias)
        return rows.unflatten(0, values.shape[:-1])
    if values.device.type != "cpu":
        return values @ weight + bias
    result: torch.Tensor = _Affine.apply(values, weight, bias)  # type: ignore[no-untyped-call]
    return result


def exp(values: Float[torch.Tensor, "*s"]) -> Float[torch.Tensor, "*s"]:
    """Return e to the power of each value, without `torch.exp`, which uses MKL."""
    return torch.exp2(values * math.log2(math.e))


class _Affine(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(values, weight)
        return _product(values, weight).add_(bias)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,) = gradients
        values, weight = ctx.saved_tensors
        needs_values, needs_weight, needs_bias = ctx.needs_input_grad
        return (
            _product(gradient, weight.mT) if needs_values else None,
            _product(values.mT, gradient) if needs_weight else None,
            gradient.sum(-2, keepdim=True) if needs_bias else None,
        )


def _product(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    with np.errstate(all="ignore"):  # as in PyTorch: an overflow gives inf, which the training loop checks for
        return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))
