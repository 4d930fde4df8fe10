import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.learning.losses import squared_error
from pipeline.seeds import torch_generator_for


def batch(*names: str) -> torch.Tensor:
    return torch.randn(7, 3, generator=torch_generator_for(0, *names))


def test_the_loss_is_the_mean_of_squares_as_two_loops_find():
    answer, truth = batch("answer"), batch("truth")
    total = sum((float(answer[i, j]) - float(truth[i, j])) ** 2 for i in range(7) for j in range(3))
    # float32 sum of 21 terms
    assert math.isclose(float(squared_error(answer, truth)), total / 21, rel_tol=1e-5)


def test_unknown_targets_neither_count_nor_pull():
    answer = batch("answer").requires_grad_()
    truth = batch("truth")
    truth[:, 2] = math.nan
    loss = squared_error(answer, truth)
    loss.backward()
    # 14 of 21 terms are left; float32 rounding
    assert math.isclose(loss.item(), float(((answer.detach()[:, :2] - truth[:, :2]) ** 2).mean()), rel_tol=1e-5)
    assert torch.isfinite(answer.grad).all()
    assert (answer.grad[:, 2] == 0).all()


@given(st.floats(-100, 100))
def test_a_shift_of_both_changes_nothing(shift):
    answer, truth = batch("answer"), batch("truth")
    # float32 numbers up to 100 carry about 1e-5 of absolute rounding
    assert math.isclose(
        float(squared_error(answer + shift, truth + shift)), float(squared_error(answer, truth)), rel_tol=1e-3
    )
