"""The optimiser of all networks: AdamW with a one-cycle schedule of the learning rate and the momentum."""

import math
from collections.abc import Iterable

import torch
from torch.optim.adamw import adamw

# The following values are the defaults of torch.optim.lr_scheduler.OneCycleLR and torch.optim.AdamW.
WARM_UP = 0.3  # fraction of the steps in which the learning rate rises
FIRST_RATE, LAST_RATE = 1 / 25, 1e-4  # first rate, relative to the peak rate; last rate, relative to the first rate
MOMENTUM_MAX, MOMENTUM_MIN = 0.95, 0.85
BETA2, EPS = 0.999, 1e-8


def one_cycle(step_i: int, steps_n: int, rate_max: float, warm_up: float = WARM_UP) -> tuple[float, float]:
    """Return the learning rate and the momentum of a step in a one-cycle schedule of `steps_n` steps.

    The learning rate first rises to `rate_max`, during the fraction `warm_up` of the steps, and then falls to nearly
    zero, both along half a period of a cosine. The momentum, which is AdamW's parameter beta1, falls while the rate
    rises, and rises while the rate falls.

    >>> [round(one_cycle(i, 10, 25.0)[0], 4) for i in (0, 2, 9)]
    [1.0, 25.0, 0.0001]
    """
    steps_n = max(steps_n, 2)
    peak_i = warm_up * steps_n - 1
    first = rate_max * FIRST_RATE
    if step_i <= peak_i:
        part = step_i / peak_i
        return _cosine(first, rate_max, part), _cosine(MOMENTUM_MAX, MOMENTUM_MIN, part)
    part = (step_i - peak_i) / (steps_n - 1 - peak_i)
    return _cosine(rate_max, first * LAST_RATE, part), _cosine(MOMENTUM_MIN, MOMENTUM_MAX, part)


def _cosine(start: float, end: float, part: float) -> float:
    return end + (start - end) / 2.0 * (math.cos(math.pi * part) + 1)


class AdamW:
    """PyTorch's optimiser AdamW (fused version). The learning rate and the momentum are arguments of each step.

    This class calls the function `torch.optim.adamw.adamw` instead of using the class `torch.optim.AdamW`. The first
    use of that class in a process would import PyTorch's compiler, which takes a second of CPU time. The results are
    bit-identical to the results of `torch.optim.AdamW`.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], weight_decay: float) -> None:
        self.parameters, self.weight_decay = list(parameters), weight_decay
        self.mean = [torch.zeros_like(parameter) for parameter in self.parameters]
        self.mean_square = [torch.zeros_like(parameter) for parameter in self.parameters]
        self.steps_n = [torch.zeros((), device=parameter.device) for parameter in self.parameters]

    @torch.no_grad()
    def step(self, rate: float, momentum: float) -> None:
        """Update the parameters, using their gradients. torch raises an error if a parameter has no gradient."""
        gradients = [parameter.grad for parameter in self.parameters if parameter.grad is not None]
        adamw(
            self.parameters, gradients, self.mean, self.mean_square, [], self.steps_n, fused=True, amsgrad=False,
            lr=rate, beta1=momentum, beta2=BETA2, weight_decay=self.weight_decay, eps=EPS, maximize=False,
        )  # fmt: skip
