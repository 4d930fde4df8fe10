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
from typing import Any

import numpy as np
import torch
from jaxtyping import Float


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
    # NumPy's warnings are turned off. As in PyTorch, an overflow then gives inf without a warning, and the training
    # loop detects it.
    with np.errstate(all="ignore"):
        return torch.from_numpy(np.matmul(left.numpy(), right.numpy()))
