import subprocess
import sys

import pytest
import torch

from reskin.models.optimiser import AdamW, one_cycle


def weights() -> list[torch.Tensor]:
    torch_rng = torch.Generator().manual_seed(1)
    shapes = [(3, 4, 5), (3, 1, 5)]
    return [torch.randn(shape, generator=torch_rng).requires_grad_() for shape in shapes]


@pytest.mark.parametrize("steps_n", [1, 2, 3, 10, 150])
@pytest.mark.parametrize("weight_decay", [0.0, 0.1])
@pytest.mark.parametrize("warm_up", [0.15, 0.3])
def test_optimiser_steps_equal_those_of_pytorch_bit_for_bit(steps_n, weight_decay, warm_up):
    ours, theirs = weights(), weights()
    optimizer = torch.optim.AdamW(theirs, 1.2e-2, weight_decay=weight_decay, fused=True)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1.2e-2, total_steps=max(steps_n, 2), pct_start=warm_up)
    adam = AdamW(ours, weight_decay)
    for step_i in range(steps_n):
        for net in (ours, theirs):
            for values in net:
                values.grad = torch.sin(7 * values.detach()) * 10.0 ** (-step_i % 5)
        adam.step(*one_cycle(step_i, steps_n, 1.2e-2, warm_up))
        optimizer.step()
        rate.step()
        for one, other in zip(ours, theirs, strict=True):
            assert torch.equal(one, other)


NETWORK_OF_THE_PAPER = """
from reskin.models.job import LossWeights
from reskin.models.train import train
from tests.models.example_jobs import recipe, some_job

train([some_job(0)], "paper", recipe(steps_n=2), LossWeights(0.0), "cpu")
"""


def test_training_does_not_import_the_compiler_of_pytorch():
    """This project compiles no network, and importing PyTorch's compiler would cost two seconds in each process."""
    ask = "print('torch._dynamo' in sys.modules)"
    code = "\n".join(["import sys", NETWORK_OF_THE_PAPER, ask])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]
