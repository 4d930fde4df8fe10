"""The losses of the paper, for a stack of networks. In: answers and truths, or features. Out: one number a network.

Both are means over the batch. Knows no optimiser, and not how triplets are drawn.
"""

import torch
from jaxtyping import Float


def squared_error(
    answer: Float[torch.Tensor, "m b t"], truth: Float[torch.Tensor, "m b t"]
) -> Float[torch.Tensor, " m"]:
    """Mean of squared errors over all known targets of a batch; an unknown target (NaN) pulls nowhere."""
    known = ~torch.isnan(truth)
    # Filled before it is squared: NaN times zero is NaN, in the gradient too.
    difference = torch.where(known, answer - truth, 0.0)
    return (difference**2).sum((1, 2)) / known.sum((1, 2))


def triplet(
    anchor: Float[torch.Tensor, "m b d"], positive: Float[torch.Tensor, "m b d"], negative: Float[torch.Tensor, "m b d"]
) -> Float[torch.Tensor, " m"]:
    """Batch mean of max(0, |a - p|^2 - |a - n|^2), squared distances of features without a margin (section 5).

    Squares, not roots: the gradient of identical points is 0 and finite.
    """
    nearer = ((anchor - positive) ** 2).sum(-1)
    farther = ((anchor - negative) ** 2).sum(-1)
    return torch.relu(nearer - farther).mean(-1)
