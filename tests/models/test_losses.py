"""Tests of the loss functions: the squared error and the triplet loss.

The triplet loss is positive if the anchor (a) is nearer to the negative (n) than to the positive (p).
"""

import math

import numpy as np
import pytest
import torch

from reskin.models.losses import squared_error, triplet_loss
from reskin.seeds import rng_for

M, B, D = 3, 7, 40
SUM_RTOL = 1e-5  # Relative tolerance: rounding of sums of up to 280 terms in single precision.


def predictions(*names: str | int) -> torch.Tensor:
    return torch.from_numpy(rng_for(0, *names).normal(size=(M, B, 3)).astype(np.float32))


def features(name: str, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(rng_for(seed, "features", name).normal(size=(M, B, D)).astype(np.float32))


def random_triplet(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return features("anchor", seed), features("positive", seed), features("negative", seed)


def looped_triplet(anchor: torch.Tensor, positive: torch.Tensor, negative: torch.Tensor) -> list[float]:
    """Return the reference, max(0, |a - p|^2 - |a - n|^2), in double precision by three nested loops."""
    losses = []
    for member_i in range(len(anchor)):
        total = 0.0
        for row_i in range(len(anchor[member_i])):
            nearer = farther = 0.0
            for k in range(len(anchor[member_i][row_i])):
                a, p, n = (float(one[member_i, row_i, k]) for one in (anchor, positive, negative))
                nearer += (a - p) ** 2
                farther += (a - n) ** 2
            total += max(0.0, nearer - farther)
        losses.append(total / len(anchor[member_i]))
    return losses


def test_squared_error_equals_nested_loops():
    predicted, truth = predictions("answer"), predictions("truth")
    for i in range(M):
        total = sum((float(predicted[i, j, k]) - float(truth[i, j, k])) ** 2 for j in range(B) for k in range(3))
        assert math.isclose(float(squared_error(predicted, truth)[i]), total / (3 * B), rel_tol=SUM_RTOL)


def test_unknown_targets_are_ignored():
    predicted, truth = predictions("answer").requires_grad_(), predictions("truth")
    truth[1, :, 2] = math.nan
    truth[2, :4] = math.nan
    loss = squared_error(predicted, truth)
    loss.sum().backward()
    for i in range(M):
        known = [(j, k) for j in range(B) for k in range(3) if not math.isnan(truth[i, j, k])]
        total = sum((float(predicted[i, j, k].detach()) - float(truth[i, j, k])) ** 2 for j, k in known)
        assert math.isclose(loss[i].item(), total / len(known), rel_tol=SUM_RTOL)
    unknown = torch.isnan(truth)
    assert (predicted.grad[unknown] == 0).all()
    assert (predicted.grad[~unknown] != 0).all()
    assert torch.isfinite(predicted.grad).all()


@pytest.mark.parametrize("seed", range(5))
def test_triplet_loss_equals_nested_loops(seed):
    anchor, positive, negative = random_triplet(seed)
    assert any(0 < one for one in looped_triplet(anchor, positive, negative))
    np.testing.assert_allclose(
        triplet_loss(anchor, positive, negative), looped_triplet(anchor, positive, negative), rtol=SUM_RTOL
    )


def test_gradient_of_a_triplet_with_a_nearer_negative_equals_the_closed_form():
    # The loss is |a - p|^2 - |a - n|^2 = 2^2 - 1^2. Its derivatives are d/dp = -2 (a - p), d/dn = 2 (a - n) and d/da =
    # 2 (a - p) - 2 (a - n).
    a, p, n = (torch.tensor([[[x]]], requires_grad=True) for x in (0.0, 2.0, 1.0))
    loss = triplet_loss(a, p, n)
    loss.sum().backward()
    assert [float(one) for one in (loss.detach(), a.grad, p.grad, n.grad)] == [3.0, -2.0, 4.0, -2.0]


def test_networks_of_a_stack_have_separate_losses():
    anchor, positive, negative = random_triplet()
    before = triplet_loss(anchor, positive, negative)
    positive[1] += 10
    after = triplet_loss(anchor, positive, negative)
    assert (after == before).tolist() == [True, False, True]
