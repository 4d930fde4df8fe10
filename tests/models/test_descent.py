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
