"""AdamW under a one-cycle rate, as torch.optim has them, bit for bit. In: weights with gradients. Out: weights moved.

torch.optim imports torch's compiler at its first optimizer: two seconds of every process that trains, for a kernel that
is one call. Refuses to know losses, batches and networks.
"""

import math
from collections.abc import Iterable

import torch

# Defaults of torch.optim.lr_scheduler.OneCycleLR: the rate rises to its peak, then falls to nearly nothing; the first
# momentum falls meanwhile, then rises.
RISING = 0.3  # of all steps
FIRST_RATE, LAST_RATE = 1 / 25, 1e-4  # of the peak; of the first
MOMENTUM_MAX, MOMENTUM_MIN = 0.95, 0.85
BETA2, EPS = 0.999, 1e-8  # defaults of torch.optim.AdamW


def one_cycle(step_i: int, steps_n: int, rate_max: float) -> tuple[float, float]:
    """Give rate and first momentum of a step: two half cosines.

    >>> [round(one_cycle(i, 10, 25.0)[0], 4) for i in (0, 2, 9)]
    [1.0, 25.0, 0.0001]
    """
    steps_n = max(steps_n, 2)
    peak_i = RISING * steps_n - 1
    first = rate_max * FIRST_RATE
    if step_i <= peak_i:
        part = step_i / peak_i
        return _cosine(first, rate_max, part), _cosine(MOMENTUM_MAX, MOMENTUM_MIN, part)
    part = (step_i - peak_i) / (steps_n - 1 - peak_i)
    return _cosine(rate_max, first * LAST_RATE, part), _cosine(MOMENTUM_MIN, MOMENTUM_MAX, part)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2.0 * (math.cos(math.pi * part) + 1)


class AdamW:
    """Remembers the moments of each weight's gradient."""

    def __init__(self, weights: Iterable[torch.Tensor], weight_decay: float) -> None:
        self.weights, self.weight_decay = list(weights), weight_decay
        self.first, self.second = ([torch.zeros_like(weight) for weight in self.weights] for _ in range(2))
        self.steps_n = [torch.zeros((), device=weight.device) for weight in self.weights]

    @torch.no_grad()
    def step(self, rate: float, momentum: float) -> None:
        """Move all weights by their gradients; torch raises if one has none."""
        gradients = [weight.grad for weight in self.weights if weight.grad is not None]
        torch._foreach_add_(self.steps_n, 1)
        torch._fused_adamw_(
            self.weights, gradients, self.first, self.second, [], self.steps_n, amsgrad=False, lr=rate,
            beta1=momentum, beta2=BETA2, weight_decay=self.weight_decay, eps=EPS, maximize=False,
        )  # fmt: skip
